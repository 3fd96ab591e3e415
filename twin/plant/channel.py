"""A control channel that reconnects after a loss and reports why it is closed."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import msgspec

from fieldtwin.gateway.core.control import ControlClient
from fieldtwin.gateway.core.errors import ConnectionLost, FieldtwinError, ReplyTimeout, Unreachable

S = TypeVar("S", bound=msgspec.Struct)
ANSWERS_WITHIN_S = 2.0


class Channel:
    """The control channel of one process. A call opens it if it is closed; `trouble` is the reason of the last failure."""

    def __init__(self, path: Path, process: str) -> None:
        self.process = process
        """The name of the process in messages: gateway, PLC or field simulator."""
        self.trouble = ""
        self._path = path
        self._client: ControlClient | None = None

    @property
    def is_offered(self) -> bool:
        """Return whether the process has a control channel."""
        return self._path.is_socket()

    async def call(self, command: str, timeout_s: float = ANSWERS_WITHIN_S, **args: Any) -> Any:
        """Send a command and return its result.

        Raises `Unreachable`, `ConnectionLost` or `ReplyTimeout` if the process does not answer, and `RemoteError` if it refuses.
        """
        client = await self._connected()
        try:
            result = await client.call(command, timeout_s, **args)
        except (ConnectionLost, ReplyTimeout) as e:
            await self._lose(e)
            raise
        self.trouble = ""
        return result

    async def ask(self, command: str, kind: type[S], timeout_s: float = ANSWERS_WITHIN_S, **args: Any) -> S:
        """Send a command and return its result as a `kind`. Raises as `call`, and `OtherVersion`."""
        client = await self._connected()
        try:
            result = await client.ask(command, kind, timeout_s, **args)
        except (ConnectionLost, ReplyTimeout) as e:
            await self._lose(e)
            raise
        self.trouble = ""
        return result

    async def aclose(self) -> None:
        """Close the channel."""
        client, self._client = self._client, None
        if client is not None:
            await client.aclose()

    async def _connected(self) -> ControlClient:
        if self._client is None:
            try:
                self._client = await ControlClient.connect_unix(self._path)
            except Unreachable as e:
                self.trouble = f"the {self.process} does not run or has ended"
                raise Unreachable(self.trouble, where=str(self._path)) from e
        return self._client

    async def _lose(self, error: FieldtwinError) -> None:
        self.trouble = str(error)
        await self.aclose()
