"""A kernel CAN interface (SocketCAN), through python-can.

The kernel owns the interface: it must exist, be up, and run at the bit rate that the system file names. This module checks all
three and changes none of them. Frames arrive through `add_reader`, without threads. This module does not interpret frames.
"""

from __future__ import annotations

import asyncio
import errno
import os
import socket

import can

from fieldtwin.gateway.connections.can.message import message_of
from fieldtwin.gateway.connections.can.netlink import query_link
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.connection import CANConnection, CanConnection, closed_locally
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, Desync, Unreachable, UsageError, WireError
from fieldtwin.gateway.wallclock import WallClock

FRAMES_PER_TURN = 256
"""The largest number of frames read from the kernel before the event loop runs other tasks. Further frames stay in the kernel."""

RECEIVE_BUFFER_BYTES = 4 << 20

FIRST_BACKOFF_S, LAST_BACKOFF_S = 0.001, 0.05
SEND_TIMEOUT_S = 2.0
"""The time for which `send` waits while the transmit queue is full. If it stays full, no node acknowledges, or the controller
is bus-off.
"""


class SocketCanConnection(CanConnection):
    """One socket on a kernel CAN interface; create it with `open`.

    Error frames are received as frames with `error` set. A frame's `t_ns` is the kernel's time of reception, monotonic.
    """

    def __init__(self, endpoint: Endpoint, bus: can.BusABC, max_pending: int = 4096) -> None:
        super().__init__(CANConnection(), endpoint, max_pending)
        self.malformed = 0
        """Received frames that are not classic CAN frames (CAN FD)."""
        self.tx_retries = 0
        """Attempts to send while the transmit queue was full."""
        self._bus = bus
        self._clock = WallClock()
        self._turn = asyncio.Lock()  # keeps the order of concurrent senders, also while they back off
        self._loop = asyncio.get_running_loop()
        _enlarge(bus.fileno())
        self._loop.add_reader(bus.fileno(), self._on_readable)

    @classmethod
    async def open(cls, endpoint: Endpoint, bitrate: int, *, max_pending: int = 4096) -> SocketCanConnection:
        """Join ``can:socketcan/IFACE``.

        Raises `Unreachable` if the kernel has no SocketCAN, or the interface does not exist or is down; `UsageError` if
        it runs at a bit rate other than `bitrate` (bit/s; a virtual interface has no bit rate and accepts any).
        """
        if endpoint.interface != "socketcan":
            raise UsageError(f"{endpoint} is not a kernel CAN interface", expected="can:socketcan/IFACE")
        _check(endpoint, bitrate)
        try:
            bus = can.Bus(interface="socketcan", channel=endpoint.path, receive_own_messages=False, ignore_config=True)
        except (OSError, can.CanError) as e:
            raise _unreachable(endpoint, e) from e
        return cls(endpoint, bus, max_pending)

    async def send(self, frame: CanFrame) -> None:
        """Pass `frame` to the kernel, backing off while its transmit queue is full (ENOBUFS).

        Raises `ConnectionLost` if the interface is gone, `WireError` if the queue stays full for `SEND_TIMEOUT_S`.
        """
        message = message_of(frame, self.endpoint)
        async with self._turn:
            deadline = self._loop.time() + SEND_TIMEOUT_S
            backoff_s = FIRST_BACKOFF_S
            while not self._try_send(message):
                self.tx_retries += 1
                if self._loop.time() >= deadline:
                    raise WireError(
                        f"the transmit queue stayed full for {SEND_TIMEOUT_S:g} s",
                        where=str(self.endpoint),
                        hint="check the cable, the bit rate, that another node acknowledges, and that the bus is not off",
                    )
                await asyncio.sleep(backoff_s)
                backoff_s = min(2 * backoff_s, LAST_BACKOFF_S)

    def _try_send(self, message: can.Message) -> bool:
        if self._lost is not None:
            raise self._loss()
        try:
            self._bus.send(message, timeout=0)
        except can.CanOperationError as e:
            # python-can reports no number if the socket is not writable: that also means a full queue.
            if e.error_code in (errno.ENOBUFS, errno.EAGAIN, None):
                return False
            raise self._end(e) from e
        return True

    async def aclose(self) -> None:
        """Close the socket; the kernel still sends the frames that it has taken."""
        self._stop(closed_locally(self.endpoint))
        self.inbound.data_stream.clear()

    def _on_readable(self) -> None:
        try:
            for _ in range(FRAMES_PER_TURN):
                message = self._bus.recv(0)
                if message is None:
                    return
                self._take(message)
        except (OSError, can.CanError) as e:
            self._end(e)

    def _take(self, message: can.Message) -> None:
        if message.is_fd:
            self.malformed += 1
            return
        # The kernel's time stamps are UTC; the age of a frame gives its time on the monotonic clock.
        age_ns = max(0, self._clock.utc_ns() - int(message.timestamp * NS_PER_S))
        try:
            frame = CanFrame(
                message.arbitration_id,
                b"" if message.is_remote_frame else bytes(message.data),
                extended=message.is_extended_id,
                remote=message.is_remote_frame,
                error=message.is_error_frame,
                dlc=message.dlc,
                t_ns=self._clock.monotonic_ns() - age_ns,
            )
        except Desync:
            self.malformed += 1
            return
        self.feed(frame)

    def _end(self, error: Exception) -> ConnectionLost:
        lost = ConnectionLost(f"the CAN interface is gone: {error}", where=str(self.endpoint), hint=_up(self.endpoint))
        self._stop(lost)
        return lost

    def _stop(self, reason: ConnectionLost) -> None:
        if self._lost is None:
            self._loop.remove_reader(self._bus.fileno())
            self._bus.shutdown()
        self.feed_lost(reason)


