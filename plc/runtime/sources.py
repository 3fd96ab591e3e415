"""The files of a PLC's programs, and which of them changed since the PLC read them.

Structured Text is read again at each change and each restart that a user requests; a Python module only when the process
starts. The modules that were imported from the folder of a program's file, or from a folder in it, count as files of the
program. This module does not interpret programs.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from sysconfig import get_paths

from fieldtwin.plc.binding import BoundProgram


@dataclass(frozen=True, slots=True)
class ProgramSource:
    """A source file of a program, as the PLC read it. `digest`: SHA-256 in hex, empty if it cannot be read."""

    program: str
    path: str
    digest: str
    compiled: bool
    """Whether it is Structured Text, which can be read again while the PLC runs."""

    def holds(self, content: bytes) -> bool:
        """Return whether `content` is the content of the file that the PLC read."""
        return sha256(content).hexdigest() == self.digest


def sources(
    programs: Sequence[BoundProgram], before: Sequence[ProgramSource] = (), *, modules: bool = True
) -> list[ProgramSource]:
    """Return the files of `programs`, which were just created, and of the `modules` in their folders.

    `before`: the sources of the programs that they replace.
    """
    imported = {source.path: source.digest for source in before if not source.compiled}
    found = []
    for bound in programs:
        made = type(bound.program)
        found += [ProgramSource(bound.name, file, digest_of(file), True) for file in made.source_files]
        if made.source_files:
            continue
        path = getattr(sys.modules.get(made.__module__), "__file__", None) or ""
        found.append(ProgramSource(bound.name, path, imported.get(path) or digest_of(path), False))
        if modules and path:
            found += [ProgramSource(bound.name, p, imported.get(p) or digest_of(p), False) for p in _beside(path)]
    return found


def _beside(path: str) -> list[str]:
    """Return the files of the imported modules in the folder of the module `path` or below it, without those of libraries."""
    folder = _folder(os.path.dirname(path))
    libraries = tuple(library for p in {*get_paths().values()} if not folder.startswith(library := _folder(p)))
    files: dict[str, set[str]] = {}
    for module in list(sys.modules.values()):
        if isinstance(file := getattr(module, "__file__", None), str) and file != path:
            files.setdefault(os.path.dirname(file), set()).add(file)
    near = (  # links are followed by folder, of which there are far fewer than files
        found
        for name, found in files.items()
        if (at := _folder(name)).startswith(folder) and not at.startswith(libraries)
    )
    return sorted(set().union(*near))


def _folder(path: str) -> str:
    """Return the folder `path` without links, with a separator at its end, so that it is a prefix of the paths below it."""
    return os.path.join(os.path.realpath(path), "")


def changed(known: Sequence[ProgramSource]) -> list[ProgramSource]:
    """Return the sources whose file has a different content now, or cannot be read any more."""
    return [source for source in known if source.digest and digest_of(source.path) != source.digest]


def digest_of(path: str) -> str:
    """Return the SHA-256 of a file in hex; empty if it cannot be read."""
    try:
        return sha256(Path(path).read_bytes()).hexdigest() if path else ""
    except OSError:
        return ""
