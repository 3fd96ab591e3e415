"""Run a network's scenario on the target `local`: all its systems as processes on this host, over their control channels."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from contextlib import AsyncExitStack
from pathlib import Path
from typing import cast

from fieldtwin.acoustic.bench import MemberTrace, NetworkBench, Part
from fieldtwin.acoustic.network import Network
from fieldtwin.acoustic.session import NetworkOptions, NetworkSession
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.results.model import ScenarioResult
from fieldtwin.results.trace import TOPSIDE, Trace, TraceKind
from fieldtwin.run.benches.control_bench import ControlBench, Where
from fieldtwin.scenarios.judging.runner import ScenarioRunner
from fieldtwin.scenarios.language.form import Scenario


async def run_network(scenario: Scenario, seed: int | None, trace: Trace) -> ScenarioResult:
    """Start the network, run the scenario, stop everything. Raises `FieldtwinError` for a part that has ended."""
    network = cast(Network, scenario.group)
    chosen = seed if seed is not None else scenario.form.seed
    options = NetworkOptions(f"test-{os.getpid()}", 0.0, chosen, scenario.profiles, cold=True, capture=True)
    session = NetworkSession(network, options)
    async with AsyncExitStack() as stack:
        kept = stack.enter_context(_Tidy())
        await stack.enter_async_context(session)
        kept.folders += [session.instance.dir, *(one.instance.dir for one in session.sessions.values())]
        bench = NetworkBench(network, trace, "local", session.faults)
        for name, one in session.sessions.items():
            notes = MemberTrace(trace, name, _later(bench, name))
            names = sorted(scenario.used | scenario.invariants.names)
            used = [local for member, local in map(network.split, names) if member == name]
            part = ControlBench(
                one.system,
                Where(one.instance.dir, capture=one.options.capture, own=True),
                notes,
                target="local",
                names=used,
                failure=one.failure,
            )
            await stack.enter_async_context(part)
            bench.parts[name] = Part(part, notes)
        if session.topside is not None:
            session.topside.on_send = _told(bench)
            bench.topside = session.topside
        return await ScenarioRunner(scenario, bench).run()


class _Tidy:
    """Removes the folders of a run at its end. If a part has failed, they are kept, because their logs contain the reason."""

    def __init__(self) -> None:
        self.folders: list[Path] = []

    def __enter__(self) -> _Tidy:
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        if kind is None or not issubclass(kind, FieldtwinError):
            for folder in self.folders:
                shutil.rmtree(folder, ignore_errors=True)


def _later(bench: NetworkBench, name: str) -> Callable[[], int]:
    """Return a function that returns the time in ns by which the bench of system `name` began later than the first one."""
    known: list[int] = []

    def later_ns() -> int:
        if not known:
            part = bench.parts.get(name)
            if part is None:
                return 0
            known.append(round((bench.now_s() - part.bench.now_s()) * NS_PER_S))
        return known[0]

    return later_ns


def _told(bench: NetworkBench) -> Callable[[int], None]:
    def commanded(period_s: int) -> None:
        data = {"text": f"commands {period_s} s", "period_s": period_s}
        bench.trace.note(bench.now_ns(), TraceKind.NOTE, TOPSIDE, data)

    return commanded
