"""`fieldtwin run`: run a plant, or its prototype, from the same system file."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path

import click

from fieldtwin.cli.campaign_options import CHOSEN_FAULTS
from fieldtwin.cli.completions import systems
from fieldtwin.cli.option_groups import GroupedCommand, group, moved_options, option
from fieldtwin.cli.options import Duration, Secret, json_option
from fieldtwin.cli.run.run_options import ReplayOptions, commands_option, listen_option, systems_of
from fieldtwin.cli.template_question import TemplateSearchOptions
from fieldtwin.gateway.core.errors import FieldtwinError, UsageError
from fieldtwin.run.live.options import RunOptions
from fieldtwin.run.live.session import RunSession
from fieldtwin.run.processes.topside import DEFAULT_SCRIPT
from fieldtwin.run.template import system_file
from fieldtwin.service.attached import RunService, ServiceOptions, check
from fieldtwin.service.journal import Format
from fieldtwin.service.notify import Notifier
from fieldtwin.service.studio_child import StudioChild

NEITHER = """run needs --plant or --prototype; there is no default.
  --prototype   emulate the field devices as defined in NAME.prototype.yaml; no real device is touched
  --plant       use the endpoints in the system file, with real hardware; read-only without --allow-writes"""
OF_A_GROUP = "--for, --faults, --commands, --instance, --thread, --cold, --json"
SIMULATE = (
    "`fieldtwin run` has no {}: use `fieldtwin simulate SYSTEM --for 24h`, which runs a prototype in virtual time"
)
MOVED = (
    *("--seed", "--seeds", "--jobs", "--ledger", "--trace", "--compare"),
    *("--fault-every", "--fault-kinds", "--fault-aims"),
)


@dataclass(frozen=True)
class PlaceOptions:
    """The options for the kind of a run: either `prototype` or `plant`. `duration_s` 0 means until stopped."""

    prototype: bool = option(
        "--prototype", is_flag=True, help="Emulate the field devices as defined in NAME.prototype.yaml."
    )
    plant: bool = option("--plant", is_flag=True, help="Use the endpoints in the system file, with real hardware.")
    allow_writes: bool = option(
        "--allow-writes",
        is_flag=True,
        help="With --plant, or with a bus that the prototype file sets to `plant`: enable writes of the tags that the "
        "system file marks writable.",
    )
    duration_s: float = option(
        "--for", type=Duration(), default=0.0, help="Stop after a time such as 20s; default: run until Ctrl-C."
    )
    instance: str = option("--instance", default="", help="Name of the run directory; default: the system's name.")
    fixed_ports: bool = option(
        "--fixed-ports",
        is_flag=True,
        help="With --prototype: servers and bridges listen at the addresses of the system file, not on free ports.",
    )
    cold: bool = option("--cold", is_flag=True, help="Start the PLC's retained variables with their initial values.")

    def check(self) -> None:
        """Raise `UsageError` unless the user has chosen either the plant or a prototype, and only options that apply to it."""
        if self.prototype == self.plant:
            raise UsageError(NEITHER if not self.plant else "--plant and --prototype exclude each other")
        if self.fixed_ports and self.plant:
            raise UsageError("--fixed-ports needs --prototype", hint="a plant always uses the addresses of its file")


@dataclass(frozen=True)
class EmulationOptions:
    """The options that state where the devices of a prototype are emulated, and the file of their faults, empty for none."""

    can: str = option(
        "--can",
        default="",
        metavar="INTERFACE/CHANNEL",
        help="Emulate CAN buses on this interface, such as socketcan/vcan0.",
    )
    faults: str = option(
        "--faults", default="", metavar="FILE", help="Inject the faults of this file (see fieldtwin faults)."
    )
    field_host: str = option(
        "--field",
        default="",
        metavar="HOST[:PORT]",
        help="Use the field devices that `fieldtwin emulate` already runs there.",
    )
    token: str = option(
        "--token",
        type=Secret(),
        default="",
        metavar="@FILE",
        help="Token of that simulator's control channel; or FIELDTWIN_RUN_TOKEN.",
    )


@dataclass(frozen=True)
class ThreadOptions:
    """The options for the plant's side of a digital thread, as in `RunOptions`."""

    thread: str = option(
        "--thread",
        default="",
        metavar="URL",
        help="A digital thread for `fieldtwin shadow` and `twin`: tcp://127.0.0.1:PORT or tls://... to listen on, "
        "mqtt://HOST/GROUP/NODE, or modem: for the system's own modem.",
    )
    thread_store: str = option(
        "--thread-store",
        default="",
        metavar="FILE|URL",
        help="Store of the thread's log; default: in the run directory.",
    )
    thread_every_s: float | None = option(
        "--thread-every",
        type=Duration(),
        default=None,
        help="Minimum time between two values of a tag in the thread; default: none, over a modem 1s.",
    )

    def check(self) -> None:
        """Raise `UsageError` for options of a digital thread if no thread was requested."""
        if (self.thread_store or self.thread_every_s is not None) and not self.thread:
            raise UsageError("--thread-store and --thread-every need --thread")


