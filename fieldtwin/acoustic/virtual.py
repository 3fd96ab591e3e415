"""A network in virtual time: the prototypes of all its systems in one loop, with the acoustic channel and one seed.

Each system behaves as it does alone (`VirtualBench`); the systems affect each other only through their modems.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from fieldtwin.acoustic.bench import MemberTrace, NetworkBench, Part
from fieldtwin.acoustic.faults import AcousticFaults
from fieldtwin.acoustic.network import Network
from fieldtwin.acoustic.ship import TopsideModem
from fieldtwin.emulators.endpoints.memory_ports import MemoryNet
from fieldtwin.emulators.models.modbus.acoustic_link import AcousticLink
from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.gateway.core.concurrency.async_resource import AsyncResource
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.results.trace import TOPSIDE, Trace, TraceKind
from fieldtwin.run.benches.virtual_bench import VirtualBench
from fieldtwin.run.processes.topside import Scripted, TopsideController

SEEDS_APART = 1_000_003
"""The difference between the seeds of two systems of a run, so that no system repeats the random numbers of another one."""


class VirtualNetwork(AsyncResource):
    """A network in virtual time: ``async with VirtualNetwork(network, loop, folder, trace, seed=7) as it``, inside `loop`.

    `it.bench` is a scenario's bench. The audit log of each system is written to `folder`. `commands` are those that the topside
    modem sends without a scenario; a scenario sends commands with `send` instead.
    """

    def __init__(
        self,
        network: Network,
        loop: VirtualLoop,
        folder: Path,
        trace: Trace,
        *,
        seed: int,
        commands: Sequence[Scripted] = (),
    ) -> None:
        super().__init__()
        self.network = network
        self.trace = trace
        self.faults = AcousticFaults(network.places, seed)
        self.medium = network.medium(seed, self.faults.spoils)
        self.bench = NetworkBench(network, trace, "virtual", self.faults)
        self.systems: dict[str, VirtualBench] = {}
        self._loop = loop
        self._folder = folder
        self._seed = seed
        self._commands = list(commands)

    async def _start(self) -> None:
        for number, (name, member) in enumerate(self.network.members.items()):
            folder = self._folder / name
            folder.mkdir()
            notes = MemberTrace(self.trace, name, self._later(name))
            seed = member.prototype.seed + SEEDS_APART * self._seed + number
            bench = VirtualBench(
                member.system,
                replace(member.prototype, seed=seed),
                self._loop,
                folder,
                notes,
                has_topside=False,
                water={member.modem: AcousticLink(self.medium, name)},
            )
            self.systems[name] = bench
            await self._stack.enter_async_context(bench)
            self.bench.parts[name] = Part(bench, notes)
        self.faults.start_ns = next(iter(self.systems.values())).run.started_ns
        if self.network.ship is not None:
            await self._board()

    @property
    def topside(self) -> TopsideController | None:
        return self.bench.topside

    def results(self) -> dict[str, Any]:
        """Return the counters of the acoustic channel, its faults, and the commands and responses of the topside modem."""
        return {
            "water": {name: counters.as_dict() for name, counters in self.medium.counters.items()},
            "faults": msgspec.to_builtins(self.faults.history.struck()),
            "ship": self.bench.topside.describe() if self.bench.topside is not None else None,
        }

    def _later(self, name: str) -> Callable[[], int]:
        """Return a function that returns the time in ns by which the system `name` began later than the first one."""
        return lambda: self.systems[name].run.started_ns - next(iter(self.systems.values())).run.started_ns

    async def _board(self) -> None:
        """Open the topside modem and create its controller."""
        clock, net = VirtualClock(self._loop), MemoryNet(self._loop)
        ship = TopsideModem(self.network, self.medium, clock)
        endpoint = await ship.open(net)
        self._stack.push_async_callback(ship.aclose)
        self.bench.topside = topside = TopsideController(ship.like.system, ship.like.modem, endpoint, clock, net)
        topside.on_send = self._commanded
        nursery = await self._stack.enter_async_context(Nursery())
        nursery.start(topside.run(self._commands), "ship")

    def _commanded(self, period_s: int) -> None:
        data = {"text": f"commands {period_s} s", "period_s": period_s}
        self.trace.note(self.bench.now_ns(), TraceKind.NOTE, TOPSIDE, data)
