"""The project folder of an agent: which files it may read, and where it may create one."""

from __future__ import annotations

import os
from pathlib import Path

from fieldtwin.gateway.core.errors import FileInvalid, NotAllowed, UsageError, os_reason
from fieldtwin.scenarios.language.file_name import SUFFIX
from fieldtwin.scenarios.language.new_file import create_scenario_file
from fieldtwin.twin.site.data_files import data_root, search_path

MOST_FILES = 1_000
"""Largest number of files in a listing."""
MOST_FILE_BYTES = 4 << 20
KINDS = {
    "scenario": (SUFFIX,),
    "prototype": (".prototype.yaml",),
    "system or profile": (".yaml", ".yml"),
    "program": (".st",),
    "recording or trace": (".jsonl",),
    "report": (".html", ".xml"),
    "document": (".md", ".txt", ".csv", ".json", ".eds", ".dcf", ".log"),
}
"""Kinds of files by the ends of their names; the first kind that fits counts. Other files are neither listed nor read, for
example tokens and keys."""


def kind_of(path: Path) -> str:
    """Return the kind of a file, "" for one that agents may not read."""
    return next((kind for kind, ends in KINDS.items() if path.name.endswith(ends)), "")


class Project:
    """The folder that was given at the start. All paths of an agent are relative to it and stay below it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()
        if not self.folder.is_dir():
            raise UsageError("the project is not a folder", got=str(folder))

    def inside(self, text: str) -> Path:
        """Return the absolute path of a file of the project, which need not exist.

        Raises `NotAllowed` for a path that leaves the folder, also by a link, and for hidden files.
        """
        try:
            path = (self.folder / text).resolve()
        except (OSError, ValueError, RuntimeError) as e:
            raise UsageError("not a path", got=repr(text[:80])) from e
        if not path.is_relative_to(self.folder):
            raise NotAllowed("the path is outside of the project", expected=f"below {self.folder}", got=repr(text[:80]))
        if any(part.startswith(".") for part in path.relative_to(self.folder).parts):
            raise NotAllowed("hidden files are not read", got=repr(text[:80]))
        return path

    def name_of(self, path: Path) -> str:
        """Return the name of a file as agents use it."""
        return str(path.relative_to(self.folder)) if path.is_relative_to(self.folder) else str(path)

    def files(self) -> tuple[list[dict[str, str]], bool]:
        """Return path and kind of each readable file, and whether the listing is complete."""
        found: list[dict[str, str]] = []
        for folder, folders, names in os.walk(self.folder):
            folders[:] = sorted(name for name in folders if not name.startswith((".", "__")))
            for name in sorted(names):
                if name.startswith(".") or not (kind := kind_of(Path(name))):
                    continue
                if len(found) == MOST_FILES:
                    return found, False
                found.append({"path": self.name_of(Path(folder) / name), "kind": kind})
        return found, True

    def read(self, text: str) -> str:
        """Return the content of a text file of the project."""
        path = self.inside(text)
        if not kind_of(path):
            known = ", ".join(end for ends in KINDS.values() for end in ends)
            raise NotAllowed("files of this kind are not read", expected=known, got=repr(path.name[:80]))
        return read_text(path)

    def system(self, text: str) -> str:
        """Return what the loader takes for a system: the path of a file in the project, or the name of a shipped system."""
        path = self.inside(text)
        if path.is_file():
            return str(path)
        if text.removesuffix(".yaml") in shipped_systems():
            return text
        raise UsageError(
            f"no system {text[:80]!r}", expected="a system file of the project, or " + ", ".join(shipped_systems())
        )

    def save_scenario(self, text: str, content: str) -> Path:
        """Write a new scenario file. Raises `UsageError` for an existing file or a different kind of file."""
        path = self.inside(text if text.endswith(SUFFIX) else text + SUFFIX)
        create_scenario_file(path, content, self.name_of(path))
        return path


def shipped_systems() -> list[str]:
    """Return the names of the systems that are shipped with fieldtwin and have a prototype."""
    suffix = ".prototype.yaml"
    folders = [place / "systems" for place in search_path() if place.is_relative_to(data_root())]
    return sorted({path.name.removesuffix(suffix) for folder in folders for path in folder.glob(f"*{suffix}")})


def read_text(path: Path) -> str:
    """Return a text file of at most `MOST_FILE_BYTES` bytes. Raises `FileInvalid`."""
    try:
        with path.open("rb") as file:
            content = file.read(MOST_FILE_BYTES + 1)
        text = content.decode("utf-8")
    except OSError as e:
        raise FileInvalid(f"cannot read the file: {os_reason(e)}", path=str(path)) from e
    except UnicodeDecodeError as e:
        raise FileInvalid("the file is not UTF-8 text", path=str(path)) from e
    if len(content) > MOST_FILE_BYTES:
        raise FileInvalid("the file is too long", path=str(path), expected=f"at most {MOST_FILE_BYTES} bytes")
    return text