@click.command("run", cls=GroupedCommand)
@click.argument("system", shell_complete=systems)
@group("Plant or prototype", place=PlaceOptions)
@group("Simulated devices", replay=ReplayOptions)
@group("Simulated devices", listen_option, commands_option, field=EmulationOptions)
@group("Digital thread", thread=ThreadOptions)
@group("Profiles and templates", sources=TemplateSearchOptions)
@group(
    "Output",
    click.option(
        "--capture",
        type=click.Path(dir_okay=False, path_type=Path),
        help="Write the traffic of all buses to this file (JSON lines).",
    ),
    click.option(
        "--studio",
        is_flag=False,
        flag_value="127.0.0.1:0",
        default="",
        metavar="[HOST:PORT]",
        help="Serve the page of this run (see fieldtwin studio), by default at a free port, and record the frames of its buses.",
    ),
    click.option(
        "--metrics",
        default="",
        metavar="HOST:PORT",
        help="Serve metrics for Prometheus at HOST:PORT, default host: loopback. See docs/reference/metrics.md.",
    ),
    click.option(
        "--log",
        type=click.Choice(["text", "json", "journal"]),
        default=None,
        help="Log events instead of a live view: as text, as JSON lines, or to the journal.",
    ),
    json_option,
)
@moved_options(SIMULATE, "--virtual", is_flag=True)
@moved_options(SIMULATE, *MOVED)
def command(
    system: str,
    place: PlaceOptions,
    commands: tuple[int, ...] | None,
    listen: dict[str, str],
    replay: ReplayOptions,
    field: EmulationOptions,
    thread: ThreadOptions,
    sources: TemplateSearchOptions,
    capture: Path | None,
    studio: str,
    metrics: str,
    log: Format | None,
    as_json: bool,
) -> int:
    """Run SYSTEM: gateway and PLC, each in a separate process.

    SYSTEM is a file, the name of a shipped system such as `observatory`, or a template (see fieldtwin template): a zip or a
    folder. With --prototype it can also be a network, such as `ocean_network`: several systems, and the acoustic channel
    between their modems.

    With --prototype a separate process emulates the field devices on real connections: a pty for each serial line, TCP
    sockets, a software CAN bus (or a kernel one, with --can). With --plant the same system file runs the plant. For virtual
    time see fieldtwin simulate.
    """
    place.check()
    if field.faults in CHOSEN_FAULTS:
        raise UsageError(SIMULATE.format(f"--faults {field.faults}"))
    others = {
        **replay.given(), "--field": field.field_host, "--listen": listen, "--can": field.can, "--capture": capture,
        "--thread-store": thread.thread_store, "--metrics": metrics, "--log": log, "--studio": studio,
        "--fixed-ports": place.fixed_ports,
    }  # fmt: skip
    systems = systems_of(system, sources, others, OF_A_GROUP, plant=place.plant, virtual=False)
    if systems is not None:
        if place.allow_writes:
            raise UsageError("--allow-writes needs --plant", hint="a prototype's emulators always accept writes")
        # imported here, because a plant has no emulators installed
        from fieldtwin.emulators.faults.schema import load_faults
        from fieldtwin.run.virtual.group_kinds import LiveRequest, kind_named

        return kind_named(systems.kind).run_live(
            LiveRequest(
                systems, place.duration_s, place.instance, sources.profiles, commands,
                load_faults(Path(field.faults), systems.check_fault) if field.faults else (), thread.thread, place.cold,
            ),
            as_json=as_json,
        )  # fmt: skip
    if place.plant and field.faults:
        raise UsageError("faults cannot be injected into a plant", hint="--faults needs --prototype")
    if place.plant and (field.field_host or listen or field.can or commands or any(replay.given().values())):
        raise UsageError(
            "these options are for emulated devices",
            hint="--field, --recording, --speed, --listen, --can, --commands need --prototype",
        )
    thread.check()
    system = system_file(
        system, sources.ask(), plant=place.plant, prototype_file=replay.prototype_file, profiles=sources.profiles
    )
    if commands is None:
        commands = () if thread.thread.startswith("modem:") else DEFAULT_SCRIPT
    options = RunOptions(
        system=system,
        prototype=place.prototype,
        allow_writes=place.allow_writes,
        duration_s=place.duration_s,
        instance=place.instance,
        profiles=sources.profiles,
        prototype_file=replay.prototype_file,
        field_host=field.field_host,
        token=field.token,
        recordings=replay.recordings,
        speed=replay.speed,
        listen=listen,
        can=field.can,
        commands=commands,
        capture=capture,
        record_frames=bool(studio),
        fixed_ports=place.fixed_ports,
        cold=place.cold,
        thread=thread.thread,
        thread_store=thread.thread_store,
        thread_every_s=thread.thread_every_s,
        fault_file=Path(field.faults) if field.faults else None,
    )
    return asyncio.run(_run(options, ServiceOptions(metrics=metrics, log=log), studio, as_json))


async def _run(options: RunOptions, service_options: ServiceOptions, studio: str, as_json: bool) -> int:
    from fieldtwin.cli.run.live_view import LiveView, print_mapping, print_metrics, print_studio
    from fieldtwin.cli.run.summary_view import print_summary
    from fieldtwin.console import show_warnings
    from fieldtwin.twin.plant.physical import program_warnings

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
        if not started:  # on a busy computer stopping takes a while, and the user should see that it has begun
            me.cancel()

    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, interrupt)
    try:
        async with session:
            started = True
            if service_options.log is None:
                print_mapping(session)
                show_warnings((*session.system.warnings, *program_warnings(session.system)))
            async with RunService(session, service_options, notifier) as service:
                if service_options.log is None:
                    print_metrics(service.url)
                if hasattr(signal, "SIGHUP"):
                    # SIGHUP from a terminal means that the terminal closed; for a service, that the configuration changed
                    watched = not notifier.wanted and any(map(os.isatty, range(3)))
                    loop.add_signal_handler(signal.SIGHUP, interrupt if watched else service.hang_up)
                async with AsyncExitStack() as stack:
                    if studio:
                        child = StudioChild(session.instance.name, session.instance.dir, studio)
                        print_studio((await stack.enter_async_context(child)).url)
                    view = LiveView(session, quiet=as_json or service_options.log is not None)
                    await stack.enter_async_context(view)
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
