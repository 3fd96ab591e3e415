"""The only difference between a prototype and its plant: below the drivers, endpoints of emulators replace those of the plant.

This module does not depend on emulators: it contains a Connector that wraps a Connector, so that drivers and gateway are the
same in prototype and plant.
"""

from __future__ import annotations

from fieldtwin.gateway.core.connection import ByteConnection, CanConnection, Connector
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError


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
        return await self._inner.open_bytes(self._target(endpoint))

    async def open_can(self, endpoint: Endpoint, bitrate: int) -> CanConnection:
        return await self._inner.open_can(self._target(endpoint), bitrate)


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
