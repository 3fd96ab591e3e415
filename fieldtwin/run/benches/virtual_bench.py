"""The test bench of a scenario for a prototype in virtual time: it records events and reads the values that checks need.

This is a `fieldtwin.scenarios.bench.Bench` for the target `virtual`, inside one `VirtualLoop`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from msgspec.structs import asdict

from fieldtwin.conformance.core.case import Impact
from fieldtwin.emulators.models.modbus.packet_link import ModemEnd
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.gateway.core.concurrency.async_resource import AsyncResource
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Unreachable, UsageError
from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.gateway.runtime.alarms.alarm_list import ALARM
from fieldtwin.gateway.runtime.gateway_status import AlarmEvent
from fieldtwin.gateway.runtime.outputs.refusals import RefusedOutput
from fieldtwin.plc.cycle.publishing import TagChange
from fieldtwin.plc.cycle.task import StopReason
from fieldtwin.results.fault_counts import struck_of
from fieldtwin.results.model import Struck
from fieldtwin.results.trace import TOPSIDE, Trace, TraceKind, alarm_data, refusal_data
from fieldtwin.run.benches.probes import Probes
from fieldtwin.run.processes.states import state_words
from fieldtwin.run.processes.topside import Scripted, TopsideController
from fieldtwin.scenarios.bench import SCENARIO, Can, Stopped, TagReading, alarm_reading, variable
from fieldtwin.scenarios.language.probe_form import ScenarioProbe
from fieldtwin.twin.prototype.file import Prototype
from fieldtwin.twin.prototype.virtual import VirtualPrototype
from fieldtwin.twin.site.system import System

ASKED_KEPT = 64
_QUALITIES = {quality: quality.name.lower() for quality in Quality}
_REASONS = {reason: reason.name.lower() for reason in Reason}
# module constants, because looking up members of an Enum is slow
_FRAME, _TAG, _SENT = TraceKind.FRAME, TraceKind.TAG, Direction.SENT


class VirtualBench(AsyncResource):
    """A bench: ``async with VirtualBench(system, prototype, loop, run_dir, trace, seed=7) as bench``, inside `loop`.

    `commands` are those that the remote client sends by itself; a scenario uses `send` instead. `has_topside` False omits
    the client. `water`: for each transmitter in a network's acoustic channel, its connection to that channel.
    """

    def __init__(
        self,
        system: System,
        prototype: Prototype,
        loop: VirtualLoop,
        run_dir: Path,
        trace: Trace,
        *,
        seed: int | None = None,
        commands: list[Scripted] | None = None,
        has_topside: bool = True,
        probes: Sequence[ScenarioProbe] = (),
        water: Mapping[str, ModemEnd] | None = None,
    ) -> None:
        super().__init__()
        self.system = system
        self.trace = trace
        self.loop = loop
        self.run = VirtualPrototype(
            system,
            prototype,
            loop,
            run_dir,
            seed=seed,
            taps=[_FrameTap(self, system)],
            on_change=self._changed,
            on_refusal=self._refused,
            water=water,
        )
        self.topside: TopsideController | None = None
        self._commands = commands or []
        self._has_topside = has_topside
        self._probe = probes
        if probes and all(probe.serve for probe in probes):  # in virtual time no probe can connect to a real server
            self.can = self.can | {Can.PROBE}
        self._probes: Probes | None = None
        self.asked_ns: dict[str, deque[int]] = {bus: deque(maxlen=ASKED_KEPT) for bus in system.buses}
        """The times at which the gateway sent frames on each bus, on the loop's clock, the latest last."""
        self._updates: dict[str, int] = {}
        self._words = {
            f"{p}.state": words for p, words in state_words(self.run.twin.ecs.layout, system.plc.programs).items()
        }

    target = "virtual"
    allowed = Impact.DISRUPT
    can = frozenset(
        {
            Can.INJECT_FAULT,
            Can.SEND_COMMAND,
            Can.SET_VALUE,
            Can.SEE_WIRE,
            Can.SEE_HELD,
            Can.EXACT_TIME,
            Can.FRESH_START,
            Can.ACKNOWLEDGE,
            Can.JUDGE_RUN,
        }
    )

    async def _start(self) -> None:
        await self._stack.enter_async_context(self.run)
        self.run.gateway.tags.subscribe(self._put)
        self.run.gateway.alarms.on_event = self._alarm
        device = next(iter(self.run.field.far), None)
        if device is not None and self._has_topside:
            self.topside = TopsideController(
                self.system, device, self.run.field.far[device], self.run.clock, self.run.net
            )
            self.topside.on_send = self._commanded
            nursery = await self._stack.enter_async_context(Nursery())
            nursery.start(self.topside.run(self._commands), "topside")
        if Can.PROBE in self.can:
            await self._all_served()
            self._probes = Probes(self._probe, self.run.clock, self._served, self.run.net)
            self._probes.on_change = self.note
            nursery = await self._stack.enter_async_context(Nursery())
            nursery.start(self._probes.run(), "probes")

    async def _all_served(self) -> None:
        """Wait until the gateway serves the endpoints of the probes, at most a second."""
        until_ns = self.loop.now_ns + NS_PER_S
        while any(server.front.bound is None for server in self.run.gateway.servers) and self.loop.now_ns < until_ns:
            await self.run.clock.sleep_until_ns(self.loop.now_ns + NS_PER_MS)

    def _served(self, name: str) -> Endpoint:
        """Return the listening endpoint of the gateway's server `name` in the system file."""
        for server in self.run.gateway.servers:
            if server.config.name == name and server.front.bound is not None:
                return server.front.bound
        raise Unreachable(f"the gateway does not serve {name!r}")

    # -- events
    # ---------------------------------------------------------------------------------------------------------

    @property
    def now_ns(self) -> int:
        """Return the time in ns since the run's start."""
        return self.loop.now_ns - self.run.started_ns

    def note(self, kind: TraceKind, where: str, data: dict[str, Any]) -> None:
        """Add an event at the current time."""
        self.trace.note(self.now_ns, kind, where, data)

    def _commanded(self, period_s: int) -> None:
        self.note(TraceKind.NOTE, TOPSIDE, {"text": f"commands {period_s} s", "period_s": period_s})

    def _put(self, name: str, value: TagValue) -> None:
        self._updates[name] = self._updates.get(name, 0) + 1
        shown = value.value
        if isinstance(shown, bytes):
            shown = shown.hex()
        data = {"value": shown, "quality": _QUALITIES[value.quality], "reason": _REASONS[value.reason]}
        self.trace.note(self.loop.now_ns - self.run.started_ns, _TAG, name, data)

    def _changed(self, change: TagChange) -> None:
        self.note(TraceKind.STATE, change.tag, {"value": self._named(change.tag, change.after)})

    def _refused(self, entry: RefusedOutput) -> None:
        self.note(TraceKind.REFUSED, entry.tag, refusal_data(asdict(entry.status())))

    def _alarm(self, event: AlarmEvent) -> None:
        self.note(TraceKind.ALARM, f"{ALARM}.{event.name}", alarm_data(asdict(event)))

    def _named(self, tag: str, value: Any) -> Any:
        """Return `value`, or the name of the state if `tag` is a state that has names."""
        return self._words[tag].get(value, value) if tag in self._words else value

    def states(self) -> dict[str, str]:
        """Return the current state of each program that has named states."""
        now = {tag.removesuffix(".state"): self._named(tag, self.run.plc.outputs.current(tag)) for tag in self._words}
        return {program: state for program, state in now.items() if isinstance(state, str)}

    # -- Bench ----------------------------------------------------------------------------------------------------------

    def now_s(self) -> float:
        return self.now_ns / NS_PER_S

    async def sleep_until_s(self, t_s: float) -> None:
        """Sleep until `t_s`. Raises the error of a part of the system that has failed."""
        await self.run.clock.sleep_until_ns(self.run.started_ns + round(t_s * NS_PER_S))
        failure = self.run.failure()
        if failure is not None:
            raise failure

    def names(self) -> list[str]:
        probed = self._probes.names if self._probes is not None else []
        alarms = [f"{ALARM}.{name}" for name in self.run.gateway.alarms.names]
        return [*self.run.gateway.tags.names, *self.run.plc.outputs.last(), *alarms, *probed]

    def reading(self, name: str) -> TagReading | None:
        if self._probes is not None and name in self._probes.names:
            return self._probes.reading(name)
        first, _, alarm = name.partition(".")
        if first == ALARM and alarm in self.run.gateway.alarms.names:
            return alarm_reading(self.run.gateway.alarms.present(alarm), self.loop.now_ns)
        outputs = self.run.plc.outputs.last()
        if name in outputs and name not in self.run.gateway.tags:
            value = self._named(name, outputs[name])
            runs = self.run.plc.stop_reason is StopReason.NONE  # a stopped PLC's variables must not be interpreted
            return None if value is None else variable(value, runs=runs)
        if name not in self.run.gateway.tags:
            raise UsageError(f"no tag or variable {name!r}", expected="DEVICE.TAG or PROGRAM.VARIABLE")
        now_ns = self.run.clock.monotonic_ns()
        seen = self.run.gateway.tags.current(name, now_ns)
        if not self._updates.get(name) and seen.value is None:
            return None
        return TagReading(
            seen.value,
            seen.quality.name.lower(),
            seen.reason.name.lower(),
            (now_ns - seen.t_ns) / NS_PER_S,
            self._updates.get(name, 0),
        )

    def why_unknown(self, name: str) -> str:
        return self._probes.why_unknown(name) if self._probes is not None else ""

    def stopped(self) -> Stopped | None:
        plc = self.run.plc
        if plc.stop_reason is StopReason.NONE:
            overdue = plc.starts.error
            return Stopped("plc", str(overdue)) if overdue is not None else None
        place = getattr(plc.error, "place", "")
        return Stopped("plc", f"the PLC stopped ({plc.stop_reason.value}): {plc.error or 'on request'}", place)

    def not_started(self) -> str:
        return "; ".join(
            f"program {start.name} waits for {start.reason()}" for start in self.run.plc.starts.missing_something
        )

    def late_ms(self) -> float:
        return 0.0

    def host_late_s(self, since_s: float) -> float:
        return 0.0

    def host_late_total_s(self, since_s: float) -> tuple[float, float]:
        return 0.0, 0.0

    async def send(self, period_s: int) -> None:
        if self.topside is None:
            raise UsageError("this system cannot be commanded", expected="a transmitter with a topside end")
        self.topside.send(period_s)

    async def set_value(self, device: str, tag: str, value: float | str | bool | None) -> None:
        self.run.field.faults.set_value(device, tag, value)

    async def acknowledge(self, alarm: str) -> None:
        self.run.gateway.alarms.acknowledge(alarm.removeprefix(f"{ALARM}."), SCENARIO, self.loop.now_ns)

    async def inject(self, fault: dict[str, Any]) -> None:
        id = self.run.field.faults.inject(fault)
        target = fault.get("device") or fault.get("bus") or ""
        self.note(TraceKind.FAULT, id, {"name": fault["name"], "on": True, "target": target, "said": fault})

    async def struck(self) -> list[Struck]:
        return [struck_of(one) for one in self.run.field.faults.history.struck()]

    async def failures(self) -> dict[str, str]:
        return dict(self.run.field.failures)

    async def clear(self, id: str) -> None:
        self.run.field.faults.clear(id)
        self.note(TraceKind.FAULT, id, {"name": "", "on": False, "target": ""})

    async def held(self, name: str) -> list[tuple[float, bytes]]:
        device, _, tag = name.partition(".")
        if device not in self.run.field.devices:
            raise UsageError(f"no emulated device {device!r}", expected=", ".join(self.run.field.devices))
        start_ns = self.run.started_ns
        return [
            ((h.t_ns - start_ns) / NS_PER_S, h.raw)
            for h in self.run.field.devices[device].journal.since(0)
            if h.tag == tag
        ]


