"""The names that a system gives to expressions, and the system's invariants, which use them."""

from __future__ import annotations

from fieldtwin.gateway.core.conditions.expression import Words
from fieldtwin.gateway.core.files.error_collector import ErrorCollector, collecting
from fieldtwin.gateway.runtime.alarms.alarm_list import ALARM
from fieldtwin.gateway.runtime.alarms.state_machine import ALARM_STATES
from fieldtwin.scenarios.language.invariants import Invariants, load_invariants
from fieldtwin.twin.plant.names import incomplete_in, names_in
from fieldtwin.twin.prototype.group import SystemGroup
from fieldtwin.twin.site.schema import NONE_STATED
from fieldtwin.twin.site.system import System


def names_of(
    system: System, group: SystemGroup | None = None, errors: ErrorCollector | None = None
) -> dict[str, Words]:
    """Return the names that expressions may contain: DEVICE.TAG, PROGRAM.VARIABLE and alarm.NAME, in a group with the name of
    their system before them. By name: the texts that it can equal, as `names_in` returns them.

    Raises `FileInvalid` for a program that cannot be created or bound; with `errors`, such errors are added to it.
    """
    from fieldtwin.twin.plant.physical import bound_programs

    if group is not None:
        of_all = [(m.name, names_of(m.system)) for m in group.members.values()]
        return {f"{member}.{name}": words for member, names in of_all for name, words in names.items()}
    with collecting(errors) as collector:
        names = names_in(system, bound_programs(system, collector))
    return names | {f"{ALARM}.{alarm}": ALARM_STATES for alarm in system.alarms}


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
    """Return the devices, buses and programs of the system file that were not resolved because of errors."""
    from fieldtwin.twin.plant.physical import bound_programs

    return incomplete_in(system, bound_programs(system, ErrorCollector()))
