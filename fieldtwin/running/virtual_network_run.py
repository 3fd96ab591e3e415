"""A run of a network in virtual time: ``fieldtwin run NETWORK --prototype --virtual --for 1h``.

Each system is judged as it is alone (`VirtualRun`): what was published against what its devices held, what both sides counted.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from emulators.virtual.loop import VirtualLoop
from fieldtwin.running.driven import TRACE_KEPT, drive
from fieldtwin.running.network_summary import summarise_network
from fieldtwin.running.shore import Scripted
from fieldtwin.running.virtual_network import VirtualNetwork
from fieldtwin.running.virtual_run import PIECE_S, VirtualOptions, VirtualRun
from fieldtwin.scenarios.trace import Trace
from gateway.core.errors import FieldtwinError
from twin.network import Network


@dataclass(frozen=True)
class VirtualNetworkOptions:
    """What to run, and for how long. `trace` is a file for every event."""

    duration_s: float
    seed: int | None = None
    profiles: tuple[Path, ...] = ()
    commands: tuple[Scripted, ...] = ()
    trace: Path | None = None


class VirtualNetworkRun:
    """One run. `summary()` afterwards."""

    def __init__(self, network: Network, options: VirtualNetworkOptions) -> None:
        self.network = network
        self.options = options
        self.seed = network.seed if options.seed is None else options.seed
        self.elapsed_s = 0.0
        self.trace = Trace(TRACE_KEPT)
        self.runs = {
            name: VirtualRun(
                VirtualOptions(
                    str(member.system.path),
                    options.duration_s,
                    profiles=options.profiles,
                    prototype_file=member.prototype.path,
                )
            )
            for name, member in network.members.items()
        }
        self.errors: list[str] = []
        self.water: dict[str, dict[str, int]] = {}
        self.ship: dict[str, Any] | None = None

    def run(self, progress: Callable[[float], None] | None = None) -> None:
        """Run it. `progress` is told the virtual seconds that are over, from time to time. Errors are kept in `errors`."""
        between = None if progress is None else lambda: progress(self.elapsed_s)
        drive(self._begin, self._end, trace=self.options.trace, between=between)

    def _begin(self, loop: VirtualLoop, folder: Path, trace: Trace) -> Coroutine[Any, Any, None]:
        self.trace = trace
        return self._main(loop, folder)

    def _end(self, main: asyncio.Task[None], loop: VirtualLoop) -> None:
        error = None if main.cancelled() else main.exception()
        if isinstance(error, FieldtwinError):
            self.errors.append(str(error))
        elif error is not None:
            raise error
        self.errors += [f"nobody caught: {context.get('message')}" for context in loop.unhandled[:100]]

    async def _main(self, loop: VirtualLoop, folder: Path) -> None:
        o = self.options
        whole = VirtualNetwork(self.network, loop, folder, self.trace, seed=self.seed, commands=list(o.commands))
        async with whole:
            for name, run in self.runs.items():
                run.attach(whole.systems[name])
            while (left_s := o.duration_s - whole.bench.now_s()) > 0:
                await whole.bench.sleep_until_s(whole.bench.now_s() + min(left_s, PIECE_S))
                self.elapsed_s = whole.bench.now_s()
                for name, run in self.runs.items():
                    run.judge(whole.systems[name])
                loop.stop()  # the world is looked at
                await asyncio.sleep(0)
            if whole.bench.shore is not None:
                await whole.bench.shore.halt()
                self.ship = whole.bench.shore.describe()
            for name, run in self.runs.items():
                await run.finish(whole.systems[name])
            self.water = {name: counters.as_dict() for name, counters in whole.medium.counters.items()}

    def summary(self) -> dict[str, Any]:
        """Nothing in it depends on how fast it was."""
        systems = {name: run.summary() for name, run in self.runs.items()}
        for one in systems.values():
            for key in ("seed", "trace", "virtual"):
                del one[key]
        return {
            **summarise_network(self.network, systems, self.water, self.ship, self.errors),
            "duration_s": round(self.elapsed_s, 3),
            "virtual": True,
            "seed": self.seed,
            "trace": {"events": self.trace.count, "sha256": self.trace.hexdigest()},
        }
