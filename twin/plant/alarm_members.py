"""The members of function blocks, and elements of arrays, that conditions of alarms name, such as ``control.motor.starts``.

Only tags are in the process image, from which the gateway takes the values of conditions. So a program gives each of these
members a tag, and a system whose alarms name none has none.
"""

from __future__ import annotations

from collections.abc import Iterator

from fieldtwin.gateway.core.conditions.expression import names_in_text
from fieldtwin.twin.site.system import System


def members_in_alarms(system: System) -> dict[str, tuple[str, ...]]:
    """Return the paths of the members in conditions of alarms, by program. It is not checked whether they exist."""
    found: dict[str, dict[str, None]] = {}
    for form in system.alarms.values():
        for program, path in members_in(system, form.condition):
            found.setdefault(program, {})[path] = None
    return {program: tuple(paths) for program, paths in found.items()}


def members_in(system: System, condition: str) -> Iterator[tuple[str, str]]:
    """Yield each member in a condition: its program, and its path there, such as ``motor.starts`` or ``levels[3]``."""
    for name in names_in_text(condition):
        program, _, path = name.partition(".")
        if program in system.plc.programs and program not in system.devices and ("." in path or "[" in path):
            yield program, path
