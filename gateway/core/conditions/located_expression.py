"""Reads an expression of a file. Each error has its exact place in the file, and each unknown name is an error."""

from __future__ import annotations

from collections.abc import Collection, Container, Mapping
from pathlib import Path

from fieldtwin.gateway.core.conditions.expression import Expression, UnknownName, Words
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.expressions import NotUnderstood
from fieldtwin.gateway.core.files.error_collector import ErrorCollector, FollowingError
from fieldtwin.gateway.core.files.yaml_file import Key, YamlFile


def read_expression(
    file: YamlFile,
    loc: tuple[Key, ...],
    text: str,
    known: Collection[str],
    words: Mapping[str, Words],
    *,
    prefix: str = "",
    incomplete: Container[str] = frozenset(),
    near: Collection[str] = (),
) -> Expression:
    """Return `text`, which is at `loc` in `file`, as an expression. `known`, `words`, `prefix` and `near` are those of
    `Expression`.

    `incomplete` are devices and programs that have errors, so that names in them cannot be checked. Raises `FileInvalid`.
    """
    try:
        return Expression(text, known, words, prefix, near)
    except UnknownName as e:
        errors = ErrorCollector()
        for one in (e, *e.others):
            if one.name.partition(".")[0] not in incomplete:
                errors.add(_located(file, loc, text, one))
        errors.raise_all()
        raise FollowingError("a part of the system has an error", path=file.path) from e
    except UsageError as e:
        raise _located(file, loc, text, e) from e


def _located(file: YamlFile, loc: tuple[Key, ...], text: str, e: UsageError) -> FileInvalid:
    """Return the error with its exact place inside the expression, if the file has the expression unchanged in one line."""
    error = file.error(loc, e.message, expected=e.expected, got=e.got, hint=e.hint)
    try:
        line = Path(file.path).read_text(encoding="utf-8").splitlines()[(error.line or 1) - 1]
    except (OSError, IndexError):
        return error
    begins = line.find(text, (error.column or 1) - 1)
    if begins < 0:
        return error
    column = begins + 1 + (e.at_column if isinstance(e, NotUnderstood) else 0)
    return FileInvalid(
        e.message, path=error.path, line=error.line, column=column, expected=e.expected, got=e.got, hint=e.hint
    )
