"""Run Studio's web server until SIGINT or SIGTERM."""

from __future__ import annotations

import webbrowser
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote

from fieldtwin.gateway.core.concurrency.stop_signal import on_stop_signal
from fieldtwin.gateway.core.errors import Unreachable, UsageError
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.studio.access import Access, allowed_hosts, new_token
from fieldtwin.studio.app import STATIC, application
from fieldtwin.studio.replay.traces import Traces
from fieldtwin.studio.web_server import WebServer, listening_socket
from fieldtwin.twin.site.servers.loopback import is_loopback

MOST_CONNECTIONS = 200


@dataclass(frozen=True)
class StudioOptions:
    """The options of the server: its address, the access to it, and the page that it shows first.

    `port` 0 chooses a free port. `names` are further names of this computer that browsers may use. An empty token is made, unless
    `no_token` is set, which is for loopback only.
    """

    host: str = "127.0.0.1"
    port: int = 0
    names: tuple[str, ...] = ()
    certificate: Path | None = None
    key: Path | None = None
    insecure: bool = False
    no_token: bool = False
    operate_token: str = field(default="", repr=False)
    view_token: str = field(default="", repr=False)
    system: str = ""
    """A system whose prototype is started with the server; empty for none."""
    instance: str = ""
    """A running instance that the page shows first, if no system is started."""
    trace: Path | None = None
    """A trace that the page shows first, or a folder with traces."""
    trace_system: str = ""
    """The system of a trace without a description."""
    at_s: float | None = None
    """The instant of the trace that the page shows first, in seconds since the start of the run."""

    def check(self) -> None:
        """Raise `UsageError` for options that would let unauthorized clients operate a plant."""
        if self.is_loopback:
            return
        if self.no_token:
            raise UsageError("--no-token is for loopback only", got=f"--listen {self.host}")
        if self.certificate is None and not self.insecure:
            raise UsageError(
                "without TLS everyone on the network can read the token",
                expected="--certificate and --key, or --insecure",
                got=f"--listen {self.host}",
            )

    @property
    def is_loopback(self) -> bool:
        """Return whether only programs on this computer can connect."""
        return is_loopback(self.host)


@dataclass(frozen=True)
class Serving:
    """A server that accepts connections. `url` contains the token for the role operate."""

    url: str
    address: str
    access: Access


def check_pages() -> None:
    """Raise `Unreachable` if the libraries of the pages are missing, as in a clone in which they were never fetched."""
    if not (STATIC / "vendor" / "preact.js").is_file():
        raise Unreachable(
            "Studio's pages are not built in this clone",
            where=str(STATIC),
            hint="scripts/studio-assets fetches them; it needs npm",
        )


async def serve(options: StudioOptions, on_ready: Callable[[Serving], None]) -> None:
    """Serve until SIGINT or SIGTERM. `on_ready` is called once, when the server accepts connections.

    Raises `UsageError`, `EndpointBusy`, `Unreachable` or `FileInvalid`.
    """
    options.check()
    listener = listening_socket(options.host, options.port, "--listen HOST:0 selects a free port")
    port = listener.getsockname()[1]
    operate = "" if options.no_token else options.operate_token or new_token()
    access = Access(allowed_hosts(options.host, options.names, port), operate, options.view_token)
    traces = Traces(Path.cwd(), () if options.trace is None else (options.trace,), options.trace_system)
    app = application(access, WallClock(), Path.cwd(), traces)
    server = WebServer(app, listener, MOST_CONNECTIONS, options.certificate, options.key)
    on_stop_signal(server.stop)
    try:
        await server.start()
        scheme = "https" if options.certificate else "http"
        shown = f"[{options.host}]" if ":" in options.host else options.host
        address = f"{scheme}://{shown}:{port}/"
        instance = await app.state.launcher.start(options.system) if options.system else options.instance
        if instance:
            await app.state.gallery.attached(instance)  # Studio keeps more changes than the gateway
        place = f"#/{instance}" if instance else await _first_trace(traces, options)
        url = (f"{address}?token={operate}" if operate else address) + place
        on_ready(Serving(url, address, access))
        await server.wait()
    finally:
        await server.aclose()


async def _first_trace(traces: Traces, options: StudioOptions) -> str:
    """Return the part of the address that shows the trace which the user named. A folder with several traces shows the list."""
    if options.trace is None:
        return ""
    within = options.trace.resolve()
    named = [trace for trace in traces.known() if within in (trace.path, trace.path.parent)]
    if not named or (options.trace.is_dir() and len(named) != 1):
        return ""
    await traces.opened(
        named[0].name
    )  # an unreadable trace is reported at once, and the others are indexed from now on
    at = "" if options.at_s is None else f"?t={options.at_s!r}"
    return f"#/{quote(f'trace:{named[0].name}')}/overview{at}"


def open_browser(url: str) -> bool:
    """Open the user's browser. Return whether a browser was found."""
    try:
        return webbrowser.open(url)
    except webbrowser.Error:
        return False
