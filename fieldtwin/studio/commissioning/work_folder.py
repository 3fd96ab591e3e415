"""The working folder of the commissioning guide: which files a page may name, list, download and write.

A page names a file by a plain name, never by a path. A link that leads out of the folder is refused. Only files that the steps
write or read are listed and can be downloaded, because the folder may also hold the user's tokens and keys.
"""

from __future__ import annotations

import hashlib
import os
import re
import tempfile
from dataclasses import dataclass
from pathlib import Path

from fieldtwin.gateway.core.errors import CheckFailed, FileInvalid, UsageError

MOST_FILES = 200
MOST_DRAFT_BYTES = 256 * 1024
_HEAD_BYTES = 4096
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,79}\Z")

DUMP, RECORDING, PROFILE, DATA_SHEET, CHECK, COMPARISON, REPORT, OTHER = (
    "dump",
    "recording",
    "profile",
    "data sheet",
    "check",
    "comparison",
    "report",
    "other",
)
_EDS_SECTION = re.compile(rb"^\[(FileInfo|DeviceInfo)\]", re.MULTILINE | re.IGNORECASE)
_SIGNS: tuple[tuple[str, str, re.Pattern[bytes]], ...] = (
    (".jsonl", DUMP, re.compile(rb'\A\{"fieldtwin_dump"')),
    (".jsonl", RECORDING, re.compile(rb'\A\{"fieldtwin_recording"')),
    (".log", RECORDING, re.compile(rb"\A\(\d+\.\d+\) \S+ [0-9A-Fa-f]+#")),
    (".eds", DATA_SHEET, _EDS_SECTION),
    (".dcf", DATA_SHEET, _EDS_SECTION),
    (".yaml", PROFILE, re.compile(rb"^device:", re.MULTILINE)),
    (".json", CHECK, re.compile(rb'"kind": ?"fieldtwin check"')),
    (".json", COMPARISON, re.compile(rb'"kind": ?"fieldtwin compare"')),
    (".html", REPORT, re.compile(rb"<title>Site acceptance")),
)
"""The suffix of a kind of file, and what its first bytes contain."""


@dataclass(frozen=True)
class KnownFile:
    """A file of the guide. `written`: a step that this server ran has written it."""

    name: str
    kind: str
    bytes: int
    modified_s: float
    written: bool


class WorkFolder:
    """The working folder, which is the one in which Studio was started, and its files."""

    def __init__(self, path: Path) -> None:
        self.path = path.resolve()
        self._written: set[str] = set()

    def checked(self, name: str, *suffixes: str) -> str:
        """Return `name` if it is a plain file name with one of the suffixes whose file is in the folder. Raises `UsageError`."""
        if not _NAME.match(name):
            raise UsageError(
                f"the file name {name[:80]!r}",
                expected="a plain name of letters, digits, '.', '-' and '_', without a folder",
            )
        if suffixes and not name.endswith(suffixes):
            raise UsageError(f"the file name {name!r}", expected=f"a name that ends with {' or '.join(suffixes)}")
        if (self.path / name).is_symlink():
            raise UsageError(f"{name} is a link, which the guide neither reads nor writes")
        return name

    def existing(self, name: str) -> Path:
        """Return the file of a checked name. Raises `UsageError` if the file is missing."""
        path = self.path / name
        if not path.is_file():
            raise UsageError(f"there is no file {name} in the working folder", hint="an earlier step writes it")
        return path

    def note_written(self, name: str) -> None:
        """Record that a step writes this file, so that `files` lists it."""
        self._written.add(name)

    def files(self) -> tuple[list[KnownFile], int]:
        """Return the files of the guide by name, at most `MOST_FILES`, and how many more there are."""
        found = []
        for entry in sorted(os.scandir(self.path), key=lambda e: e.name):
            if _NAME.match(entry.name) and entry.is_file(follow_symlinks=False):
                kind = self._kind(Path(entry.path))
                if kind:
                    info = entry.stat(follow_symlinks=False)
                    written = entry.name in self._written
                    found.append(KnownFile(entry.name, kind, info.st_size, info.st_mtime, written))
        return found[:MOST_FILES], max(0, len(found) - MOST_FILES)

    def _kind(self, path: Path) -> str:
        kinds = [(kind, sign) for suffix, kind, sign in _SIGNS if path.name.endswith(suffix)]
        if kinds:
            try:
                with path.open("rb") as file:
                    head = file.read(_HEAD_BYTES)
            except OSError:
                return ""
            for kind, sign in kinds:
                if sign.search(head):
                    return kind
        return OTHER if path.name in self._written else ""

    def listed(self, name: str) -> Path:
        """Return the path of a listed file, for a download. Raises `UsageError` for any other name."""
        self.checked(name)
        path = self.existing(name)
        if not self._kind(path):
            raise UsageError(f"{name} is not a file of the guide", expected="a file that a step writes or reads")
        return path

    def draft(self, name: str) -> tuple[str, str]:
        """Return the text of a profile, and its version. Raises `UsageError` or `FileInvalid`."""
        path = self.listed(self.checked(name, ".yaml"))
        if path.stat().st_size > MOST_DRAFT_BYTES:
            raise FileInvalid("the file is too long for the editor", path=name, expected=f"{MOST_DRAFT_BYTES} bytes")
        content = path.read_bytes()
        try:
            return content.decode(), _version(content)
        except UnicodeDecodeError as e:
            raise FileInvalid("the file is not UTF-8 text", path=name) from e

    def save_draft(self, name: str, text: str, version: str) -> str:
        """Write a profile and return its new version.

        `version` is the one that the editor began with, "" for a new file. Raises `CheckFailed` if the file has changed
        since then.
        """
        path = self.path / self.checked(name, ".yaml")
        content = text.encode()
        if len(content) > MOST_DRAFT_BYTES:
            raise UsageError("the profile is too long", expected=f"at most {MOST_DRAFT_BYTES} bytes")
        if path.exists():
            self.listed(name)  # a page must not replace a file that is not a profile
            if version != _version(path.read_bytes()):
                raise CheckFailed(
                    f"{name} has changed since the editor read it", hint="open it again, or save it under another name"
                )
        elif version:
            raise CheckFailed(f"{name} no longer exists", hint="save it under another name")
        try:
            with tempfile.NamedTemporaryFile(dir=self.path, prefix=".draft-", delete=False) as file:
                file.write(content)
            Path(file.name).chmod(0o644)
            os.replace(file.name, path)
        except OSError as e:
            raise FileInvalid(f"cannot write the file: {e.strerror or e}", path=name) from e
        self.note_written(name)
        return _version(content)


def _version(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]
