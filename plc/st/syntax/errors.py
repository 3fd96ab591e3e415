"""Errors at a position of the source."""

from __future__ import annotations

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.syntax.tree import Pos


def invalid(pos: Pos, message: str, expected: str = "", got: str = "", hint: str = "") -> FileInvalid:
    """Return an error at a place of the source."""
    return FileInvalid(message, path=pos.path, line=pos.line, column=pos.column, expected=expected, got=got, hint=hint)
