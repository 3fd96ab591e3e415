"""The error that stops a task because an operation of its program has no result."""

from __future__ import annotations

from fieldtwin.gateway.core.errors import Blame, FieldtwinError


class LogicError(FieldtwinError):
    """An operation of the program has no result."""

    exit_code = 1
    blame = Blame.FILE
