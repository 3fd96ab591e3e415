"""Faults of a wire of which nobody knows more than its framing: a link between two strangers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from random import Random
from typing import Any

from emulators.faults.engine import WireFaults
from emulators.faults.fault import Active, Kind
from emulators.faults.frames import Framing
from emulators.faults.schema import FaultSpec, WrongAim, addressed, parse_fault
from gateway.core.clock import NS_PER_S


def check_link(spec: FaultSpec) -> None:
    """Raises `WrongAim` for what needs a system file: devices, registers by name, CAN, values."""
    aim = spec.aim
    if spec.kind.kind is not Kind.BYTES:
        raise WrongAim(
            "name", f"fault {spec.kind.name} is for {spec.kind.kind.value}", expected="one of a line or socket"
        )
    for key, name in (("device", aim.device), ("bus", aim.bus), ("register", aim.register_)):
        if name:
            raise WrongAim(key, f"fault {spec.id}: a link knows no names", expected="unit, function, address")
    if aim.address is not None:
        addressed(aim.address)


def wire_faults(said: Iterable[Mapping[str, Any]], framing: Framing, seed: int, start_ns: int) -> WireFaults:
    """The faults, all put in; their times count from `start_ns`. Raises as `check_link`."""
    faults = WireFaults(framing)
    for number, one in enumerate(said, 1):
        spec = parse_fault(dict(one), number=number)
        check_link(spec)
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
                functions=functions,
            )
        )
    return faults
