"""The statuses of the servers of tags that run in separate processes, such as an OPC UA server.

Each of these processes reports its status over the gateway's control channel. So the gateway's status contains all servers of the
`serve` section, and no client of that status needs to know where a server runs.
"""

from __future__ import annotations

from typing import Any

import msgspec
from msgspec import structs

from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.runtime.gateway_status import ServerStatus
from fieldtwin.twin.site.serving import Serving

REPORTED_WITHIN_S = 10.0
"""The time in seconds after which a server that has not reported its status again counts as one that does not listen."""
STARTS_WITHIN_S = 60.0
"""The time in seconds that a server may take until its first report."""


class ServerReports:
    """The latest status that each server reported. Create it with the `Serving` of the system."""

    def __init__(self, serving: Serving, clock: Clock) -> None:
        until_ns = clock.monotonic_ns() + int(STARTS_WITHIN_S * NS_PER_S)
        self._clock = clock
        self._latest = {
            s.name: (ServerStatus(listening=None, error="", counters={}, kind=s.kind), until_ns)
            for s in serving.separate
        }
        """The latest status of each server, and the time at which it is out of date."""

    async def report(self, args: dict[str, Any]) -> dict[str, Any]:
        """Take the status of a server: the control command `report`. Raises `UsageError` for an unknown server or an invalid
        status.
        """
        name = args.get("server")
        if name not in self._latest:
            raise UsageError(f"no server {name!r} with a separate process", expected=", ".join(self._latest) or "none")
        try:
            status = msgspec.convert(args.get("status"), ServerStatus)
        except msgspec.ValidationError as e:
            raise UsageError(f"not the status of a server: {e}") from e
        self._latest[name] = status, self._clock.monotonic_ns() + int(REPORTED_WITHIN_S * NS_PER_S)
        return {"reported": True}

    def statuses(self) -> dict[str, ServerStatus]:
        """Return the status of each server. A server that has not reported in time does not listen."""
        now_ns = self._clock.monotonic_ns()
        return {
            name: status if now_ns <= until_ns else _lost(status) for name, (status, until_ns) in self._latest.items()
        }


def _lost(status: ServerStatus) -> ServerStatus:
    error = status.error or "the server's process does not report its status; its log is in the run directory"
    return structs.replace(status, listening=None, clients=[], error=error)
