"""Run scenarios on every target.

`virtual` runs in this thread, `local` as processes on this host, `compose` and `real` use a running system or start one
here. The scenario is the same; targets differ in their abilities and in what is allowed on them.
"""

from __future__ import annotations

import asyncio
import os
import shlex
import shutil
import signal
from contextlib import AsyncExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType

from fieldtwin.conformance.core.case import Impact
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.reports.run.coverage import Collector
from fieldtwin.reports.run.machines import machines_of
from fieldtwin.results.model import ScenarioResult, Verdict
from fieldtwin.results.trace import Trace, open_sink
from fieldtwin.results.trace_about import TraceAbout, write_results
from fieldtwin.run.benches.control_bench import ControlBench, Where
from fieldtwin.run.live.options import RunOptions
from fieldtwin.run.live.session import RunSession
from fieldtwin.run.processes.children import Failure
from fieldtwin.run.processes.field_found import find_field
from fieldtwin.run.processes.with_controller import WithController
from fieldtwin.run.targets.progress import Progress
from fieldtwin.run.targets.virtual_scenario import prototype_of, reproduce, run_virtual
from fieldtwin.run.virtual.group_kinds import kind_named
from fieldtwin.run.virtual.trace_description import begin_bare_description, described_checks
from fieldtwin.scenarios.bench import Can, NothingKnown
from fieldtwin.scenarios.judging.runner import ScenarioRunner, gone
from fieldtwin.scenarios.judging.target_limits import refusal
from fieldtwin.scenarios.language.about import result_of
from fieldtwin.scenarios.language.form import Scenario
from fieldtwin.twin.plant.instance import Instance, runtime_root
from fieldtwin.twin.prototype.field_process import FieldConfig


@dataclass(frozen=True)
class ScenarioTarget:
    """The target of a scenario.

    `instance` of `compose` and `real`: one that runs on this host already; empty: `compose` takes the system's name,
    `real` starts the plant. `field_host`, `token`: the field simulator of `compose`. `far`: the topside modem of a plant.
    `capture`: the capture file of a running instance. `allow`: the highest impact level on a plant. `can`: on `local` the
    interface of emulated CAN buses (`socketcan/vcan0`); empty: the interface in the prototype file. `controller`: on `local`
    the user's program and its arguments, which replaces fieldtwin's gateway and PLC. `variables` of programs are in the trace of
    `virtual`.
    """

    name: str = "virtual"
    seed: int | None = None
    instance: str = ""
    field_host: str = ""
    token: str = field(default="", repr=False)
    far: str = ""
    capture: Path | None = None
    allow: Impact = Impact.READ
    can: str = ""
    controller: tuple[str, ...] = ()
    variables: tuple[str, ...] = ()


def run_scenario(
    scenario: Scenario,
    target: ScenarioTarget,
    trace_file: Path | None = None,
    retries: int = 0,
    progress: Progress | None = None,
) -> ScenarioResult:
    """Run the scenario, and repeat it at most `retries` times while it is INCONCLUSIVE; the first other verdict counts.

    In virtual time there is one attempt only, because all attempts would be equal.
    """
    earlier: list[str] = []
    while True:
        result = _attempt(scenario, target, trace_file, progress)
        if progress is not None:
            progress.end(result)
        if result.verdict is not Verdict.INCONCLUSIVE or len(earlier) >= retries or target.name == "virtual":
            return replace(result, earlier=tuple(earlier))
        earlier.append(result.why)


