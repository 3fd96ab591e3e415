"""`fieldtwin studio`: see and operate running systems in the browser."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from pathlib import Path

import click

from fieldtwin.cli.completions import systems
from fieldtwin.cli.option_groups import GroupedCommand, group, option
from fieldtwin.cli.options import Duration, Secret
from fieldtwin.console import stderr
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.installation import install_hint
from fieldtwin.service.studio_child import READY


@dataclass(frozen=True)
class ServerOptions:
    """The options that state where the page is served, and how it is protected."""

    listen: str = option(
        "--listen", default="127.0.0.1:0", metavar="HOST:PORT", help="Where to serve; port 0: a free one."
    )
    names: tuple[str, ...] = option(
        "--host-name", multiple=True, metavar="NAME", help="Another name of this computer that browsers may use."
    )
    certificate: Path | None = option(
        "--certificate",
        type=click.Path(dir_okay=False, path_type=Path),
        default=None,
        help="Serve HTTPS with this file (PEM).",
    )
    key: Path | None = option(
        "--key", type=click.Path(dir_okay=False, path_type=Path), default=None, help="The key of the certificate (PEM)."
    )
    insecure: bool = option(
        "--insecure", is_flag=True, help="Allow HTTP beyond this computer: others can read the token."
    )
    no_token: bool = option(
        "--no-token", is_flag=True, help="On loopback only: every program of this computer may operate."
    )
    operate_token: str = option(
        "--token", type=Secret(), default="", metavar="@FILE", help="Token of the role operate; default: a new one."
    )
    view_token: str = option(
        "--view-token",
        type=Secret(),
        default="",
        metavar="@FILE",
        help="Token of the role view, which changes nothing.",
    )


@dataclass(frozen=True)
class TraceOptions:
    """The options for showing a trace."""

    at_s: float | None = option(
        "--at", type=Duration(), default=None, metavar="TIME", help="Show this instant of the TRACE first."
    )
    system: str = option(
        "--system", default="", metavar="SYSTEM", help="The system of a TRACE that has no description in its folder."
    )

    def check(self, trace: Path | None) -> None:
        """Raise `UsageError` for options of a trace if no trace was given."""
        if trace is None and (self.at_s is not None or self.system):
            raise UsageError("--at and --system need a trace", expected="fieldtwin studio TRACE --at 12.5s")


@click.command("studio", cls=GroupedCommand)
@click.argument("shown", metavar="[SYSTEM|TRACE]", required=False, default="", shell_complete=systems)
@click.option("--no-browser", is_flag=True, help="Print the address, and open no browser.")
@click.option("--instance", default="", metavar="NAME", help="Show this running instance first.")
@group("Trace of a virtual run", trace=TraceOptions)
@group("Server", server=ServerOptions)
def command(shown: str, no_browser: bool, instance: str, trace: TraceOptions, server: ServerOptions) -> int:
    """Serve a page that shows and operates the running systems of this computer: values, frames, PLC, trends and faults.

    With SYSTEM its prototype is started first, and stopped at the end. Without it the page lists the running instances, the
    shipped systems and those in the working directory.

    With TRACE, a file that simulate --trace or test --trace has written, or a folder with such files, the page shows the run
    as of any instant: values, frames, PLC and trends, with faults and failed checks marked.

    The page is for this computer only, unless --listen names another address. Its address contains a token; everyone who has the
    token can operate the systems.
    """
    try:
        from fieldtwin.studio.replay.traces import is_trace
        from fieldtwin.studio.server import Serving, StudioOptions, check_pages, open_browser, serve
    except ModuleNotFoundError as e:
        raise UsageError(f"Studio needs {e.name}", hint=install_hint("studio")) from e
    host, _, port = server.listen.rpartition(":")
    if not host or not port.isdigit() or int(port) > 65_535:
        raise UsageError("--listen", expected="HOST:PORT, such as 127.0.0.1:8080", got=server.listen)
    path = Path(shown) if shown and (is_trace(Path(shown)) or (trace.system and Path(shown).is_file())) else None
    trace.check(path)
    options = StudioOptions(
        host=host.strip("[]"),
        port=int(port),
        names=server.names,
        certificate=server.certificate,
        key=server.key,
        insecure=server.insecure,
        no_token=server.no_token,
        operate_token=server.operate_token,
        view_token=server.view_token,
        system="" if path is not None else shown,
        instance=instance,
        trace=path,
        trace_system=trace.system,
        at_s=trace.at_s,
    )
    options.check()
    check_pages()

    def on_ready(serving: Serving) -> None:
        stderr.print(f"{READY}{serving.url}", soft_wrap=True, markup=False, highlight=False)
        if not no_browser and not open_browser(serving.url):
            stderr.print("no browser was found: open this address yourself", soft_wrap=True)

    asyncio.run(serve(options, on_ready))
    return 0