class _FrameTap:
    """A tap (`fieldtwin.gateway.core.connection.Tap`) that writes all bytes and frames into the bench's trace."""

    def __init__(self, bench: VirtualBench, system: System) -> None:
        self._bench = bench
        self._bus = {str(bus.endpoint): name for name, bus in system.buses.items()}
        self._known: dict[int, tuple[Endpoint, str]] = {}

    def on_bytes(self, endpoint: Endpoint, direction: Direction, t_ns: int, data: bytes) -> None:
        self._note(endpoint, direction, t_ns, {"dir": direction._value_, "bytes": data.hex()})

    def on_frame(self, endpoint: Endpoint, direction: Direction, t_ns: int, frame: CanFrame) -> None:
        data: dict[str, Any] = {"dir": direction._value_, "id": frame.can_id, "bytes": frame.data.hex()}
        if frame.remote:
            data["rtr"] = True
        if frame.extended:
            data["ext"] = True
        if frame.error:
            data["err"] = True
        self._note(endpoint, direction, t_ns, data)

    def _note(self, endpoint: Endpoint, direction: Direction, t_ns: int, data: dict[str, Any]) -> None:
        # the text is cached, because formatting an endpoint takes longer than the rest of this function
        known = self._known.get(id(endpoint))
        if known is None or known[0] is not endpoint:
            known = self._known[id(endpoint)] = endpoint, self._bus.get(str(endpoint), str(endpoint))
        bus, bench = known[1], self._bench
        if direction is _SENT and bus in bench.asked_ns:
            bench.asked_ns[bus].append(t_ns)
        bench.trace.note(t_ns - bench.run.started_ns, _FRAME, bus, data)
