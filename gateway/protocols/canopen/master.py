"""The CANopen master on one bus. It alone reads the bus's CanConnection, and it provides the services that drivers use.

It is a thin asyncio layer around the protocol modules (`sdo`, `nmt`, `pdo`, `emcy`), which quote the clauses of the standard. It
is independent of particular devices and of bus hardware.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S, Clock
from fieldtwin.gateway.core.connection import CanConnection
from fieldtwin.gateway.core.errors import (
    Bug,
    ConnectionLost,
    Desync,
    FieldtwinError,
    ReplyTimeout,
    SdoAborted,
    UsageError,
)
from fieldtwin.gateway.core.histogram import response_times
from fieldtwin.gateway.protocols.canopen import cob_id
from fieldtwin.gateway.protocols.canopen.nmt import states as nmt
from fieldtwin.gateway.protocols.canopen.nmt.heartbeat import HeartbeatConsumer
from fieldtwin.gateway.protocols.canopen.nmt.states import NmtCommand, NmtState, NodeEvent, conflict_text
from fieldtwin.gateway.protocols.canopen.sdo import abort_codes
from fieldtwin.gateway.protocols.canopen.sdo.block import SdoBlockDownload, SdoBlockUpload
from fieldtwin.gateway.protocols.canopen.sdo.channel import SdoChannel, SdoCounters
from fieldtwin.gateway.protocols.canopen.sdo.transfers import (
    WHOLE_S,
    SdoDownload,
    SdoTransfer,
    SdoUpload,
    TransferTooLong,
)

PdoCallback = Callable[[bytes, int], None]
"""A callback with the frame's data and its time of reception (monotonic, ns)."""

EventCallback = Callable[[NodeEvent], None]


def _nobody(event: NodeEvent) -> None:
    pass


def _no_one(data: bytes, t_ns: int) -> None:
    pass


