"""A scenario's lease on the simulated field devices.

The other side is `fieldtwin.twin.prototype.field_leases`. All faults and values of the scenario are removed when the lease
ends: at the end of the scenario, or `LEASE_S` seconds after the last renewal if the testing process died.
"""

from __future__ import annotations

import asyncio
import os
import secrets
import socket
from contextlib import suppress
from typing import Any

from fieldtwin.gateway.core.control import ControlClient, RemoteError
from fieldtwin.gateway.core.errors import FieldtwinError, Unreachable, UsageError
from fieldtwin.scenarios.bench import NothingKnown
from fieldtwin.twin.prototype.field_leases import LEASE_S

RENEW_EVERY_S = 2.0
OPEN_WITHIN_S = 2 * LEASE_S
"""Time in seconds to wait for a lease, because the lease of a killed process has to expire first."""
TRY_EVERY_S = 0.2
FRESH_TIMEOUT_S = 30.0


class LeaseLost(NothingKnown):
    """Raised when the lease ended before its scenario. Its faults and values were removed meanwhile, so no verdict is
    possible.
    """


class FieldLease:
    """The client side of a lease: ``await open()``, then `run` it as a task, and ``await release()`` at the end.

    `client` is a connection that only the lease uses.
    """

    def __init__(self, client: ControlClient) -> None:
        self.id = f"{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(4)}"
        self.lost: LeaseLost | None = None
        self.before = ""
        """Descriptions of the faults and values that were already active when the lease was opened, and that do not belong to
        the scenario.
        """
        self._client = client
        self._life = ""

    async def open(self) -> None:
        """Open the lease. Wait at most `OPEN_WITHIN_S` seconds for the end of another test runner's lease. Raises
        `Unreachable` after that.
        """
        loop = asyncio.get_running_loop()
        deadline_s = loop.time() + OPEN_WITHIN_S
        while True:
            try:
                answer = await self._client.call("lease", id=self.id, for_s=LEASE_S)
            except RemoteError as e:
                if e.kind != "LeaseTaken":
                    raise
                if loop.time() > deadline_s:
                    raise Unreachable(str(e)) from e
                await asyncio.sleep(TRY_EVERY_S)
                continue
            self._life = answer["life"]
            said = [f"the fault {fault['id']!r} ({fault['name']})" for fault in answer["faults"]]
            said += [f"{name} set to {value:g}" for name, value in answer["set"].items()]
            self.before = ", ".join(said)
            return

    async def run(self) -> None:
        """Renew the lease until cancelled, or until it is lost; then `lost` is the reason."""
        while self.lost is None:
            await asyncio.sleep(RENEW_EVERY_S)
            try:
                answer = await self._client.call("lease", id=self.id, for_s=LEASE_S, renew=True)
                if answer["life"] != self._life:
                    self.lost = LeaseLost("the simulated field devices were restarted by another program meanwhile")
            except RemoteError as e:
                self.lost = LeaseLost(str(e))
            except FieldtwinError as e:
                self.lost = LeaseLost(f"the simulated field devices cannot be reached: {e}")

    async def call(self, command: str, **args: Any) -> Any:
        """Call `fault` or `set` under this lease. Raises `LeaseLost`, and `UsageError` for invalid arguments."""
        try:
            return await self._client.call(command, lease=self.id, **args)
        except RemoteError as e:
            if e.kind == "LeaseEnded":
                self.lost = LeaseLost(str(e))
                raise self.lost from e
            if e.remote_exit_code == UsageError.exit_code:
                raise UsageError(str(e)) from e
            raise

    async def fresh(self) -> int:
        """Reset every device; return the time of the reset in ns on the host's monotonic clock."""
        answer = await self._client.call("fresh", FRESH_TIMEOUT_S, lease=self.id)
        self._life, self.before = answer["life"], ""
        return int(answer["now_ns"])

    async def release(self) -> None:
        """End the lease. If the field simulator cannot be reached, the lease expires by itself."""
        with suppress(FieldtwinError):
            await self._client.call("lease", id=self.id, release=True)
