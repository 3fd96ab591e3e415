"""The CAN bus of a single emulated node: an existing bus, or a software bus that is made for it."""

from __future__ import annotations

from collections.abc import Sequence

from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.emulators.endpoints.ports import CanPort, JoinedBus, ServedBus
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import EndpointBusy, Unreachable, UsageError

DEFAULT_BIT_RATE = 125_000


def only_bus(wires: Sequence[Endpoint]) -> Endpoint:
    """Return the only one of `wires`, which has to be a CAN bus. Raises `UsageError` otherwise."""
    if len(wires) != 1 or not wires[0].is_can:
        raise UsageError(
            "a CANopen node needs a CAN bus",
            expected="--on can:fieldtwin/127.0.0.1:29536 or can:socketcan/vcan0",
            got=" ".join(map(str, wires)),
        )
    return wires[0]


async def open_bus(wire: Endpoint, bitrate: int | None) -> tuple[CanPort, str]:
    """Create the software bus at `wire` in this process, at `bitrate` bit/s.

    If it exists already, or is a kernel bus, the returned port joins it. Returns the port and a description of its place.
    Raises `Unreachable`, `EndpointBusy`, or `UsageError` where a bus runs at a bit rate other than the requested one
    (None: any).
    """
    if wire.interface != "fieldtwin":
        return JoinedBus(wire, bitrate or DEFAULT_BIT_RATE), str(wire)
    try:
        made = await SoftBusServer.open(wire, bitrate or DEFAULT_BIT_RATE)
    except (EndpointBusy, Unreachable):  # another process listens there, or the address belongs to another computer
        return JoinedBus(wire, bitrate or 0), f"{wire}, with others"
    host, port = made.bound.address
    look = f"python -m can.viewer -i fieldtwin -c {host}:{port}"
    return ServedBus(made), f"{made.bound}, a new bus with {made.bitrate} bit/s (watch it: {look})"
