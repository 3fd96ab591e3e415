"""One node's default SDO channel: one transfer at a time, and no reply paired with a request that it does not answer.

Between the pure transfers (`sdo`), the bookkeeping of late replies (`late_replies`) and the master, which owns the bus
and delivers what comes on 580h + node id. It decides nothing about objects.
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
from fieldtwin.gateway.core.latency import Latencies
from fieldtwin.gateway.protocols.canopen import abort_codes
from fieldtwin.gateway.protocols.canopen.late_replies import LateReplies, Multiplexor
from fieldtwin.gateway.protocols.canopen.sdo import ABORT, Done, Failed, SdoTransfer, SdoUpload, Send, Step, Stray, Wait

MAX_ANSWERS = 16
"""Answered requests of one node that a second reply is compared with."""

MAX_INBOX = 128
"""Frames that wait for the transfer's task; a flood beyond that is dropped and counted."""


class NodeRestarted(ReplyTimeout):
    """The node booted during a transfer: its reply will never come. What is to be done again can be done at once."""


@dataclass(slots=True)
class Counters:
    """What a master has seen and done since it was made.

    Requests and replies are counted in frames, as a bus analyser would: each initiate and each segment that is sent,
    each reply that carried a transfer on or ended it. Aborts that the node sent are in `sdo_aborts` only, aborts that
    the master sent in `frames_out` only. `sdo_timeouts` are requests that got no reply, `sdo_retries` transfers that
    were begun again; `sdo_probes` are the transfers made to get past late replies. `ignored` are frames that were for nobody.
    `foreign_sdo_requests` are the SDO requests of other clients on the bus, and `foreign_syncs` the SYNCs of other producers.
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
    """Whether an SDO reply leaves no transfer open in the node: an abort, or an expedited upload's reply."""
    return len(data) == 8 and (data[0] == ABORT or (data[0] >> 5 == 2 and bool(data[0] & 0x02)))


def has_multiplexor(data: bytes) -> bool:
    """Whether an SDO reply carries one: replies to initiate requests and aborts. Segments look like anything."""
    return data[0] == ABORT or data[0] >> 5 in (2, 3) or (data[0] >> 5 in (5, 6) and not data[0] & 3)


def multiplexor_of(data: bytes) -> Multiplexor:
    """Index and subindex of an SDO that carries them."""
    return int.from_bytes(data[1:3], "little"), data[3]


