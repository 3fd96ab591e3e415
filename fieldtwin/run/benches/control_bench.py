"""The test bench of a scenario whose system runs in separate processes. It uses their control channels, image and capture file.

This is a `fieldtwin.scenarios.bench.Bench` for the targets `local`, `compose` and `real`. Its abilities depend on the parts
that it can reach: without a field simulator it cannot inject faults, and without a capture it cannot see frames. It starts and
ends only its own connections. Where no fieldtwin gateway runs, a scenario that uses only probes tests a third-party controller
with the field simulator alone.

All faults and values that a scenario injects into the simulated devices belong to a lease (`FieldLease`). They are removed
when the scenario ends, and also when this process is killed.
"""

from __future__ import annotations

import asyncio
import os
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from fieldtwin.conformance.core.case import Impact
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.concurrency.async_resource import AsyncResource
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.control import ControlClient, RemoteError
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Unreachable, UsageError
from fieldtwin.gateway.core.image.image import OUTPUTS
from fieldtwin.gateway.core.image.region import RegionReader
from fieldtwin.gateway.runtime.alarms.alarm_list import ALARM
from fieldtwin.gateway.runtime.gateway_status import AlarmEvent, GatewayStatus
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.plc.status import PlcStatus
from fieldtwin.results.fault_counts import struck_of
from fieldtwin.results.model import Struck
from fieldtwin.results.trace import TOPSIDE, Trace, TraceEvent, TraceKind, alarm_data, refusal_data
from fieldtwin.run.benches.capture_tail import CaptureTail
from fieldtwin.run.benches.field_lease import FieldLease
from fieldtwin.run.benches.fresh_start import make_fresh, programs_scan
from fieldtwin.run.benches.host_lateness import HostLateness
from fieldtwin.run.benches.probes import Probes
from fieldtwin.run.processes.children import Failure, naming_failures
from fieldtwin.run.processes.field_contact import check_same, connect_control, reachable
from fieldtwin.run.processes.states import state_words
from fieldtwin.run.processes.topside import TopsideController
from fieldtwin.run.processes.with_program import environment_from
from fieldtwin.scenarios.bench import SCENARIO, Can, Stopped, TagReading, alarm_reading, variable
from fieldtwin.scenarios.language.probe_form import ScenarioProbe
from fieldtwin.twin.plant.physical import attached, gateway_lost_ms, image_layout
from fieldtwin.twin.prototype.field_status import FieldStatus, StruckStatus
from fieldtwin.twin.site.system import System

PLC_EVERY_S = 0.25
STARTING_S = 5.0
"""Time in seconds within which a PLC must start and receive the gateway's first heartbeat."""
HELD_KEPT = 20_000
SERVED_WITHIN_S = 5.0
SERVED_LOOK_S = 0.005


@dataclass(frozen=True)
class Where:
    """The access to a running system.

    `run_dir` is its run directory on this host. `field_host` is its field simulator, ``HOST[:PORT]`` with a token, or
    empty for the one in the run directory. `far` is the endpoint of the topside controller's modem, needed only if no field
    simulator reports it. `capture` is the capture file of its buses.
    """

    run_dir: Path
    field_host: str = ""
    token: str = field(default="", repr=False)
    field_socket: Path | None = None
    """The Unix socket of a field simulator on this host, if it is not in the run directory."""
    far: str = ""
    capture: Path | None = None
    plant: bool = False
    """The devices are real, so no faults and no values are injected, even if a field simulator can be reached."""
    own: bool = False
    """The system was started for this scenario alone, so it is in its initial state."""
    foreign: bool = False
    """The controller is a user's program, so the bench cannot query a fieldtwin gateway."""
    env: Mapping[str, str] = field(default_factory=dict)
    """The environment variables that give a user's program the endpoints; endpoints of probes may refer to them."""
    allowed: Impact = Impact.DISRUPT


