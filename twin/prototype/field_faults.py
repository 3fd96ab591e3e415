"""The faults of the simulated field devices: each fault is aimed, using the system file, at a bus, a device, a register
or a tag.

A plant does not have this module. Faults are injected by `fieldtwin run --faults`, a scenario, or a client of the
control channel.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from random import Random
from typing import Any

from fieldtwin.emulators.distortion import Distortions
from fieldtwin.emulators.endpoints.faulty.can import bus_rule
from fieldtwin.emulators.faults.can_fault import BusFault
from fieldtwin.emulators.faults.engine import WireFaults
from fieldtwin.emulators.faults.fault import Active, Aim, ValueFault
from fieldtwin.emulators.faults.frames import FrameDirection, framing_of
from fieldtwin.emulators.faults.schema import FaultSpec, parse_fault
from fieldtwin.emulators.faults.values.set_value import Form, SetValue
from fieldtwin.emulators.faults.values.value_ranges import check_value
from fieldtwin.emulators.wires.can_faults import ErrorRule
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.twin.prototype.fault_aims import tag_of, target
from fieldtwin.twin.prototype.fault_history import FaultHistory
from fieldtwin.twin.prototype.field_status import ActiveFaultStatus
from fieldtwin.twin.site.system import System

MOST = 1_000


class FieldFaults:
    """The active faults on the buses of a system and in its devices.

    `start_ns` is when the run began; `from` and `until` count from then.
    """

    def __init__(self, system: System, seed: int, clock: Clock) -> None:
        self.start_ns = clock.monotonic_ns()
        self._system = system
        self._seed = seed
        self._clock = clock
        self._buses = {name: WireFaults(framing_of(bus.endpoint)) for name, bus in system.buses.items()}
        self._distortions: dict[str, Distortions] = {}
        self._rules: dict[str, tuple[str, ErrorRule]] = {}
        self._disturb: dict[str, Callable[[ErrorRule], None]] = {}
        self._undisturb: dict[str, Callable[[ErrorRule], None]] = {}
        self._active: dict[str, tuple[FaultSpec, Active, str]] = {}
        self._set: dict[tuple[str, str], float] = {}
        self.history = FaultHistory()

    # -- where faults can be --------------------------------------------------------------------------------------------

    def on_bus(self, bus: str) -> WireFaults:
        """Return the faults on the traffic of a bus."""
        return self._buses[bus]

    def on_values(self, device: str, distortions: Distortions) -> None:
        """Register the distortions through which the values of `device` can be changed."""
        self._distortions[device] = distortions

    def on_wire(self, bus: str, disturb: Callable[[ErrorRule], None], undisturb: Callable[[ErrorRule], None]) -> None:
        """Register a modelled CAN bus, on which bus errors can be injected."""
        self._disturb[bus], self._undisturb[bus] = disturb, undisturb

    def watch(self, told: Callable[[str, object, bool, bytes], None]) -> None:
        """Call `told` with the traffic on each serial line and socket from now on.

        Its arguments are the bus, the connection object, whether an emulator sent the bytes, and the bytes. CAN buses have their
        own listeners (`FieldSimulator.join`).
        """
        for name, wire in self._buses.items():
            wire.watch = _watcher(name, told)

    # -- putting in and taking away -------------------------------------------------------------------------------------

    def inject(self, said: Mapping[str, Any], start_ns: int | None = None) -> str:
        """Inject a fault and return its id.

        Its times count from `start_ns`, by default from the run's start. Raises `UsageError` for an invalid fault, or
        an id that is already active.
        """
        start_ns = self.start_ns if start_ns is None else start_ns
        spec = parse_fault(dict(said), number=len(self._active) + 1)
        if spec.id in self._active:
            raise UsageError(
                f"the fault {spec.id!r} is already active", hint="clear it first, or choose a different id"
            )
        if len(self._active) >= MOST:
            raise UsageError("too many faults at once", expected=f"at most {MOST}")
        fault = spec.make()
        at = target(self._system, spec)
        until_ns = None if spec.until_s is None else start_ns + round(spec.until_s * NS_PER_S)
        active = Active(
            spec.id,
            fault,
            at.aim,
            Random(f"{self._seed} {spec.id}"),
            start_ns + round(spec.from_s * NS_PER_S),
            until_ns,
            units=at.units,
            addresses=at.addresses,
            functions=at.functions,
            counts=at.counts,
        )
        self._put(spec, active, at.bus)
        self._active[spec.id] = (spec, active, at.bus)
        self.history.add(active, spec.aim.device or at.bus)
        return spec.id

    def silence(self, device: str) -> None:
        """Let no frame from or to `device` pass, from now on and including a reply that is being made."""
        on_can = self._system.buses[self._system.devices[device].bus].endpoint.is_can
        self.inject({"name": "lost-frame" if on_can else "drop", "device": device, "id": f"failed {device}"})

    def _put(self, spec: FaultSpec, active: Active, bus: str) -> None:
        if isinstance(active.fault, ValueFault):
            found = self._distortions.get(spec.aim.device)
            if found is None:
                raise UsageError(
                    f"the values of {spec.aim.device} cannot be changed", expected="a device that is emulated here"
                )
            active.fault.learn(self._system.devices[spec.aim.device].profile.tags.values())
            found.put_in(active, spec.aim.register_)
        elif isinstance(active.fault, BusFault):
            disturb = self._disturb.get(bus)
            if disturb is None:
                raise UsageError(
                    f"no transmission errors can be produced on bus {bus!r}", expected="the software CAN bus"
                )
            nodes = frozenset(active.units) or frozenset(d.address for d in self._system.devices_on(bus))
            rule = bus_rule(active, self._clock.monotonic_ns, nodes)
            self._rules[spec.id] = bus, rule
            disturb(rule)
        else:
            self._buses[bus].put_in(active)

    def clear(self, id: str) -> None:
        """Clear a fault. Raises `UsageError` for an id that is not active."""
        if id not in self._active:
            raise UsageError(
                f"no fault {id!r} is active", expected=", ".join(self._active) or "an active fault; none is active"
            )
        spec, _, bus = self._active.pop(id)
        if spec.aim.device in self._distortions:
            self._distortions[spec.aim.device].take_away(id)
        if id in self._rules:
            on, rule = self._rules.pop(id)
            self._undisturb[on](rule)
        elif bus:
            self._buses[bus].take_away(id)

    def set_value(self, device: str, tag: str, value: float | str | bool | None) -> None:
        """Set the value of `tag` in the device to `value` from now on; None restores the device's own value."""
        found = tag_of(self._system, device, tag)
        distortions = self._distortions.get(device)
        if distortions is None or found.is_text:
            raise UsageError(f"{device}.{tag} cannot be set", expected="a number of a device that is emulated here")
        if isinstance(value, str):
            raise UsageError(f"{device}.{tag}", expected="a number", got=repr(value))
        if value is not None:
            check_value(found, float(value), f"{device}.{tag}")
        id = f"set {device}.{tag}"
        distortions.take_away(id)
        self._set.pop((device, tag), None)
        if value is None:
            return
        now_ns = self._clock.monotonic_ns()
        fault = SetValue(Form(value=float(value)))
        active = Active(id, fault, Aim(), Random(id), now_ns, None)
        distortions.put_in(active, tag)
        self.history.add(active, f"{device}.{tag}")
        self._set[device, tag] = float(value)

    def value_set(self, device: str, tag: str) -> float | None:
        """Return the value that `set_value` has set for the tag, or None."""
        return self._set.get((device, tag))

    def values_set(self) -> dict[str, float]:
        """Return each value that is set, by DEVICE.TAG."""
        return {f"{device}.{tag}": value for (device, tag), value in self._set.items()}

    def ids(self) -> list[str]:
        """Return the ids of the active faults."""
        return list(self._active)

    def active(self) -> list[ActiveFaultStatus]:
        """Return the active faults, and how often each took effect."""
        return [
            ActiveFaultStatus(id=id, name=spec.kind.name, bus=bus, device=spec.aim.device, struck=active.struck)
            for id, (spec, active, bus) in self._active.items()
        ]


def _watcher(
    bus: str, told: Callable[[str, object, bool, bytes], None]
) -> Callable[[object, FrameDirection, bytes], None]:
    return lambda end, way, data: told(bus, end, way is FrameDirection.REPLY, data)
