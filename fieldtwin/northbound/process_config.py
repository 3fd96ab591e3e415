"""The configuration of the process of a server of tags, and the check that its packages are installed."""

from __future__ import annotations

from importlib.util import find_spec

import msgspec

from fieldtwin.gateway.core.errors import Bug, UsageError
from fieldtwin.installation import install_hint
from fieldtwin.northbound.http_tokens import tokens_of
from fieldtwin.twin.site.servers.serving_http import HttpServeConfig
from fieldtwin.twin.site.serving import SeparateServer
from fieldtwin.twin.site.system import System

PACKAGES = {
    "opcua": ("opcua", ("asyncua",)),
    "http": ("studio", ("starlette", "uvicorn", "websockets")),
    "mqtt": ("mqtt", ("aiomqtt",)),
}
"""By kind of server: the extra that it needs, and the packages of the extra."""
MODULES = {
    "opcua": "fieldtwin.northbound.opcua.process",
    "http": "fieldtwin.studio.run_api.process",
    "mqtt": "fieldtwin.northbound.mqtt.process",
}
"""By kind of server: the module of its process."""


class ServerProcessConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The configuration of the process.

    `resolved` is the system as the run has read it (`fieldtwin.twin.site.resolved`), `server` the name of the server in its
    `serve` section. With `free_port` (a prototype) the operating system chooses the port.
    `prototype` says that the run is a prototype, whose messages must not be taken for those of the plant.
    """

    resolved: str
    run_dir: str
    server: str
    free_port: bool
    prototype: bool = False


def server_of(system: System, config: ServerProcessConfig) -> SeparateServer:
    """Return the server of a system that a process shall run."""
    for server in system.serving.for_run(allow_writes=False, free_ports=config.free_port).separate:
        if server.name == config.server:
            return server
    raise Bug(f"the system has no server {config.server!r} with a separate process")


def check_server(server: SeparateServer) -> None:
    """Raise `UsageError` or `FileInvalid` if a server cannot start: its packages are missing, or its tokens are unusable."""
    require_packages(server)
    if isinstance(server, HttpServeConfig):
        tokens_of(server)


def require_packages(server: SeparateServer) -> None:
    """Raise `UsageError` if a package of the extra that a server needs is not installed."""
    extra, packages = PACKAGES[server.kind]
    for package in packages:
        if find_spec(package) is None:
            raise UsageError(
                f"the server {server.name!r} in `serve` needs the package {package}", hint=install_hint(extra)
            )
