"""SDO block transfers of the client, pure: frame by frame from the standard, and with losses of any kind."""

from __future__ import annotations

from collections import deque

import pytest
from canopen_master_bus import frame
from hypothesis import given, settings
from hypothesis import strategies as st
from sdo_block_peer import BlockServer

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.errors import Desync, ReplyTimeout, SdoAborted, UsageError
from fieldtwin.gateway.protocols.canopen.sdo.block import MAX_REPEATS, SdoBlockDownload, SdoBlockUpload, crc16
from fieldtwin.gateway.protocols.canopen.sdo.transfers import Done, Failed, SdoTransfer, SendFrame, Stray, WaitForFrame

MS = 1_000_000
TIMEOUT = 500 * MS
MUX = bytes.fromhex("002000")


def upload(**kwargs: int) -> SdoBlockUpload:
    transfer = SdoBlockUpload(5, 0x2000, 0, TIMEOUT, **kwargs)
    transfer.start(0)
    return transfer


def feed(transfer: SdoTransfer, data: str, now_ns: int = 0) -> object:
    return transfer.feed(frame("585#" + data), now_ns)


def sent(data: str, *, more: bool = False) -> SendFrame:
    return SendFrame(frame("605#" + data), more)


def refused(step: object, code: int) -> None:
    assert isinstance(step, Failed)
    assert isinstance(step.error, Desync)
    assert step.abort is not None
    assert step.abort.data == bytes.fromhex("80002000") + code.to_bytes(4, "little")


def test_the_crc_is_that_of_the_standard() -> None:
    assert crc16(b"123456789") == 0x31C3
    assert crc16(b"") == 0


def test_upload_frame_by_frame() -> None:
    transfer = SdoBlockUpload(5, 0x2000, 0, TIMEOUT, block=2, switch_bytes=4)
    assert transfer.start(0) == frame("605#A4 00 20 00 02 04 00 00")
    assert feed(transfer, "C6 00 20 00 11 00 00 00") == sent("A3 00 00 00 00 00 00 00")
    assert feed(transfer, "01 61 62 63 64 65 66 67") == WaitForFrame()
    assert feed(transfer, "02 68 69 6A 6B 6C 6D 6E") == sent("A2 02 02 00 00 00 00 00")
    assert feed(transfer, "81 6F 70 71 00 00 00 00") == sent("A2 01 02 00 00 00 00 00")
    crc = crc16(b"abcdefghijklmnopq").to_bytes(2, "little").hex()
    assert feed(transfer, f"D1 {crc} 00 00 00 00 00") == Done(
        b"abcdefghijklmnopq", frame("605#A1 00 00 00 00 00 00 00")
    )


def test_download_frame_by_frame() -> None:
    transfer = SdoBlockDownload(5, 0x2000, 0, TIMEOUT, b"abcdefghijklmnopq")
    assert transfer.start(0) == frame("605#C6 00 20 00 11 00 00 00")
    assert feed(transfer, "A4 00 20 00 02 00 00 00") == sent("01 61 62 63 64 65 66 67", more=True)
    assert transfer.more(0) == sent("02 68 69 6A 6B 6C 6D 6E")
    assert transfer.more(0) is None
    assert feed(transfer, "A2 02 02 00 00 00 00 00") == sent("81 6F 70 71 00 00 00 00")
    crc = crc16(b"abcdefghijklmnopq").to_bytes(2, "little").hex()
    assert feed(transfer, "A2 01 02 00 00 00 00 00") == sent(f"D1 {crc} 00 00 00 00 00")
    assert feed(transfer, "A1 00 00 00 00 00 00 00") == Done(b"")


def test_co030_nothing_at_all_is_one_empty_segment() -> None:
    for transfer, replies in (
        (upload(), ("C6 00 20 00 00 00 00 00", "81 00 00 00 00 00 00 00", "DD 00 00 00 00 00 00 00")),
        (
            SdoBlockDownload(5, 0x2000, 0, TIMEOUT, b""),
            ("A4 00 20 00 7F 00 00 00", "A2 01 7F 00 00 00 00 00", "A1 00 00 00 00 00 00 00"),
        ),
    ):
        transfer.start(0)
        step = [feed(transfer, reply) for reply in replies][-1]
        assert isinstance(step, Done)
        assert step.data == b""


@pytest.mark.parametrize("size", [0, 128, 255])
def test_co014_an_invalid_block_size(size: int) -> None:
    transfer = SdoBlockDownload(5, 0x2000, 0, TIMEOUT, bytes(20))
    transfer.start(0)
    refused(feed(transfer, f"A4 00 20 00 {size:02X} 00 00 00"), 0x0504_0002)
    transfer = SdoBlockDownload(5, 0x2000, 0, TIMEOUT, bytes(20))
    transfer.start(0)
    feed(transfer, "A4 00 20 00 02 00 00 00")
    transfer.more(0)
    refused(feed(transfer, f"A2 01 {size:02X} 00 00 00 00 00"), 0x0504_0002)


