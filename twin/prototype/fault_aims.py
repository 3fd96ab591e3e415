"""Resolves a fault's aim in a system: names of buses, devices, registers and tags become units, addresses and objects.

This module performs no I/O, so that an invalid aim is found before a device runs. The physical twin does not use this module.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from fieldtwin.emulators.faults.effect import check_can_effect, check_wire_effect
from fieldtwin.emulators.faults.fault import Aim, InjectionPoint
from fieldtwin.emulators.faults.frames import framing_of
from fieldtwin.emulators.faults.schema import FUNCTIONS_OF, FaultSpec, addressed, counted
from fieldtwin.emulators.faults.values.value_ranges import check_fault
from fieldtwin.emulators.faults.wrong_aim import WrongAim
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.twin.site.system import System


@dataclass(frozen=True, slots=True)
class FaultTarget:
    """The target of a fault.

    Empty `units` means all units of the bus, `addresses` None all addresses, and empty `functions` all function codes.
    """

    bus: str
    units: tuple[int, ...]
    aim: Aim
    addresses: range | None = None
    functions: frozenset[int] = frozenset()
    counts: range | None = None


def target(system: System, spec: FaultSpec) -> FaultTarget:
    """Resolve the aim of `spec`.

    Raises `WrongAim` for a name that the system does not have, with the nearest one, and for a fault that does not
    apply to this kind of bus.
    """
    aim, kind = spec.aim, spec.kind.kind
    bus = _bus(system, spec)
    tag = None
    if aim.register_:
        if not aim.device:
            raise WrongAim("register", "a register needs a device", expected="device: NAME")
        tag = tag_of(system, aim.device, aim.register_, "register")
    if kind is InjectionPoint.VALUE and tag is not None and tag.is_text:
        raise WrongAim("register", f"{aim.device}.{tag.name} is not a number", expected="a tag that is one")
    if aim.device:
        check_fault(spec.make(), aim.register_, system.devices[aim.device].profile.tags.values(), aim.device)
    is_can = system.buses[bus].endpoint.is_can
    if kind is not InjectionPoint.VALUE and is_can != (kind is InjectionPoint.CAN):
        raise WrongAim("name", f"fault {spec.kind.name} is for {kind.value}", got=f"bus {bus!r}")
    if aim.device and aim.unit not in (None, system.devices[aim.device].address):
        address = str(system.devices[aim.device].address)
        raise WrongAim("unit", f"{aim.device} has a different address", expected=address, got=str(aim.unit))
    table = tag.registers.table if kind is InjectionPoint.BYTES and tag is not None else None
    check_wire_effect(spec, framing_of(system.buses[bus].endpoint), table)
    units = (aim.unit,) if aim.unit is not None else (system.devices[aim.device].address,) if aim.device else ()
    index = tag.object[0] if kind is InjectionPoint.CAN and tag is not None and tag.object is not None else None
    check_can_effect(spec, units[0] if units else None, index)
    if index is not None:
        return FaultTarget(bus, units, aim.model_copy(update={"index": index}))
    if kind is not InjectionPoint.BYTES:
        return FaultTarget(bus, units, aim)
    if tag is not None:
        at = tag.registers
        return FaultTarget(bus, units, aim, range(at.address, at.end), FUNCTIONS_OF[at.table], counted(aim.registers))
    addresses, functions = (None, frozenset[int]()) if aim.address is None else addressed(aim.address)
    return FaultTarget(bus, units, aim, addresses, functions, counted(aim.registers))


def tag_of(system: System, device: str, tag: str, key: str = "") -> Tag:
    """Return a device's tag by its name. Raises `WrongAim`."""
    known("device", device, system.devices, "device")
    tags = system.devices[device].profile.tags
    known(f"tag of {device}", tag, tags, key)
    return tags[tag]


def known(what: str, name: str, names: Iterable[str], key: str = "") -> None:
    """Check that `name` is one of `names`. Raises `WrongAim` with the nearest name otherwise."""
    names = list(names)
    if name not in names:
        hint = did_you_mean(name, names)
        raise WrongAim(key, f"no {what} {name!r}", expected=", ".join(names), hint=hint)


def _bus(system: System, spec: FaultSpec) -> str:
    aim = spec.aim
    if aim.bus:
        known("bus", aim.bus, system.buses, "bus")
    if aim.device:
        known("device", aim.device, system.devices, "device")
        on = system.devices[aim.device].bus
        if aim.bus and aim.bus != on:
            raise WrongAim("bus", f"{aim.device} is on another bus", expected=on, got=aim.bus)
        return on
    if not aim.bus:
        raise WrongAim("name", f"fault {spec.kind.name} has no target", expected="device: NAME, or bus: NAME")
    return aim.bus
