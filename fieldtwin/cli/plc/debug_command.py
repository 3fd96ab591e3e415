"""`fieldtwin plc debug`: a debugger for Structured Text, which an editor controls over the Debug Adapter Protocol."""

from __future__ import annotations

import socket
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fieldtwin.cli.option_groups import GroupedCommand, group
from fieldtwin.cli.options import Duration
from fieldtwin.cli.plc.sources import dialect_option, library_option, source_file, st_sources
from fieldtwin.cli.template_question import TemplateSearchOptions
from fieldtwin.console import stderr
from fieldtwin.gateway.core.errors import UsageError

if TYPE_CHECKING:
    from fieldtwin.run.debug.programs import Debuggee

DEFAULT_S = 60.0
"""The virtual time of a system that is debugged, in seconds."""


@dataclass(frozen=True, slots=True)
class _Options:
    """The options of a program, which a launch request can override."""

    dialect: str | None
    libraries: tuple[Path, ...]
    duration_s: float
    seed: int | None

    def overridden(self, given: dict[str, Any]) -> _Options:
        """Return the options with the arguments of a launch request. Raises `UsageError`."""
        try:
            duration_s = Duration().convert(given.get("for", self.duration_s), None, None)
        except click.BadParameter as e:
            raise UsageError(f"`for` in the launch request: {e.message}") from e
        libraries = tuple(Path(one) for one in given.get("libraries", self.libraries))
        return _Options(given.get("dialect", self.dialect), libraries, duration_s, given.get("seed", self.seed))


@click.command("debug", cls=GroupedCommand)
@click.argument("source", required=False, default="")
@group(
    "Program",
    dialect_option,
    library_option,
    click.option(
        "--for",
        "duration_s",
        type=Duration(),
        default=DEFAULT_S,
        help="For a system: the virtual time; default: 1min.",
    ),
    click.option("--seed", type=int, default=None, help="For a system: the seed of the run."),
)
@group("Profiles and templates", sources=TemplateSearchOptions)
@group(
    "Editor",
    click.option(
        "--port",
        type=click.IntRange(0, 65_535),
        default=None,
        help="Listen on this port of 127.0.0.1 for one editor (0: a free port); default: stdin and stdout.",
    ),
)
def debug(
    source: str,
    dialect: str | None,
    libraries: tuple[Path, ...],
    duration_s: float,
    seed: int | None,
    sources: TemplateSearchOptions,
    port: int | None,
) -> int:
    """Debug unit tests (a file *.test.st) or the programs of a system (in virtual time) from an editor.

    The editor speaks the Debug Adapter Protocol: breakpoints, steps over lines, variables, watches. Without SOURCE, the launch
    request of the editor names it as `program`. Its arguments `for`, `seed`, `dialect` and `libraries` override the options.
    """
    from fieldtwin.run.debug.adapter import Adapter
    from fieldtwin.run.debug.messages import Messages

    options = _Options(dialect, libraries, duration_s, seed)

    def launch(given: dict[str, Any]) -> Debuggee:
        named = source or str(given.get("program", ""))
        if not named:
            raise UsageError("which program is to be debugged", expected="SOURCE, or `program` in the launch request")
        return _debuggee(named, options.overridden(given), sources)

    if port is None:
        Adapter(Messages(sys.stdin.buffer, sys.stdout.buffer), launch).serve()
        return 0
    with socket.create_server(("127.0.0.1", port)) as server:
        stderr.print(f"waiting for an editor on 127.0.0.1:{server.getsockname()[1]}", markup=False)
        connection, _ = server.accept()
    with connection, connection.makefile("rb") as reading, connection.makefile("wb") as writing:
        Adapter(Messages(reading, writing), launch).serve()
    return 0


def _debuggee(named: str, options: _Options, sources: TemplateSearchOptions) -> Debuggee:
    from fieldtwin.plc.st.project import compile_source
    from fieldtwin.run.debug.programs import unit_tests, virtual_run
    from fieldtwin.run.template import system_file
    from fieldtwin.run.virtual.run import VirtualOptions
    from fieldtwin.twin.site.system import load_system

    found = source_file(named, options.dialect, options.libraries)
    if found is not None:
        path, chosen, used = found
        return unit_tests(path, chosen, used)
    file = system_file(named, sources.ask(), virtual=True, profiles=sources.profiles)
    programs = st_sources(load_system(file, sources.profiles))
    if not programs:
        raise UsageError(f"no program in Structured Text in {named}", expected="a system whose `plc.programs` have one")
    units = [compile_source(*one) for one in dict.fromkeys(programs.values())]
    return virtual_run(VirtualOptions(file, options.duration_s, options.seed, sources.profiles), units)
