"""Scenarios on every target: `virtual` in this thread, `local` as processes on this host, `compose` and `real` what runs already
or is started here. The scenario is the same; targets differ in what they can do and what may be done to them."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
from collections.abc import Callable
from contextlib import AsyncExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType

from fieldtwin.conformance.case import Danger
from fieldtwin.report.coverage import Collector
from fieldtwin.report.machines import machines_of
from fieldtwin.report.model import ScenarioResult, Verdict
from fieldtwin.running.control_bench import ControlBench, Where
from fieldtwin.running.network_local import run_network
from fieldtwin.running.options import RunOptions
from fieldtwin.running.session import RunSession
from fieldtwin.running.virtual_scenario import prototype_of, reproduce, run_virtual
from fieldtwin.scenarios.about import result_of
from fieldtwin.scenarios.bench import Can
from fieldtwin.scenarios.form import Scenario
from fieldtwin.scenarios.runner import Runner, refusal
from fieldtwin.scenarios.trace import Trace, open_sink
from gateway.core.errors import FieldtwinError
from gateway.wallclock import WallClock
from twin.instance import Instance, runtime_root

TARGETS = ("virtual", "local", "compose", "real")


@dataclass(frozen=True)
class Target:
    """Where scenarios run. `instance` of `compose` and `real`: one that runs on this host already; empty: `compose` takes the
    system's name, `real` starts the plant. `field_host`, `token`: the field side of `compose`. `far`: the far end of a plant.
    `capture`: the file that a running instance's wires are captured to. `allow`: what may be done to a plant. `can`: on `local`
    the interface that emulated CAN buses are on (`socketcan/vcan0`); empty: as the prototype file says."""

    name: str = "virtual"
    seed: int | None = None
    instance: str = ""
    field_host: str = "field"
    token: str = field(default="", repr=False)
    far: str = ""
    capture: Path | None = None
    allow: Danger = Danger.READ
    can: str = ""


def run_scenario(scenario: Scenario, target: Target, trace_file: Path | None = None) -> ScenarioResult:
    """Run it. What the target does not allow or cannot do is SKIPPED; a system that is gone is an ERROR with its reason."""
    if target.name == "virtual":
        return run_virtual(scenario, target.seed, trace_file)
    collector = Collector(scenario.system, machines_of(scenario.system))
    began_ns = WallClock().monotonic_ns()
    refused = _of_a_plant(scenario, target) if target.name == "real" else ""
    if scenario.network is not None and target.name != "local":
        refused = f"a network is a prototype, and the target {target.name} is none: each of its systems is a plant"
    elif scenario.network is not None and target.can:
        refused = "--can is of one system, and this is a network"
    sink = open_sink(trace_file) if trace_file is not None else None
    trace = Trace(sink=sink)
    trace.listen(collector.feed)
    try:
        if refused:  # then the plant is left alone
            result = result_of(scenario, target.name, Verdict.SKIPPED, reason=refused)
        else:
            result = asyncio.run(_run(scenario, target, trace))
    except asyncio.CancelledError:  # SIGTERM: everything went down in order
        raise KeyboardInterrupt from None
    except FieldtwinError as e:
        result = result_of(scenario, target.name, Verdict.ERROR, reason=str(e), trace=tuple(trace.events))
    finally:
        trace.close()
    return replace(
        result,
        seed=target.seed if target.seed is not None else scenario.form.seed,
        reproduce=reproduce(scenario, *_words(target)),
        took_s=(WallClock().monotonic_ns() - began_ns) / 1e9,
        counts=collector.finish(),
        trace_hash="",  # no two runs on a clock have the same
    )


def _of_a_plant(scenario: Scenario, target: Target) -> str:
    """What is clear before anything of a plant is touched."""
    can = {Can.PROBE}
    if target.far:
        can.add(Can.SEND_COMMAND)
    if target.capture or not target.instance:
        can.add(Can.SEE_WIRE)
    return refusal(scenario, target.name, can, target.allow)


def _words(target: Target) -> list[str]:
    """How the command line says it; never a token."""
    words = ["--target", target.name]
    said = {
        "--seed": "" if target.seed is None else str(target.seed),
        "--instance": target.instance,
        "--field": target.field_host if target.field_host != Target.field_host else "",
        "--far": target.far,
        "--capture": str(target.capture or ""),
        "--can": target.can,
        "--allow": target.allow.value if target.name == "real" and target.allow is not Target.allow else "",
    }
    return words + [word for option, value in said.items() if value for word in (option, value)]


async def _run(scenario: Scenario, target: Target, trace: Trace) -> ScenarioResult:
    me = asyncio.current_task()
    assert me is not None
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, me.cancel)
    if scenario.network is not None:
        return await run_network(scenario, target.seed, trace)
    async with AsyncExitStack() as stack:
        gone: Callable[[], FieldtwinError | None] = lambda: None  # noqa: E731
        if target.name == "compose" or target.instance:
            where = _running(scenario, target)
        else:
            session = _session(scenario, target)
            own = session.instance.dir

            def tidy(kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
                if kind is None or not issubclass(kind, FieldtwinError):  # else its logs are what tells why
                    shutil.rmtree(own, ignore_errors=True)

            stack.push(tidy)
            await stack.enter_async_context(session)
            where = Where(
                own,
                far=target.far,
                capture=session.options.capture,
                plant=target.name == "real",
                allowed=target.allow if target.name == "real" else Danger.DISRUPT,
            )

            def gone() -> FieldtwinError | None:
                return next((failed for child in session.children.values() if (failed := child.failure())), None)

        bench = ControlBench(
            scenario.system,
            where,
            trace,
            target=target.name,
            names=sorted(scenario.used),
            probes=scenario.probes,
            gone=gone,
        )
        async with bench:
            return await Runner(scenario, bench).run()


def _session(scenario: Scenario, target: Target) -> RunSession:
    """The system, brought up for this scenario."""
    name = f"test-{os.getpid()}"
    seed = target.seed if target.seed is not None else scenario.form.seed
    plant = target.name == "real"
    options = RunOptions(
        system=str(scenario.system.path),
        prototype=not plant,
        allow_writes=plant and target.allow.rank >= Danger.WRITE.rank,
        instance=name,
        profiles=scenario.profiles,
        prototype_file=prototype_of(scenario),
        capture=Instance(name).dir / "capture.jsonl",
        cold=True,
        seed=None if plant else seed,
        can="" if plant else target.can,
    )
    return RunSession(options)


def _running(scenario: Scenario, target: Target) -> Where:
    """One that runs already, under its name on this host (in its container, for `compose`)."""
    plant = target.name == "real"
    return Where(
        runtime_root() / (target.instance or scenario.system.name),
        field_host="" if plant else target.field_host,
        token=target.token,
        far=target.far,
        capture=target.capture,
        plant=plant,
        allowed=target.allow if plant else Danger.DISRUPT,
    )
