"""The interface ``fieldtwin`` of python-can: a node on the software CAN bus, for any program that uses python-can.

``python -m can.logger -i fieldtwin -c HOST:PORT``, ``canopen.Network.connect(interface="fieldtwin", channel=...)``. The entry
point in pyproject.toml registers this module with python-can. The gateway itself joins the bus with `can.soft_bus`.
"""

from __future__ import annotations

import select
import socket
import threading

import can
from can.typechecking import CanFilters

from fieldtwin.gateway.connections.can.soft_bus import CLOSE_TIMEOUT_S, OPEN_TIMEOUT_S, not_reached
from fieldtwin.gateway.connections.can.soft_bus_hello import ask, read_answer
from fieldtwin.gateway.core.canframe import FD_RECORD_SIZE, RECORD_SIZE, CanFrame, pack_record, unpack_record
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Desync, FieldtwinError, UsageError
from fieldtwin.gateway.wallclock import WallClock

SEND_BUFFER_BYTES = 8 * 1024
"""The size of the kernel's send buffer. It is small because a new frame waits behind all buffered ones."""


class SoftBus(can.BusABC):
    """The class for python-can's interface ``fieldtwin``. `channel` is ``HOST:PORT`` of a software CAN bus.

    `bitrate` (bit/s) is checked against the bus's; 0 accepts any. With `fd` it also sends and receives CAN FD frames, and
    `data_bitrate` (bit/s, 0: any) is checked likewise. With `receive_own_messages` own frames are received, with ``is_rx`` false,
    after they were sent on the bus. Time stamps are seconds since 1970, and mark the exact end of the frame on the bus. `recv`
    takes exactly one record from the socket, so its descriptor stays readable while more records wait; `fileno` serves
    `can.Notifier` with a loop. Errors are those of python-can: `CanInitializationError` if the bus cannot be joined,
    `CanOperationError` if it is gone, `CanTimeoutError` if it accepts no more frames.

    Error frames have the layout of the kernel's interface and pass all filters. They are received when this node's
    controller becomes error-passive, bus-off or active again, and when frames for it were lost; with `bus_errors` also
    for each error on the bus.

    If a program requests its own messages but does not read them, the bus stops accepting frames from it.
    """

    def __init__(
        self,
        channel: str,
        can_filters: CanFilters | None = None,
        *,
        bitrate: int = 0,
        receive_own_messages: bool = False,
        timeout: float = OPEN_TIMEOUT_S,
        fd: bool = False,
        data_bitrate: int = 0,
        bus_errors: bool = False,
        # Programs of python-can pass this argument to every interface; a handle on this bus always belongs to one
        # program.
        single_handle: bool = True,
    ) -> None:
        if data_bitrate and not fd:
            raise can.CanInitializationError("a data bit rate needs CAN FD: fd=True")
        self._fd = fd
        self._record_size = FD_RECORD_SIZE if fd else RECORD_SIZE
        clock = WallClock()
        self._clock = clock
        self._partial = b""
        self._unsent = b""
        self._sending = threading.Lock()
        try:
            host, port = Endpoint.parse(f"can:fieldtwin/{channel}").address
            self._socket = socket.create_connection((host, port), timeout)
        except UsageError as e:
            raise can.CanInitializationError(str(e)) from e
        except OSError as e:
            raise can.CanInitializationError(str(not_reached(e, f"can:fieldtwin/{channel}"))) from e
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
            asked_ns = clock.monotonic_ns()
            request = ask(
                bitrate, confirmations=receive_own_messages, violations=bus_errors, fd=fd, data_bitrate=data_bitrate
            )
            self._socket.sendall(request)
            welcome = read_answer(
                self._read_answer(), bitrate, f"can:fieldtwin/{channel}", fd=fd, data_bitrate=data_bitrate
            )
            offset_ns = welcome.clock_offset_ns(asked_ns, clock.monotonic_ns())
            self._utc_minus_bus_ns = offset_ns + clock.utc_ns() - clock.monotonic_ns()
            self._socket.setblocking(False)
        except (OSError, FieldtwinError) as e:
            self._socket.close()
            raise can.CanInitializationError(str(e)) from e
        self.channel_info = f"fieldtwin bus {channel} at {welcome.bitrate} bit/s"
        self._channel = channel
        super().__init__(channel, can_filters)
        self._can_protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20

    def _read_answer(self) -> bytes:
        answer = b""
        while len(answer) < RECORD_SIZE and (more := self._socket.recv(RECORD_SIZE - len(answer))):
            answer += more
        return answer

    def fileno(self) -> int:
        """Return the socket's descriptor, for `select` and `add_reader`; -1 after `shutdown`."""
        return self._socket.fileno()

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next message, or None after `timeout` seconds (None: wait without a limit).

        If another thread calls `shutdown` meanwhile, this call returns None at the end of its timeout, or immediately if it has
        no timeout, because python-can's Notifier keeps polling until it is stopped. Raises `can.CanOperationError` if the bus is
        gone.
        """
        deadline_ns = self._clock.monotonic_ns() + int((timeout or 0) * NS_PER_S)
        try:
            return super().recv(timeout)
        except can.CanOperationError:
            if not self._is_shutdown:
                raise
        threading.Event().wait(
            max(0, deadline_ns - self._clock.monotonic_ns()) / NS_PER_S
        )  # an event that is never set
        return None

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        try:
            if not select.select([self._socket], [], [], timeout)[0]:
                return None, False
            # Never more than the rest of one record: further records must keep the descriptor readable.
            data = self._socket.recv(self._record_size - len(self._partial))
        except BlockingIOError:
            return None, False  # another thread was faster
        except (OSError, ValueError) as e:  # ValueError: shut down by another thread
            raise can.CanOperationError(f"the software CAN bus is gone: {e}") from e
        if not data:
            raise can.CanOperationError("the software CAN bus closed")
        self._partial += data
        if len(self._partial) < self._record_size:
            return None, False
        record, self._partial = self._partial, b""
        try:
            frame, own = unpack_record(record)
        except Desync as e:
            raise can.CanOperationError(str(e)) from e
        return self._message(frame, own), frame.error  # python-can's filters are for frames of the bus only

    def _message(self, frame: CanFrame, own: bool) -> can.Message:
        return can.Message(
            timestamp=(frame.t_ns + self._utc_minus_bus_ns) / NS_PER_S,
            arbitration_id=frame.can_id,
            is_extended_id=frame.extended,
            is_remote_frame=frame.remote,
            is_error_frame=frame.error,
            channel=self._channel,
            dlc=frame.dlc,
            data=frame.data,
            is_rx=not own,
            is_fd=frame.fd,
            bitrate_switch=frame.brs,
            error_state_indicator=frame.esi,
        )

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Pass `msg` to the bus, waiting at most `timeout` seconds while the bus accepts no frames (None: without a limit)."""
        if msg.is_fd and not self._fd:
            raise can.CanOperationError("a CAN FD frame needs an interface that was opened with fd=True")
        record = pack_record(_frame_of(msg), fd=self._fd)
        deadline_ns = None if timeout is None else self._clock.monotonic_ns() + int(timeout * NS_PER_S)
        with self._sending:
            self._flush(deadline_ns)  # first the rest of a record that a timeout cut in two
            self._unsent = record
            try:
                self._flush(deadline_ns)
            except can.CanTimeoutError:
                if len(self._unsent) == self._record_size:
                    self._unsent = b""  # no byte of it was sent
                    raise

    def _flush(self, deadline_ns: int | None) -> None:
        while self._unsent:
            left_s = None if deadline_ns is None else max(0, deadline_ns - self._clock.monotonic_ns()) / NS_PER_S
            try:
                if not select.select([], [self._socket], [], left_s)[1]:
                    raise can.CanTimeoutError("the software CAN bus accepts no more frames at present")
                self._unsent = self._unsent[self._socket.send(self._unsent) :]
            except can.CanTimeoutError:
                raise  # CanTimeoutError is also an OSError, through TimeoutError
            except BlockingIOError:
                pass  # the buffer was filled between select and send
            except (OSError, ValueError) as e:
                raise can.CanOperationError(f"the software CAN bus is gone: {e}") from e

    def shutdown(self) -> None:
        """Leave the bus after it has accepted the frames sent (waiting at most `CLOSE_TIMEOUT_S`). A second call does nothing."""
        if self._is_shutdown:
            return
        super().shutdown()
        deadline_ns = self._clock.monotonic_ns() + int(CLOSE_TIMEOUT_S * NS_PER_S)
        try:
            # Closing with unread records would reset the connection, and the bus would lose frames that it has not read yet.
            self._socket.shutdown(socket.SHUT_WR)
            self._socket.setblocking(True)
            while (left_ns := deadline_ns - self._clock.monotonic_ns()) > 0:
                self._socket.settimeout(left_ns / NS_PER_S)
                if not self._socket.recv(65536):
                    break
            self._socket.shutdown(socket.SHUT_RDWR)  # ends a `recv` of another thread
        except OSError:
            pass  # the bus was already gone, or is slow
        self._socket.close()


def _frame_of(msg: can.Message) -> CanFrame:
    if msg.is_error_frame:
        raise can.CanOperationError("only data and remote frames can be sent")
    try:
        return CanFrame(
            msg.arbitration_id,
            b"" if msg.is_remote_frame else bytes(msg.data),
            extended=msg.is_extended_id,
            remote=msg.is_remote_frame,
            dlc=min(msg.dlc, 8) if msg.is_remote_frame else -1,
            fd=msg.is_fd,
            brs=msg.bitrate_switch,
            esi=msg.error_state_indicator,
        )
    except Desync as e:
        raise can.CanOperationError(str(e)) from e