def _attempt(
    scenario: Scenario, target: ScenarioTarget, trace_file: Path | None, progress: Progress | None
) -> ScenarioResult:
    """Run the scenario once.

    A scenario that the target does not allow or cannot run is SKIPPED; a lost system is an ERROR with its reason.
    """
    if target.name == "virtual":
        return run_virtual(scenario, target.seed, trace_file, progress=progress, variables=target.variables)
    collector = Collector(scenario.system, machines_of(scenario.system))
    began_ns = WallClock().monotonic_ns()
    refused = _of_a_plant(scenario, target) if target.name == "real" else ""
    if scenario.group is not None and (reason := _of_a_group(scenario.group.kind, target)):
        refused = reason
    elif target.controller:
        refused = _of_a_foreign_controller(scenario)
    sink = open_sink(trace_file) if trace_file is not None else None
    trace = Trace(sink=sink)
    seed = target.seed if target.seed is not None else scenario.form.seed
    about: TraceAbout | None = None
    if trace_file is not None and not refused:
        about = begin_bare_description(
            trace_file,
            scenario.system,
            target=target.name,
            seed=seed,
            profiles=scenario.profiles,
            title=scenario.form.scenario,
        )
    trace.listen(collector.feed)
    if progress is not None:
        progress.begin(scenario, target.name, trace)
    try:
        if refused:  # nothing is sent to the plant
            result = result_of(scenario, target.name, Verdict.SKIPPED, reason=refused)
        else:
            result = asyncio.run(_run(scenario, target, trace))
    except asyncio.CancelledError:  # SIGTERM: everything has stopped in order
        raise KeyboardInterrupt from None
    except NothingKnown as e:  # the host was late, or another test interfered
        result = result_of(scenario, target.name, Verdict.INCONCLUSIVE, reason=str(e), trace=tuple(trace.events))
    except FieldtwinError as e:
        events = tuple(trace.events)
        checks = (gone(e, events[-1].t_ns if events else 0),)
        result = result_of(scenario, target.name, Verdict.ERROR, checks=checks, reason=str(e), trace=events)
    finally:
        trace.close()
    if trace_file is not None:
        checks_of = described_checks(result.checks)
        write_results(trace_file, about, verdict=result.verdict.value, reason=result.reason, checks=checks_of)
    return replace(
        result,
        seed=seed,
        trace_file="" if about is None else str(trace_file),
        reproduce=reproduce(scenario, *_words(target)) + _with_words(target),
        took_s=(WallClock().monotonic_ns() - began_ns) / 1e9,
        counts=collector.finish(),
        trace_hash="",  # two runs in real time never have the same trace
    )


def _of_a_group(kind: str, target: ScenarioTarget) -> str:
    """Return the reason why the target cannot run a scenario of several systems (`kind` of their file); empty if it can."""
    if target.name != "local":
        return f"a {kind} runs as prototypes, on --target virtual or local only, not on {target.name}"
    if target.can:
        return f"--can needs a single system, and this is a {kind}"
    return (
        f"a {kind} has a controller in each of its systems, and --with starts one program" if target.controller else ""
    )


def _of_a_plant(scenario: Scenario, target: ScenarioTarget) -> str:
    """Return the reason for which a plant cannot run the scenario, found before the plant is accessed, or an empty string."""
    can = {Can.PROBE}
    if target.far:
        can.add(Can.SEND_COMMAND)
    if target.capture or not target.instance:
        can.add(Can.SEE_WIRE)
    return refusal(scenario, target.name, can, target.allow)


def _words(target: ScenarioTarget) -> list[str]:
    """Return the command-line options that select the target, without a token."""
    words = ["--target", target.name]
    said = {
        "--seed": "" if target.seed is None else str(target.seed),
        "--instance": target.instance,
        "--field": target.field_host,
        "--far": target.far,
        "--capture": str(target.capture or ""),
        "--can": target.can,
        "--allow": target.allow.value if target.name == "real" and target.allow is not ScenarioTarget.allow else "",
    }
    return words + [word for option, value in said.items() if value for word in (option, value)]


def _with_words(target: ScenarioTarget) -> str:
    """Return the part of the command line that names the user's controller; empty if fieldtwin controls."""
    return f" --with -- {shlex.join(target.controller)}" if target.controller else ""


def _of_a_foreign_controller(scenario: Scenario) -> str:
    """Return the reason why a user's program cannot be tested by the scenario; empty if it can."""
    probed = {name for probe in scenario.probes for name in probe.names}
    ours = sorted(scenario.used - probed) + [
        f"the probe {probe.name} (serve)" for probe in scenario.probes if probe.serve
    ]
    if not ours:
        return ""
    told = f"{', '.join(ours[:5])}{', ...' if len(ours) > 5 else ''}"
    return (
        f"the scenario reads {told}, which fieldtwin's own gateway and PLC publish. In this run your program controls "
        "the devices, so read registers through `probes` instead"
    )


