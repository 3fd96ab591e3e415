"""A system that runs in processes as a scenario's bench: asked over control channels, process image and capture file.

A `fieldtwin.scenarios.bench.Bench` for the targets `local`, `compose` and `real`. What it can do is what can be reached: no field
side, no faults; no capture, no wire. It starts nothing and ends nothing but its own connections. Where no gateway of ours runs, a
scenario that is about probes only judges somebody else's controller, with the field side alone.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fieldtwin.conformance.case import Danger
from fieldtwin.running.capture_tail import CaptureTail
from fieldtwin.running.field_contact import connect_control, reachable
from fieldtwin.running.probes import Probes
from fieldtwin.running.shore import Shore
from fieldtwin.running.states import state_words
from fieldtwin.scenarios.bench import Can, Reading
from fieldtwin.scenarios.probe_form import Probe
from fieldtwin.scenarios.trace import FAR_END, Event, Kind, Trace
from gateway.core.clock import NS_PER_S
from gateway.core.control import ControlClient, RemoteError
from gateway.core.endpoint import Endpoint
from gateway.core.errors import FieldtwinError, Unreachable, UsageError
from gateway.core.image import OUTPUTS
from gateway.core.image_region import RegionReader
from gateway.core.nursery import Nursery
from gateway.core.started import Started
from gateway.wallclock import WallClock
from twin.physical import attached, image_layout
from twin.system import System

PLC_EVERY_S = 0.25
HELD_KEPT = 20_000
STALLS_KEPT = 10_000
SERVED_WITHIN_S = 5.0
TICK_SLACK_S = 0.005
"""A wait that ends so much later than asked for is what waits do."""


@dataclass(frozen=True)
class Where:
    """How a running system is reached: its run directory on this host; its field side, ``HOST[:PORT]`` with a token, or empty
    for the one in the run directory; its far end, where no field side says it; the file that its wires are captured to."""

    run_dir: Path
    field_host: str = ""
    token: str = field(default="", repr=False)
    far: str = ""
    capture: Path | None = None
    plant: bool = False
    """Nothing is emulated: no faults, nothing set, whatever else is there."""
    allowed: Danger = Danger.DISRUPT


class ControlBench(Started):
    """``async with ControlBench(system, where, trace, target="local", names=[...]) as bench``. `names` is what readings are asked
    for. `gone` tells why the system is not there any more, or None."""

    def __init__(
        self,
        system: System,
        where: Where,
        trace: Trace,
        *,
        target: str,
        names: Collection[str],
        probes: Sequence[Probe] = (),
        gone: Callable[[], FieldtwinError | None] = lambda: None,
    ) -> None:
        super().__init__()
        self.system = system
        self.trace = trace
        self.target = target
        self.allowed = where.allowed
        self.can: frozenset[Can] = frozenset()
        self._where = where
        self._names = list(names)
        self._gone = gone
        self._clock = WallClock()
        self._start_ns = self._clock.monotonic_ns()
        self._gateway: ControlClient | None = None
        self._plc: ControlClient | None = None
        self._field: ControlClient | None = None
        self._shore: Shore | None = None
        self._outputs: RegionReader | None = None
        self._tail: CaptureTail | None = None
        self._probe = probes
        self._probes: Probes | None = None
        self._tags: dict[str, list[Any]] = {}
        self._asked: list[str] = []
        self._seen_ns = 0
        self._since = 0
        self._updates: dict[str, int] = {}
        self._states: dict[str, Any] = {}
        self._words: dict[str, dict[int, str]] = {}
        self._plc_due_s = 0.0
        self._worst_us = -1.0
        self._overruns = -1
        self._late_ms = 0.0
        self._stalls: deque[tuple[float, float]] = deque(maxlen=STALLS_KEPT)
        self._held: dict[str, deque[tuple[float, bytes]]] = {}
        self._held_since: dict[str, int] = {}

    async def _start(self) -> None:
        where = self._where
        if not self._foreign():
            await self._open_controller()
        can = set()
        if not where.plant:
            await self._open_field()
            can |= {Can.INJECT_FAULT, Can.SET_VALUE, Can.SEE_HELD} if self._field is not None else set()
        nursery = await self._stack.enter_async_context(Nursery())
        far = Endpoint.parse(where.far) if where.far else await self._far_of_field()
        device = next((d.name for d in self.system.devices.values() if d.profile.inbox is not None), None)
        if far is not None and device is not None and where.allowed.rank >= Danger.WRITE.rank:
            self._shore = Shore(self.system, device, far, self._clock)
            self._shore.on_send = self._commanded
            nursery.start(self._shore.run([]), "far end")
            can.add(Can.SEND_COMMAND)
        if where.capture is not None:
            self._tail = CaptureTail(where.capture, self.system)
            self._stack.callback(self._tail.close)
            can.add(Can.SEE_WIRE)
        if self._probe:
            served = {probe.serve: await self._served(probe.serve) for probe in self._probe if probe.serve}
            self._probes = Probes(self._probe, self._clock, served.__getitem__)
            nursery.start(self._probes.run(), "probes")
            can.add(Can.PROBE)
        self.can = frozenset(can)
        self._start_ns = self._clock.monotonic_ns()
        await self._refresh()
        self._updates.clear()

    def _foreign(self) -> bool:
        """No gateway of ours is here, and nothing is asked of one."""
        probed = {name for probe in self._probe for name in probe.names}
        asked = any(probe.serve for probe in self._probe) or not probed.issuperset(self._names)
        return (
            bool(probed) and not asked and not self._where.plant and not (self._where.run_dir / "gateway.sock").exists()
        )

    async def _open_controller(self) -> None:
        where, layout = self._where, image_layout(self.system)
        self._gateway = await self._connect("gateway")
        self._plc = await self._connect("plc")
        known = set((await self._gateway.call("get"))["tags"])
        self._asked = [name for name in self._names if name in known]
        image = self._stack.enter_context(attached(layout, where.run_dir / "image"))
        self._outputs = image.reader(OUTPUTS)
        self._words = {f"{p}.state": w for p, w in state_words(layout, self.system.plc.programs).items()}

    async def _connect(self, name: str) -> ControlClient:
        client = await ControlClient.connect_unix(self._where.run_dir / f"{name}.sock")
        self._stack.push_async_callback(client.aclose)
        return client

    async def _open_field(self) -> None:
        if self._where.field_host:
            self._field, _ = await connect_control(self._where.field_host, self._where.token)
            self._stack.push_async_callback(self._field.aclose)
        elif (self._where.run_dir / "field.sock").exists():
            self._field = await self._connect("field")

    async def _served(self, name: str) -> Endpoint:
        """Where the gateway serves what the system file calls `name`, once it does."""
        assert self._gateway is not None
        until_s = self.now_s() + SERVED_WITHIN_S
        while not (listening := (await self._gateway.call("get"))["serve"][name]["listening"]):
            if self.now_s() > until_s:
                raise Unreachable(f"the gateway does not serve {name!r}")
            await asyncio.sleep(TICK_SLACK_S)
        return Endpoint.parse(listening)

    async def _far_of_field(self) -> Endpoint | None:
        if self._field is None:
            return None
        far = (await self._field.call("get"))["far"]
        host = self._where.field_host.rpartition(":")[0] or self._where.field_host or "localhost"
        return next((reachable(Endpoint.parse(url), host) for url in far.values()), None)

    # -- Bench ----------------------------------------------------------------------------------------------------------

    def now_s(self) -> float:
        return (self._clock.monotonic_ns() - self._start_ns) / NS_PER_S

    async def sleep_until_s(self, t_s: float) -> None:
        """Raises what the system is gone for."""
        before_s = self.now_s()
        await asyncio.sleep(max(0.0, t_s - before_s))
        asked_s = max(t_s, before_s)
        await self._refresh()
        late_s = self.now_s() - asked_s
        if late_s > TICK_SLACK_S:
            self._stalls.append((self.now_s(), late_s))

    def names(self) -> list[str]:
        return list(self._names)

    def reading(self, name: str) -> Reading | None:
        if self._probes is not None and name in self._probes.names:
            return self._probes.reading(name)
        if name in self._asked:
            value, quality, reason, t_ns = self._tags[name]
            if value is None and not self._updates.get(name):
                return None
            age_s = (self._seen_ns - t_ns) / NS_PER_S if t_ns else float("inf")
            return Reading(value, quality, reason.replace(" ", "_"), age_s, self._updates.get(name, 0))
        if name not in self._names:
            raise UsageError(f"no tag or variable {name!r}", expected="DEVICE.TAG or PROGRAM.VARIABLE")
        value = self._states.get(name)
        return None if value is None else Reading(value, "good", "", 0.0, 0)

    def late_ms(self) -> float:
        if self._plc is None:
            raise UsageError("nobody can tell how late the scans of somebody else's controller are", where="plc.late")
        return self._late_ms

    def host_late_s(self, since_s: float) -> float:
        return max((late_s for t_s, late_s in self._stalls if t_s >= since_s), default=0.0)

    async def send(self, period_s: int) -> None:
        if self._shore is None:
            raise UsageError("nobody can command this system", expected="a transmitter with a far end")
        self._shore.send(period_s)

    async def set_value(self, device: str, tag: str, value: float | str | bool | None) -> None:
        await self._to_field("set", device=device, tag=tag, value=value)

    async def inject(self, fault: dict[str, Any]) -> None:
        answer = await self._to_field("fault", fault=fault, start_ns=self._start_ns)
        target = fault.get("device") or fault.get("bus") or ""
        self._note(Kind.FAULT, answer["id"], {"name": fault["name"], "on": True, "target": target, "said": fault})

    async def clear(self, id: str) -> None:
        await self._to_field("clear", id=id)
        self._note(Kind.FAULT, id, {"name": "", "on": False, "target": ""})

    async def held(self, name: str) -> list[tuple[float, bytes]]:
        """Clocks are one on one host: `compose` is judged beside its containers."""
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

    async def _to_field(self, verb: str, **args: Any) -> Any:
        if self._field is None:
            raise UsageError("there is no emulated field", expected="a prototype")
        try:
            return await self._field.call(verb, **args)
        except RemoteError as e:
            if e.remote_exit_code == UsageError.exit_code:
                raise UsageError(str(e)) from e
            raise

    # -- what happens ---------------------------------------------------------------------------------------------------

    def _note(self, kind: Kind, where: str, data: dict[str, Any]) -> None:
        self.trace.note(round(self.now_s() * NS_PER_S), kind, where, data)

    def _commanded(self, period_s: int) -> None:
        self._note(Kind.NOTE, FAR_END, {"text": f"commands {period_s} s", "period_s": period_s})

    async def _refresh(self) -> None:
        gone = self._gone()
        if gone is not None:
            raise gone
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

    async def _changed_tags(self) -> list[Event]:
        if self._gateway is None:
            return []
        answer = await self._gateway.call("watch", since=self._since, names=self._asked)
        self._tags, self._seen_ns = answer["tags"], answer["now_ns"]
        events = []
        for number, t_ns, tag, value, quality, reason in answer["changes"]:
            self._since = number
            self._updates[tag] = self._updates.get(tag, 0) + 1
            data = {"value": value, "quality": quality, "reason": reason.replace(" ", "_")}
            events.append(Event(t_ns - self._start_ns, Kind.TAG, tag, data))
        return events

    def _changed_states(self) -> list[Event]:
        """What programs show, looked at now; between two looks a value may have been another one unseen."""
        if self._outputs is None:
            return []
        snapshot = self._outputs.snapshot()
        if not snapshot.counter:
            return []
        events = []
        for name, value in snapshot.all().items():
            shown: Any = value.value.hex() if isinstance(value.value, bytes) else value.value
            shown = self._words[name].get(shown, shown) if name in self._words else shown
            if name not in self._states or self._states[name] != shown:
                self._states[name] = shown
                events.append(Event(snapshot.t_ns - self._start_ns, Kind.STATE, name, {"value": shown}))
        return events

    async def _ask_plc(self) -> None:
        """How late scans were since the last question: a new maximum, or the limit that some overran."""
        assert self._plc is not None
        tasks = (await self._plc.call("get", brief=True))["tasks"].values()
        worst_us = max(task["lateness_us"]["max"] for task in tasks)
        overruns = sum(task["overruns"] for task in tasks)
        if self._overruns >= 0:
            limit_ms = float(self.system.plc.watchdog.late_ms) if overruns > self._overruns else 0.0
            self._late_ms = max(worst_us / 1000 if worst_us > self._worst_us else 0.0, limit_ms)
            if overruns > self._overruns:
                self._stalls.append((self.now_s(), max(self._late_ms, limit_ms) / 1000))
        self._worst_us, self._overruns = worst_us, overruns
        self._plc_due_s = self.now_s() + PLC_EVERY_S
