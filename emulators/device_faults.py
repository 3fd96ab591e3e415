"""The faults of one emulated device outside of a system: `fieldtwin emulate DEVICE --faults FILE`.

Such a fault may not name a bus or device as its target. It may name a register if the device has a profile. Faults that change
values need a profile.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from random import Random
from typing import Any

from fieldtwin.emulators.distortion import Distortions
from fieldtwin.emulators.faults.effect import check_wire_effect
from fieldtwin.emulators.faults.engine import WireFaults
from fieldtwin.emulators.faults.fault import Active, Aim, InjectionPoint, ValueFault
from fieldtwin.emulators.faults.frames import Framing
from fieldtwin.emulators.faults.schema import FUNCTIONS_OF, FaultSpec, addressed, counted, parse_fault
from fieldtwin.emulators.faults.values.value_ranges import check_fault
from fieldtwin.emulators.faults.wrong_aim import WrongAim
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.files.profile import DeviceProfile, Tag


class DeviceFaults:
    """The faults of a file, which `check_device` has checked. Their times count from `start_ns`, in the event
    loop's time.
    """

    def __init__(
        self, said: Iterable[Mapping[str, Any]], profile: DeviceProfile | None, seed: int, start_ns: int
    ) -> None:
        self.put_in: list[Active] = []
        """The injected faults, once for each connection, with the number of times that each one took effect."""
        self._specs = [parse_fault(dict(one), number=number) for number, one in enumerate(said, 1)]
        self._profile = profile
        self._seed = seed
        self._start_ns = start_ns

    def on_wire(self, framing: Framing) -> WireFaults:
        """Return the faults that act on the bytes of one connection of the device."""
        faults = WireFaults(framing)
        for spec in self._specs:
            if spec.kind.kind is InjectionPoint.BYTES:
                faults.put_in(self._active(spec))
        return faults

    def on_values(self, distortions: Distortions) -> None:
        """Inject the value faults into a device."""
        for spec in self._specs:
            if spec.kind.kind is InjectionPoint.VALUE:
                active = self._active(spec)
                if isinstance(active.fault, ValueFault) and self._profile is not None:
                    active.fault.learn(self._profile.tags.values())
                distortions.put_in(active, spec.aim.register_)

    def _active(self, spec: FaultSpec) -> Active:
        aim = spec.aim
        addresses, functions = _place(aim, self._profile)
        until_ns = None if spec.until_s is None else self._start_ns + round(spec.until_s * NS_PER_S)
        active = Active(
            spec.id,
            spec.make(),
            aim,
            Random(f"{self._seed} {spec.id}"),
            self._start_ns + round(spec.from_s * NS_PER_S),
            until_ns,
            units=() if aim.unit is None else (aim.unit,),
            addresses=addresses,
            functions=functions,
            counts=counted(aim.registers),
        )
        self.put_in.append(active)
        return active


def check_device(spec: FaultSpec, profile: DeviceProfile | None, framings: Iterable[Framing] = ()) -> None:
    """Raise `WrongAim` for a fault that does not apply to a single device, or that changes nothing on any of its connections."""
    aim, kind = spec.aim, spec.kind.kind
    for key, name in (("device", aim.device), ("bus", aim.bus)):
        if name:
            raise WrongAim(
                key, f"fault {spec.id}: there is only one device, and no name is needed", hint="leave it out"
            )
    if kind is InjectionPoint.CAN:
        raise WrongAim("name", f"fault {spec.kind.name} is for {kind.value}", expected="one of a line or socket")
    tag = _tag(aim, profile)
    if kind is InjectionPoint.VALUE and profile is None:
        raise WrongAim(
            "name",
            f"fault {spec.kind.name} changes the values of registers, and a recording alone does not describe them",
            hint="emulate a profile and give it the recording: fieldtwin emulate PROFILE --recording FILE",
        )
    if kind is InjectionPoint.VALUE and tag is not None and tag.is_text:
        raise WrongAim("register", f"{tag.name} is not a number", expected="a tag that is one")
    if profile is not None:
        check_fault(spec.make(), aim.register_, profile.tags.values())
    _place(aim, profile)
    table = None if tag is None or kind is not InjectionPoint.BYTES else tag.registers.table
    without: list[WrongAim] = []
    for framing in (framings := tuple(framings)):
        try:
            check_wire_effect(spec, framing, table)
        except WrongAim as e:
            without.append(e)
    if without and len(without) == len(framings):
        raise without[0]


def _tag(aim: Aim, profile: DeviceProfile | None) -> Tag | None:
    if not aim.register_:
        return None
    if profile is None:
        raise WrongAim("register", "a recording has no registers by name", expected="address: holding:0x10")
    if aim.register_ not in profile.tags:
        raise WrongAim("register", f"no register {aim.register_!r}", expected=", ".join(profile.tags))
    return profile.tags[aim.register_]


def _place(aim: Aim, profile: DeviceProfile | None) -> tuple[range | None, frozenset[int]]:
    """Return the addresses that are the target of the fault (None for all), and the function codes of their table."""
    tag = _tag(aim, profile)
    if tag is not None:
        at = tag.registers
        return range(at.address, at.end), FUNCTIONS_OF[at.table]
    return (None, frozenset()) if aim.address is None else addressed(aim.address)
