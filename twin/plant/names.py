"""The names in the conditions of a system: tags of devices, variables of programs, and members of these variables.

Only tags are in the process image, from which the gateway takes the values of conditions. So a program gives each member in the
condition of an alarm a tag, and a system whose alarms name none has none.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from fieldtwin.gateway.core.conditions.expression import Words, names_in_text
from fieldtwin.plc.binding import BoundProgram
from fieldtwin.twin.site.system import System


def names_in(system: System, programs: Iterable[BoundProgram]) -> dict[str, Words]:
    """Return the names of a system with these programs: DEVICE.TAG and PROGRAM.VARIABLE. By name: the texts that a program's
    state can equal; for a number of a device, a mapping from the names in the tag's `values` to numbers; an empty tuple if any
    text is possible.
    """
    names: dict[str, Words] = {
        f"{d.name}.{t.name}": () if t.is_text else {name: number for number, name in t.values}
        for d in system.devices.values()
        for t in d.profile.tags.values()
    }
    for program in programs:
        inputs = [binding.tag for binding in program.inputs.values()]
        names = {tag: () for tag in inputs if tag.partition(".")[0] in system.devices} | names
        for variable, tag in program.published():
            if tag not in names and tag.partition(".")[0] in (program.name, *system.devices):
                is_state = tag == f"{program.name}.state"
                names[tag] = tuple(word for _, word in variable.words) if is_state else ()
    return names


def incomplete_in(system: System, programs: Iterable[BoundProgram]) -> frozenset[str]:
    """Return the devices, buses and programs of the system file that were not resolved because of errors.

    A program is also complete if all its variables are bound to tags, although it then publishes no name.
    """
    known = {*system.devices, *system.buses, *(program.name for program in programs)}
    return frozenset({*system.file.section("devices"), *system.file.section("buses"), *system.plc.programs} - known)


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


def variable_users(system: System) -> dict[str, list[str]]:
    """Return what uses each variable of a program, by its tag ``program.variable``: texts such as ``alarm high``.

    An online change must not remove such a variable: an alarm whose condition has no value would not be raised any more. Bindings
    of programs are not included, because the PLC knows them.
    """
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