class SdoChannel:
    """The client's end of one channel. `deliver` is called by the bus's reader, `run` by whoever wants an object."""

    def __init__(
        self,
        node: int,
        send: Callable[[CanFrame], Awaitable[None]],
        clock: Clock,
        counters: Counters,
        latency: Latencies | None = None,
    ) -> None:
        self._node = node
        self._send = send
        self._clock = clock
        self._counters = counters
        self._latency = latency if latency is not None else Latencies()
        self._turn = asyncio.Lock()
        self._late = LateReplies()
        self._active: SdoTransfer | None = None
        self._inbox: deque[CanFrame] = deque()
        self._arrived = asyncio.Event()
        self._lost: ConnectionLost | None = None
        self._answers: dict[Multiplexor, bytes] = {}
        """The last reply to each of the last requests, oldest first: a second reply to one of them is another node's."""
        self._foreign: dict[Multiplexor, None] = {}
        """What other clients asked this node for: the replies are theirs."""
        self._reply = b""
        self.first_reply = b""
        """The reply that the last repeated one was compared with; 8 bytes, or none where it is not known."""
        self._owed: CanFrame | None = None
        self._rebooted = False
        self._began_ambiguous = False
        """Whether replies to earlier requests for the same object could still come when the present transfer began."""

    def deliver(self, frame: CanFrame) -> bool:
        """A frame came from the node. True when it answers what was answered before (CO-042): two nodes share the id.

        The reply to another client on the same SDO channel is no such answer, since its request was seen (`foreign_request`).
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
        """Another client asked the node for something: its reply is not a second one to a request of ours."""
        self._counters.foreign_sdo_requests += 1
        if len(frame.data) == 8 and frame.data[0] >> 5 in (1, 2, 5, 6):  # not the segments of a transfer
            if len(self._foreign) >= MAX_ANSWERS:
                self._foreign.pop(next(iter(self._foreign)))
            self._foreign[multiplexor_of(frame.data)] = None

    def lose(self, error: ConnectionLost | None) -> None:
        """Nobody reads the bus any more (None: again): what waits fails now, what comes later at once."""
        self._lost = error
        self._arrived.set()

    def on_boot_up(self) -> None:
        """The node booted: what it owed, it will never send, and a transfer under way ends now."""
        self._late.settle()
        self._answers.clear()
        self._foreign.clear()
        self._owed = None
        if self._active is not None:
            self._rebooted = True
            self._arrived.set()

    async def run(self, transfer: SdoTransfer) -> bytes:
        """Do `transfer` when its turn comes. Raises `SdoAborted`, `ReplyTimeout`, `Desync` or `ConnectionLost`."""
        async with self._turn:
            await self._settle(transfer)
            return await self._run(transfer)

    async def _settle(self, transfer: SdoTransfer) -> None:
        """Make sure that no late reply can pass for one to `transfer` (see `late_replies`)."""
        wanted = (transfer.index, transfer.subindex)
        if not self._late.is_ambiguous(wanted):
            return
        self._counters.sdo_probes += 1
        index, subindex = self._late.probe()
        try:
            await self._run(SdoUpload(self._node, index, subindex, transfer.timeout_ns))
        except (SdoAborted, NodeRestarted):
            pass  # an answer, which is all that was wanted, or nothing to wait for any more
        except ReplyTimeout as e:
            hint = (
                f"an earlier request for {transfer.name} is unanswered, so {index:04X}h:{subindex:02X} was asked first"
            )
            raise ReplyTimeout(f"{transfer.name}: the node does not answer", hint=hint) from e
        if self._late.is_ambiguous(wanted):
            raise ReplyTimeout(f"{transfer.name}: an earlier reply is still outstanding")

    async def _run(self, transfer: SdoTransfer) -> bytes:
        """Drive one transfer to its end, leaving on record whether its answer may still come."""
        if self._lost is not None:
            raise self._again(self._lost)
        request, complete = (transfer.index, transfer.subindex), False
        self._active, self._reply, self._rebooted = transfer, b"", False
        self._began_ambiguous = self._late.is_ambiguous(request)
        self._answers.pop(request, None)
        try:
            await self._tell_owed(transfer)
            began_ns = self._clock.monotonic_ns()
            data = await self._drive(transfer)
            self._latency.note(self._clock.monotonic_ns() - began_ns)
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
            if not self._rebooted:  # else nothing can be on its way, and there is nothing to abort
                other_expected = transfer.answered and self._late.answered(request)
                if not complete or other_expected:
                    self._late.unanswered(request)
                self._owe(transfer)

    def _answered(self, request: Multiplexor) -> None:
        if len(self._answers) >= MAX_ANSWERS:
            self._answers.pop(next(iter(self._answers)))
        self._answers[request] = self._reply

    def _owe(self, transfer: SdoTransfer) -> None:
        """`transfer` is left as it is (cancelled, or the bus takes no frames): the node has to be told later."""
        if transfer.to_abort:
            self._owed = transfer.abort_frame(abort_codes.GENERAL_ERROR)

    async def _tell_owed(self, transfer: SdoTransfer) -> None:
        """An earlier transfer was left as it was: the node might take our request for one of its segments."""
        if self._owed is not None:
            try:
                async with asyncio.timeout(transfer.timeout_ns / NS_PER_S):
                    await self._send(self._owed)
            except TimeoutError as e:
                raise ReplyTimeout(f"{transfer.name}: nothing can be sent", hint="the bus takes no frames") from e
            self._owed = None

    async def _drive(self, transfer: SdoTransfer) -> bytes:
        step: Step | None = Send(transfer.start(self._clock.monotonic_ns()))
        while True:
            match step:
                case Send(frame, more):
                    await self._request(frame, transfer)
                    step = await self._after_send(transfer) if more else None
                    if step is not None:
                        continue
                case Done(data, last):
                    await self._confirm(last, transfer)
                    return data
                case Failed() as failed:
                    await self._fail(failed, transfer)
                case Stray() | Wait() | None:
                    pass
            step = await self._next_step(transfer)

    async def _after_send(self, transfer: SdoTransfer) -> Step | None:
        """The next frame of several, unless the node has something to say meanwhile (CO-018)."""
        await asyncio.sleep(0)  # a bus that takes frames at once would otherwise let nobody read
        return None if self._inbox else transfer.more(self._clock.monotonic_ns())

    async def _next_step(self, transfer: SdoTransfer) -> Step | None:
        frame = await self._next_frame(transfer)
        if frame is None:
            self._counters.sdo_timeouts += 1
            return transfer.expire(transfer.deadline_ns)
        step = transfer.feed(frame, self._clock.monotonic_ns())
        if not isinstance(step, Stray):
            self._reply = frame.data
        if isinstance(step, Send | Wait | Done):
            self._counters.sdo_replies += 1
        if isinstance(step, Stray):  # no answer: what was being sent goes on
            self._counters.ignored += 1
            return transfer.more(self._clock.monotonic_ns())
        return step

    async def _request(self, frame: CanFrame, transfer: SdoTransfer) -> None:
        """Send within the time of the reply: a transmit queue that never empties must not block for ever (CO-063)."""
        self._counters.sdo_requests += 1
        try:
            async with asyncio.timeout(self._left_s(transfer)):
                await self._send(frame)
        except TimeoutError as e:
            self._counters.sdo_timeouts += 1
            self._owe(transfer)
            transfer.over = True
            raise ReplyTimeout(f"{transfer.name}: the request could not be sent", hint="the bus takes no frames") from e

    async def _confirm(self, last: CanFrame | None, transfer: SdoTransfer) -> None:
        """The node has said all; that it hears so is a courtesy, and the value is good without it."""
        if last is not None:
            with suppress(TimeoutError):
                async with asyncio.timeout(transfer.timeout_ns / NS_PER_S):
                    await self._send(last)

    async def _fail(self, failed: Failed, transfer: SdoTransfer) -> None:
        """Tell the node why, if it was us who gave up, and raise."""
        if isinstance(failed.error, SdoAborted):
            self._counters.sdo_aborts += 1
        if failed.abort is not None:
            try:
                async with asyncio.timeout(transfer.timeout_ns / NS_PER_S):
                    await self._send(failed.abort)
            except TimeoutError:
                self._owed = failed.abort  # before the next request
        raise failed.error

    async def _next_frame(self, transfer: SdoTransfer) -> CanFrame | None:
        """The next frame for the transfer, None when its reply is overdue."""
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
        """Put a reply that answers no present request on record; True when it answers once more what was answered."""
        if len(frame.data) != 8 or not has_multiplexor(frame.data) or (active is not None and active.unmarked):
            return False
        request = multiplexor_of(frame.data)
        if active is not None and (active.index, active.subindex) == request:
            if self._began_ambiguous:
                return False  # after a stall the replies to earlier requests come all at once
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
        first = self._answers.pop(request, None)  # told once an answer
        self.first_reply = first or b""
        return first is not None

    def _again(self, lost: ConnectionLost) -> ConnectionLost:
        """A fresh error for each caller: one instance would collect all their tracebacks."""
        return ConnectionLost(lost.message, where=lost.where)
