"""The command line: it parses, calls, prints, and turns every error into one line and an exit code.

Each command is imported when it is called, so `--version` and completion stay fast.
"""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import sys
from importlib import import_module
from typing import Any, NoReturn

import click

from fieldtwin.__about__ import __version__
from fieldtwin.cli.broken_pipe import VERDICTS, survive_broken_stderr, survive_broken_stdout, to_nowhere
from fieldtwin.gateway.core.files.nearest import nearest

COMMANDS = {
    "new": ("fieldtwin.cli.system.new_command", "Write a working site into a new folder."),
    "run": ("fieldtwin.cli.run.run_command", "Run a system: the plant, or its prototype."),
    "simulate": (
        "fieldtwin.cli.run.simulate_command",
        "Simulate a system in virtual time, with seeds and random faults.",
    ),
    "studio": ("fieldtwin.cli.run.studio_command", "See and operate running systems in the browser."),
    "mcp": ("fieldtwin.cli.agents.mcp_command", "Serve tools to a language-model agent; plants are read-only."),
    "approve": (
        "fieldtwin.cli.agents.approve_command",
        "Confirm or refuse a write that a language-model agent has proposed.",
    ),
    "reload": ("fieldtwin.cli.run.reload_command", "Let a running instance read its files again, between two polls."),
    "alarm": ("fieldtwin.cli.run.alarm_command", "List the alarms of a running instance; acknowledge and shelve them."),
    "emulate": ("fieldtwin.cli.emulate.emulate_command", "Emulate the field devices of a system, or one device."),
    "plc": (
        "fieldtwin.cli.plc.plc_command",
        "Look into a running PLC: tags, forces, steps, reasons; draw and prove programs.",
    ),
    "topside": (
        "fieldtwin.cli.run.topside_command",
        "The topside controller of a system's modem: send commands, show responses.",
    ),
    "shadow": (
        "fieldtwin.cli.twin.shadow_command",
        "A digital shadow: observe a plant remotely, and compare it with its model.",
    ),
    "twin": ("fieldtwin.cli.twin.twin_command", "A digital twin: a shadow that also plans and commands."),
    "link": (
        "fieldtwin.cli.emulate.link_command",
        "The emulated connection on its own: a serial port carried over TCP.",
    ),
    "bridge": (
        "fieldtwin.cli.emulate.bridge_command",
        "Connect Modbus TCP clients to serial units, or serial clients to TCP devices.",
    ),
    "can-bus": ("fieldtwin.cli.emulate.can_bus_command", "A software CAN bus on a TCP port."),
    "check": (
        "fieldtwin.cli.test.check_command",
        "Run conformance tests of a Modbus or CANopen device, client or master.",
    ),
    "line": (
        "fieldtwin.cli.device.line_command",
        "Examine a serial line or bus without sending; rank possible faults.",
    ),
    "scan": (
        "fieldtwin.cli.device.scan_command",
        "Find the units or nodes on a bus: listen first, then ask at a limited rate.",
    ),
    "identify": (
        "fieldtwin.cli.device.identify_command",
        "Read a device's identification, and find the profile that fits.",
    ),
    "read": ("fieldtwin.cli.device.read_command", "Read values of one device, by name or address."),
    "write": (
        "fieldtwin.cli.device.write_command",
        "Write values of one device, with confirmation, read-back and restore.",
    ),
    "watch": ("fieldtwin.cli.device.watch_command", "Show live values of one device, with sparklines or as a plot."),
    "dump": ("fieldtwin.cli.device.dump_command", "Read all values of a device, with its gaps, limits and latency."),
    "report": (
        "fieldtwin.cli.system.report_command",
        "Make a site acceptance document from dumps, comparisons and checks.",
    ),
    "record": ("fieldtwin.cli.recordings.record_command", "Record a device, a line between two ports, or a CAN bus."),
    "diff": ("fieldtwin.cli.device.diff_command", "Compare two dumps, or a dump and a profile, by name."),
    "infer": (
        "fieldtwin.cli.device.infer_command",
        "Infer a draft profile, with confidence, from dumps taken over time.",
    ),
    "profile": (
        "fieldtwin.cli.device.profile_command",
        "Convert device descriptions (EDS, DCF, ...) to profiles, and profiles to such descriptions.",
    ),
    "compare": ("fieldtwin.cli.recordings.compare_command", "Compare a device, or a recording, with a recording."),
    "import": ("fieldtwin.cli.recordings.import_command", "Convert files of other programs to recordings."),
    "export": (
        "fieldtwin.cli.recordings.export_group",
        "Convert recordings to CSV, Parquet, candump logs or pcap; pack a prototype as an FMU.",
    ),
    "what-if": (
        "fieldtwin.cli.twin.what_if_command",
        "Simulate the effect of a plan from the present state.",
    ),
    "test": ("fieldtwin.cli.test.test_command", "Run test scenarios against a prototype."),
    "campaign": ("fieldtwin.cli.test.campaign_command", "Join the results of campaigns that ran on several computers."),
    "test-host": ("fieldtwin.cli.test.worker_command", "Emulated devices for tests, over stdin and stdout."),
    "with": (
        "fieldtwin.cli.run.with_command",
        "Run any command against the simulated field devices; end with its exit status.",
    ),
    "faults": ("fieldtwin.cli.emulate.faults_command", "List the faults that can be injected into buses and devices."),
    "template": (
        "fieldtwin.cli.system.template_command",
        "Pack a system into one file; check, compare and unpack such files.",
    ),
    "draw": ("fieldtwin.cli.system.draw_command", "Draw a system's buses and their devices as text or SVG."),
    "trace": (
        "fieldtwin.cli.recordings.trace_command",
        "Show the events of a run: decoded frames, JSON, or waveforms.",
    ),
    "opcua": (
        "fieldtwin.cli.system.opcua_command",
        "Create the certificate of an OPC UA server, and manage its users.",
    ),
    "schema": ("fieldtwin.cli.system.schema_command", "Print the JSON schema of a kind of file."),
    "explain": (
        "fieldtwin.cli.system.explain_command",
        "Explain a test case, a fault, a code or a word of a message.",
    ),
    "completion": (
        "fieldtwin.cli.system.completion_command",
        "Print or install the completion for bash, zsh or fish.",
    ),
    "doctor": ("fieldtwin.cli.system.doctor_command", "Check what this computer supports, and what to change."),
}
SECTIONS = {
    "Run a system, or parts of it": (
        *("new", "run", "simulate", "studio", "mcp", "approve", "reload", "alarm", "emulate", "with"),
        *("plc", "topside", "link", "bridge", "can-bus", "draw"),
    ),
    "Examine a device": (
        *("line", "scan", "identify", "read", "write", "watch", "dump", "diff", "infer", "profile"),
        *("record", "import", "export", "compare", "check", "report"),
    ),
    "Test": ("test", "campaign", "faults", "trace"),
    "Twins": ("template", "shadow", "twin", "what-if"),
    "Help and setup": ("explain", "doctor", "schema", "opcua", "completion", "test-host"),
}
"""The order of commands in `--help`; each command is in one section."""
RENAMED = {"shore": "topside"}
INTERRUPTED = 130
BUG = 70
HOST_REFUSES = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG, errno.EIO, errno.EACCES, errno.EPERM)
"""Error numbers that mean that the disk is full or broken, or that the user may not write: not a bug of fieldtwin."""


