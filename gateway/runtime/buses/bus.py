"""The interface of a bus to the gateway and its outputs, the same for each protocol.

Devices and tags are named as in the system file (``speed`` of ``drive``), so that a caller needs no driver of a certain
protocol. This module is independent of protocols: services that only one protocol has (jobs, LSS) are methods of its bus class.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import Protocol

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.gateway.core.errors import FieldtwinError, NotAllowed
from fieldtwin.gateway.core.histogram import Histogram
from fieldtwin.gateway.core.values import COMMAND
from fieldtwin.gateway.devices.config import BusConfig
from fieldtwin.gateway.runtime.buses.pending_config import PendingConfig
from fieldtwin.gateway.runtime.gateway_status import BusStatus, DeviceStatus, LatencyStatus

Ended = Callable[[str, FieldtwinError | None], None]
"""A function that is called once for each tag with the result of its write: None, or the error. The error of a tag that was
not sent is `HeldBack`.
"""

MOST_LOCALS = 64
"""The number of local addresses that are remembered. Each opening of the bus adds one."""


class HeldBack(NotAllowed):
    """A tag of an output group was not written, because a different tag of the group could not be written."""


def not_sent(where: str) -> HeldBack:
    """Return the error for a tag that was not sent because the write of another tag failed. `where` locates it."""
    return HeldBack("not sent: the write of another member of its group failed", where=where)


class Bus(Protocol):
    """A bus with its devices. It runs until cancelled, and opens its connection again whenever it is lost."""

    config: BusConfig
    connected: bool
    opens: int
    """The number of connections that were opened so far."""
    locals: deque[str]
    """The local addresses of the connections so far, the latest one last; an empty text for a medium without addresses."""
    error: str
    """The reason why the bus is not connected; empty while it is connected."""
    latency: Histogram

    def takes(self, device: str, tag: str) -> bool:
        """Return whether a write of this tag can be sent now: the device answers and is the expected one."""
        ...

    def frame_of(self, device: str, tag: str) -> object | None:
        """Return the frame in which this tag is sent together with others, or None for a tag that is sent by itself.

        All tags of one frame get the same object."""
        ...

    def settle_ns(self, device: str, tag: str) -> int:
        """Return how long after a write the device may still report the previous value, in ns."""
        ...

    def unrequested(self, device: str, tag: str) -> bool:
        """Return whether the device sends this tag by itself, so that the gateway does not have to poll it."""
        ...

    def write(self, device: str, writes: Sequence[tuple[str, COMMAND]], ended: Ended) -> None:
        """Start to write tags of one device, each with its command, in this order and with the fewest messages.

        After a failed write, the remaining tags are not sent. `ended` is called once for each tag, immediately if the bus cannot
        send it.
        """
        ...

    def reconfigure(self, coming: PendingConfig) -> None:
        """Take over a new configuration, each device's part between two of its polls."""
        ...

    def totals(self) -> Counter[str]:
        """Return counters over all connections so far."""
        ...

    def status(self) -> BusStatus:
        """Return the bus's part of the gateway's status."""
        ...

    def device_statuses(self, now_ns: int) -> dict[str, DeviceStatus]:
        """Return the statuses of the bus's devices, by name."""
        ...

    async def run(self) -> None:
        """Open the connection, serve, and open it again, until cancelled."""
        ...

    async def halt(self, timeout_s: float) -> None:
        """Stop sending, and put devices that the gateway started back into their earlier state; each may take `timeout_s`
        seconds.
        """
        ...


def status_of(bus: Bus) -> BusStatus:
    """Return the part of a bus's status that is the same for all kinds of buses."""
    return BusStatus(
        endpoint=str(bus.config.endpoint),
        connected=bus.connected,
        opens=bus.opens,
        local=sorted({address for address in bus.locals if address}),
        error=bus.error,
        counters=dict(bus.totals()),
        latency=latency_status(bus.latency),
    )


def latency_status(times: Histogram) -> LatencyStatus:
    """Return the response times of a bus as its status reports them."""
    return LatencyStatus(
        bounds_ms=[ns // NS_PER_MS for ns in times.limits_ns],
        counts=list(times.counts),
        total_s=times.total_ns / NS_PER_S,
    )
