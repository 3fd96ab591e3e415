"""The pure SDO transfers, row by row of the test-case list (CO-0xx), and with garbage."""

from __future__ import annotations

import pytest
from canopen_master_bus import frame
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.errors import Desync, ReplyTimeout, SdoAborted, UsageError
from fieldtwin.gateway.protocols.canopen.sdo.transfers import (
    MAX_STRAYS,
    Done,
    Failed,
    SdoDownload,
    SdoTransfer,
    SdoUpload,
    SendFrame,
    Step,
    Stray,
    abort_codes,
)

MS = 1_000_000
TIMEOUT = 500 * MS


def upload(**kwargs: int) -> SdoUpload:
    transfer = SdoUpload(5, 0x1008, 0, TIMEOUT, **kwargs)
    assert transfer.start(0) == frame("605#40 08 10 00 00 00 00 00")
    return transfer


def feed(transfer: SdoTransfer, data: str, now_ns: int = 0) -> Step:
    return transfer.feed(frame("585#" + data), now_ns)


def refused(step: Step, code: int) -> None:
    """The client gave up, sent the node an abort with `code`, and raises Desync."""
    assert isinstance(step, Failed)
    assert isinstance(step.error, Desync)
    assert step.abort is not None
    assert step.abort.can_id == 0x605
    assert step.abort.data == bytes.fromhex("80081000") + code.to_bytes(4, "little")


# -- transfers without errors ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("reply", "data"),
    [
        ("4F 08 10 00 7F AA AA AA", "7F"),
        ("4B 08 10 00 E8 03 AA AA", "E803"),
        ("47 08 10 00 01 02 03 AA", "010203"),
        ("43 08 10 00 01 02 03 04", "01020304"),
    ],
)
def test_an_expedited_upload_returns_its_data(reply: str, data: str) -> None:
    assert feed(upload(), reply) == Done(bytes.fromhex(data))


def test_a_segmented_upload_returns_its_data() -> None:
    transfer = upload()
    assert feed(transfer, "41 08 10 00 09 00 00 00") == SendFrame(frame("605#60 00 00 00 00 00 00 00"))
    assert feed(transfer, "00 61 62 63 64 65 66 67") == SendFrame(frame("605#70 00 00 00 00 00 00 00"))
    assert feed(transfer, "1B 68 69 00 00 00 00 00") == Done(b"abcdefghi")


@pytest.mark.parametrize("size", range(1, 5))
def test_an_expedited_download_sends_its_data(size: int) -> None:
    transfer = SdoDownload(5, 0x1017, 0, TIMEOUT, b"\x01\x02\x03\x04"[:size])
    request = transfer.start(0)
    assert request.data[0] == {1: 0x2F, 2: 0x2B, 3: 0x27, 4: 0x23}[size]
    assert request.data[4:] == b"\x01\x02\x03\x04"[:size].ljust(4, b"\0")
    assert feed(transfer, "60 17 10 00 00 00 00 00") == Done(b"")


def test_a_segmented_download_sends_its_data() -> None:
    transfer = SdoDownload(5, 0x2000, 1, TIMEOUT, b"abcdefghi")
    assert transfer.start(0) == frame("605#21 00 20 01 09 00 00 00")
    assert feed(transfer, "60 00 20 01 00 00 00 00") == SendFrame(frame("605#00 61 62 63 64 65 66 67"))
    assert feed(transfer, "20 00 00 00 00 00 00 00") == SendFrame(frame("605#1B 68 69 00 00 00 00 00"))
    assert feed(transfer, "30 00 00 00 00 00 00 00") == Done(b"")


def test_co030_nothing_at_all_is_one_empty_segment() -> None:
    down = SdoDownload(5, 0x2000, 1, TIMEOUT, b"")
    assert down.start(0) == frame("605#21 00 20 01 00 00 00 00")
    assert feed(down, "60 00 20 01 00 00 00 00") == SendFrame(frame("605#0F 00 00 00 00 00 00 00"))
    assert feed(down, "20 00 00 00 00 00 00 00") == Done(b"")
    up = upload()
    feed(up, "41 08 10 00 00 00 00 00")
    assert feed(up, "0F 00 00 00 00 00 00 00") == Done(b"")


def test_an_abort_of_the_node_is_a_refusal() -> None:
    step = feed(upload(), "80 08 10 00 00 00 02 06")
    assert isinstance(step, Failed)
    assert isinstance(step.error, SdoAborted)
    assert (step.error.index, step.error.subindex, step.error.code) == (0x1008, 0, 0x0602_0000)
    assert "does not exist" in str(step.error)
    assert step.abort is None