class LazyGroup(click.Group):
    """A group that imports a command's module when the command is called."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; a closed pipe ends a listing with exit code 0.

        Click exits with code 1 when a pipe closes, but in `fieldtwin ... | head` the reader has received all that it needs.
        Commands that give a verdict run to their end, and exit with it.
        """
        try:
            result = super().invoke(ctx)
            sys.stdout.flush()
        except BrokenPipeError:
            to_nowhere(sys.stdout.fileno())
            return 0
        return result

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        command = import_module(COMMANDS[cmd_name][0]).command
        assert isinstance(command, click.Command)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command; the error for an unknown command suggests similar names, because click suggests only options."""
        if args[0] in RENAMED:
            raise click.UsageError(f"{args[0]!r} is now called {RENAMED[args[0]]!r}", ctx)
        near = nearest(args[0], COMMANDS)
        if args[0] not in COMMANDS and near:
            raise click.UsageError(f"No such command {args[0]!r}. Did you mean {near[0]!r}?", ctx)
        if args[0] in VERDICTS:
            survive_broken_stdout()
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        widest = max(map(len, COMMANDS))
        for title, names in SECTIONS.items():
            with formatter.section(title):
                formatter.write_dl([(name.ljust(widest), COMMANDS[name][1]) for name in names])


@click.command(
    cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "auto_envvar_prefix": "FIELDTWIN"}
)
@click.version_option(__version__, "--version", prog_name="fieldtwin")
def cli() -> None:
    """Run a plant's own control software without the plant: gateway, soft PLC and emulators on real serial lines, sockets and
    CAN buses.

    Results go to stdout, diagnostics to stderr. Exit codes: 0 ok, 1 a check failed, 2 wrong usage, 3 a file is invalid, 4
    unreachable, 5 the device refused, 70 internal error, 130 interrupted.

    fieldtwin is not a safety function.
    """


def main() -> None:
    """Run the console script. It shows no traceback unless FIELDTWIN_TRACEBACK is set."""
    from fieldtwin.cli.ascii_output import write_plainly
    from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid

    write_plainly()
    survive_broken_stderr()
    signal.signal(signal.SIGTERM, _end_on_sigterm)
    try:
        code = cli.main(prog_name="fieldtwin", standalone_mode=False)
        sys.exit(code if isinstance(code, int) else 0)
    except click.exceptions.Abort:
        sys.exit(INTERRUPTED)
    except click.ClickException as e:
        e.show()
        sys.exit(e.exit_code)
    except click.exceptions.Exit as e:
        sys.exit(e.exit_code)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except FieldtwinError as e:
        if os.environ.get("FIELDTWIN_TRACEBACK"):
            raise
        click.echo(f"fieldtwin: {e}", err=True)
        for other in e.others if isinstance(e, FileInvalid) else ():
            click.echo(f"fieldtwin: {other}", err=True)
        theirs = getattr(e, "child_exit_code", 0) or getattr(e, "remote_exit_code", 0)
        sys.exit(theirs if theirs > 0 else e.exit_code)  # a negative exit code means that a signal ended the process
    except OSError as e:
        if os.environ.get("FIELDTWIN_TRACEBACK") or e.errno not in HOST_REFUSES:
            _bug(e)
        click.echo(f"fieldtwin: {e.filename or 'a file or the output'}: {e.strerror}", err=True)
        _discard_unsent_output()
        sys.exit(FileInvalid.exit_code)
    except Exception as e:  # the outermost handler: an exception that arrives here is a bug of fieldtwin
        _bug(e)


def _end_on_sigterm(number: int, frame: object) -> NoReturn:
    """Handle SIGTERM for commands that do not handle it: delete temporary files, as after Ctrl-C."""
    sys.exit(128 + number)


def _bug(error: Exception) -> NoReturn:
    if os.environ.get("FIELDTWIN_TRACEBACK"):
        raise error
    click.echo(
        f"fieldtwin: internal error: {type(error).__name__}: {error} (run again with FIELDTWIN_TRACEBACK=1 and report it)",
        err=True,
    )
    sys.exit(BUG)


def _discard_unsent_output() -> None:
    """Discard buffered output: else Python tries to flush it at exit, fails, and exits with 120."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
