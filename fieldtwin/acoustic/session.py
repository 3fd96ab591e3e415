"""A network on this host: each system runs as its own processes on ptys and sockets, the acoustic channel in this process.

Start order: the acoustic channel, the topside modem, then all systems at the same time. The end of one system does not
end the others.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from fieldtwin.acoustic.faults import AcousticFaults
from fieldtwin.acoustic.network import Network
from fieldtwin.acoustic.schema import WATER
from fieldtwin.acoustic.ship import TopsideModem
from fieldtwin.emulators.endpoints.acoustic_end import AcousticServer
from fieldtwin.emulators.endpoints.ports import OsPorts
from fieldtwin.gateway.core.concurrency.async_resource import AsyncResource
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.run.live.options import RunOptions
from fieldtwin.run.live.session import RunSession
from fieldtwin.run.processes.topside import Scripted, TopsideController
from fieldtwin.twin.plant.instance import Instance


@dataclass(frozen=True)
class NetworkOptions:
    """The options of a network run.

    `instance` is the name of the run; the run of each system is named INSTANCE-SYSTEM. With `duration_s` 0 the network runs until
    it is stopped.
    """

    instance: str = ""
    duration_s: float = 0.0
    seed: int | None = None
    profiles: tuple[Path, ...] = ()
    cold: bool = False
    capture: bool = False
    """Whether each system's bus traffic is written to ``capture.jsonl`` in its run directory."""
    commands: Sequence[Scripted] = ()
    faults: tuple[dict[str, Any], ...] = ()
    """The faults of the systems and of the acoustic channel. Their targets are names of the network, such as SYSTEM.DEVICE."""
    thread: str = ""
    """The address on which each system's digital thread listens, at a free port. Empty if there is to be no digital thread."""


class NetworkSession(AsyncResource):
    """A run of a network. Use it as ``async with NetworkSession(network, options) as session: await session.wait()``. `sessions`
    maps the name of each member to its run.
    """

    def __init__(self, network: Network, options: NetworkOptions) -> None:
        super().__init__()
        self.network = network
        self.options = options
        self.seed = network.seed if options.seed is None else options.seed
        self.clock = WallClock()
        self.faults = AcousticFaults(network.places, self.seed)
        self.medium = network.medium(self.seed, self.faults.spoils)
        self.instance = Instance(options.instance or network.name)
        self.sessions: dict[str, RunSession] = {}
        self.topside: TopsideController | None = None
        self.ship: Endpoint | None = None
        self.stopped = asyncio.Event()
        self.started_ns = 0
        self._faults = network.place(options.faults)
        self._nursery = Nursery()

    async def _start(self) -> None:
        self._stack.enter_context(self.instance)
        server, socket = AcousticServer(self.medium, self.clock), self.instance.path("water.sock")
        await server.open(socket)
        self._stack.push_async_callback(server.aclose)
        await self._stack.enter_async_context(self._nursery)
        self._nursery.start(server.run(), "water")
        if self.network.ship is not None:
            ship = TopsideModem(self.network, self.medium, self.clock)
            self.ship = await ship.open(OsPorts())
            self._stack.push_async_callback(ship.aclose)
        await self._start_systems(socket)
        self.started_ns = self.faults.start_ns = self.clock.monotonic_ns()
        for fault in self._faults.get(WATER, ()):  # each has its own start time
            self.faults.inject(fault)
        if self.ship is not None:
            like = next(iter(self.network.members.values()))
            self.topside = TopsideController(like.system, like.modem, self.ship, self.clock)
            self._nursery.start(self.topside.run(list(self.options.commands)), "ship")

    async def _stop(self) -> None:
        if self.topside is not None:
            await self.topside.halt()

    async def _start_systems(self, socket: Path) -> None:
        """Start all systems at the same time. If one fails to start, the others are stopped with the rest."""
        self.sessions = {
            name: RunSession(self._of(number, name, socket)) for number, name in enumerate(self.network.members)
        }
        ended = await asyncio.gather(*map(self._start_one, self.sessions.values()), return_exceptions=True)
        for result in ended:
            if result is not None:
                raise result

    async def _start_one(self, session: RunSession) -> None:
        await session.__aenter__()
        self._stack.push_async_exit(session)

    def _of(self, number: int, name: str, socket: Path) -> RunOptions:
        member, instance = self.network.members[name], f"{self.instance.name}-{name}"
        return RunOptions(
            system=str(member.system.path),
            prototype=True,
            instance=instance,
            profiles=self.options.profiles,
            prototype_file=member.prototype.path,
            capture=Instance(instance).dir / "capture.jsonl" if self.options.capture else None,
            cold=self.options.cold,
            seed=member.prototype.seed + 1_000_003 * self.seed + number,
            thread=self.options.thread,
            faults=self._faults.get(name, ()),
            water={member.modem: (str(socket), name)},
        )

    @property
    def elapsed_s(self) -> float:
        return (self.clock.monotonic_ns() - self.started_ns) / 1e9

    def results(self) -> dict[str, Any]:
        """Return the counters of the acoustic channel, its faults, and the commands and responses of the topside modem."""
        ship = self.topside.describe() if self.topside is not None else None
        return {"water": self.counters(), "faults": msgspec.to_builtins(self.faults.history.struck()), "ship": ship}

    def counters(self) -> dict[str, dict[str, int]]:
        """Return the counters of each modem in the acoustic channel."""
        return {name: counters.as_dict() for name, counters in self.medium.counters.items()}

    async def wait(self) -> None:
        """Wait until the duration is over, `stopped` is set, or a part in this process fails."""
        waiting = self._nursery.start(self.stopped.wait(), "until stopped")
        done = asyncio.ensure_future(self._nursery.wait())
        try:
            await asyncio.wait(
                [waiting, done], timeout=self.options.duration_s or None, return_when=asyncio.FIRST_COMPLETED
            )
            if done.done():
                done.result()
        finally:
            done.cancel()
