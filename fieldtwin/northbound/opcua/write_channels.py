"""The connections to the gateway's control channel over which an OPC UA server writes.

A write waits for its device, and a connection carries one request at a time, so each write in flight has its own.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fieldtwin.twin.plant.channel import Channel

ANSWERS_WITHIN_S = 7.0
"""Time limit of a write in seconds. It is longer than that of the gateway, which knows whether the value may still be written."""


class WriteChannels:
    """Connections that are opened when they are needed and kept; as many as calls were in flight at a time."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._free: list[Channel] = []

    async def call(self, command: str, **args: Any) -> Any:
        """Call a command of the gateway. Raises as `Channel.call`."""
        channel = self._free.pop() if self._free else Channel(self._path, "gateway")
        try:
            return await channel.call(command, ANSWERS_WITHIN_S, **args)
        finally:
            self._free.append(channel)

    async def aclose(self) -> None:
        """Close the connections that no call uses."""
        while self._free:
            await self._free.pop().aclose()
