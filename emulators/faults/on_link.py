"""Faults of a link between two third-party programs, of which only the framing is known."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from random import Random
from typing import Any

from fieldtwin.emulators.faults.can_fault import BusFault, only_sends
from fieldtwin.emulators.faults.effect import check_can_effect, check_wire_effect
from fieldtwin.emulators.faults.engine import WireFaults
from fieldtwin.emulators.faults.fault import Active, InjectionPoint
from fieldtwin.emulators.faults.frames import Framing
from fieldtwin.emulators.faults.schema import FaultSpec, addressed, counted, parse_fault
from fieldtwin.emulators.faults.wrong_aim import WrongAim
from fieldtwin.gateway.core.clock import NS_PER_S


def check_link(spec: FaultSpec, framing: Framing = Framing.RTU) -> None:
    """Raise `WrongAim` for a fault that needs a system file, devices, register names, values or a CAN bus, and for one that
    changes nothing in frames of `framing`.
    """
    _check_kind(spec, InjectionPoint.BYTES, "one of a line or socket")
    _check_names(spec, "unit, function, address")
    if spec.aim.address is not None:
        addressed(spec.aim.address)
    check_wire_effect(spec, framing)


def check_can_link(spec: FaultSpec) -> None:
    """Raise `WrongAim` for a fault that a link between two CAN buses cannot inject."""
    _check_kind(spec, InjectionPoint.CAN, "one of a CAN bus")
    _check_names(spec, "unit, cob_id, index")
    if issubclass(spec.kind, BusFault):
        raise WrongAim(
            "name", f"fault {spec.kind.name} needs a modelled bus, and a link has none",
            hint="`fieldtwin run` and `fieldtwin with` have one",
        )  # fmt: skip
    if only_sends(spec.kind) and spec.aim.unit is None:
        raise WrongAim("name", f"fault {spec.kind.name} is sent by a node", expected="unit: the node ID")
    check_can_effect(spec, spec.aim.unit)


def _check_kind(spec: FaultSpec, kind: InjectionPoint, expected: str) -> None:
    if spec.kind.kind is not kind:
        raise WrongAim("name", f"fault {spec.kind.name} is for {spec.kind.kind.value}", expected=expected)


def _check_names(spec: FaultSpec, expected: str) -> None:
    aim = spec.aim
    for key, name in (("device", aim.device), ("bus", aim.bus), ("register", aim.register_)):
        if name:
            raise WrongAim(key, f"fault {spec.id}: a link has no device or bus names", expected=expected)


def wire_faults(
    said: Iterable[Mapping[str, Any]],
    framing: Framing,
    seed: int,
    start_ns: int,
    check: Callable[[FaultSpec], None] | None = None,
) -> WireFaults:
    """Return the faults `said`, given as in a fault file, as injected faults of a link. Their times count from `start_ns`.

    Raises the errors of `check`, by default those of `check_link`.
    """
    check = check or partial(check_link, framing=framing)
    faults = WireFaults(framing)
    for number, one in enumerate(said, 1):
        spec = parse_fault(dict(one), number=number)
        check(spec)
        aim = spec.aim
        addresses, functions = (None, frozenset[int]()) if aim.address is None else addressed(aim.address)
        until_ns = None if spec.until_s is None else start_ns + round(spec.until_s * NS_PER_S)
        faults.put_in(
            Active(
                spec.id,
                spec.make(),
                aim,
                Random(f"{seed} {spec.id}"),
                start_ns + round(spec.from_s * NS_PER_S),
                until_ns,
                units=() if aim.unit is None else (aim.unit,),
                addresses=addresses,
                counts=counted(aim.registers),
                functions=functions,
            )
        )
    return faults
