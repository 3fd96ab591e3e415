"""`fieldtwin run`: run a plant, or its prototype, from the same system file."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import click

from fieldtwin.cli.campaign_options import Choice, fault_choice
from fieldtwin.cli.options import Duration, Secret, json_option, pairs, profiles_option
from fieldtwin.cli.template_question import consent, trust_option
from fieldtwin.gateway.core.errors import FieldtwinError, UsageError
from fieldtwin.run.live.options import RunOptions
from fieldtwin.run.live.session import RunSession
from fieldtwin.run.processes.topside import DEFAULT_SCRIPT, parse_periods
from fieldtwin.run.template import system_file
from fieldtwin.service.attached import Service, ServiceOptions, check
from fieldtwin.service.journal import Format
from fieldtwin.service.notify import Notifier
from fieldtwin.twin.site.groups import group_file

if TYPE_CHECKING:
    from fieldtwin.run.virtual.run import VirtualOptions
    from fieldtwin.twin.prototype.group import SystemGroup

NEITHER = """run needs --plant or --prototype; there is no default.
  --prototype   emulate the field devices as defined in NAME.prototype.yaml; no real device is touched
  --plant       use the endpoints in the system file, with real hardware; read-only without --allow-writes"""


@click.command("run")
@click.argument("system")
@click.option("--prototype", is_flag=True, help="Emulate the field devices as defined in NAME.prototype.yaml.")
@click.option("--plant", is_flag=True, help="Use the endpoints in the system file, with real hardware.")
@click.option(
    "--allow-writes", is_flag=True, help="With --plant: enable writes of the tags that the system file marks writable."
)
@click.option(
    "--for",
    "duration_s",
    type=Duration(),
    default=0.0,
    help="Stop after a time such as 20s; default: run until Ctrl-C.",
)
@click.option("--instance", default="", help="Name of the run directory; default: the system's name.")
@click.option("--prototype-file", type=click.Path(exists=True, dir_okay=False), help="Use this prototype file.")
@click.option(
    "--field",
    "field_host",
    default="",
    metavar="HOST[:PORT]",
    help="Use the field devices that `fieldtwin emulate` already runs there.",
)
@click.option(
    "--token",
    type=Secret(),
    default="",
    metavar="@FILE",
    help="Token of that simulator's control channel; or FIELDTWIN_RUN_TOKEN.",
)
@click.option(
    "--recording", "recordings", multiple=True, metavar="DEVICE=FILE", help="Replay this recording for a device."
)
@click.option("--speed", type=float, default=0.0, help="Speed factor for recordings.")
@click.option("--listen", multiple=True, metavar="BUS=ENDPOINT", help="Endpoint for the emulators of a bus.")
@click.option(
    "--can",
    default="",
    metavar="INTERFACE/CHANNEL",
    help="Emulate CAN buses on this interface, such as socketcan/vcan0.",
)
@click.option(
    "--commands",
    default=None,
    metavar="1,2,0,-1",
    help="Sample periods that the topside controller commands, spread over the run; or none.",
)
@click.option(
    "--capture", type=click.Path(dir_okay=False), help="Write the traffic of all buses to this file (JSON lines)."
)
@click.option("--virtual", is_flag=True, help="With --prototype: run in virtual time, as fast as possible.")
@click.option("--seed", type=int, default=None, help="With --virtual: use this seed instead of the prototype file's.")
@click.option(
    "--seeds", default="", metavar="1..200", help="With --virtual: one run for each of these seeds, such as 1..200."
)
@click.option("--jobs", type=click.IntRange(1, 256), default=1, help="Number of --seeds runs at a time.")
@click.option(
    "--ledger",
    type=click.Path(dir_okay=False),
    help="With --seeds: record each run in this file, and skip seeds that it contains.",
)
@click.option(
    "--trace", type=click.Path(dir_okay=False), help="With --virtual: write every event to this file (JSON lines)."
)
@click.option(
    "--compare",
    type=click.Path(exists=True, dir_okay=False),
    help="With --virtual: compare the run with an older trace, as fieldtwin trace --against; exit code 1 if it differs.",
)
@click.option(
    "--faults",
    default="",
    metavar="FILE|random",
    help="With --prototype: inject these faults (see fieldtwin faults); random, with --virtual: the seed chooses them.",
)
@click.option(
    "--thread",
    default="",
    metavar="URL",
    help="A digital thread for `fieldtwin shadow` and `twin`: tcp://127.0.0.1:PORT or tls://... to listen on, "
    "mqtt://HOST/GROUP/NODE, or modem: for the system's own modem.",
)
@click.option(
    "--thread-store", default="", metavar="FILE|URL", help="Store of the thread's log; default: in the run directory."
)
@click.option(
    "--thread-every",
    "thread_every_s",
    type=Duration(),
    default=None,
    help="Minimum time between two values of a tag in the thread; default: none, over a modem 1s.",
)
@click.option(
    "--metrics",
    default="",
    metavar="HOST:PORT",
    help="Serve metrics for Prometheus at HOST:PORT, such as 127.0.0.1:9464; default host: loopback (docs/service.md).",
)
@click.option(
    "--log",
    type=click.Choice(["text", "json", "journal"]),
    default=None,
    help="Log events instead of a live view: as text, as JSON lines, or to the journal.",
)
@fault_choice
@trust_option
@click.option("--cold", is_flag=True, help="Start the PLC's retained variables with their initial values.")
@profiles_option
@json_option
def command(
    system: str,
    prototype: bool,
    plant: bool,
    allow_writes: bool,
    duration_s: float,
    instance: str,
    prototype_file: str | None,
    field_host: str,
    token: str,
    recordings: tuple[str, ...],
    speed: float,
    listen: tuple[str, ...],
    can: str,
    commands: str | None,
    capture: str | None,
    virtual: bool,
    seed: int | None,
    seeds: str,
    jobs: int,
    ledger: str | None,
    trace: str | None,
    compare: str | None,
    faults: str,
    thread: str,
    thread_store: str,
    thread_every_s: float | None,
    metrics: str,
    log: Format | None,
    trust: bool,
    cold: bool,
    profiles: tuple[str, ...],
    as_json: bool,
    choice: Choice,
) -> int:
    """Run SYSTEM: gateway and PLC, each in a separate process.

    SYSTEM is a file, the name of a shipped system such as `observatory`, or a template (see fieldtwin template): a zip or a
    folder. With --prototype it can also be a network, such as `ocean_network`: several systems, and the acoustic channel
    between their modems.

    With --prototype a separate process emulates the field devices on real connections: a pty for each serial line, TCP
    sockets, a software CAN bus (or a kernel one, with --can). With --plant the same system file runs the plant.
    """
    if prototype == plant:
        raise UsageError(NEITHER if not plant else "--plant and --prototype exclude each other")
    random_faults = choice.of(faults)
    if group_file(system, [Path(p) for p in profiles]) is not None:
        others = {
            "--field": field_host, "--recording": recordings, "--speed": speed, "--listen": listen, "--can": can,
            "--capture": capture, "--compare": compare, "--thread-store": thread_store, "--metrics": metrics, "--log": log,
            "--prototype-file": prototype_file,
        }  # fmt: skip
        said = [option for option, value in others.items() if value]
        group = _group(system, profiles, trust=trust, plant=plant, virtual=virtual, others=said)
        periods = parse_periods(commands) if commands is not None else None
        from fieldtwin.emulators.faults.schema import load_faults  # here and below: a plant has no emulators installed
        from fieldtwin.run.virtual.group_kinds import LiveRequest, kind_named
        from fieldtwin.run.virtual.run import VirtualOptions

        chosen = load_faults(Path(faults), group.check_fault) if faults not in ("", "random") else ()
        folders = tuple(Path(p) for p in profiles)
        if not virtual:
            if seed is not None or trace:
                raise UsageError("--seed and --trace need --virtual")
            if seeds or faults == "random":
                raise UsageError("--seeds and random faults need --virtual")
            live = LiveRequest(group, duration_s, instance, folders, periods, chosen, thread, cold)
            return kind_named(group.kind).run_live(live, as_json=as_json)
        if duration_s <= 0:
            raise UsageError("--virtual needs an end time", expected="--for 24h")
        if thread:
            raise UsageError("--thread needs a run in real time", hint="without --virtual")
        simulated = VirtualOptions(
            str(group.path), duration_s, seed, folders,
            commands=periods, faults=chosen, random_faults=random_faults, trace=Path(trace) if trace else None,
        )  # fmt: skip
        return _simulate(simulated, seeds, jobs, Path(ledger) if ledger else None, None, as_json)
    if plant and faults:
        raise UsageError("faults cannot be injected into a plant", hint="--faults needs --prototype")
    if plant and (field_host or recordings or listen or can or speed or prototype_file or commands):
        raise UsageError(
            "these options are for emulated devices",
            hint="--field, --recording, --speed, --listen, --can, --commands need --prototype",
        )
    if prototype and allow_writes:
        raise UsageError("--allow-writes needs --plant", hint="a prototype's emulators always accept writes")
    system = system_file(
        system,
        consent(trust=trust),
        plant=plant,
        virtual=virtual,
        prototype_file=Path(prototype_file) if prototype_file else None,
        profiles=[Path(p) for p in profiles],
    )
    if (thread_store or thread_every_s is not None) and not thread:
        raise UsageError("--thread-store and --thread-every need --thread")
    if virtual:
        if plant or field_host or listen or can or capture or thread or metrics or log:
            raise UsageError(
                "--virtual runs a prototype in this process, with buses in memory",
                hint="not with --plant, --field, --listen, --can, --capture, --thread, --metrics, --log; --trace has the frames",
            )
        if duration_s <= 0:
            raise UsageError("--virtual needs an end time", expected="--for 24h")
        from fieldtwin.run.virtual.run import VirtualOptions

        return _simulate(
            VirtualOptions(
                system,
                duration_s,
                seed,
                tuple(Path(p) for p in profiles),
                Path(prototype_file) if prototype_file else None,
                pairs(recordings, "--recording"),
                speed,
                parse_periods(commands) if commands is not None else None,
                _faults(faults, system, profiles) if faults not in ("", "random") else (),
                random_faults,
                Path(trace) if trace else None,
            ),
            seeds,
            jobs,
            Path(ledger) if ledger else None,
            Path(compare) if compare else None,
            as_json,
        )
    if seeds or seed is not None or trace or compare or jobs != 1:
        raise UsageError("--seed, --seeds, --jobs, --trace and --compare need --virtual")
    options = RunOptions(
        system=system,
        prototype=prototype,
        allow_writes=allow_writes,
        duration_s=duration_s,
        instance=instance,
        profiles=tuple(Path(p) for p in profiles),
        prototype_file=Path(prototype_file) if prototype_file else None,
        field_host=field_host,
        token=token,
        recordings=pairs(recordings, "--recording"),
        speed=speed,
        listen=pairs(listen, "--listen"),
        can=can,
        commands=parse_periods(commands)
        if commands is not None
        else ()
        if thread.startswith("modem:")
        else DEFAULT_SCRIPT,
        capture=Path(capture) if capture else None,
        cold=cold,
        thread=thread,
        thread_store=thread_store,
        thread_every_s=thread_every_s,
        faults=_faults(faults, system, profiles) if faults else (),
    )
    return asyncio.run(_run(options, ServiceOptions(metrics=metrics, log=log), as_json))


def _group(
    system: str, profiles: tuple[str, ...], *, trust: bool, plant: bool, virtual: bool, others: list[str]
) -> SystemGroup:
    """Return the systems of a file that describes several, if the user agrees to them. `others`: unavailable options."""
    from fieldtwin.run.template import agree
    from fieldtwin.twin.prototype.group import load_group

    folders = [Path(p) for p in profiles]
    group = load_group(system, folders)
    assert group is not None
    if plant:
        raise UsageError(
            f"a {group.kind} file runs only as prototypes: each of its systems is a separate plant",
            hint="run each system on its computer, with its own system file",
        )
    if others:
        raise UsageError(
            f"{', '.join(others)}: not available for a {group.kind}",
            expected="--for, --virtual, --seed, --seeds, --jobs, --ledger, --faults, --trace, --commands, --instance, --thread, "
            "--cold, --json",
            hint="its systems can be run separately",
        )
    members = [(member.system, member.prototype.path) for member in group.members.values()]
    agree(consent(trust=trust), group.path, members, beside=group.path, virtual=virtual)
    return group


def _faults(path: str, system: str, profiles: tuple[str, ...]) -> tuple[dict[str, Any], ...]:
    from fieldtwin.emulators.faults.schema import load_faults
    from fieldtwin.twin.prototype.fault_aims import target
    from fieldtwin.twin.site.system import load_system

    if path == "random":
        raise UsageError("random faults need --virtual")
    aimed_at = load_system(system, [Path(p) for p in profiles])
    return load_faults(Path(path), lambda spec: target(aimed_at, spec))


def _simulate(
    options: VirtualOptions, seeds: str, jobs: int, ledger: Path | None, compare: Path | None, as_json: bool
) -> int:
    from fieldtwin.cli.run.virtual_view import parse_seeds, run_many, run_one

    if not seeds:
        if ledger is not None:
            raise UsageError("--ledger needs --seeds")
        return _run_against(options, compare, as_json) if compare is not None else run_one(options, as_json)
    if options.trace or compare or options.seed is not None:
        raise UsageError("--seeds, which makes several runs", hint="--seed, --trace and --compare need a single run")
    return run_many(options, parse_seeds(seeds), jobs, as_json, ledger)


def _run_against(options: VirtualOptions, old: Path, as_json: bool) -> int:
    """Run, then compare the run with the trace `old`; return the worse of the two exit codes."""
    from fieldtwin.cli.recordings.regression_view import judged, show
    from fieldtwin.cli.run.virtual_view import run_one
    from fieldtwin.scenarios.regression.comparing import Allowed
    from fieldtwin.twin.site.system import load_system

    if as_json:
        raise UsageError(
            "--compare with --json", hint="--trace NEW, then fieldtwin trace NEW SYSTEM --against OLD --json"
        )
    with TemporaryDirectory(prefix="ft-") as folder:
        trace = options.trace or Path(folder) / "trace.jsonl"
        code = run_one(replace(options, trace=trace), as_json)
        return max(
            code, show(judged(load_system(options.system, options.profiles), old, trace, Allowed()), old, as_json=False)
        )


async def _run(options: RunOptions, service_options: ServiceOptions, as_json: bool) -> int:
    from fieldtwin.cli.run.live_view import LiveView, print_mapping, print_metrics, print_summary
    from fieldtwin.console import show_warnings

    check(service_options)
    notifier = Notifier.from_environment()
    session = RunSession(options)
    interrupted = started = False
    me = asyncio.current_task()
    assert me is not None

    def interrupt() -> None:
        nonlocal interrupted
        interrupted = True
        session.stopped.set()
        if not started:  # on a busy computer this takes a while, and the user has asked to stop
            me.cancel()

    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, interrupt)
    try:
        async with session:
            started = True
            if service_options.log is None:
                print_mapping(session)
                show_warnings(session.system.warnings)
            async with Service(session, service_options, notifier) as service:
                if service_options.log is None:
                    print_metrics(service.url)
                if hasattr(signal, "SIGHUP"):
                    # SIGHUP from a terminal means that the terminal closed; for a service, that the configuration changed
                    watched = not notifier.wanted and any(map(os.isatty, range(3)))
                    loop.add_signal_handler(signal.SIGHUP, interrupt if watched else service.hang_up)
                async with LiveView(session, quiet=as_json or service_options.log is not None):
                    await session.wait()
    except (asyncio.CancelledError, FieldtwinError):
        if interrupted and not started:
            return 130
        raise
    notifier.close()
    summary = session.summary()
    if as_json:
        json.dump(summary, sys.stdout, indent=2)
        sys.stdout.write("\n")
    else:
        print_summary(summary)
    if interrupted and options.duration_s:
        return 130
    return 0 if summary["ok"] else 1
