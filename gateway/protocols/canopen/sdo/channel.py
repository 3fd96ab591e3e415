"""One node's default SDO channel. It carries out one transfer at a time, and never uses a reply to one request as the reply to
another request.

It connects the transfers (`transfers`, `block`), the tracking of late replies (`late_replies`) and the master, which owns the
bus and delivers the frames on 580h + node ID. It does not interpret the objects transferred.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.errors import ConnectionLost, ReplyTimeout, SdoAborted
from fieldtwin.gateway.core.histogram import Histogram, response_times
from fieldtwin.gateway.protocols.canopen.sdo import abort_codes
from fieldtwin.gateway.protocols.canopen.sdo.late_replies import LateReplies, Multiplexor
from fieldtwin.gateway.protocols.canopen.sdo.transfers import (
    ABORT,
    Done,
    Failed,
    SdoTransfer,
    SdoUpload,
    SendFrame,
    Step,
    Stray,
    WaitForFrame,
)

MAX_ANSWERS = 16
"""The number of answered requests of one node whose replies are kept, to detect a second reply."""

MAX_INBOX = 128
"""The number of frames that may wait for the transfer's task; more are dropped and counted."""


class NodeRestarted(ReplyTimeout):
    """The node booted during a transfer, so its reply will never arrive. The transfer may be repeated immediately."""


@dataclass(slots=True)
class SdoCounters:
    """Counters of a master since it was created.

    Requests and replies are counted in frames, as a bus analyser would: each initiate and each segment that is sent, each reply
    that advanced or ended a transfer. Aborts sent by the node count in `sdo_aborts` only, aborts sent by the master in
    `frames_out` only. `sdo_timeouts` counts requests without a reply, `sdo_retries` repeated transfers, `sdo_probes` the reads
    that ensure that no late reply can arrive any more (see `late_replies`), and `ignored` frames that no service used.
    `foreign_sdo_requests` counts SDO requests of other clients on the bus, and `foreign_syncs` the SYNCs of other producers.
    """

    frames_in: int = 0
    frames_out: int = 0
    sdo_requests: int = 0
    sdo_replies: int = 0
    sdo_aborts: int = 0
    sdo_timeouts: int = 0
    sdo_retries: int = 0
    sdo_probes: int = 0
    pdos: int = 0
    heartbeats: int = 0
    emcys: int = 0
    ignored: int = 0
    foreign_sdo_requests: int = 0
    foreign_syncs: int = 0


def is_final(data: bytes) -> bool:
    """Return whether an SDO reply ends the transfer in the node: an abort, or the reply of an expedited upload."""
    return len(data) == 8 and (data[0] == ABORT or (data[0] >> 5 == 2 and bool(data[0] & 0x02)))


def has_multiplexor(data: bytes) -> bool:
    """Return whether an SDO reply looks like one with a multiplexor: a reply to an initiate request, or an abort.

    A segment may look like either of them.
    """
    return data[0] == ABORT or data[0] >> 5 in (2, 3) or (data[0] >> 5 in (5, 6) and not data[0] & 3)


def multiplexor_of(data: bytes) -> Multiplexor:
    """Return index and subindex of an SDO frame that carries them."""
    return int.from_bytes(data[1:3], "little"), data[3]


