"""The services of a compose file that run fieldtwin, with variables replaced by their defaults."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from fieldtwin.gateway.core.files.yaml_file import Key, YamlFile
from fieldtwin.twin.site.data_files import data_root

IMAGE_DATA = "/opt/fieldtwin/share"
"""The folder of the shipped profiles and recordings in the image (Dockerfile)."""
_VARIABLE = re.compile(r"\$\{\w+:?-([^{}]*)\}")
_IMAGE = re.compile(r"(?:.*/)?fieldtwin(?:[:@].*)?")


@dataclass(frozen=True)
class WrongWord:
    """A wrong word of a command line: its index and the error."""

    index: int
    message: str
    expected: str = ""
    hint: str = ""


@dataclass(frozen=True)
class Service:
    """A service that runs fieldtwin. `words` are its command line; `folders` maps mounted folders to folders of this computer."""

    name: str
    words: list[str]
    environment: dict[str, str]
    ports: dict[int, str]
    health: list[str]
    folders: dict[str, Path] = field(default_factory=dict)
    one_word: bool = False

    @property
    def at(self) -> tuple[Key, ...]:
        return ("services", self.name)

    def word(self, index: int) -> tuple[Key, ...]:
        """Return the position of a word of the command in the file. A command written as one text has one position for all
        words.
        """
        return (*self.at, "command") if self.one_word else (*self.at, "command", index)

    def option(self, name: str) -> tuple[int, str] | None:
        """Return the index and the value of the last `--name=VALUE` or `--name VALUE`, or None."""
        return next(reversed(list(self.options(name))), None)

    def options(self, name: str) -> Iterator[tuple[int, str]]:
        """Yield index and value of each `--name=VALUE` and `--name VALUE`."""
        for index, word in enumerate(self.words):
            if word.startswith(f"--{name}="):
                yield index, word.partition("=")[2]
            elif word == f"--{name}" and index + 1 < len(self.words):
                yield index + 1, self.words[index + 1]

    def local(self, inside: str) -> Path | None:
        """Return the path on this computer of the path `inside` the container; None if it is not below a mounted folder."""
        for folder, outside in sorted(self.folders.items(), key=lambda item: -len(item[0])):
            if PurePosixPath(inside).is_relative_to(folder):
                return outside / PurePosixPath(inside).relative_to(folder)
        return None


def is_compose(data: Mapping[str, Any]) -> bool:
    """Return whether a YAML file is a compose file with a service that runs fieldtwin."""
    return isinstance(data.get("services"), dict) and "fieldtwin" in str(data)


def services_of(file: YamlFile) -> Iterator[Service]:
    """Yield the services that run fieldtwin: by their image, by the program, or by their variables."""
    services = file.data.get("services")
    for name, form in services.items() if isinstance(services, dict) else ():
        if isinstance(form, dict) and (service := _service(str(name), form, Path(file.path).parent)):
            yield service


def resolved(text: object) -> str:
    """Return a text with each `${NAME:-default}` replaced by its default. `$$` is a dollar sign."""
    return _VARIABLE.sub(r"\1", str(text)).replace("$$", "$")


def _service(name: str, form: Mapping[str, Any], folder: Path) -> Service | None:
    command = form.get("command") or []
    entrypoint = form.get("entrypoint") or []
    words = [resolved(word) for word in (shlex.split(command) if isinstance(command, str) else command)]
    program = (shlex.split(entrypoint) if isinstance(entrypoint, str) else list(map(str, entrypoint)))[:1]
    if not words or (program and Path(program[0]).name != "fieldtwin"):
        return None
    if not program and not _IMAGE.fullmatch(resolved(form.get("image", ""))):
        return None
    health = form.get("healthcheck")
    test = health.get("test", []) if isinstance(health, dict) else []
    return Service(
        name,
        words,
        _environment(form.get("environment")),
        _ports(form.get("ports")),
        [resolved(word) for word in (test if isinstance(test, list) else shlex.split(str(test)))],
        {IMAGE_DATA: data_root(), **_folders(form.get("volumes"), folder)},
        isinstance(command, str),
    )


def _environment(form: object) -> dict[str, str]:
    if isinstance(form, dict):
        return {str(key): resolved(value) for key, value in form.items()}
    pairs = (str(line).partition("=") for line in form) if isinstance(form, list) else ()
    return {key: resolved(value) for key, _, value in pairs}


def _folders(form: object, base: Path) -> dict[str, Path]:
    found = {}
    for volume in form if isinstance(form, list) else ():
        if isinstance(volume, dict):
            source, target = resolved(volume.get("source", "")), resolved(volume.get("target", ""))
        else:
            source, target = (*resolved(volume).split(":"), "", "")[:2]
        if source.startswith((".", "/")) and target.startswith("/"):
            found[target.rstrip("/") or "/"] = base / source
    return found


def _ports(form: object) -> dict[int, str]:
    """Return the published ports: by port in the container, the text of the entry. Ranges of ports are left out."""
    found = {}
    for entry in form if isinstance(form, list) else ():
        text = str(entry.get("target", "")) if isinstance(entry, dict) else resolved(entry)
        inside = text.rpartition(":")[2].partition("/")[0]
        if inside.isdecimal():
            found[int(inside)] = text
    return found
