"""The files that a PLC's programs come from, and which of them changed since the PLC read them.

Structured Text is read again at each restart of the programs, a module of Python only when the process begins. What a module
imports is not looked at. It must never know what a program does.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from fieldtwin.plc.binding import BoundProgram


@dataclass(frozen=True, slots=True)
class Source:
    """The file of one program as it was when the PLC read it. `digest`: SHA-256 in hex, empty where it cannot be read."""

    program: str
    path: str
    digest: str
    compiled: bool
    """Whether it is Structured Text, which a restart of the programs reads again."""

    def describe(self) -> dict[str, Any]:
        """JSON-able: the program, its file, and what takes over the file as it is now."""
        cure = "fieldtwin plc restart" if self.compiled else "stop the system and run it again"
        return {"program": self.program, "path": self.path, "cure": cure}


def sources(programs: Sequence[BoundProgram], before: Sequence[Source] = ()) -> list[Source]:
    """The files of `programs`, which were made just now. `before`: those of the programs that they replace."""
    imported = {source.path: source.digest for source in before if not source.compiled}
    found = []
    for bound in programs:
        made = type(bound.program)
        path = made.source_path or getattr(sys.modules.get(made.__module__), "__file__", None) or ""
        digest = imported.get(path) or _digest(path)
        found.append(Source(bound.name, path, digest, bool(made.source_path)))
    return found


def changed(known: Sequence[Source]) -> list[Source]:
    """Those whose file has another content now, or cannot be read any more."""
    return [source for source in known if source.digest and _digest(source.path) != source.digest]


def _digest(path: str) -> str:
    try:
        return sha256(Path(path).read_bytes()).hexdigest() if path else ""
    except OSError:
        return ""
