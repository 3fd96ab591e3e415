"""`fieldtwin mcp`: tools for language-model agents over the Model Context Protocol."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from pathlib import Path

import click

from fieldtwin.cli.option_groups import GroupedCommand, group, option
from fieldtwin.cli.options import Secret
from fieldtwin.console import stderr
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.installation import install_hint
from fieldtwin.twin.plant.instance import runtime_root
from fieldtwin.twin.site.system import load_system

AUDIT = "agent-audit.jsonl"
READY = "MCP  →  "
"""The text before the URL, which is printed when the server accepts agents."""


@dataclass(frozen=True)
class HttpOptions:
    """The options of a server for agents that connect over HTTP."""

    listen: str = option(
        "--listen",
        default="",
        metavar="HOST:PORT",
        help="Serve over HTTP at this address, in place of stdin and stdout.",
    )
    names: tuple[str, ...] = option(
        "--host-name", multiple=True, metavar="NAME", help="Another name of this computer that agents may use."
    )
    certificate: Path | None = option(
        "--certificate",
        type=click.Path(dir_okay=False, path_type=Path),
        default=None,
        help="Serve HTTPS with this file (PEM); required beyond loopback.",
    )
    key: Path | None = option(
        "--key", type=click.Path(dir_okay=False, path_type=Path), default=None, help="The key of the certificate (PEM)."
    )
    token: str = option(
        "--token", type=Secret(), default="", metavar="@FILE", help="Token of the agents; required with --listen."
    )


@click.command("mcp", cls=GroupedCommand)
@click.argument("project", type=click.Path(exists=True, file_okay=False, path_type=Path), default=".")
@click.option(
    "--plant",
    "plants",
    multiple=True,
    metavar="INSTANCE",
    help="Let the agent read this running system.",
)
@click.option(
    "--allow-proposals",
    "proposals",
    multiple=True,
    metavar="INSTANCE",
    allow_from_autoenv=False,
    help="Let the agent read this running system, and propose writes to it. A user confirms each with `fieldtwin approve`.",
)
@click.option(
    "--allow-devices",
    "systems",
    multiple=True,
    metavar="SYSTEM",
    allow_from_autoenv=False,
    help="Let the agent open the buses of this system file to read, scan, dump and identify devices.",
)
@click.option(
    "--audit",
    type=click.Path(dir_okay=False, path_type=Path),
    default=None,
    help=f"Append each call to this file; default: {AUDIT} in the folder of the run directories.",
)
@group("HTTP", http=HttpOptions)
def command(
    project: Path,
    plants: tuple[str, ...],
    proposals: tuple[str, ...],
    systems: tuple[str, ...],
    audit: Path | None,
    http: HttpOptions,
) -> int:
    """Serve tools to a language-model agent over the Model Context Protocol (MCP), on stdin and stdout or over HTTP.

    The agent reads the files in the folder PROJECT, explanations and documentation; starts prototypes and injects faults into
    them; checks, saves and runs scenarios. It reads a running plant only if --plant names it, and no tool writes to a plant:
    a write that the agent proposes (--allow-proposals) waits until a user confirms it. It opens the buses of a system
    to read devices only if --allow-devices names it. The audit log has every call.
    """
    try:
        from fieldtwin.agents.mcp_server import serve_http, serve_stdio
    except ModuleNotFoundError as e:
        raise UsageError(f"the server for agents needs {e.name}", hint=install_hint("mcp")) from e
    from fieldtwin.agents.calls import Calls
    from fieldtwin.agents.device_jobs import DeviceJobs
    from fieldtwin.agents.http_place import HttpPlace, parsed_address
    from fieldtwin.agents.library import Library
    from fieldtwin.agents.plant_writes import PlantWrites
    from fieldtwin.agents.tools.all_tools import TOOLS
    from fieldtwin.agents.workplace import Workplace

    place = None
    if http.listen:
        place = HttpPlace(*parsed_address(http.listen), http.token, http.names, http.certificate, http.key)
    clock = WallClock()
    root = runtime_root()
    if audit is None:
        root.mkdir(mode=0o700, parents=True, exist_ok=True)
    audit = audit or root / AUDIT
    log = AuditLog(audit, clock)
    by = "agent over stdio" if place is None else "agent over HTTP"
    writes = PlantWrites(proposals, clock, by, audit)
    devices = DeviceJobs({system.name: system for system in map(load_system, systems)}, project, log, by)

    async def serve() -> None:
        async with Workplace(project, (*plants, *proposals), writes, devices, clock) as workplace:
            calls = Calls(TOOLS, Library(workplace), workplace, log, by)
            if place is None:
                await serve_stdio(calls)
            else:
                await serve_http(
                    calls, place, clock, lambda url: stderr.print(f"{READY}{url}", soft_wrap=True, markup=False)
                )

    try:
        asyncio.run(serve())
    finally:
        log.close()
    return 0
