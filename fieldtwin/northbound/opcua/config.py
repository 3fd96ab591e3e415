"""The configuration of the OPC UA server's process, and the check that its library is installed."""

from __future__ import annotations

from importlib.util import find_spec

import msgspec

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.installation import install_hint


class OpcuaProcessConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The configuration of the process.

    `resolved` is the system as the run has read it (`fieldtwin.twin.site.resolved`), `server` the name of the server in its
    `serve` section. With `free_port` (a prototype) the operating system chooses the port.
    """

    resolved: str
    run_dir: str
    server: str
    free_port: bool


def require_library(server: str) -> None:
    """Raise `UsageError` if the package of the extra `opcua` is not installed. `server` is the name of the server."""
    if find_spec("asyncua") is None:
        raise UsageError(f"the server {server!r} in `serve` needs the package asyncua", hint=install_hint("opcua"))
