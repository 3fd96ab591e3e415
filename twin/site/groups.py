"""The registration point for kinds of files that describe several systems which run together.

Each kind has a separate folder, which no other module imports. This module finds the kind of a file and imports the kind's
module only then, because that module needs the emulators, which a plant does not have.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.input_file import read_input
from fieldtwin.twin.site.data_files import MAX_BYTES, find

GROUP_KINDS = {"network": "fieldtwin.acoustic.kind"}
"""The module of each kind, which implements `fieldtwin.run.virtual.group_kinds.GroupKind`.

A file of the kind has the kind's name as a key at its top level."""


def kind_of(data: Mapping[str, Any]) -> str:
    """Return the kind of a file's data; empty if no registered kind fits, as for a system file."""
    return next((kind for kind in GROUP_KINDS if kind in data and "system" not in data), "")


def group_file(name: str, profiles: Iterable[Path] = ()) -> tuple[str, Path] | None:
    """Return kind and path of the file that `name` refers to if it describes several systems.

    Return None for any other file, and if the file does not exist.
    """
    try:
        path = find("systems", name, extra=profiles)
    except UsageError:
        return None
    if path.suffix not in (".yaml", ".yml"):
        return None
    try:
        lines = read_input(path, MAX_BYTES).decode("utf-8").splitlines()
    except (OSError, UnicodeDecodeError, FileInvalid):
        return None
    kind = next((kind for kind in GROUP_KINDS if any(line.startswith(f"{kind}:") for line in lines)), "")
    return (kind, path) if kind else None


def group_module(kind: str) -> ModuleType:
    """Import the module of a registered kind. `fieldtwin.run.virtual.group_kinds.kind_named` returns it with its type."""
    return import_module(GROUP_KINDS[kind])