def test_abort_codes_have_the_standards_meaning() -> None:
    assert len(abort_codes.MEANINGS) == 31
    assert abort_codes.meaning(0x0609_0030) == "invalid value for parameter"
    assert "vendor" in abort_codes.meaning(0x1234_5678)


@pytest.mark.parametrize(
    ("index", "sub", "node"), [(0x10000, 0, 5), (0x1000, 256, 5), (-1, 0, 5), (0x1000, 0, 0), (0x1000, 0, 128)]
)
def test_no_such_object_is_the_callers_fault(index: int, sub: int, node: int) -> None:
    with pytest.raises(UsageError):
        SdoUpload(node, index, sub, TIMEOUT)


# -- the test-case list ------------------------------------------------------------------------------------------------


def test_co001_repeated_toggle_aborts() -> None:
    transfer = upload()
    feed(transfer, "40 08 10 00 00 00 00 00")
    assert isinstance(feed(transfer, "00 61 62 63 64 65 66 67"), SendFrame)
    refused(feed(transfer, "00 61 62 63 64 65 66 67"), 0x0503_0000)
    assert isinstance(feed(transfer, "1B 68 69 00 00 00 00 00"), Stray)


def test_co001_repeated_acknowledge_aborts() -> None:
    transfer = SdoDownload(5, 0x1008, 0, TIMEOUT, bytes(20))
    transfer.start(0)
    feed(transfer, "60 08 10 00 00 00 00 00")
    feed(transfer, "20 00 00 00 00 00 00 00")
    refused(feed(transfer, "20 00 00 00 00 00 00 00"), 0x0503_0000)


def test_co002_abort_amid_segments() -> None:
    transfer = upload()
    feed(transfer, "41 08 10 00 09 00 00 00")
    step = feed(transfer, "80 08 10 00 00 00 00 08")
    assert isinstance(step, Failed)
    assert isinstance(step.error, SdoAborted)


@pytest.mark.parametrize("wrong", ["20 00 00 00 00 00 00 00", "60 08 10 00 00 00 00 00", "43 08 10 00 01 02 03 04"])
def test_co004_another_kind_of_reply_amid_segments_aborts(wrong: str) -> None:
    transfer = upload()
    feed(transfer, "41 08 10 00 09 00 00 00")
    refused(feed(transfer, wrong), 0x0504_0001)


def test_co013_more_than_indicated() -> None:
    transfer = upload()
    feed(transfer, "41 08 10 00 06 00 00 00")
    refused(feed(transfer, "01 61 62 63 64 65 66 67"), 0x0607_0012)


def test_co013_less_than_indicated() -> None:
    transfer = upload()
    feed(transfer, "41 08 10 00 09 00 00 00")
    refused(feed(transfer, "01 61 62 63 64 65 66 67"), 0x0607_0013)


def test_a_segmented_upload_without_size_ends_with_its_last_segment() -> None:
    transfer = upload()
    feed(transfer, "40 08 10 00 00 00 00 00")
    assert feed(transfer, "01 61 62 63 64 65 66 67") == Done(b"abcdefg")


def test_a_node_that_never_stops_is_stopped() -> None:
    refused(feed(upload(max_bytes=10), "41 08 10 00 0B 00 00 00"), 0x0504_0005)
    transfer = upload(max_bytes=10)
    feed(transfer, "40 08 10 00 00 00 00 00")
    feed(transfer, "00 61 62 63 64 65 66 67")
    refused(feed(transfer, "10 61 62 63 64 65 66 67"), 0x0504_0005)
    transfer = upload()
    feed(transfer, "40 08 10 00 00 00 00 00")
    refused(feed(transfer, "0E 00 00 00 00 00 00 00"), 0x0504_0001)


def test_co022_the_time_out_starts_again_with_each_segment_and_not_with_garbage() -> None:
    transfer = upload()
    feed(transfer, "41 08 10 00 09 00 00 00", 400 * MS)
    assert transfer.expire(899 * MS) is None
    feed(transfer, "00 61 62 63 64 65 66 67", 800 * MS)
    feed(transfer, "80 00 20 00 00 00 00 08", 1200 * MS)
    assert transfer.expire(1299 * MS) is None
    step = transfer.expire(1300 * MS)
    assert step is not None
    assert isinstance(step.error, ReplyTimeout)
    assert step.abort == frame("605#80 08 10 00 00 00 04 05")
    assert isinstance(feed(transfer, "1B 68 69 00 00 00 00 00"), Stray)