@pytest.mark.parametrize(("block", "switch"), [(0, 0), (128, 0), (63, 256), (63, -1)])
def test_an_impossible_block_upload_is_an_error_of_the_caller(block: int, switch: int) -> None:
    with pytest.raises(UsageError):
        SdoBlockUpload(5, 0x2000, 0, TIMEOUT, block=block, switch_bytes=switch)


def test_a_too_large_size_is_not_even_started() -> None:
    refused(feed(upload(max_bytes=10), "C2 00 20 00 0B 00 00 00"), 0x0504_0005)


@pytest.mark.parametrize(("size", "code"), [(8, 0x0607_0013), (6, 0x0607_0012)])
def test_co013_another_size_than_indicated(size: int, code: int) -> None:
    transfer = upload()
    feed(transfer, f"C2 00 20 00 {size:02X} 00 00 00")
    feed(transfer, "81 61 62 63 64 65 66 67")
    refused(feed(transfer, "C1 00 00 00 00 00 00 00"), code)


def test_a_sequence_number_that_was_not_sent_is_refused() -> None:
    transfer = SdoBlockDownload(5, 0x2000, 0, TIMEOUT, bytes(70))
    transfer.start(0)
    feed(transfer, "A4 00 20 00 04 00 00 00")
    refused(feed(transfer, "A2 02 04 00 00 00 00 00"), 0x0504_0003)
    refused(feed(upload(), "C2 00 20 00 07 00 00 00") and upload_with_segment("7F"), 0x0504_0003)


def upload_with_segment(number: str) -> object:
    transfer = upload(block=5)
    feed(transfer, "C2 00 20 00 07 00 00 00")
    return feed(transfer, f"{number} 61 62 63 64 65 66 67")


def test_blocks_that_never_bring_anything_come_to_an_end() -> None:
    down = SdoBlockDownload(5, 0x2000, 0, TIMEOUT, bytes(70))
    down.start(0)
    feed(down, "A4 00 20 00 04 00 00 00")
    steps = [feed(down, "A2 00 04 00 00 00 00 00") for _ in range(MAX_REPEATS + 1)]
    assert all(isinstance(step, SendFrame) for step in steps[:-1])
    refused(steps[-1], 0x0504_0003)
    up = upload(block=2)
    feed(up, "C0 00 20 00 00 00 00 00")
    steps = [feed(up, "02 00 00 00 00 00 00 00") for _ in range(MAX_REPEATS + 1)]
    refused(steps[-1], 0x0504_0003)


def test_an_abort_ends_it_in_every_state_and_a_segment_never_passes_for_one() -> None:
    transfer = upload()
    feed(transfer, "C0 00 20 00 00 00 00 00")
    assert feed(transfer, "01 00 20 00 61 62 63 64") == WaitForFrame()
    assert isinstance(feed(transfer, "80 00 20 01 00 00 04 05"), Stray)  # another object's
    step = feed(transfer, "80 00 20 00 00 00 00 08")
    assert isinstance(step, Failed)
    assert isinstance(step.error, SdoAborted)
    transfer = upload()
    feed(transfer, "C0 00 20 00 00 00 00 00")
    assert feed(transfer, "81 00 20 00 61 62 63 64") == sent("A2 01 3F 00 00 00 00 00")  # the last segment


def test_late_segments_pass_for_no_reply_to_a_later_request() -> None:
    """The reason for blocks of 63 segments."""
    for number in range(1, 64):
        for first in (number, 0x80 | number):
            later = upload()
            assert isinstance(later.feed(CanFrame(0x585, bytes([first]) + MUX + bytes(4)), 0), Stray)


Wire = deque[tuple[int, bytes]]


