"""Merging the values that a variable has after two paths of a program."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import z3

from fieldtwin.plc.st.model_checking.execution.floats import is_float, merged_floats
from fieldtwin.plc.st.model_checking.execution.symbolic import (
    TEXT,
    Choice,
    Condition,
    Text,
    Undefined,
    both,
    either,
    is_condition,
    is_integer,
    merged_integers,
    negated,
)


def merged(condition: Condition, yes: Any, no: Any) -> Any:
    """Return `yes` if `condition` is true, else `no`."""
    if condition is True or yes is no:
        return yes
    if condition is False:
        return no
    if isinstance(yes, Undefined) or isinstance(no, Undefined):
        return no if isinstance(yes, Undefined) else yes
    if is_condition(yes) and is_condition(no):
        if isinstance(yes, bool) and isinstance(no, bool) and yes == no:
            return yes
        if isinstance(yes, bool):
            return either(condition, no) if yes else both(negated(condition), no)
        if isinstance(no, bool):
            return either(negated(condition), yes) if no else both(condition, yes)
        return z3.If(condition, yes, no)
    if is_integer(yes) and is_integer(no):
        return merged_integers(condition, yes, no)
    if is_float(yes) and is_float(no):
        return merged_floats(condition, yes, no)
    if isinstance(yes, str) and yes == no:
        return yes
    if _is_unknown_text(yes, no):
        return TEXT
    if isinstance(yes, tuple) and isinstance(no, tuple) and len(yes) == len(no):
        return tuple(merged(condition, a, b) for a, b in zip(yes, no, strict=True))
    return _choice([*_options(condition, yes), *_options(negated(condition), no)])


def options_of(value: Any) -> Iterator[tuple[Condition, Any]]:
    """Return each value that `value` may be, with its condition."""
    yield from _options(True, value)


def _options(condition: Condition, value: Any) -> Iterator[tuple[Condition, Any]]:
    if isinstance(value, Choice):
        for each, option in value.options:
            yield both(condition, each), option
    else:
        yield condition, value


def _choice(options: list[tuple[Condition, Any]]) -> Any:
    """Return the choice between `options`, of which those that can be merged are one."""
    found: list[tuple[Condition, Any]] = []
    for condition, value in options:
        for n, (other, known) in enumerate(found):
            if _alike(value, known):
                found[n] = (either(other, condition), merged(condition, value, known))
                break
        else:
            found.append((condition, value))
    return found[0][1] if len(found) == 1 else Choice(tuple(found))


def _is_unknown_text(a: Any, b: Any) -> bool:
    """Return whether one of two texts is not known."""
    return (isinstance(a, Text) and isinstance(b, Text | str)) or (isinstance(b, Text) and isinstance(a, str))


def _alike(a: Any, b: Any) -> bool:
    if a is b or (isinstance(a, str) and isinstance(b, str) and a == b) or _is_unknown_text(a, b):
        return True
    return any(is_kind(a) and is_kind(b) for is_kind in (is_condition, is_integer, is_float))