@pytest.mark.parametrize(
    "stray",
    [
        "43 08 10 01 01 02 03 04",  # another subindex
        "43 09 10 00 01 02 03 04",  # another index
        "60 08 10 00 00 00 00 00",  # a download's reply
        "00 61 62 63 64 65 66 67",  # a segment
        "80 09 10 00 00 00 04 05",  # another object's abort (CO-024)
        "43 08 10 00 01 02 03",  # CO-026
        "",
        "C1 08 10 00 01 02 03 04",
    ],
)
def test_co005_co023_co024_co026_foreign_replies_are_ignored(stray: str) -> None:
    transfer = upload()
    assert isinstance(feed(transfer, stray), Stray)
    assert feed(transfer, "4F 08 10 00 2A 00 00 00") == Done(b"\x2a")


@pytest.mark.parametrize(
    "other",
    [
        CanFrame(0x586, bytes.fromhex("4F0810002A000000")),
        CanFrame(0x585, bytes.fromhex("4F0810002A000000"), extended=True),
        CanFrame(0x585, remote=True, dlc=8),
        CanFrame(0x585, bytes.fromhex("4F0810002A000000"), error=True),
    ],
)
def test_co060_other_identifiers_and_kinds_of_frame(other: CanFrame) -> None:
    assert isinstance(upload().feed(other, 0), Stray)


def test_co025_a_flood_of_garbage_ends_the_transfer() -> None:
    transfer = upload()
    for _ in range(MAX_STRAYS):
        assert isinstance(feed(transfer, "80 00 20 00 00 00 00 08"), Stray)
    refused(feed(transfer, "80 00 20 00 00 00 00 08"), 0x0504_0001)


def test_co029_expedited_without_size_has_the_objects_own_length() -> None:
    assert feed(upload(length=2), "42 08 10 00 E8 03 AA AA") == Done(b"\xe8\x03")
    assert feed(upload(), "42 08 10 00 E8 03 AA AA") == Done(b"\xe8\x03\xaa\xaa")
    assert feed(upload(length=4), "4B 08 10 00 E8 03 00 00") == Done(b"\xe8\x03")  # the content counts


# -- any garbage ---------------------------------------------------------------------------------------------------

OTHER = st.binary(min_size=3, max_size=3).filter(lambda m: m != b"\x08\x10\x00")
GARBAGE = st.one_of(
    st.binary(max_size=7),
    st.builds(lambda c, m, d: bytes([c]) + m + d, st.integers(0x40, 0x9F), OTHER, st.binary(min_size=4, max_size=4)),
    st.builds(lambda c, d: bytes([c]) + d, st.integers(0xA0, 0xFF), st.binary(min_size=7, max_size=7)),
)


@given(value=st.binary(max_size=40), sized=st.booleans(), data=st.data())
def test_no_garbage_and_no_repetition_yields_a_wrong_object(value: bytes, sized: bool, data: st.DataObject) -> None:
    """Between the correct frames: foreign and repeated frames. The value is correct or there is an error."""
    parts = [value[i : i + 7] for i in range(0, len(value), 7)] or [b""]
    replies = [bytes([0x40 | sized, 0x08, 0x10, 0x00]) + (len(value) if sized else 0).to_bytes(4, "little")]
    for i, part in enumerate(parts):
        command = (i & 1) << 4 | (7 - len(part)) << 1 | (i == len(parts) - 1)
        replies.append(bytes([command]) + part.ljust(7, b"\0"))
    transfer, repeated = upload(), False
    for i, reply in enumerate(replies):
        for junk in data.draw(st.lists(GARBAGE, max_size=3)):
            assert isinstance(transfer.feed(CanFrame(0x585, junk), 0), Stray)
        if i and data.draw(st.booleans()) and data.draw(st.booleans()):
            repeated = True
            step = transfer.feed(CanFrame(0x585, replies[i - 1]), 0)
            assert isinstance(step, Failed)
        step = transfer.feed(CanFrame(0x585, reply), 0)
        if repeated:
            assert isinstance(step, Stray)
            return
    assert step == Done(value)


@given(frames=st.lists(st.binary(max_size=8), max_size=100), size=st.integers(0, 30))
def test_a_transfer_ends_whatever_bytes_arrive(frames: list[bytes], size: int) -> None:
    for transfer in (upload(), SdoDownload(5, 0x1008, 0, TIMEOUT, bytes(size))):
        transfer.start(0)
        for data in frames:
            step = transfer.feed(CanFrame(0x585, data), 0)
            assert isinstance(step, SendFrame | Stray) or transfer.over
