"""The names that a system gives to expressions, and the system's invariants, which use them."""

from __future__ import annotations

from fieldtwin.gateway.core.files.error_collector import ErrorCollector, collecting
from fieldtwin.scenarios.language.expression import Words
from fieldtwin.scenarios.language.invariants import Invariants, load_invariants
from fieldtwin.twin.prototype.group import SystemGroup
from fieldtwin.twin.site.schema import NONE_STATED
from fieldtwin.twin.site.system import System


def names_of(
    system: System, group: SystemGroup | None = None, errors: ErrorCollector | None = None
) -> dict[str, Words]:
    """Return the names that expressions may contain: DEVICE.TAG and PROGRAM.VARIABLE, in a group with the
    name of their system before them. By name: the texts that a program's state can equal; for a number of a device, a mapping
    from the names in the tag's `values` to numbers; an empty tuple if any text is possible.

    Raises `FileInvalid` for a program that cannot be created or bound; with `errors`, such errors are added to it.
    """
    from fieldtwin.twin.plant.physical import bound_programs

    if group is not None:
        of_all = [(m.name, names_of(m.system)) for m in group.members.values()]
        return {f"{member}.{name}": words for member, names in of_all for name, words in names.items()}
    names: dict[str, Words] = {
        f"{d.name}.{t.name}": () if t.is_text else {name: number for number, name in t.values}
        for d in system.devices.values()
        for t in d.profile.tags.values()
    }
    with collecting(errors) as collector:
        for program in bound_programs(system, collector):
            inputs = [binding.tag for binding in program.inputs.values()]
            names = {tag: () for tag in inputs if tag.partition(".")[0] in system.devices} | names
            for variable, tag in program.published():
                if tag not in names and tag.partition(".")[0] in (program.name, *system.devices):
                    is_state = tag == f"{program.name}.state"
                    names[tag] = tuple(word for _, word in variable.words) if is_state else ()
    return names


def invariants_of(system: System, group: SystemGroup | None = None, errors: ErrorCollector | None = None) -> Invariants:
    """Return the invariants of a system, or of all systems of a group.

    Raises `FileInvalid`; with `errors`, the errors are added to it.
    """
    members = [("", system)] if group is None else [(m.prefix, m.system) for m in group.members.values()]
    every = Invariants()
    with collecting(errors) as collector:
        for prefix, one in members:
            if one.invariants != NONE_STATED:
                names = names_of(one, errors=collector)
                every += load_invariants(one, names, collector, incomplete_parts(one), prefix)
    return every


def incomplete_parts(system: System) -> frozenset[str]:
    """Return the devices, buses and programs of the system file that were not resolved because of errors.

    A program is also complete if all its variables are bound to tags, although it then publishes no name.
    """
    from fieldtwin.twin.plant.physical import bound_programs

    programs = [program.name for program in bound_programs(system, ErrorCollector())]
    known = {*system.devices, *system.buses, *programs}
    return frozenset({*system.file.data["devices"], *system.file.data["buses"], *system.plc.programs} - known)
