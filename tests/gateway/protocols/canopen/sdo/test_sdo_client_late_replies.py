"""CO-023: late replies, with a server that is slow, loses requests and answers in order."""

from __future__ import annotations

import asyncio
import random

import pytest
from canopen_master_bus import LoopClock, MemoryEnd, bus, run_virtual, running
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support import eventually

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.errors import FieldtwinError, ReplyTimeout
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster
from fieldtwin.gateway.protocols.canopen.sdo.late_replies import MAX_OUTSTANDING, PROBES, LateReplies

M, N = (0x2000, 0), (0x2000, 1)


def drained(end: MemoryEnd) -> list[CanFrame]:
    frames = list(end.inbound.data_stream)
    end.inbound.data_stream.clear()
    return frames


def test_an_object_without_an_outstanding_reply_is_requested_at_once() -> None:
    late = LateReplies()
    late.unanswered(M)
    assert late.is_ambiguous(M)
    assert not late.is_ambiguous(N)


def test_a_reply_settles_earlier_requests() -> None:
    late = LateReplies()
    late.unanswered(M)
    late.answered(N)
    assert not late.is_ambiguous(M)


def test_a_reply_that_may_be_the_late_one_settles_only_older_requests() -> None:
    late = LateReplies()
    for request in (M, N, PROBES[0], PROBES[0]):
        late.unanswered(request)
    late.answered(N)
    assert not late.is_ambiguous(M)
    assert not late.is_ambiguous(N)
    assert late.answered(PROBES[0])
    assert late.is_ambiguous(PROBES[0])
    assert late.answered(PROBES[0])
    assert not late.answered(PROBES[0])


def test_after_a_boot_up_no_reply_is_outstanding() -> None:
    late = LateReplies()
    late.unanswered(M)
    late.settle()
    assert not late.is_ambiguous(M)


def test_probes_differ_from_outstanding_requests_while_possible_and_the_record_is_bounded() -> None:
    late = LateReplies()
    asked = []
    for _ in range(2 * MAX_OUTSTANDING):
        asked.append(late.probe())
        late.unanswered(asked[-1])
    assert asked[:4] == list(PROBES)
    assert asked[4:8] == list(PROBES)  # then the oldest request
    assert len(late._outstanding) == MAX_OUTSTANDING


class OrderlyServer:
    """An SDO server that numbers its requests, and answers each with its number, late, in order or never.

    Objects of subindex 0 are 4 bytes (the number), those of subindex 1 are 12 (the number three times), segmented.
    """

    def __init__(self, end: MemoryEnd, seed: int, loss: float, delay_s: float) -> None:
        self.end, self.random, self.loss, self.delay_s = end, random.Random(seed), loss, delay_s
        self.number = 0
        self.last_s = 0.0
        self.rest = b""
        self.toggle = 0

    async def run(self) -> None:
        while True:
            request = (await self.end.recv()).data
            loop = asyncio.get_running_loop()
            if self.random.random() < self.loss:
                continue
            reply = self.reply(request)
            if reply is None:
                continue
            # One frame after the other, because asyncio's timers of one instant have no order.
            self.last_s = max(self.last_s + 1e-6, loop.time() + self.random.random() ** 3 * self.delay_s)
            loop.call_at(self.last_s, self.end.peer.feed, CanFrame(0x585, reply))

    def reply(self, request: bytes) -> bytes | None:
        if request[0] >> 5 == 2:
            self.number += 1
            number = self.number.to_bytes(4, "little")
            if request[3] == 0:
                return b"\x43" + request[1:4] + number
            self.rest, self.toggle = number * 3, 0
            return b"\x41" + request[1:4] + b"\x0c\0\0\0"
        if request[0] >> 5 == 3 and self.rest:
            part, self.rest = self.rest[:7], self.rest[7:]
            command = self.toggle << 4 | (7 - len(part)) << 1 | (not self.rest)
            self.toggle ^= 1
            return bytes([command]) + part.ljust(7, b"\0")
        return None


OBJECTS = ((0x2000, 0), (0x2000, 1), (0x2001, 0), (0x2001, 1))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    loss=st.sampled_from([0.0, 0.1, 0.5]),
    delay_s=st.sampled_from([0.2, 1.0, 3.0]),
    wanted=st.lists(st.tuples(st.integers(0x2000, 0x2001), st.integers(0, 1)), min_size=5, max_size=40),
)
@example(502922616, 0.0, 3.0, [OBJECTS[int(n)] for n in "103213133000023032"])  # two replies to one probe
def test_co023_a_value_is_never_older_than_its_request(
    seed: int, loss: float, delay_s: float, wanted: list[tuple[int, int]]
) -> None:
    """Whatever the delays, an object has the number of a request sent after the call, complete."""

    async def main() -> int:
        ours, theirs = bus()
        server = OrderlyServer(theirs, seed, loss, delay_s)
        serving = asyncio.ensure_future(server.run())
        master = CanopenMaster(ours, LoopClock(), sdo_timeout_s=0.5)
        good = 0
        async with running(master):
            for index, sub in wanted:
                before = server.number
                try:
                    data = await master.sdo_upload(5, index, sub)
                except FieldtwinError:
                    continue
                good += 1
                assert len(data) == (12 if sub else 4)
                numbers = {int.from_bytes(data[i : i + 4], "little") for i in range(0, len(data), 4)}
                assert len(numbers) == 1
                assert int.from_bytes(data[:4], "little") > before
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)
        if loss == 0.0 and delay_s < 0.5:
            assert good == len(wanted)
        return good

    run_virtual(main())


