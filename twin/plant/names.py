"""The names that conditions of a system may contain: tags of devices and variables of programs."""

from __future__ import annotations

from collections.abc import Iterable

from fieldtwin.gateway.core.conditions.expression import Words
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
