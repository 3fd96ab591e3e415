"""A scenario's bench for several running systems and the acoustic channel between them. Names are ``SYSTEM.DEVICE.TAG``.

Each system has its own bench, which is independent of the other systems; this bench forwards each query to the system that the
name begins with, and merges the events of all systems into one trace. The code that creates this bench also starts and stops the
systems.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from fieldtwin.acoustic.faults import AcousticFaults
from fieldtwin.acoustic.network import Network
from fieldtwin.acoustic.schema import WATER
from fieldtwin.conformance.core.case import Impact
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.results.fault_counts import struck_of
from fieldtwin.results.model import Struck
from fieldtwin.results.trace import Trace, TraceKind
from fieldtwin.run.processes.topside import TopsideController
from fieldtwin.scenarios.bench import Bench, Can, Stopped, TagReading


class MemberTrace(Trace):
    """The events of one system's bench, which are prefixed with the system's name and added to the common trace.

    `later_ns` returns the time by which this system started later than the first one.
    """

    def __init__(self, whole: Trace, member: str, later_ns: Callable[[], int]) -> None:
        super().__init__(0)
        self._later_ns = later_ns
        self._whole = whole
        self._prefix = f"{member}."

    @property
    def offset_ns(self) -> int:
        return self._later_ns()

    def note(self, t_ns: int, kind: TraceKind, where: str, data: dict[str, Any]) -> None:
        if kind is TraceKind.FAULT:
            if data.get("target"):
                data = {**data, "target": self._prefix + data["target"]}
        else:
            self.notify(t_ns, kind, where, data)
            where = self._prefix + where
        self._whole.note(t_ns + self.offset_ns, kind, where, data)


@dataclass
class Part:
    """One system of the network: its bench, and the trace in which that bench records its events."""

    bench: Bench
    trace: MemberTrace


class NetworkBench:
    """A bench for a network of systems; it implements `fieldtwin.scenarios.bench.Bench`.

    `parts` maps the name of each member of the network to its part; `topside` sends commands
    through the topside modem.
    """

    def __init__(self, network: Network, trace: Trace, target: str, faults: AcousticFaults) -> None:
        self.network = network
        self.trace = trace
        self.target = target
        self.allowed = Impact.DISRUPT
        self.parts: dict[str, Part] = {}
        self.topside: TopsideController | None = None
        self.faults = faults
        self._where: dict[str, str] = {}
        """By fault ID: the system into which the fault was injected, or the acoustic channel."""

    @property
    def can(self) -> frozenset[Can]:
        """Return the abilities that all parts have, except probes; sending commands only if the network has a topside modem."""
        can = frozenset.intersection(*(part.bench.can for part in self.parts.values())) - {Can.SEND_COMMAND, Can.PROBE}
        return can | ({Can.SEND_COMMAND} if self.topside is not None else frozenset())

    def _part(self, name: str) -> tuple[Part, str]:
        member, local = self.network.split(name)
        return self.parts[member], local

    def now_ns(self) -> int:
        """Return the time in ns since the start of the first system."""
        return round(self.now_s() * NS_PER_S)

    # -- Bench ----------------------------------------------------------------------------------------------------------

    def now_s(self) -> float:
        """Return the time in seconds since the start of the first system, which began before the others."""
        return next(iter(self.parts.values())).bench.now_s()

    async def sleep_until_s(self, t_s: float) -> None:
        for part in self.parts.values():  # the first call waits, and the other calls return immediately
            await part.bench.sleep_until_s(t_s - part.trace.offset_ns / NS_PER_S)

    def names(self) -> list[str]:
        return [f"{member}.{name}" for member, part in self.parts.items() for name in part.bench.names()]

    def reading(self, name: str) -> TagReading | None:
        part, local = self._part(name)
        return part.bench.reading(local)

    def why_unknown(self, name: str) -> str:
        part, local = self._part(name)
        return part.bench.why_unknown(local)

    def stopped(self) -> Stopped | None:
        for member, part in self.parts.items():
            if (stopped := part.bench.stopped()) is not None:
                return replace(stopped, what=f"{member}: {stopped.what}")
        return None

    def not_started(self) -> str:
        told = {member: part.bench.not_started() for member, part in self.parts.items()}
        return "; ".join(f"{member}: {text}" for member, text in told.items() if text)

    def late_ms(self) -> float:
        return max(part.bench.late_ms() for part in self.parts.values())

    def host_late_s(self, since_s: float) -> float:
        return max(part.bench.host_late_s(since_s - part.trace.offset_ns / NS_PER_S) for part in self.parts.values())

    def host_late_total_s(self, since_s: float) -> tuple[float, float]:
        """Return the lateness of the first system's bench (see `Bench.host_late_total_s`), because only that bench waits.
        It waits for all systems.
        """
        told = [p.bench.host_late_total_s(since_s - p.trace.offset_ns / NS_PER_S) for p in self.parts.values()]
        return told[0][0], max(any_s for _, any_s in told)

    async def send(self, period_s: int) -> None:
        if self.topside is None:
            raise UsageError("this network cannot be commanded", expected="`ship:` in its file")
        self.topside.send(period_s)

    async def set_value(self, device: str, tag: str, value: float | str | bool | None) -> None:
        part, local = self._part(device)
        await part.bench.set_value(local, tag, value)

    async def acknowledge(self, alarm: str) -> None:
        part, local = self._part(alarm)
        await part.bench.acknowledge(local)

    async def inject(self, fault: dict[str, Any]) -> None:
        where, local = self.network.place_of(fault)
        if where == WATER:
            id = self.faults.inject(fault)
            self._where[id] = WATER
            target = f"{WATER} {fault.get('device', '')}".strip()
            self.trace.note(
                self.now_ns(), TraceKind.FAULT, id, {"name": fault["name"], "on": True, "target": target, "said": fault}
            )
            return
        await self.parts[where].bench.inject(local)
        self._where[str(fault["id"])] = where

    async def struck(self) -> list[Struck]:
        found = [struck_of(one) for one in self.faults.history.struck()]
        for member, part in self.parts.items():
            found += [replace(one, on=f"{member}.{one.on}") for one in await part.bench.struck()]
        return found

    async def failures(self) -> dict[str, str]:
        found: dict[str, str] = {}
        for member, part in self.parts.items():
            found |= {f"{member}.{device}": why for device, why in (await part.bench.failures()).items()}
        return found

    async def clear(self, id: str) -> None:
        where = self._where.pop(id, None)
        if where is None:
            raise UsageError(
                f"no fault {id!r} is active", expected=", ".join(self._where) or "an active fault; none is active"
            )
        if where == WATER:
            self.faults.clear(id)
            self.trace.note(self.now_ns(), TraceKind.FAULT, id, {"name": "", "on": False, "target": ""})
        else:
            await self.parts[where].bench.clear(id)

    async def held(self, name: str) -> list[tuple[float, bytes]]:
        part, local = self._part(name)
        offset_s = part.trace.offset_ns / NS_PER_S
        return [(t_s + offset_s, raw) for t_s, raw in await part.bench.held(local)]