async def _answer(end: MemoryEnd, number: int, value: str) -> None:
    """Answer one request for 2000h:00 or a probe with `value`."""
    while number:
        request = (await end.recv()).data
        if request[0] != 0x80:
            number -= 1
    await end.send(CanFrame(0x585, b"\x43" + request[1:4] + bytes.fromhex(value)))


def test_co023_the_same_object_again_is_preceded_by_a_probe() -> None:
    async def main() -> None:
        ours, theirs = bus()
        master = CanopenMaster(ours, LoopClock())
        async with running(master):
            with pytest.raises(ReplyTimeout, match="2000h:00"):
                await master.sdo_upload(5, 0x2000, 0)
            assert (await theirs.recv()).data[:4].hex() == "40002000"
            assert (await theirs.recv()).data.hex() == "8000200000000405"
            again = asyncio.ensure_future(master.sdo_upload(5, 0x2000, 0))
            probe = await theirs.recv()
            assert probe.data[:4].hex() == "40001000"
            await theirs.send(CanFrame(0x585, bytes.fromhex("4300200001010101")))  # the late one
            await theirs.send(CanFrame(0x585, bytes.fromhex("4300100092010200")))
            assert (await theirs.recv()).data[:4].hex() == "40002000"
            await theirs.send(CanFrame(0x585, bytes.fromhex("4300200002020202")))
            assert await again == b"\x02\x02\x02\x02"
            assert master.counters.sdo_probes == 1

    run_virtual(main())


def test_co023_a_late_reply_that_comes_while_nothing_is_asked_makes_the_probe_needless() -> None:
    async def main() -> None:
        ours, theirs = bus()
        master = CanopenMaster(ours, LoopClock())
        async with running(master):
            await asyncio.gather(master.sdo_upload(5, 0x2000, 0), return_exceptions=True)
            await theirs.send(CanFrame(0x585, bytes.fromhex("4300200001010101")))
            await eventually(lambda: master.counters.ignored == 1)
            answering = asyncio.ensure_future(_answer(theirs, 2, "07000000"))
            assert await master.sdo_upload(5, 0x2000, 0) == b"\x07\0\0\0"
            await answering
            assert master.counters.sdo_probes == 0

    run_virtual(main())


def test_replies_that_come_all_at_once_after_a_stall_are_not_those_of_two_nodes() -> None:
    """A node that was blocked answers every request received meanwhile, also the current one: this is not CO-042."""

    async def main() -> None:
        ours, theirs = bus()
        master = CanopenMaster(ours, LoopClock())
        async with running(master):
            for _ in range(12):
                await asyncio.gather(master.sdo_upload(5, 0x2000, 0), return_exceptions=True)
            again = asyncio.ensure_future(master.sdo_upload(5, 0x2000, 0))
            await asyncio.sleep(0)
            await asyncio.sleep(0)
            for request in drained(theirs):
                if request.data[0] == 0x40:
                    ours.feed(CanFrame(0x585, b"\x43" + request.data[1:4] + bytes(4)))
            await asyncio.gather(again, return_exceptions=True)
            assert master.conflicts == {}

    run_virtual(main())


@settings(max_examples=200, deadline=None)
@given(
    asked=st.lists(st.sampled_from([(0x1001, 0), (0x1018, 4), (0x2000, 0), (0x2000, 2)]), min_size=1, max_size=14),
    wanted=st.sampled_from([(0x1001, 0), (0x2000, 0)]),
    pauses=st.sets(st.integers(0, 40)),
)
@example([(0x2000, 0)] * 12, (0x2000, 0), {10})
def test_co042_replies_after_a_stall_are_not_a_conflict_however_they_arrive(
    asked: list[tuple[int, int]], wanted: tuple[int, int], pauses: set[int]
) -> None:
    """Defect: after a process had stood still for 10 s, one late reply was taken for the answer of a second node.

    The client handles the replies between two of `pauses` in one turn of the event loop.
    """

    async def main() -> None:
        ours, theirs = bus()
        master = CanopenMaster(ours, LoopClock())
        async with running(master):
            for index, sub in asked:
                await asyncio.gather(master.sdo_upload(5, index, sub), return_exceptions=True)
            waiting = sum(request.data[0] == 0x40 for request in theirs.inbound.data_stream)
            last = [asyncio.ensure_future(master.sdo_upload(5, *wanted)) for _ in range(3)]
            number = 0
            while not all(task.done() for task in last):
                await asyncio.sleep(0.001)
                for request in drained(theirs):
                    if request.data[0] == 0x40:
                        ours.feed(CanFrame(0x585, b"\x43" + request.data[1:4] + number.to_bytes(4, "little")))
                        number += 1
                        if number in pauses:
                            await asyncio.sleep(0.001)
            for task in last:
                if task.exception() is None:
                    assert int.from_bytes(task.result(), "little") >= waiting
            assert master.conflicts == {}

    run_virtual(main())


def test_co023_a_cancelled_request_counts_as_unanswered() -> None:
    async def main() -> None:
        ours, theirs = bus()
        master = CanopenMaster(ours, LoopClock())
        async with running(master):
            task = asyncio.ensure_future(master.sdo_upload(5, 0x2000, 0))
            await theirs.recv()
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            again = asyncio.ensure_future(master.sdo_upload(5, 0x2000, 0))
            assert (await theirs.recv()).data[:4].hex() == "40001000"
            await theirs.send(CanFrame(0x585, bytes.fromhex("8000100000000206")))  # an abort is an answer too
            assert (await theirs.recv()).data[:4].hex() == "40002000"
            await theirs.send(CanFrame(0x585, bytes.fromhex("4F00200009000000")))
            assert await again == b"\x09"

    run_virtual(main())