class ControlBench(AsyncResource):
    """A bench: ``async with ControlBench(system, where, trace, target="local", names=[...]) as bench``.

    `names` are the tags and variables to read. `fresh` is called with the bench's abilities and returns whether the
    system is to be reset before the scenario begins. `failure` returns why a process of the system has ended; None if
    this program did not start the processes.
    """

    def __init__(
        self,
        system: System,
        where: Where,
        trace: Trace,
        *,
        target: str,
        names: Collection[str],
        probes: Sequence[ScenarioProbe] = (),
        fresh: Callable[[frozenset[Can]], bool] = lambda can: False,
        failure: Failure | None = None,
    ) -> None:
        super().__init__()
        self.system = system
        self.trace = trace
        self.target = target
        self.allowed = where.allowed
        self.can: frozenset[Can] = frozenset()
        self._where = where
        self._names = list(names)
        self._fresh = fresh
        self._failure = failure
        self._env: dict[str, str] = {}
        """The endpoints of the simulated devices, to which endpoints of probes may refer."""
        self.lease: FieldLease | None = None
        self._clock = WallClock()
        self._start_ns = self._clock.monotonic_ns()
        self._gateway: ControlClient | None = None
        self._plc: ControlClient | None = None
        self._field: ControlClient | None = None
        self._topside: TopsideController | None = None
        self._outputs: RegionReader | None = None
        self._tail: CaptureTail | None = None
        self._probe = probes
        self._probes: Probes | None = None
        self._tags: dict[str, list[Any]] = {}
        self._asked: list[str] = []
        self._seen_ns = 0
        self._since: int | None = None
        """The number of the newest change of a tag that the gateway has reported; None before its first answer."""
        self._refused = 0
        """The number, in the gateway's journal, of the newest refused output that the gateway has reported."""
        self._alarms: dict[str, AlarmEvent | None] = {}
        """The last change of each alarm, by its name in expressions; None before its first change."""
        self._alarm_number = 0
        """The number of the newest change of an alarm that the gateway has reported."""
        self._updates: dict[str, int] = {}
        self._states: dict[str, Any] = {}
        self._words: dict[str, dict[int, str]] = {}
        self._plc_due_s = 0.0
        self._stopped: Stopped | None = None
        self._fault_numbers: set[int] = set()
        """The numbers that the field simulator gave to the faults of this bench."""
        self._not_started = ""
        self._gateway_seen = False
        self._worst_us = -1.0
        self._overruns = -1
        self._late_ms = 0.0
        self._lateness = HostLateness()
        self._held: dict[str, deque[tuple[float, bytes]]] = {}
        self._held_since: dict[str, int] = {}

    async def _start(self) -> None:
        async with naming_failures(self._failure):
            await self._open()

    async def _open(self) -> None:
        where = self._where
        if not self._foreign():
            await self._open_controller()
        can = {Can.FRESH_START} if where.own else set()
        if not where.plant:
            await self._open_field()
        if self._field is not None:
            can |= {Can.INJECT_FAULT, Can.SET_VALUE, Can.SEE_HELD} | (
                {Can.FRESH_START} if self._plc is not None else set()
            )
        far = Endpoint.parse(where.far) if where.far else await self._far_of_field()
        device = next((d.name for d in self.system.devices.values() if d.profile.inbox is not None), None)
        if far is not None and device is not None and where.allowed.rank >= Impact.WRITE.rank:
            can.add(Can.SEND_COMMAND)
        can |= {Can.ACKNOWLEDGE} if self._gateway is not None else set()
        can |= {Can.SEE_WIRE} if where.capture is not None else set()
        can |= {Can.PROBE} if self._probe else set()
        self.can = frozenset(can)
        nursery = await self._stack.enter_async_context(Nursery())
        await self._open_lease(nursery)
        if not where.own and self._fresh(self.can):
            assert self._gateway is not None
            assert self._plc is not None
            assert self.lease is not None
            await make_fresh(self.lease, self._gateway, self._plc)
        if far is not None and device is not None and Can.SEND_COMMAND in self.can:
            self._topside = TopsideController(self.system, device, far, self._clock)
            self._topside.on_send = self._commanded
            nursery.start(self._topside.run([]), "topside")
        if where.capture is not None:
            self._tail = CaptureTail(where.capture, self.system)
            self._stack.callback(self._tail.close)
        if self._probe:
            served = {probe.serve: await self._served(probe.serve) for probe in self._probe if probe.serve}
            probes = [probe.at({**os.environ, **self._env}) for probe in self._probe]
            self._probes = Probes(probes, self._clock, served.__getitem__)
            nursery.start(self._probes.run(), "probes")
        if where.own and self._plc is not None:  # a short scenario would end before the programs had their first inputs
            await programs_scan(self._plc)
        self._start_ns = self._clock.monotonic_ns()
        await self._look()
        self._updates.clear()

    async def _open_lease(self, nursery: Nursery) -> None:
        """Open the lease, which limits the lifetime of all faults and values that the bench injects."""
        if self._field is None:
            return
        self.lease = FieldLease(await self._connect_field())
        await self.lease.open()
        self._stack.push_async_callback(self.lease.release)
        nursery.start(self.lease.run(), "lease")

    def _foreign(self) -> bool:
        """Return whether this instance has no fieldtwin gateway and the scenario needs none."""
        if self._where.foreign:
            return True
        probed = {name for probe in self._probe for name in probe.names}
        asked = any(probe.serve for probe in self._probe) or not probed.issuperset(self._names)
        return (
            bool(probed) and not asked and not self._where.plant and not (self._where.run_dir / "gateway.sock").exists()
        )

    async def _open_controller(self) -> None:
        where, layout = self._where, image_layout(self.system)
        self._gateway = await self._connect("gateway")
        self._plc = await self._connect("plc")
        known = set((await self._gateway.ask("get", GatewayStatus)).tags)
        self._asked = [name for name in self._names if name in known]
        self._alarms = {f"{ALARM}.{name}": None for name in self.system.alarms}
        image = self._stack.enter_context(attached(layout, where.run_dir / "image"))
        self._outputs = image.reader(OUTPUTS)
        self._words = {f"{p}.state": w for p, w in state_words(layout, self.system.plc.programs).items()}

    async def _connect_field(self) -> ControlClient:
        """Open another connection to the field simulator."""
        if not self._where.field_host:
            return await self._connect_unix(self._field_socket)
        client, _ = await connect_control(self._where.field_host, self._where.token)
        self._stack.push_async_callback(client.aclose)
        return client

    async def _connect(self, name: str) -> ControlClient:
        return await self._connect_unix(self._where.run_dir / f"{name}.sock")

    async def _connect_unix(self, path: Path) -> ControlClient:
        client = await ControlClient.connect_unix(path)
        self._stack.push_async_callback(client.aclose)
        return client

    @property
    def _field_socket(self) -> Path:
        return self._where.field_socket or self._where.run_dir / "field.sock"

    async def _open_field(self) -> None:
        if self._where.field_host or self._where.field_socket or self._field_socket.exists():
            self._field = await self._connect_field()
            status = await self._field.ask("get", FieldStatus)
            check_same(self.system, status)
            self._env = {**environment_from(status, self.system, self._field_at, self._field_socket), **self._where.env}

    async def _served(self, name: str) -> Endpoint:
        """Return the listening endpoint of the gateway's server `name` in the system file. Wait until the server listens."""
        assert self._gateway is not None
        until_s = self.now_s() + SERVED_WITHIN_S
        while not (listening := (await self._gateway.ask("get", GatewayStatus)).serve[name].listening):
            if self.now_s() > until_s:
                raise Unreachable(f"the gateway does not serve {name!r}")
            await asyncio.sleep(SERVED_LOOK_S)
        return Endpoint.parse(listening)

    async def _far_of_field(self) -> Endpoint | None:
        if self._field is None:
            return None
        far = (await self._field.ask("get", FieldStatus)).far
        return next((reachable(Endpoint.parse(url), self._field_at) for url in far.values()), None)

    @property
    def _field_at(self) -> str:
        """Return the host of the field simulator."""
        return self._where.field_host.rpartition(":")[0] or self._where.field_host or "localhost"

    # -- Bench ----------------------------------------------------------------------------------------------------------

    def now_s(self) -> float:
        return (self._clock.monotonic_ns() - self._start_ns) / NS_PER_S

    async def sleep_until_s(self, t_s: float) -> None:
        """Sleep until `t_s`. Raises the reason if the system has ended."""
        before_s = self.now_s()
        await asyncio.sleep(max(0.0, t_s - before_s))
        asked_s, slept_s = max(t_s, before_s), self.now_s()
        self._lateness.slept(slept_s, slept_s - asked_s)
        await self._refresh()
        now_s = self.now_s()
        self._lateness.waited(now_s, now_s - asked_s)

    def names(self) -> list[str]:
        return list(self._names)

    def reading(self, name: str) -> TagReading | None:
        if self._probes is not None and name in self._probes.names:
            return self._probes.reading(name)
        if name in self._asked:
            value, quality, reason, t_ns = self._tags[name]
            if value is None and not self._updates.get(name):
                return None
            age_s = (self._seen_ns - t_ns) / NS_PER_S if t_ns else float("inf")
            return TagReading(value, quality, reason.replace(" ", "_"), age_s, self._updates.get(name, 0))
        if name in self._alarms:
            changed = self._alarms[name]
            return None if changed is None else alarm_reading(changed, self._seen_ns)
        if name not in self._names:
            raise UsageError(f"no tag or variable {name!r}", expected="DEVICE.TAG or PROGRAM.VARIABLE")
        value = self._states.get(name)
        return None if value is None else variable(value, runs=self._stopped is None)

    def why_unknown(self, name: str) -> str:
        return self._probes.why_unknown(name) if self._probes is not None else ""

    def stopped(self) -> Stopped | None:
        return self._stopped

    def not_started(self) -> str:
        return self._not_started

    def late_ms(self) -> float:
        if self._plc is None:
            raise UsageError("the scan times of a third-party controller are not known", where="plc.late")
        return self._late_ms

    def host_late_s(self, since_s: float) -> float:
        return self._lateness.longest_s(since_s)

    def host_late_total_s(self, since_s: float) -> tuple[float, float]:
        return self._lateness.own_s(since_s), self._lateness.any_s(since_s)

    async def send(self, period_s: int) -> None:
        if self._topside is None:
            raise UsageError("this system cannot be commanded", expected="a transmitter with a topside end")
        self._topside.send(period_s)

    async def set_value(self, device: str, tag: str, value: float | str | bool | None) -> None:
        answer = await self._put("set", device=device, tag=tag, value=value)
        if value is not None:
            self._fault_numbers.add(answer["number"])

    async def acknowledge(self, alarm: str) -> None:
        assert self._gateway is not None
        async with naming_failures(self._failure):
            await self._gateway.call("acknowledge", alarm=alarm.removeprefix(f"{ALARM}."), by=SCENARIO)

    async def inject(self, fault: dict[str, Any]) -> None:
        answer = await self._put("fault", fault=fault, start_ns=self._start_ns)
        self._fault_numbers.add(answer["number"])
        target = fault.get("device") or fault.get("bus") or ""
        self._note(TraceKind.FAULT, answer["id"], {"name": fault["name"], "on": True, "target": target, "said": fault})

    async def struck(self) -> list[Struck]:
        if not self._fault_numbers:
            return []
        told = msgspec.convert((await self._to_field("get"))["struck"], list[StruckStatus])
        return [struck_of(one) for one in told if one.number in self._fault_numbers]

    async def failures(self) -> dict[str, str]:
        if self._field is None:
            return {}
        return msgspec.convert((await self._to_field("get")).get("failures", {}), dict[str, str])

    async def clear(self, id: str) -> None:
        await self._to_field("clear", id=id)
        self._note(TraceKind.FAULT, id, {"name": "", "on": False, "target": ""})

    async def held(self, name: str) -> list[tuple[float, bytes]]:
        """Return the values that a device held for the tag `name`, each as (time in s since the start, raw bytes).

        All processes share the host's clock: `compose` is tested on the host of its containers.
        """
        device = name.partition(".")[0]
        while True:
            answer = await self._to_field("held", since={device: self._held_since.get(device, 0)})
            entries = answer.get(device, [])
            for number, tag, raw, t_ns in entries:
                kept = self._held.setdefault(f"{device}.{tag}", deque(maxlen=HELD_KEPT))
                kept.append(((t_ns - self._start_ns) / NS_PER_S, bytes.fromhex(raw)))
                self._held_since[device] = number
            if not entries:
                return list(self._held.get(name, ()))

    async def _put(self, command: str, **args: Any) -> Any:
        """Inject a fault or a value into the simulated devices, under the lease."""
        if self.lease is None:
            raise UsageError("there are no simulated field devices", expected="a prototype")
        return await self.lease.call(command, **args)

    async def _to_field(self, command: str, **args: Any) -> Any:
        if self._field is None:
            raise UsageError("there are no simulated field devices", expected="a prototype")
        try:
            async with naming_failures(self._failure):
                return await self._field.call(command, **args)
        except RemoteError as e:
            if e.remote_exit_code == UsageError.exit_code:
                raise UsageError(str(e)) from e
            raise

    # -- events -------------------------------------------------------------------------------------------------------

    def _note(self, kind: TraceKind, where: str, data: dict[str, Any]) -> None:
        self.trace.note(round(self.now_s() * NS_PER_S), kind, where, data)

    def _commanded(self, period_s: int) -> None:
        self._note(TraceKind.NOTE, TOPSIDE, {"text": f"commands {period_s} s", "period_s": period_s})

    async def _refresh(self) -> None:
        async with naming_failures(self._failure):
            await self._look()

    async def _look(self) -> None:
        failed = self._failure() if self._failure is not None else None
        if failed is None and self.lease is not None:
            failed = self.lease.lost
        if failed is not None:
            raise failed
        events = await self._changed_tags() + self._changed_states()
        if self._probes is not None:
            events += self._probes.changes(self._start_ns)
        if self._tail is not None:
            events += self._tail.read(self._start_ns)
        for event in sorted(events, key=lambda e: e.t_ns):
            if event.t_ns >= 0:
                self.trace.note(*event)
        if self._plc is not None and self.now_s() >= self._plc_due_s:
            await self._ask_plc()

    async def _changed_tags(self) -> list[TraceEvent]:
        if self._gateway is None:
            return []
        answer = await self._gateway.call(
            "watch",
            samples=True,
            since=self._since,
            names=self._asked,
            refused=self._refused,
            alarms=self._alarm_number,
        )
        self._tags, self._seen_ns = answer["tags"], answer["now_ns"]
        events = []
        for entry in answer["refusals"]:
            self._refused = entry["number"]
            t_ns = entry["t_ns"] - self._start_ns
            if (
                t_ns >= 0 or self.target == "local" or entry["standing"]
            ):  # the output was refused earlier in this run, or it is refused again now
                events.append(TraceEvent(max(0, t_ns), TraceKind.REFUSED, entry["tag"], refusal_data(entry)))
        for change in msgspec.convert(answer["alarms"], list[AlarmEvent]):
            name, self._alarm_number = f"{ALARM}.{change.name}", change.number
            self._alarms[name] = change
            if change.t_ns >= self._start_ns:
                data = alarm_data(msgspec.structs.asdict(change))
                events.append(TraceEvent(change.t_ns - self._start_ns, TraceKind.ALARM, name, data))
        for number, t_ns, tag, value, quality, reason in answer["changes"]:
            self._since = number
            self._updates[tag] = self._updates.get(tag, 0) + 1
            data = {"value": value, "quality": quality, "reason": reason.replace(" ", "_")}
            events.append(TraceEvent(t_ns - self._start_ns, TraceKind.TAG, tag, data))
        if self._since is None:
            self._since = answer["last"]
        return events

    def _changed_states(self) -> list[TraceEvent]:
        """Return the changes of programs' states since the last call; a value between two calls may be missed."""
        if self._outputs is None:
            return []
        snapshot = self._outputs.snapshot()
        if snapshot.stopped and self._stopped is None:
            self._plc_due_s = 0.0  # the reason of the stop is queried at once
        if not snapshot.counter:
            return []
        events = []
        for name, value in snapshot.all().items():
            shown: Any = value.value.hex() if isinstance(value.value, bytes) else value.value
            shown = self._words[name].get(shown, shown) if name in self._words else shown
            if name not in self._states or self._states[name] != shown:
                self._states[name] = shown
                events.append(TraceEvent(snapshot.t_ns - self._start_ns, TraceKind.STATE, name, {"value": shown}))
        return events

    async def _ask_plc(self) -> None:
        """Query the PLC's status: whether it has stopped, and how late its scans were since the last query."""
        assert self._plc is not None
        told = await self._plc.ask("get", PlcStatus, brief=True)
        self._stopped = self._what_stopped(told)
        self._not_started = "; ".join(
            f"program {name} waits for {start.reason}" for name, start in told.waiting.items()
        )
        tasks = told.tasks.values()
        worst_us = max(task.lateness_us["max"] for task in tasks)
        overruns = sum(task.overruns for task in tasks)
        if self._overruns >= 0:
            limit_ms = float(self.system.plc.watchdog.late_ms) if overruns > self._overruns else 0.0
            self._late_ms = max(worst_us / 1000 if worst_us > self._worst_us else 0.0, limit_ms)
            if overruns > self._overruns:
                self._lateness.waited(self.now_s(), max(self._late_ms, limit_ms) / 1000)
        self._worst_us, self._overruns = worst_us, overruns
        self._plc_due_s = self.now_s() + PLC_EVERY_S
        if self._field is not None:
            await self._field.call("ready")  # this call raises if the field simulator is lost

    def _what_stopped(self, told: PlcStatus) -> Stopped | None:
        """Return the stopped part according to the PLC's status: the PLC itself, or the gateway, whose heartbeat it monitors."""
        starting = self.now_s() < STARTING_S
        state, late_s = told.state, float(self.system.plc.watchdog.late_ms) / 1000
        if state == "stopped":
            watchdog = told.stop_reason == "watchdog"
            what = f"the PLC stopped ({told.stop_reason}): {told.error or 'on request'}"
            return Stopped("plc", what, told.error_at, late_s if watchdog else 0.0)
        if state == "paused" or (state == "ready" and not starting):
            return Stopped("plc", "the PLC is paused" if state == "paused" else "the PLC was not started")
        if state == "waiting" and told.error:  # the program has waited for its inputs for too long
            return Stopped("plc", told.error)
        self._gateway_seen |= told.gateway_alive
        if told.gateway_alive or (starting and not self._gateway_seen):
            return None
        what = "the PLC does not see the gateway's heartbeat"
        return Stopped("gateway", what, bound_s=gateway_lost_ms(self.system) / 1000)
