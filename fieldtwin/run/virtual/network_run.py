"""A run of a network in virtual time: ``fieldtwin run NETWORK --prototype --virtual --for 1h``.

Each system is checked as it is alone (`VirtualRun`): published values against those that its devices held, and the
counters of both sides.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.run.live.network_summary import summarise_network
from fieldtwin.run.processes.topside import Scripted
from fieldtwin.run.virtual.driven import DrivenRun
from fieldtwin.run.virtual.fault_schedule import RandomFaults, random_network_schedule
from fieldtwin.run.virtual.network import VirtualNetwork
from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun
from fieldtwin.twin.network.faults import placed_all
from fieldtwin.twin.network.network import load_network


@dataclass(frozen=True)
class VirtualNetworkOptions:
    """The system to run and the duration of the run.

    `system` is the network's file; `faults` are injected in addition; `trace` is a file for every event.
    """

    system: str
    duration_s: float
    seed: int | None = None
    profiles: tuple[Path, ...] = ()
    commands: tuple[Scripted, ...] = ()
    faults: tuple[dict[str, Any], ...] = ()
    random_faults: RandomFaults | None = None
    """The random faults that the seed chooses, in addition to `faults`."""
    trace: Path | None = None

    def make(self) -> VirtualNetworkRun:
        """Return the run of these options."""
        return VirtualNetworkRun(self)


class VirtualNetworkRun(DrivenRun):
    """One run. `summary()` afterwards."""

    def __init__(self, options: VirtualNetworkOptions) -> None:
        self.network = network = load_network(Path(options.system), options.profiles)
        self.options = options
        super().__init__(network.seed if options.seed is None else options.seed, options.duration_s, options.trace)
        self.water_faults: list[dict[str, Any]] = []
        self.faults = options.faults
        if options.random_faults is not None:
            options.random_faults.check(network.whole, network)
            self.faults += random_network_schedule(network, self.seed, options.duration_s, options.random_faults)
        faults = placed_all(network, self.faults)
        self.runs = {
            name: VirtualRun(
                VirtualOptions(
                    str(member.system.path),
                    options.duration_s,
                    profiles=options.profiles,
                    prototype_file=member.prototype.path,
                    faults=faults.get(name, ()),
                )
            )
            for name, member in network.members.items()
        }
        self.water: dict[str, dict[str, int]] = {}
        self.ship: dict[str, Any] | None = None

    @property
    def scripted(self) -> list[tuple[float, int]]:
        """The times (s) and periods of the topside modem's commands; empty in a network without one."""
        return [(one.at_s, one.period_s) for one in self.options.commands] if self.network.ship is not None else []

    @property
    def files(self) -> tuple[str, ...]:
        return self.network.path.read_text(encoding="utf-8"), *(
            text for run in self.runs.values() for text in run.files
        )

    async def _main(self, loop: VirtualLoop, folder: Path) -> None:
        commands = list(self.options.commands)
        whole = VirtualNetwork(self.network, loop, folder, self.trace, seed=self.seed, commands=commands)
        async with whole:
            for name, run in self.runs.items():
                run.attach(whole.systems[name])
            self._judged = True
            for fault in self.faults:  # each has its own start time
                await whole.bench.inject(fault)
            async with Nursery() as nursery:
                for name, run in self.runs.items():
                    run.watch_invariants(whole.systems[name], nursery)
                await self._through(whole.bench, loop, lambda: self._judge(whole))
            if whole.bench.shore is not None:
                await whole.bench.shore.halt()
                self.ship = whole.bench.shore.describe()
            for name, run in self.runs.items():
                await run.finish(whole.systems[name])
            self.water = {name: counters.as_dict() for name, counters in whole.medium.counters.items()}
            self.water_faults = whole.faults.history.describe()

    def _judge(self, whole: VirtualNetwork) -> None:
        for name, run in self.runs.items():
            run.judge(whole.systems[name])

    def summary(self) -> dict[str, Any]:
        systems = {name: run.summary() for name, run in self.runs.items()}
        for one in systems.values():
            for key in ("seed", "trace", "virtual"):
                del one[key]
        return {
            **summarise_network(self.network, systems, self.water, self.ship, self.errors, self.water_faults),
            "duration_s": round(self.elapsed_s, 3),
            "virtual": True,
            "seed": self.seed,
            "trace": {"events": self.trace.count, "sha256": self.trace.hexdigest()},
        }