def _check(endpoint: Endpoint, bitrate: int) -> None:
    """Refuse an interface that does not exist, is not CAN, is down, or has another bit rate, before python-can opens a socket."""
    try:
        socket.socket(socket.PF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
        link = query_link(endpoint.path)
    except AttributeError as e:  # an operating system without these families
        raise _unreachable(endpoint, OSError(errno.EAFNOSUPPORT, "no SocketCAN")) from e
    except OSError as e:
        raise _unreachable(endpoint, e) from e
    if not link.is_can:
        raise Unreachable(f"{endpoint.path} is not a CAN interface", where=str(endpoint), hint="ip -brief link show")
    if not link.is_up:
        raise Unreachable(f"{endpoint.path} is down", where=str(endpoint), hint=_up(endpoint))
    if link.bitrate and bitrate and link.bitrate != bitrate:
        raise UsageError(
            f"{endpoint.path} runs at a different bit rate",
            expected=f"{bitrate} bit/s",
            got=f"{link.bitrate} bit/s",
            where=str(endpoint),
            hint=f"ip link set {endpoint.path} down && ip link set {endpoint.path} type can bitrate {bitrate}",
        )


def _unreachable(endpoint: Endpoint, error: Exception) -> Unreachable:
    number = getattr(error, "errno", None) or getattr(error, "error_code", None)
    if number in (errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT):
        text, hint = (
            "this kernel has no SocketCAN",
            "modprobe can_raw, or use the software bus: can:fieldtwin/HOST:PORT",
        )
    elif number in (errno.ENODEV, errno.ENXIO):
        text = f"there is no interface {endpoint.path}"
        hint = "ip -brief link show; for a virtual one: ip link add vcan0 type vcan && ip link set vcan0 up"
    else:
        text, hint = f"cannot open {endpoint.path}: {error}", _up(endpoint)
    return Unreachable(text, where=str(endpoint), hint=hint)


def _up(endpoint: Endpoint) -> str:
    return f"ip link set {endpoint.path} up"


def _enlarge(descriptor: int) -> None:
    """Enlarge the receive buffer as far as the kernel allows: the default holds a few hundred frames."""
    with socket.socket(fileno=os.dup(descriptor)) as can_socket:
        can_socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
