"""An emulated node's own end of a CAN bus: the software bus over TCP, or a kernel interface through python-can.

It shares no code with the gateway's side (fieldtwin.gateway.connections), so that each side reveals mistakes of the
other. It does not interpret frames.
"""

from __future__ import annotations

import asyncio
import errno
import os
import socket
from pathlib import Path

import can
from msgspec.structs import replace

from fieldtwin.emulators.endpoints.can.bus_hello import (
    WANTS_CONFIRMATIONS,
    WANTS_ERRORS,
    BusHello,
    Status,
    unpack_hello,
)
from fieldtwin.emulators.endpoints.can.overrun import ReportsOverrun
from fieldtwin.gateway.core.canframe import RECORD_SIZE, CanFrame, pack_record, unpack_record
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.connection import CANConnection, CanConnection, closed_locally
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import (
    ConnectionLost,
    Desync,
    EndpointBusy,
    FieldtwinError,
    Unreachable,
    UsageError,
    WireError,
    os_reason,
)

OPEN_TIMEOUT_S = 5.0
CLOSE_TIMEOUT_S = 1.0
TX_FULL_TIMEOUT_S = 2.0
TX_RETRY_S = 0.005
FRAMES_PER_TURN = 256
RECEIVE_BUFFER_BYTES = 4 << 20
ARPHRD_CAN = "280"  # include/uapi/linux/if_arp.h


async def open_can_end(endpoint: Endpoint, bitrate: int) -> CanConnection:
    """Join the bus at `endpoint`: ``can:fieldtwin/HOST:PORT`` or ``can:socketcan/IFACE``.

    A software bus must run at `bitrate` bit/s (0: any), else `UsageError`; the bit rate of a kernel interface is set in
    the kernel. Raises `Unreachable` if there is no such bus, `EndpointBusy` if it is full, `UsageError` for a different
    kind of endpoint.
    """
    if endpoint.interface == "fieldtwin":
        return await _join_soft_bus(endpoint, bitrate)
    if endpoint.interface == "socketcan":
        return _open_kernel_end(endpoint)
    raise UsageError(f"no emulator can join {endpoint}", expected="can:fieldtwin/HOST:PORT or can:socketcan/IFACE")


async def _join_soft_bus(endpoint: Endpoint, bitrate: int) -> SoftBusEnd:
    host, port = endpoint.address
    try:
        async with asyncio.timeout(OPEN_TIMEOUT_S):
            reader, writer = await asyncio.open_connection(host, port)
    except OSError as e:  # includes TimeoutError
        raise Unreachable(f"cannot reach the software CAN bus: {os_reason(e)}", where=str(endpoint)) from e
    try:
        loop = asyncio.get_running_loop()
        asked_ns = int(loop.time() * NS_PER_S)
        async with asyncio.timeout(OPEN_TIMEOUT_S):
            writer.write(BusHello(bitrate, options=WANTS_CONFIRMATIONS | WANTS_ERRORS).pack())
            answer = unpack_hello(await reader.readexactly(RECORD_SIZE))
        if answer is None:
            raise Unreachable("the program that answers there is not a software CAN bus", where=str(endpoint))
        _check_answer(answer, bitrate, endpoint)
    except (OSError, EOFError) as e:
        await _hang_up(writer)
        raise Unreachable("the program that listens there is not a software CAN bus", where=str(endpoint)) from e
    except BaseException:
        await _hang_up(writer)
        raise
    # Processes on one host share a monotonic clock; the offset of a remote bus's clock is known to half a round trip.
    told_ns = int(loop.time() * NS_PER_S)
    offset_ns = 0 if asked_ns <= answer.t_ns <= told_ns else (asked_ns + told_ns) // 2 - answer.t_ns
    return SoftBusEnd(endpoint, reader, writer, answer.window, offset_ns)