class SdoChannel:
    """The client's end of one channel. The master calls `deliver` with each received frame, and `run` for each transfer."""

    def __init__(
        self,
        node: int,
        send: Callable[[CanFrame], Awaitable[None]],
        clock: Clock,
        counters: SdoCounters,
        latency: Histogram | None = None,
    ) -> None:
        self._node = node
        self._send = send
        self._clock = clock
        self._counters = counters
        self._latency = latency if latency is not None else response_times()
        self._turn = asyncio.Lock()
        self._late = LateReplies()
        self._active: SdoTransfer | None = None
        self._inbox: deque[CanFrame] = deque()
        self._arrived = asyncio.Event()
        self._lost: ConnectionLost | None = None
        self._answers: dict[Multiplexor, bytes] = {}
        """The last reply to each of the last requests, oldest first: a second reply to one of them comes from another node."""
        self._foreign: dict[Multiplexor, None] = {}
        """Requests of other clients to this node, whose replies are not for this client."""
        self._reply = b""
        self.first_reply = b""
        """The first of two conflicting replies, with 8 bytes; empty if it is not known."""
        self._owed: CanFrame | None = None
        self._rebooted = False
        self._began_ambiguous = False
        """Whether replies to earlier requests for the same object could still arrive when the present transfer began."""
        self._final_seen = False
        """Whether a reply that ends the present transfer has arrived, so that `_late` is up to date."""

    def deliver(self, frame: CanFrame) -> bool:
        """Take a frame of the node. Return True if it is a second answer to one request: then two nodes share the node ID
        (CO-042).

        A reply to another client on the same SDO channel does not count as a second answer if that client's request was seen
        (`foreign_request`).
        """
        active = self._active
        repeated = self._is_foreign(frame, active)
        if active is None or len(self._inbox) >= MAX_INBOX:
            self._counters.ignored += 1
        else:
            self._inbox.append(frame)
            self._arrived.set()
        return repeated

    def foreign_request(self, frame: CanFrame) -> None:
        """Note a request of another client, so that the node's reply is not taken for a second reply to this client's request."""
        self._counters.foreign_sdo_requests += 1
        if len(frame.data) == 8 and frame.data[0] >> 5 in (1, 2, 5, 6):  # not the segments of a transfer
            if len(self._foreign) >= MAX_ANSWERS:
                self._foreign.pop(next(iter(self._foreign)))
            self._foreign[multiplexor_of(frame.data)] = None

    def lose(self, error: ConnectionLost | None) -> None:
        """Note that the master no longer reads the bus: waiting and later transfers fail immediately with `error`.

        None means that the master reads the bus again.
        """
        self._lost = error
        self._arrived.set()

    def on_boot_up(self) -> None:
        """Note that the node booted: no outstanding reply will arrive, and a transfer in progress ends now."""
        self._late.settle()
        self._answers.clear()
        self._foreign.clear()
        self._owed = None
        if self._active is not None:
            self._rebooted = True
            self._arrived.set()

    async def run(self, transfer: SdoTransfer) -> bytes:
        """Carry out `transfer` after the queued transfers. Raises `SdoAborted`, `ReplyTimeout`, `Desync` or `ConnectionLost`."""
        async with self._turn:
            await self._settle(transfer)
            return await self._run(transfer)

    async def end(self) -> None:
        """Wait for the transfers that were requested before this call. A transfer that is requested later waits until it is
        cancelled.
        """
        await self._turn.acquire()  # the lock is never released, so that no later transfer begins

    async def _settle(self, transfer: SdoTransfer) -> None:
        """Make sure that no late reply can be taken for the reply to `transfer` (see `late_replies`)."""
        wanted = (transfer.index, transfer.subindex)
        if not self._late.is_ambiguous(wanted):
            return
        self._counters.sdo_probes += 1
        index, subindex = self._late.probe()
        probe = SdoUpload(self._node, index, subindex, transfer.timeout_ns)
        probe.whole_ns = transfer.whole_ns
        try:
            await self._run(probe)
        except (SdoAborted, NodeRestarted):
            pass  # the node answered, which settles earlier requests; or no reply can arrive any more
        except ReplyTimeout as e:
            hint = (
                f"an earlier request for {transfer.name} is unanswered, so {index:04X}h:{subindex:02X} was asked first"
            )
            raise ReplyTimeout(f"{transfer.name}: the node does not answer", hint=hint) from e
        if self._late.is_ambiguous(wanted):
            raise ReplyTimeout(f"{transfer.name}: an earlier reply is still outstanding")

    async def _run(self, transfer: SdoTransfer) -> bytes:
        """Carry out one transfer to its end, and note whether its reply may still arrive."""
        if self._lost is not None:
            raise self._again(self._lost)
        request, complete = (transfer.index, transfer.subindex), False
        self._active, self._reply, self._rebooted = transfer, b"", False
        self._began_ambiguous, self._final_seen = self._late.is_ambiguous(request), False
        self._answers.pop(request, None)
        try:
            await self._send_owed_abort(transfer)
            began_ns = self._clock.monotonic_ns()
            data = await self._drive(transfer)
            self._latency.record(self._clock.monotonic_ns() - began_ns)
            complete = True
            self._answered(request)
            return data
        except SdoAborted:
            complete = True
            self._answered(request)
            raise
        finally:
            self._active = None
            self._counters.ignored += len(self._inbox)
            self._inbox.clear()
            if not self._rebooted:  # after a reboot no reply can arrive, and there is nothing to abort
                if not self._final_seen:
                    other_expected = transfer.answered and self._late.answered(request)
                    if not complete or other_expected:
                        self._late.unanswered(request)
                self._owe(transfer)

    def _answered(self, request: Multiplexor) -> None:
        if len(self._answers) >= MAX_ANSWERS:
            self._answers.pop(next(iter(self._answers)))
        self._answers[request] = self._reply

    def _owe(self, transfer: SdoTransfer) -> None:
        """Keep the abort frame of an abandoned `transfer` (cancelled, or the bus accepts no frames), to send it later."""
        if transfer.to_abort:
            self._owed = transfer.abort_frame(abort_codes.GENERAL_ERROR)

    async def _send_owed_abort(self, transfer: SdoTransfer) -> None:
        """Send the abort of a transfer that was abandoned earlier. Otherwise the node might take the next request for a segment
        of the abandoned transfer.
        """
        if self._owed is not None:
            try:
                async with asyncio.timeout(transfer.timeout_ns / NS_PER_S):
                    await self._send(self._owed)
            except TimeoutError as e:
                raise ReplyTimeout(f"{transfer.name}: nothing can be sent", hint="the bus accepts no frames") from e
            self._owed = None

    async def _drive(self, transfer: SdoTransfer) -> bytes:
        step: Step | None = SendFrame(transfer.start(self._clock.monotonic_ns()))
        while True:
            match step:
                case SendFrame(frame, more):
                    await self._request(frame, transfer)
                    step = await self._after_send(transfer) if more else None
                    if step is not None:
                        continue
                case Done(data, last):
                    await self._confirm(last, transfer)
                    return data
                case Failed() as failed:
                    await self._fail(failed, transfer)
                case Stray() | WaitForFrame() | None:
                    pass
            step = await self._next_step(transfer)

    async def _after_send(self, transfer: SdoTransfer) -> Step | None:
        """Return the next frame of a sequence; None if none is left, or if a frame from the node has to be handled (CO-018)."""
        await asyncio.sleep(0)  # otherwise a bus that accepts frames immediately would never let the reader run
        return None if self._inbox else transfer.more(self._clock.monotonic_ns())

    async def _next_step(self, transfer: SdoTransfer) -> Step | None:
        frame = await self._next_frame(transfer)
        if frame is None:
            self._counters.sdo_timeouts += 1
            return transfer.expire(transfer.deadline_ns)
        step = transfer.feed(frame, self._clock.monotonic_ns())
        if not isinstance(step, Stray):
            self._reply = frame.data
        if isinstance(step, SendFrame | WaitForFrame | Done):
            self._counters.sdo_replies += 1
        if isinstance(step, Stray):  # not a reply: continue sending
            self._counters.ignored += 1
            return transfer.more(self._clock.monotonic_ns())
        return step

    async def _request(self, frame: CanFrame, transfer: SdoTransfer) -> None:
        """Send a request within the reply timeout, because a full transmit queue must not block forever (CO-063)."""
        self._counters.sdo_requests += 1
        try:
            async with asyncio.timeout(self._left_s(transfer)):
                await self._send(frame)
        except TimeoutError as e:
            self._counters.sdo_timeouts += 1
            self._owe(transfer)
            transfer.over = True
            raise ReplyTimeout(
                f"{transfer.name}: the request could not be sent", hint="the bus accepts no frames"
            ) from e

    async def _confirm(self, last: CanFrame | None, transfer: SdoTransfer) -> None:
        """Send the final confirmation. The node has sent everything, so the value is valid even if this fails."""
        if last is not None:
            with suppress(TimeoutError):
                async with asyncio.timeout(transfer.timeout_ns / NS_PER_S):
                    await self._send(last)

    async def _fail(self, failed: Failed, transfer: SdoTransfer) -> None:
        """Send the abort frame, unless the node itself aborted, and raise the error."""
        if isinstance(failed.error, SdoAborted):
            self._counters.sdo_aborts += 1
        if failed.abort is not None:
            try:
                async with asyncio.timeout(transfer.timeout_ns / NS_PER_S):
                    await self._send(failed.abort)
            except TimeoutError:
                self._owed = failed.abort  # sent before the next request
        raise failed.error

    async def _next_frame(self, transfer: SdoTransfer) -> CanFrame | None:
        """Return the next received frame, or None if the reply is overdue. Raises `ConnectionLost` or `NodeRestarted`."""
        while not self._inbox:
            if self._lost is not None:
                raise self._again(self._lost)
            if self._rebooted:
                transfer.over = True
                raise NodeRestarted(f"{transfer.name}: the node restarted meanwhile")
            left_s = self._left_s(transfer)
            if left_s <= 0:
                return None
            self._arrived.clear()
            try:
                async with asyncio.timeout(left_s):
                    await self._arrived.wait()
            except TimeoutError:
                continue
        return self._inbox.popleft()

    def _left_s(self, transfer: SdoTransfer) -> float:
        return (transfer.deadline_ns - self._clock.monotonic_ns()) / NS_PER_S

    def _is_foreign(self, frame: CanFrame, active: SdoTransfer | None) -> bool:
        """Note a reply that does not answer the present request. Return True if it is a second answer to an earlier request."""
        if len(frame.data) != 8 or not has_multiplexor(frame.data) or (active is not None and active.unmarked):
            return False
        request = multiplexor_of(frame.data)
        if active is not None and (active.index, active.subindex) == request:
            if is_final(frame.data):
                self._settle_earlier(request)
            if self._began_ambiguous:
                return False  # after a stall, the replies to earlier requests arrive together
            waiting = next((f for f in self._inbox if f.data[:4] == frame.data[:4]), None)
            self.first_reply = b"" if waiting is None else waiting.data
            return waiting is not None
        if request in self._foreign:
            del self._foreign[request]
            return False
        if self._late.is_ambiguous(request):
            if is_final(frame.data):
                self._late.answered(request)
            return False
        first = self._answers.pop(request, None)  # reported once per answer
        self.first_reply = first or b""
        return first is not None

    def _settle_earlier(self, request: Multiplexor) -> None:
        """Note a reply that names the object of the present `request`, and settle the earlier requests that it proves to be over.

        This is done when the reply arrives, not when the transfer's task runs, because a reply that arrives between the two would
        otherwise settle the present request as well.
        """
        if self._late.answered(request) and not self._final_seen:
            self._late.unanswered(request)  # this may be the reply to an earlier request, so one more is expected
        self._final_seen = True

    def _again(self, lost: ConnectionLost) -> ConnectionLost:
        """Return a new error for each caller: one instance would collect all their tracebacks."""
        return ConnectionLost(lost.message, where=lost.where)
