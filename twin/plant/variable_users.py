"""Which parts of a system file use variables of its programs: alarms, invariants and servers with located variables.

An online change must not remove such a variable: an alarm whose condition has no value would not be raised any more. Bindings
of programs are not listed here, because the PLC knows them. This module reads no program.
"""

from __future__ import annotations

from fieldtwin.gateway.core.conditions.expression import names_in_text
from fieldtwin.twin.site.system import System


def variable_users(system: System) -> dict[str, list[str]]:
    """Return what uses each variable of a program, by its tag ``program.variable``: texts such as ``alarm high``."""
    found: dict[str, list[str]] = {}

    def note(user: str, *texts: str) -> None:
        for name in dict.fromkeys(name for text in texts for name in names_in_text(text)):
            if "." in name and name.partition(".")[0] in system.plc.programs:
                found.setdefault(name, []).append(user)

    for alarm, form in system.alarms.items():
        note(f"alarm {alarm}", form.condition)
    for word, texts in (("always", system.invariants.always), ("never", system.invariants.never)):
        for n, text in enumerate(texts):
            note(f"invariant {word} {n + 1}", text)
    for n, one in enumerate(system.invariants.within):
        note(f"invariant within {n + 1}", one.after, one.then)
    for server in system.serving.serve:
        for tag in server.tags:
            if tag.from_plc:
                found.setdefault(tag.tag, []).append(f"server {server.name}")
    return found
