"""Reconnect the run's control client to a remote field simulator, with back-off, after the simulator was lost.

Gateway, remote client and links have their own connections and reconnect by themselves; until then, values are bad.
This module knows only the control channel: when it was lost, when it came back, and whether the simulator is still the
same process.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

from fieldtwin.gateway.core.control import ControlClient, OtherVersion
from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid, ReplyTimeout, Unreachable
from fieldtwin.gateway.runtime.buses.backoff import Backoff
from fieldtwin.run.processes.field_contact import FieldContact, check_same, connect_control
from fieldtwin.twin.prototype.field_status import FieldStatus
from fieldtwin.twin.site.system import System

FIRST_S, LIMIT_S = 0.25, 4.0
CONNECT_S = 4.0
"""Time limit of an attempt in seconds: a host that is down does not answer, and without a limit TCP would try for minutes."""


class FieldReturn:
    """A watcher of `contact`, whose field simulator is at `where`. `run` it, and report a failed call to it with `lost`.

    `client` is None while the simulator does not answer. `returned` is called when one answers again, with True if it
    is a different process, which does not know the counts, values and commands of the first one.
    """

    def __init__(
        self,
        contact: FieldContact,
        system: System,
        where: str,
        token: str,
        returned: Callable[[bool], Awaitable[None]],
    ) -> None:
        self._contact = contact
        self._system = system
        self._where = where
        self._token = token
        self._returned = returned
        self._gone = asyncio.Event()
        self._gone_s = 0.0
        self._away_s = 0.0
        self._reason = ""
        self.losses = 0
        self.news = ""
        """A sentence for the user about the latest reconnection."""
        self.moved = ""
        """The reason why the gateway cannot reach the returned simulator, if any."""

    @property
    def client(self) -> ControlClient | None:
        return None if self._gone.is_set() else self._contact.client

    @property
    def trouble(self) -> str:
        """Return the current problem, in words that do not change while it lasts, or an empty string."""
        if not self._gone.is_set():
            return self.moved
        return self._reason or f"the field simulator at {self._where} was lost: the values of its devices are not known"

    def lost(self) -> None:
        """Record that the field simulator did not answer a call, or that the control connection is lost."""
        if not self._gone.is_set():
            self.losses += 1
            self._gone_s = asyncio.get_running_loop().time()
            self._gone.set()

    async def run(self) -> None:
        """Reconnect after every loss, until cancelled."""
        while True:
            await self._gone.wait()
            backoff = Backoff(FIRST_S, LIMIT_S)
            while not await self._try():
                await asyncio.sleep(backoff.next_s())
            away_s = asyncio.get_running_loop().time() - self._gone_s
            self._away_s += away_s
            self.news = f"the field simulator at {self._where} is back after {away_s:.1f} s"

    async def _try(self) -> bool:
        client: ControlClient | None = None
        try:
            async with asyncio.timeout(CONNECT_S):
                client, _ = await connect_control(self._where, self._token)
                status = await client.ask("get", FieldStatus)
            self._check(status)
            await self._contact.client.aclose()
            another = status.life != self._contact.life
            self._contact.client, client = client, None
            await self._returned(another)
            self._contact.life = status.life
            self._reason = ""
            self._gone.clear()
        except (FieldtwinError, TimeoutError) as e:
            if isinstance(e, FileInvalid | OtherVersion):
                self._reason = f"the field simulator at {self._where} came back with differences: {e}"
            return False
        finally:
            if client is not None:
                await client.aclose()
        return True

    def _check(self, status: FieldStatus) -> None:
        check_same(self._system, status)
        was = {
            **self._contact.listening,
            **{f"topside end of {d}": url for d, url in self._contact.reported_endpoints.items()},
        }
        now = {**status.listening, **{f"topside end of {d}": url for d, url in status.far.items()}}
        elsewhere = [
            f"{name} at {now.get(name, 'nothing')}, not {url}" for name, url in was.items() if now.get(name) != url
        ]
        self.moved = (
            f"the field simulator at {self._where} came back with different endpoints: {'; '.join(elsewhere)}. "
            "Give its buses fixed ports, in the prototype file or with --listen"
            if elsewhere
            else ""
        )

    def describe(self) -> dict[str, Any]:
        """Return the counts for the run's summary."""
        gone_s = asyncio.get_running_loop().time() - self._gone_s if self._gone.is_set() else 0.0
        return {"at": self._where, "losses": self.losses, "away_s": round(self._away_s + gone_s, 3)}


def is_loss(error: FieldtwinError) -> bool:
    """Return whether a failed call means that the other process, or the connection to it, is lost."""
    return isinstance(error, Unreachable | ReplyTimeout)
