"""The drawings of a PLC's programs, and their present values, for displays.

A PLC makes drawings when it starts, because this takes several ms for each. Their values are read between two scans, those of one
drawing at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.plc.binding import BoundProgram

MAX_SVG_BYTES = 2 * 1024 * 1024
"""The largest size of all drawings of a PLC together. Further ones are left out, so that an answer fits in one line."""


def drawings_of_programs(programs: Sequence[BoundProgram]) -> dict[str, list[dict[str, Any]]]:
    """Return the drawings of each program by its name: each with its name, its SVG text, and its number for `present_values`."""
    left = MAX_SVG_BYTES
    found: dict[str, list[dict[str, Any]]] = {}
    for bound in programs:
        shown = []
        for number, (name, svg) in enumerate(bound.program.drawings()):
            left -= len(svg.encode())
            if left >= 0:
                shown.append({"number": number, "name": name, "svg": svg})
        if shown:
            found[bound.name] = shown
    return found


def present_values(programs: Sequence[BoundProgram], program: Any, number: Any) -> dict[str, Any]:
    """Return the present values of one drawing. Raises `UsageError` for an unknown one."""
    bound = next((one for one in programs if one.name == program), None)
    count = len(bound.program.drawings()) if bound is not None else 0
    if bound is None or type(number) is not int or not 0 <= number < count:
        raise UsageError(
            f"no drawing {number!r} of {program!r}", expected="a program and a number that `drawings` lists"
        )
    return bound.program.drawn(number)