def _check_answer(answer: BusHello, bitrate: int, endpoint: Endpoint) -> None:
    """Raise the error for an answer by which the bus refuses the node."""
    if answer.status == Status.WRONG_BITRATE:
        raise UsageError(
            "the software CAN bus runs at a different bit rate",
            expected=f"{bitrate} bit/s",
            got=f"{answer.bitrate} bit/s",
            where=str(endpoint),
        )
    if answer.status == Status.FULL:
        raise EndpointBusy("the software CAN bus is full", where=str(endpoint))
    if answer.status != Status.WELCOME:
        raise Unreachable(
            "the software CAN bus does not support this protocol version",
            got=f"version {answer.version}",
            where=str(endpoint),
        )


class SoftBusEnd(ReportsOverrun):
    """A node on the software bus over TCP: a task reads records, `send` keeps within the bus's transmit window.

    Error frames (gateway/core/can_error.py) report changes of its controller's state, and overruns.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        window: int,
        offset_ns: int,
    ) -> None:
        super().__init__(CANConnection(), endpoint)
        self._reader = reader
        self._writer = writer
        self._offset_ns = offset_ns
        self._slots = asyncio.Semaphore(max(window, 1))  # wakes its waiters in order
        self._unconfirmed = 0
        self._all_sent = asyncio.Event()
        self._all_sent.set()
        self._task = asyncio.create_task(self._read_records(), name=f"bus {endpoint}")

    async def send(self, frame: CanFrame) -> None:
        if frame.error:
            raise UsageError("a node cannot send an error frame", got=str(frame), where=str(self.endpoint))
        await self._slots.acquire()
        if self.lost is not None:
            self._slots.release()
            raise self._loss()
        self._unconfirmed += 1
        self._all_sent.clear()
        self._writer.write(pack_record(frame))

    async def aclose(self) -> None:
        """Leave the bus as soon as it has sent all frames of this node, or after one second."""
        if self.lost is None:
            try:
                await asyncio.wait_for(self._all_sent.wait(), CLOSE_TIMEOUT_S)
            except TimeoutError:
                pass  # the bus is slow: it sends the rest after this node has left
        self._end(closed_locally(self.endpoint))
        self.inbound.data_stream.clear()
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)
        await _hang_up(self._writer)

    async def _read_records(self) -> None:
        try:
            while True:
                frame, confirmed = unpack_record(await self._reader.readexactly(RECORD_SIZE))
                if not confirmed:
                    self.feed(replace(frame, t_ns=frame.t_ns + self._offset_ns))
                    continue
                self._unconfirmed -= 1
                self._slots.release()
                if not self._unconfirmed:
                    self._all_sent.set()
        except (OSError, EOFError) as e:
            self._end(ConnectionLost(f"the software CAN bus is gone: {e}", where=str(self.endpoint)))
        except Desync as e:
            self._end(ConnectionLost(f"the software CAN bus sent no record: {e}", where=str(self.endpoint)))

    def _end(self, reason: FieldtwinError) -> None:
        self.feed_lost(reason)
        self._all_sent.set()
        self._slots.release()  # each waiting task that wakes and finds the end wakes the next one


async def _hang_up(writer: asyncio.StreamWriter) -> None:
    writer.close()
    try:
        await asyncio.wait_for(writer.wait_closed(), CLOSE_TIMEOUT_S)
    except OSError:  # the connection was reset, or the peer has stopped reading
        writer.transport.abort()


def _no_interface(endpoint: Endpoint) -> Unreachable:
    """Return the error for a missing interface, or for a kernel without CAN."""
    instead = "or use the software bus: can:fieldtwin/HOST:PORT"
    try:
        socket.socket(socket.PF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (AttributeError, OSError):  # AttributeError: a system, or a Python build, without CAN sockets
        return Unreachable("this kernel has no SocketCAN", where=str(endpoint), hint=f"modprobe can_raw, {instead}")
    make = f"ip link add {endpoint.path} type vcan && ip link set {endpoint.path} up"
    return Unreachable(f"there is no interface {endpoint.path}", where=str(endpoint), hint=f"{make}, {instead}")


def _open_kernel_end(endpoint: Endpoint) -> KernelCanEnd:
    link = Path("/sys/class/net") / endpoint.path
    try:
        kind = (link / "type").read_text().strip()
        up = int((link / "flags").read_text(), 16) & 1
    except OSError as e:
        raise _no_interface(endpoint) from e
    if kind != ARPHRD_CAN:
        raise Unreachable(f"{endpoint.path} is not a CAN interface", where=str(endpoint))
    if not up:
        raise Unreachable(f"{endpoint.path} is down", where=str(endpoint), hint=f"ip link set {endpoint.path} up")
    try:
        bus = can.Bus(interface="socketcan", channel=endpoint.path, ignore_config=True)
    except (OSError, can.CanError) as e:
        raise Unreachable(f"cannot open {endpoint.path}: {e}", where=str(endpoint)) from e
    return KernelCanEnd(endpoint, bus)


class KernelCanEnd(ReportsOverrun):
    """A node on a kernel interface (usually vcan). Frames are stamped when they are read."""

    def __init__(self, endpoint: Endpoint, bus: can.BusABC) -> None:
        super().__init__(CANConnection(), endpoint)
        self._bus = bus
        self._loop = asyncio.get_running_loop()
        self._order = asyncio.Lock()
        _enlarge(bus.fileno())
        self._loop.add_reader(bus.fileno(), self._read_some)

    async def send(self, frame: CanFrame) -> None:
        """Send a frame. Raises `WireError` if the kernel's transmit queue stays full for `TX_FULL_TIMEOUT_S`."""
        message = can.Message(
            arbitration_id=frame.can_id,
            data=frame.data,
            dlc=frame.dlc,
            is_extended_id=frame.extended,
            is_remote_frame=frame.remote,
        )
        async with self._order:
            give_up = self._loop.time() + TX_FULL_TIMEOUT_S
            while self.lost is None:
                try:
                    return self._bus.send(message, timeout=0)
                except can.CanOperationError as e:
                    if e.error_code not in (None, errno.ENOBUFS, errno.EAGAIN):
                        self._end(ConnectionLost(f"{self.endpoint.path} is gone: {e}", where=str(self.endpoint)))
                    elif self._loop.time() > give_up:
                        raise WireError("the transmit queue stays full", where=str(self.endpoint)) from e
                    else:
                        await asyncio.sleep(TX_RETRY_S)
            raise self._loss()

    async def aclose(self) -> None:
        self._end(closed_locally(self.endpoint))
        self.inbound.data_stream.clear()

    def _read_some(self) -> None:
        try:
            for _ in range(FRAMES_PER_TURN):  # further frames keep the descriptor readable
                message = self._bus.recv(0)
                if message is None:
                    return
                if not message.is_fd:
                    self.feed(self._frame(message))
        except (OSError, can.CanError) as e:
            self._end(ConnectionLost(f"{self.endpoint.path} is gone: {e}", where=str(self.endpoint)))

    def _frame(self, message: can.Message) -> CanFrame:
        return CanFrame(
            message.arbitration_id,
            b"" if message.is_remote_frame else bytes(message.data),
            extended=message.is_extended_id,
            remote=message.is_remote_frame,
            error=message.is_error_frame,
            dlc=message.dlc,
            t_ns=int(self._loop.time() * NS_PER_S),
        )

    def _end(self, reason: FieldtwinError) -> None:
        if self.lost is None:
            self._loop.remove_reader(self._bus.fileno())
            self._bus.shutdown()
        self.feed_lost(reason)


def _enlarge(descriptor: int) -> None:
    """Enlarge the receive buffer as far as the kernel allows: the default one holds some hundred frames."""
    with socket.socket(fileno=os.dup(descriptor)) as can_socket:
        can_socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