async def _run(scenario: Scenario, target: ScenarioTarget, trace: Trace) -> ScenarioResult:
    me = asyncio.current_task()
    assert me is not None
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, me.cancel)
    if scenario.group is not None:
        return await kind_named(scenario.group.kind).run_scenario(scenario, target.seed, trace)
    async with AsyncExitStack() as stack:
        failure: Failure | None = None
        if target.name == "compose" or target.instance:
            where = await _running(scenario, target)
            if where.foreign and (refused := _of_a_foreign_controller(scenario)):
                return result_of(scenario, target.name, Verdict.SKIPPED, reason=refused)
        elif target.controller:
            name = f"test-{os.getpid()}"
            both = await stack.enter_async_context(
                WithController(scenario.system, _field_config(scenario, target), target.controller, name)
            )
            where = Where(both.instance.dir, own=True, foreign=True, env=both.env)
            failure = both.failure
        else:
            session = _session(scenario, target)
            own = session.instance.dir

            def tidy(kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
                # otherwise the logs of the system contain the reason
                if kind is None or not issubclass(kind, FieldtwinError):
                    shutil.rmtree(own, ignore_errors=True)

            stack.push(tidy)
            await stack.enter_async_context(session)
            where = Where(
                own,
                far=target.far,
                capture=session.options.capture,
                own=target.name == "local",
                plant=target.name == "real",
                allowed=target.allow if target.name == "real" else Impact.DISRUPT,
            )
            failure = session.failure

        bench = ControlBench(
            scenario.system,
            where,
            trace,
            target=target.name,
            names=sorted(scenario.used | _invariant_names(scenario, where)),
            probes=scenario.probes,
            fresh=lambda can: scenario.form.start == "fresh" and not refusal(scenario, target.name, can, where.allowed),
            failure=failure,
        )
        async with bench:
            result = await ScenarioRunner(scenario, bench).run()
            return _with_what_was_in(result, bench)


def _invariant_names(scenario: Scenario, where: Where) -> set[str]:
    """Return the tags and variables of the system file's invariants, if a fieldtwin gateway publishes them."""
    ours = not where.foreign and (where.run_dir / "gateway.sock").exists()
    return scenario.invariants.names if ours else set()


def _with_what_was_in(result: ScenarioResult, bench: ControlBench) -> ScenarioResult:
    """Add to a result that is not a pass the faults and values that were active in the devices before the scenario began."""
    before = bench.lease.before if bench.lease is not None else ""
    if not before or result.verdict in (Verdict.PASSED, Verdict.SKIPPED):
        return result
    return replace(
        result, reason=f"{result.reason}; before this scenario began, these faults were already active: {before}"
    )


def _session(scenario: Scenario, target: ScenarioTarget) -> RunSession:
    """Return the run of the system for this scenario."""
    name = f"test-{os.getpid()}"
    seed = target.seed if target.seed is not None else scenario.form.seed
    plant = target.name == "real"
    options = RunOptions(
        system=str(scenario.system.path),
        prototype=not plant,
        allow_writes=plant and target.allow.rank >= Impact.WRITE.rank,
        instance=name,
        profiles=scenario.profiles,
        prototype_file=prototype_of(scenario),
        capture=Instance(name).dir / "capture.jsonl",
        cold=True,
        seed=None if plant else seed,
        can="" if plant else target.can,
    )
    return RunSession(options)


def _field_config(scenario: Scenario, target: ScenarioTarget) -> FieldConfig:
    """Return the configuration of the simulated field devices for the user's program."""
    system, file = scenario.system, prototype_of(scenario)
    cans = [name for name, bus in system.buses.items() if bus.endpoint.is_can and target.can]
    return FieldConfig(
        system=str(system.path.resolve()),
        run_dir="",
        prototype=str(file.resolve()) if file is not None else "",
        profiles=tuple(str(path.resolve()) for path in scenario.profiles),
        listen=dict.fromkeys(cans, f"can:{target.can}"),
        seed=target.seed if target.seed is not None else scenario.form.seed,
    )


async def _running(scenario: Scenario, target: ScenarioTarget) -> Where:
    """Return the access to a running instance, by its name on this host (in its container, for `compose`)."""
    plant = target.name == "real"
    run_dir = runtime_root() / (target.instance or scenario.system.name)
    host, socket, foreign = target.field_host, None, False
    if not plant and not host:
        under_with = {} if target.instance else os.environ
        host, socket = await find_field(scenario.system, run_dir, under_with)
        foreign = "FIELDTWIN_CONTROL" in under_with
    return Where(
        run_dir,
        field_host="" if plant else host,
        field_socket=socket,
        foreign=foreign,
        token=target.token,
        far=target.far,
        capture=target.capture,
        plant=plant,
        allowed=target.allow if plant else Impact.DISRUPT,
    )