class CanopenMaster:
    """SDO client, NMT master, heartbeat consumer, PDO and EMCY receiver for the nodes of one bus.

    Frames are received only while `run` is running. `on_event` may be set at any time. `run` calls it and the PDO callbacks. They
    must be quick. An exception in a callback is a bug, so it is not hidden: it ends `run`.

    `sdo_timeout_s` is the timeout for each SDO reply of a node without its own setting. `sdo_retries` is how often an
    upload without a valid reply is repeated. `sdo_transfer_s` is the longest time for a whole SDO transfer, in seconds;
    a transfer that reaches it ends with `ReplyTimeout` and is not repeated. `short_sdo` also accepts SDO replies of
    fewer than 8 bytes (CO-026).
    """

    def __init__(
        self,
        connection: CanConnection,
        clock: Clock,
        *,
        sdo_timeout_s: float = 0.5,
        sdo_retries: int = 0,
        sdo_transfer_s: float = WHOLE_S,
        short_sdo: bool = False,
        on_event: EventCallback | None = None,
    ) -> None:
        self.counters = SdoCounters()
        self.latency = response_times()  # durations of completed SDO transfers
        self.on_event: EventCallback = on_event or _nobody
        self.on_sync: PdoCallback = _no_one
        """A function that is called with each SYNC that this master did not send. Like `on_event`, it may be set at any time."""
        self.conflicts: dict[int, str] = {}
        """Detected conflicts by node ID, as text that contains the last two replies to one request."""
        self._connection = connection
        self._clock = clock
        self._sdo_timeout_s = sdo_timeout_s
        self._sdo_retries = sdo_retries
        self._sdo_transfer_s = sdo_transfer_s
        self._short_sdo = short_sdo
        self._timeouts_s: dict[int, float] = {}
        self._retries: dict[int, int] = {}
        self._transfers_s: dict[int, float] = {}
        self._heartbeat = HeartbeatConsumer()
        self._channels: dict[int, SdoChannel] = {}
        self._pdos: dict[int, list[PdoCallback]] = {}
        self._services: dict[int, PdoCallback] = {}
        self._stopped: ConnectionLost | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._timer_due_ns = 0

    # -- services for drivers -------------------------------------------------------------------------------------

    def add_node(
        self,
        node: int,
        *,
        heartbeat_consumer_ms: int = 0,
        sdo_timeout_s: float | None = None,
        sdo_retries: int | None = None,
        sdo_transfer_s: float | None = None,
    ) -> None:
        """Register `node`. If a consumer time is given, the node is monitored from its first heartbeat on.

        If `sdo_timeout_s`, `sdo_retries` or `sdo_transfer_s` is None, the setting of the master applies.
        """
        self._channel(cob_id.check_node(node))
        if sdo_timeout_s is not None:
            self._timeouts_s[node] = sdo_timeout_s
        if sdo_retries is not None:
            self._retries[node] = sdo_retries
        if sdo_transfer_s is not None:
            self._transfers_s[node] = sdo_transfer_s
        self._heartbeat.monitor(node, heartbeat_consumer_ms)
        self._arm()

    def node_state(self, node: int) -> NmtState | None:
        """Return the NMT state that the node reported last, or None if it never did."""
        return self._heartbeat.state(node)

    def heartbeat_watched(self, node: int) -> bool:
        """Return whether the node has a heartbeat consumer time and has sent a heartbeat, so that its loss is an event."""
        return self._heartbeat.is_watched(node)

    def heartbeat_lost(self, node: int) -> bool:
        """Return whether the node is monitored and its heartbeat is overdue."""
        return self._heartbeat.is_lost(node)

    async def sdo_upload(
        self,
        node: int,
        index: int,
        subindex: int,
        timeout_s: float | None = None,
        *,
        length: int | None = None,
        block: bool = False,
        retries: int | None = None,
    ) -> bytes:
        """Read an object. `timeout_s` is for each reply; `length` is the object's size if known (CO-029).

        Each node has one transfer at a time, in the order of the calls; nodes are served in parallel. A late reply is
        never taken for the reply to a later request, even for the same object (see `late_replies`). A transfer without
        a valid reply is repeated `retries` times. `block` is for long objects; if a node does not support block
        transfer, the transfer is repeated without it. Raises `SdoAborted`, `ReplyTimeout`, `Desync` or
        `ConnectionLost`.
        """
        timeout_ns = self._ns(node, timeout_s)
        again = self._retries.get(node, self._sdo_retries) if retries is None else retries
        if block:
            try:
                return await self._transfer(
                    lambda: SdoBlockUpload(node, index, subindex, timeout_ns, length=length), again
                )
            except SdoAborted as e:
                if e.code != abort_codes.UNKNOWN_SPECIFIER:
                    raise
        return await self._transfer(lambda: SdoUpload(node, index, subindex, timeout_ns, length=length), again)

    async def sdo_download(
        self,
        node: int,
        index: int,
        subindex: int,
        data: bytes,
        timeout_s: float | None = None,
        *,
        block: bool = False,
        retries: int = 0,
    ) -> None:
        """Write an object, with parameters and errors as `sdo_upload`.

        After a `ReplyTimeout` the node may or may not have taken the value. A write may be a command, so it is repeated
        only if the caller asks for it.
        """
        timeout_ns = self._ns(node, timeout_s)
        if block:
            try:
                await self._transfer(lambda: SdoBlockDownload(node, index, subindex, timeout_ns, data), retries)
                return
            except SdoAborted as e:
                if e.code != abort_codes.UNKNOWN_SPECIFIER:
                    raise
        await self._transfer(lambda: SdoDownload(node, index, subindex, timeout_ns, data), retries)

    async def end_transfers(self, timeout_s: float) -> None:
        """Send no further SDO request: wait for the transfers under way, for `timeout_s` seconds at most.

        A transfer that is requested later waits until it is cancelled. NMT commands and PDOs can still be sent.
        """
        ending = [asyncio.ensure_future(channel.end()) for channel in self._channels.values()]
        if ending:
            _, late = await asyncio.wait(ending, timeout=timeout_s)
            for task in late:
                task.cancel()

    async def nmt(self, command: NmtCommand, node: int) -> None:
        """Send an NMT command to `node` (0: all nodes). It is not confirmed: the node's heartbeat shows the result."""
        frame = nmt.command_frame(command, node)
        if command.boots:
            self._heartbeat.expect_boot_up(node)
        await self.send(frame)

    async def send(self, frame: CanFrame) -> None:
        """Send a SYNC, TIME or LSS frame. Waits while the transmit queue is full; raises `ConnectionLost`."""
        await self._connection.send(frame)
        self.counters.frames_out += 1

    def listen(self, can_id: int, callback: PdoCallback) -> None:
        """Call `callback` for each data frame on the identifier of a service without a node, such as 7E4h (LSS).

        An identifier has only one callback."""
        if can_id in self._services:
            raise UsageError("this identifier already has a listener", got=f"{can_id:X}h")
        self._services[can_id] = callback

    def subscribe_pdo(self, cob_id_: int, callback: PdoCallback) -> None:
        """Call `callback` for each data frame with this CAN-ID. Raises `UsageError` for a CAN-ID that a PDO must not use."""
        self._pdos.setdefault(cob_id.check_pdo_cob_id(cob_id_), []).append(callback)

    def unsubscribe_pdo(self, cob_id_: int, callback: PdoCallback) -> None:
        """Stop calling `callback`. Nothing happens if it was not subscribed."""
        callbacks = [known for known in self._pdos.pop(cob_id_, []) if known != callback]
        if callbacks:
            self._pdos[cob_id_] = callbacks

    # -- the reader -----------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Receive and dispatch frames until cancelled. Raises `ConnectionLost` when the connection is lost.

        Heartbeats are also checked here, at their deadlines. When this method ends, waiting transfers fail with `ConnectionLost`.
        """
        self._loop = asyncio.get_running_loop()
        self._stop(None)
        self._arm()
        reason = ConnectionLost("the CANopen master was stopped", where=self._where())
        try:
            while True:
                self._dispatch(await self._connection.recv())
        except ConnectionLost as e:
            reason = e
            raise
        finally:
            self._loop = None
            self._disarm()
            self._stop(reason)

    def _dispatch(self, frame: CanFrame) -> None:
        """Pass a frame to its service. Extended, remote and error frames are ignored (CO-060)."""
        self.counters.frames_in += 1
        if frame.extended or frame.remote or frame.error:
            self.counters.ignored += 1
            return
        t_ns = frame.t_ns or self._clock.monotonic_ns()
        can_id = frame.can_id
        callbacks = self._pdos.get(can_id)
        if callbacks is not None:
            self.counters.pdos += 1
            for callback in callbacks:
                callback(frame.data, t_ns)
            return
        base, node = can_id & 0x780, can_id & 0x7F
        if (service := self._services.get(can_id)) is not None:
            service(frame.data, t_ns)
        elif can_id == cob_id.SYNC:
            self.counters.ignored += 1
            self.counters.foreign_syncs += 1  # a node does not receive its own SYNCs
            self.on_sync(frame.data, t_ns)
        elif node == 0:
            self.counters.ignored += 1  # NMT and other broadcasts of another master
        elif base == cob_id.SDO_REQUEST_BASE:
            self.counters.ignored += 1
            if (asked := self._channels.get(node)) is not None:
                asked.foreign_request(frame)
        elif base == cob_id.SDO_RESPONSE_BASE:
            self._on_sdo(node, frame, t_ns)
        elif base == cob_id.HEARTBEAT_BASE:
            self._on_heartbeat(node, frame.data, t_ns)
        elif base == cob_id.EMCY_BASE:
            self._on_emcy(node, frame.data, t_ns)
        else:
            self.counters.ignored += 1

    def _on_sdo(self, node: int, frame: CanFrame, t_ns: int) -> None:
        channel = self._channels.get(node)
        if channel is None:
            self.counters.ignored += 1
        elif channel.deliver(frame):
            conflict = NodeEvent(
                node, "conflict", self._heartbeat.state(node), frame.data, t_ns, first=channel.first_reply
            )
            self.conflicts[node] = conflict_text(conflict)
            self.on_event(conflict)

    def _on_heartbeat(self, node: int, data: bytes, t_ns: int) -> None:
        if nmt.heartbeat_state(data) is None:
            self.counters.ignored += 1
        else:
            self.counters.heartbeats += 1
        for event in self._heartbeat.observe(node, data, t_ns):
            if event.kind == "boot-up" and node in self._channels:
                self._channels[node].on_boot_up()
            if event.kind == "conflict":
                self.conflicts[node] = conflict_text(event)
            self.on_event(event)
        due_ns = self._heartbeat.deadline_ns(node)  # the deadlines of other nodes have not changed
        if due_ns is not None and (self._timer is None or due_ns < self._timer_due_ns):
            self._arm()

    def _on_emcy(self, node: int, data: bytes, t_ns: int) -> None:
        if len(data) < 2:  # too short for a code (CO-053)
            self.counters.ignored += 1
            return
        self.counters.emcys += 1
        self.on_event(NodeEvent(node, "emcy", self._heartbeat.state(node), data, t_ns))

    # -- overdue heartbeats ---------------------------------------------------------------------------------------

    def _arm(self) -> None:
        """Set the timer so that the next heartbeat deadline is checked when it is due."""
        due_ns = self._heartbeat.next_deadline_ns()
        if self._loop is None or due_ns is None or (self._timer is not None and self._timer_due_ns <= due_ns):
            return
        self._disarm()
        left_ns = max(due_ns - self._clock.monotonic_ns(), 0) + NS_PER_MS  # a loop may wake a little early
        self._timer_due_ns = due_ns
        self._timer = self._loop.call_later(left_ns / NS_PER_S, self._on_deadline)

    def _disarm(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _on_deadline(self) -> None:
        """Check heartbeats only up to the time of the oldest unread frame, because that frame may be a heartbeat that arrived in
        time.
        """
        self._timer = None
        unread = self._connection.inbound.data_stream
        now_ns = self._clock.monotonic_ns()
        for event in self._heartbeat.check((unread[0].t_ns or now_ns) if unread else now_ns):
            self.on_event(event)
        self._arm()

    # -- helpers --------------------------------------------------------------------------------------------------

    async def _transfer(self, make: Callable[[], SdoTransfer], retries: int) -> bytes:
        for left in range(retries, -1, -1):
            transfer = make()
            transfer.tolerate_short = self._short_sdo
            transfer.whole_ns = int(self._transfers_s.get(transfer.node, self._sdo_transfer_s) * NS_PER_S)
            try:
                return await self._channel(transfer.node).run(transfer)
            except ConnectionLost:
                raise
            except FieldtwinError as e:
                if not left or isinstance(e, TransferTooLong) or not isinstance(e, ReplyTimeout | Desync):
                    raise e.at(f"{self._where()} node {transfer.node}") from e.__cause__
                self.counters.sdo_retries += 1
        raise Bug("retries without end", got=str(retries))

    def _channel(self, node: int) -> SdoChannel:
        channel = self._channels.get(node)
        if channel is None:
            channel = SdoChannel(node, self.send, self._clock, self.counters, self.latency)
            channel.lose(self._stopped)
            self._channels[node] = channel
        return channel

    def _stop(self, reason: ConnectionLost | None) -> None:
        self._stopped = reason
        for channel in self._channels.values():
            channel.lose(reason)

    def _ns(self, node: int, timeout_s: float | None) -> int:
        return int((self._timeouts_s.get(node, self._sdo_timeout_s) if timeout_s is None else timeout_s) * NS_PER_S)

    def _where(self) -> str:
        return str(self._connection.endpoint)
