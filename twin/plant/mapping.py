"""The only difference between a prototype and its plant: below the drivers, endpoints of emulators replace those of the plant.

Emulators are unknown here: this is a Connector that wraps a Connector (DESIGN.md, "Who opens a wire").
"""

from __future__ import annotations

from pathlib import Path

from fieldtwin.gateway.core.connection import ByteConnection, CanConnection, Connector
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Unreachable, UsageError


class MappedConnector:
    """A connector that opens `mapping[plant endpoint]` instead of the plant endpoint.

    An endpoint that is not mapped is refused, never opened.
    """

    def __init__(self, inner: Connector, mapping: dict[Endpoint, Endpoint]) -> None:
        self._inner = inner
        self._mapping = mapping

    def _target(self, endpoint: Endpoint) -> Endpoint:
        target = self._mapping.get(endpoint)
        if target is None:
            raise UsageError(
                "a prototype may not open a plant endpoint that is not mapped",
                where=str(endpoint),
                hint="map the bus in the prototype file, or set it to `plant`",
            )
        return target

    async def open_bytes(self, endpoint: Endpoint) -> ByteConnection:
        """Open the endpoint that replaces `endpoint`. Also raises `Unreachable` if its virtual serial port no longer exists."""
        target = self._target(endpoint)
        if target.is_serial and target != endpoint:
            _refuse_stale_link(target)
        return await self._inner.open_bytes(target)

    async def open_can(self, endpoint: Endpoint, bitrate: int) -> CanConnection:
        return await self._inner.open_can(self._target(endpoint), bitrate)


def _refuse_stale_link(target: Endpoint) -> None:
    """Raise `Unreachable` if `target` is a link to a pseudo-terminal that is newer than the link.

    The kernel reuses the numbers of pseudo-terminals. The link of an emulator that was killed may therefore lead to the terminal
    of another program, and the gateway must not send requests to that. The change time of a pseudo-terminal is the time of its
    creation, and an emulator makes its link later.
    """
    link = Path(target.path)
    try:
        device = link.resolve()
        stale = (
            link.is_symlink() and device.match("/dev/pts/*") and device.stat().st_ctime_ns > link.lstat().st_mtime_ns
        )
    except OSError:
        return  # opening it gives the reason
    if stale:
        raise Unreachable(
            "the virtual serial port is gone, and its link points to a newer pseudo-terminal", where=str(target)
        )


def mapped_endpoint(plant: Endpoint, listening: Endpoint) -> Endpoint:
    """Return the endpoint that the controller opens instead of `plant` if the emulator listens on `listening`.

    A pty is opened as the serial port that it replaces, with the plant's baud rate and character format.
    """
    if listening.scheme == "pty":
        return plant.with_path(listening.path)
    if plant.is_serial:
        raise UsageError("a serial line over TCP needs `fieldtwin link` to become a port", where=str(listening))
    return plant.with_address(listening.host, listening.port) if not plant.is_can else listening


def mapping_to_json(mapping: dict[Endpoint, Endpoint]) -> dict[str, str]:
    return {str(plant): str(target) for plant, target in mapping.items()}


def mapping_from_json(text: dict[str, str]) -> dict[Endpoint, Endpoint]:
    return {Endpoint.parse(plant): Endpoint.parse(target) for plant, target in text.items()}