def drive(transfer: SdoTransfer, server: BlockServer, fates: list[int], delays: list[int]) -> object:
    """Run client and server over a wire that loses (fate 0), duplicates the server's frames (1) or delays; the order is kept.

    One step per millisecond; returns `Done` or `Failed` of the transfer, or fails if it never ends.
    """
    fate, delay = iter(fates), iter(delays)
    to_server: Wire = deque()
    to_client: Wire = deque()
    now = 0

    def put(wire: Wire, data: bytes, doubled: bool) -> None:
        what = next(fate, 9)
        due = max([now + MS + next(delay, 0) * MS, *(at for at, _ in wire)])
        for _ in range(0 if what == 0 else 2 if what == 1 and doubled else 1):
            wire.append((due, data))

    put(to_server, transfer.start(now).data, False)
    burst = False
    for _ in range(200_000):
        step: object = None
        if to_server and to_server[0][0] <= now:
            for reply in server.feed(to_server.popleft()[1]):
                put(to_client, reply, True)
        if to_client and to_client[0][0] <= now:
            step = transfer.feed(CanFrame(0x585, to_client.popleft()[1]), now)
            if isinstance(step, Stray):
                step = transfer.more(now) if burst else None
        elif burst:
            step = transfer.more(now)
        elif now >= transfer.deadline_ns:
            step = transfer.expire(now)
        match step:
            case SendFrame(request, more):
                put(to_server, request.data, False)
                burst = more
            case Failed(_, abort):
                if abort is not None:
                    server.feed(abort.data)
                return step
            case Done(_, last):
                if last is not None:
                    server.feed(last.data)
                return step
        now += MS
    raise AssertionError("stuck")


FATES = st.lists(st.integers(0, 12), max_size=60)
DELAYS = st.lists(st.sampled_from([0, 0, 0, 1, 5, 300, 700]), max_size=40)


@settings(max_examples=150, deadline=None)
@given(value=st.binary(max_size=150), block=st.integers(1, 9), fates=FATES, delays=DELAYS, sized=st.booleans())
def test_an_upload_over_any_wire_is_right_or_fails(
    value: bytes, block: int, fates: list[int], delays: list[int], sized: bool
) -> None:
    server = BlockServer({MUX: value}, sized=sized)
    outcome = drive(SdoBlockUpload(5, 0x2000, 0, TIMEOUT, block=block), server, fates, delays)
    if isinstance(outcome, Done):
        assert outcome.data == value
    else:
        assert isinstance(outcome, Failed)


@settings(max_examples=150, deadline=None)
@given(value=st.binary(max_size=150), block=st.integers(1, 9), fates=FATES, delays=DELAYS, early=st.booleans())
def test_a_download_over_any_wire_is_right_or_fails(
    value: bytes, block: int, fates: list[int], delays: list[int], early: bool
) -> None:
    server = BlockServer({}, block=block, early=early)
    outcome = drive(SdoBlockDownload(5, 0x2000, 0, TIMEOUT, value), server, fates, delays)
    assert server.written.get(MUX, value) == value
    if isinstance(outcome, Done):
        assert server.written[MUX] == value


@pytest.mark.parametrize("lost", range(40))
def test_co016_co017_one_lost_segment_is_always_got_over(lost: int) -> None:
    """Every single segment frame may be lost, including the last of a sub-block and the last of all."""
    value = bytes(range(210))
    fates = [9] * lost + [0]
    server = BlockServer({MUX: value})
    outcome = drive(SdoBlockUpload(5, 0x2000, 0, TIMEOUT, block=7), server, fates, [])
    kind = "segment" if (lost >= 3 and (lost - 3) % 8 != 7 and lost < 37) else "other"
    assert isinstance(outcome, Done) or kind == "other"
    server = BlockServer({}, block=7)
    outcome = drive(SdoBlockDownload(5, 0x2000, 0, TIMEOUT, value), server, fates, [])
    kind = "segment" if (lost >= 2 and (lost - 2) % 8 != 7 and lost < 36) else "other"
    assert isinstance(outcome, Done) or kind == "other"
    if isinstance(outcome, Failed):
        assert isinstance(outcome.error, ReplyTimeout | SdoAborted | Desync)


@given(frames=st.lists(st.binary(max_size=8), max_size=80), size=st.integers(0, 60))
def test_a_transfer_ends_whatever_bytes_arrive(frames: list[bytes], size: int) -> None:
    for transfer in (upload(), SdoBlockDownload(5, 0x2000, 0, TIMEOUT, bytes(size))):
        transfer.start(0)
        for data in [bytes.fromhex("C400200000000000"), bytes.fromhex("A400200004000000"), *frames]:
            step = transfer.feed(CanFrame(0x585, data), 0)
            assert isinstance(step, SendFrame | Stray | WaitForFrame) or transfer.over


@pytest.mark.parametrize("lost", [3, 11])
def test_co017_the_only_segment_of_a_sub_block_is_got_over_too(lost: int) -> None:
    server = BlockServer({MUX: bytes(range(7 if lost == 3 else 56))})
    outcome = drive(SdoBlockUpload(5, 0x2000, 0, TIMEOUT, block=7), server, [9] * lost + [0], [])
    assert isinstance(outcome, Done)
    assert outcome.data == server.objects[MUX]
