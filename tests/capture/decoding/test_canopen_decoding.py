"""CANopen frames of a trace as text and exchanges: SDO transfers of every kind, learned PDOs, and the small services."""

from __future__ import annotations

import json
from collections import deque
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from report_rig import MS, can, note, observatory

from fieldtwin.capture.decoding.decoder import Decoder, exchanges
from fieldtwin.capture.decoding.exchange import DecodedExchange, TouchedSpan
from fieldtwin.capture.decoding.sdo import SdoWatch, Transfer
from fieldtwin.emulators.canopen.sdo.server import SdoServer
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.protocols.canopen.sdo.block import SdoBlockDownload, SdoBlockUpload
from fieldtwin.gateway.protocols.canopen.sdo.transfers import Done, SdoDownload, SdoTransfer, SdoUpload, SendFrame
from fieldtwin.results.trace import TraceEvent, TraceKind


def only(events: list[TraceEvent]) -> DecodedExchange:
    (found,) = exchanges(observatory(), events)
    return found


def texts(events: list[TraceEvent]) -> list[str]:
    decoder = Decoder(observatory())
    return [decoder.decode(e).text for e in events]


def test_an_upload_is_decoded_with_device_object_and_value() -> None:
    events = [can(1, "605#4018100400000000"), can(4, "585#43181004ED030000")]
    assert texts(events) == ["inclinometer: SDO upload 1018h:04 serial", "inclinometer: 1018h:04 serial = 1005"]
    found = only(events)
    assert (found.device, found.unit, found.service, found.latency_ns) == ("inclinometer", 5, "SDO upload", 3 * MS)
    assert found.spans == (TouchedSpan("read", "object", 0x1018, 1, 4),)
    assert (found.value, found.tags, found.ok) == (1005, {"serial": 1005}, True)
    assert str(found.spans[0]) == "1018h:04"


def test_a_download_and_its_abort() -> None:
    events = [can(1, "605#2B171000F4010000"), can(4, "585#8017100030000906")]
    assert texts(events) == [
        "inclinometer: SDO download 1017h:00 Producer heartbeat time = 500",
        "inclinometer: 1017h:00 Producer heartbeat time: abort 06090030h invalid value for parameter",
    ]
    found = only(events)
    assert (found.abort, found.problem, found.value, found.access) == (0x06090030, "abort", 500, "write")


def test_an_unanswered_transfer() -> None:
    found = exchanges(observatory(), [can(1, "605#4018100400000000"), can(500, "605#4018100400000000")])
    assert [(e.t_ns // MS, e.problem, e.value) for e in found] == [(1, "no reply", None), (500, "no reply", None)]


def test_a_tpdo_as_the_system_file_maps_it() -> None:
    found = only([can(1, "185#9E013500")])
    assert (found.service, found.tags, found.access) == ("TPDO1", {"slope_long": 4.14, "slope_lateral": 0.53}, "read")
    assert found.text == "inclinometer: TPDO1 slope_long 4.14 deg, slope_lateral 0.53 deg"


def write(t_ms: float, index: int, sub: int, value: int) -> list[TraceEvent]:
    head = index.to_bytes(2, "little").hex() + f"{sub:02X}"
    command = "23" if sub else "2F"  # 4 bytes, or 1
    return [
        can(t_ms, f"605#{command}{head}{value.to_bytes(4, 'little').hex()}"),
        can(t_ms + 1, f"585#60{head}00000000"),
    ]


def test_a_mapping_is_learned_from_writes() -> None:
    """TPDO1 is moved to a different identifier with one of its two objects, as a configuration tool would do."""
    moved = [*write(0, 0x1800, 1, 0x8000_0185), *write(2, 0x1A00, 0, 0), *write(4, 0x1A00, 1, 0x6020_0010)]
    moved += [*write(6, 0x1A00, 0, 1), *write(8, 0x1800, 1, 0x0000_01A5)]
    found = exchanges(observatory(), [*moved, can(10, "1A5#3500"), can(11, "185#3500")])
    assert found[-2].tags == {"slope_lateral": 0.53}
    assert found[-1].tags == {}  # that identifier is unassigned now, so its content is unknown
    assert texts(moved)[0::2] == [
        "inclinometer: SDO download 1800h:01 COB-ID used by TPDO = 185h (off)",
        "inclinometer: SDO download 1A00h:00 Number of mapped objects = 0",
        "inclinometer: SDO download 1A00h:01 Mapped object 1 = 6020h:00/16",
        "inclinometer: SDO download 1A00h:00 Number of mapped objects = 1",
        "inclinometer: SDO download 1800h:01 COB-ID used by TPDO = 1A5h",
    ]


def test_a_refused_mapping_is_not_learned() -> None:
    refused = [can(0, "605#23001A0110002060"), can(1, "585#80001A0100000106")]
    assert exchanges(observatory(), [*refused, can(10, "185#9E013500")])[-1].tags["slope_long"] == 4.14


def test_a_too_short_pdo_gives_no_values() -> None:
    found = only([can(1, "185#9E01")])
    assert (found.problem, found.tags) == ("malformed", {})


@pytest.mark.parametrize(
    ("frame", "service", "text", "value"),
    [
        ("000#0105", "NMT start", "inclinometer: NMT start", None),
        ("000#8000", "NMT enter pre-operational", "all nodes: NMT enter pre-operational", None),
        ("080#", "SYNC", "SYNC", None),
        ("080#07", "SYNC", "SYNC 7", None),
        ("085#1081110000000000", "EMCY", "inclinometer: EMCY 8110h CAN overrun (objects lost)", 0x8110),
        ("705#00", "boot-up", "inclinometer: boot-up", "INITIALISING"),
        ("705#05", "heartbeat", "inclinometer: OPERATIONAL", "OPERATIONAL"),
        ("70C#7F", "heartbeat", "node 12: PRE-OPERATIONAL", "PRE-OPERATIONAL"),
        ("18C#0102", "TPDO1", "node 12: TPDO1 01 02", None),
        ("20C#0102", "RPDO1", "node 12: RPDO1 01 02", None),
        ("100#112233445566", "TIME", "TIME 11 22 33 44 55 66", None),
    ],
)
def test_each_kind_of_message_is_decoded(frame: str, service: str, text: str, value: object) -> None:
    found = only([can(1, frame)])
    assert (found.service, found.text, found.value, found.ok) == (service, text, value, True)


def test_frames_outside_canopen() -> None:
    odd = [can(0, "18DA00F1#01", ext=True), can(1, "000#", err=True), can(2, "705#", rtr=True), can(3, "6E1#00")]
    odd += [
        note(4, TraceKind.FRAME, "can0", id=1 << 31, bytes="00", dir="sent"),
        note(5, TraceKind.FRAME, "can0", id=1, bytes="zz"),
    ]
    assert texts(odd)[:4] == [
        "18DA00F1#01: not CANopen (29-bit identifier)", "error frame", "asks for 705h", "6E1#00: not a CANopen identifier",
    ]  # fmt: skip
    assert all(text.startswith("unreadable") for text in texts(odd)[4:])
    assert exchanges(observatory(), odd) == []


def test_lss_requests_are_decoded_with_their_replies() -> None:
    found = exchanges(
        observatory(),
        [can(0, "7E5#0401000000000000"), can(1, "7E5#1105000000000000"), can(3, "7E4#1100000000000000"),
         can(5, "7E5#1700000000000000"), can(6, "7E4#1702000000000000"), can(7, "7E5#5E00000000000000"),
         can(8, "7E5#5100000000800000")],
    )  # fmt: skip
    assert [(e.text, e.reply_text, e.problem) for e in found] == [
        ("LSS switch state global to configuration", "", ""),
        ("LSS configure node id 5", "done", ""),
        ("LSS store configuration", "storage media access error", "abort"),
        ("LSS inquire node id", "no reply", "no reply"),
        ("LSS fastscan from the start", "no reply", ""),
    ]
    assert found[1].latency_ns == 2 * MS


class Objects:
    """An object dictionary of one entry."""

    def __init__(self, value: bytes) -> None:
        self.value = value

    def read(self, index: int, subindex: int, now_ns: int) -> bytes:
        return self.value

    def begin_write(self, index: int, subindex: int, size: int | None) -> None:
        return None

    def write(self, index: int, subindex: int, raw: bytes, now_ns: int) -> None:
        self.value = raw


def listened(transfer: SdoTransfer, server: SdoServer) -> Transfer:
    """A transfer between our client and the emulator's server, and the decoding of a listener."""
    watch, seen = SdoWatch(), []
    waiting = deque([transfer.start(0).data])
    while waiting:
        request = waiting.popleft()
        seen.append(watch.request(request, 0).done)
        for reply in server.request(request, 0):
            seen.append(watch.reply(reply, 0).done)
            step = transfer.feed(reply_frame(reply), 0)
            if isinstance(step, SendFrame):
                waiting.append(step.frame.data)
            if isinstance(step, Done) and step.last is not None:
                waiting.append(step.last.data)
        while waiting and (more := transfer.more(0)) is not None:
            waiting.append(more.frame.data)
    (done,) = [t for t in seen if t is not None]
    assert watch.open is None
    return done


def reply_frame(data: bytes) -> CanFrame:
    return CanFrame(0x585, data)


@pytest.mark.parametrize("size", [1, 4, 5, 7, 8, 34, 35, 36, 500])
@pytest.mark.parametrize("blocks", [False, True])
def test_transfers_of_every_kind_are_followed(size: int, blocks: bool) -> None:
    value = bytes(i % 251 for i in range(size))
    server = SdoServer(Objects(value), 10**9, block=5)
    kind = SdoBlockUpload if blocks else SdoUpload
    done = listened(kind(5, 0x2000, 3, 10**9), server)
    assert (done.service, done.name, bytes(done.data), done.abort) == ("SDO upload", "2000h:03", value, None)
    objects = Objects(b"")
    server = SdoServer(objects, 10**9, block=5)
    download = SdoBlockDownload if blocks else SdoDownload
    done = listened(download(5, 0x2000, 3, 10**9, value), server)
    assert (done.service, bytes(done.data), objects.value) == ("SDO download", value, value)


@given(st.lists(st.tuples(st.sampled_from([0x605, 0x585, 0x7E4, 0x7E5, 0x185, 0x85, 0x705]), st.binary(max_size=8))))
@settings(max_examples=60)
def test_any_frames_are_described(frames: list[tuple[int, bytes]]) -> None:
    events = [note(t, TraceKind.FRAME, "can0", id=i, bytes=d.hex(), dir="sent") for t, (i, d) in enumerate(frames)]
    assert all(texts(events))
    exchanges(observatory(), events)


def test_invalid_frames_are_described_too() -> None:
    events = [
        note(0, TraceKind.TAG, "ctd.pressure", value=12.5, quality="good", reason="none"),
        note(0, TraceKind.TAG, "ctd.status", value=1, quality="bad", reason="timeout"),
        note(0, TraceKind.STATE, "relay.state", value=1),
        note(0, TraceKind.FAULT, "f1", name="drop", on=True, target="line1"),
        note(0, TraceKind.STEP, "3", text="wait for ctd", verdict="passed"),
        note(0, TraceKind.NOTE, "run", text="began"),
    ]
    assert texts(events) == [
        "ctd.pressure 12.5 dbar, good", "ctd.status 1 (sampling), bad: timeout", "relay.state = 1",
        "fault f1: drop on line1", "step 3: wait for ctd: passed", "run: began",
    ]  # fmt: skip


def test_a_segment_that_was_lost_comes_again() -> None:
    """Block upload: the second of three segments is lost, one is acknowledged, the rest is repeated from number 1."""
    watch = SdoWatch()
    watch.request(bytes.fromhex("A4 0020 00 7F 00 0000"), 0)
    watch.reply(bytes.fromhex("C6 0020 00 15000000"), 1)
    watch.request(bytes.fromhex("A3 000000 00000000"), 2)
    for segment in ("01 61626364656667", "03 78787878787878"):
        watch.reply(bytes.fromhex(segment), 3)
    watch.request(bytes.fromhex("A2 01 7F 0000000000"), 4)
    for segment in ("01 68696A6B6C6D6E", "82 6F707172737475"):
        watch.reply(bytes.fromhex(segment), 5)
    watch.request(bytes.fromhex("A2 02 7F 0000000000"), 6)
    watch.reply(bytes.fromhex("C1 0000 0000000000"), 7)
    done = watch.request(bytes.fromhex("A1 00000000000000"), 8).done
    assert done is not None
    assert bytes(done.data) == b"abcdefghijklmnopqrstu"


def test_secrets_have_no_value_in_text_nor_in_json() -> None:
    system = observatory()
    tags = system.devices["inclinometer"].profile.tags
    hidden = {name: replace(tag, secret=name in ("serial", "slope_lateral")) for name, tag in tags.items()}
    profile = replace(system.devices["inclinometer"].profile, tags=hidden)
    device = replace(system.devices["inclinometer"], profile=profile)
    system = replace(system, devices={**system.devices, "inclinometer": device})
    decoder, told = Decoder(system), []
    frames = ["605#4018100400000000", "585#43181004ED030000", "605#2318100477000000", "185#9E013599", "185#9E01FF"]
    found: list[DecodedExchange] = []
    for ms, frame in enumerate(frames):
        decoded = decoder.decode(can(ms, frame))
        told.append(decoded.text)
        found += decoded.exchanges
    assert told == [
        "inclinometer: SDO upload 1018h:04 serial",
        "inclinometer: 1018h:04 serial = (secret)",
        "inclinometer: SDO download 1018h:04 serial = (secret)",
        "inclinometer: TPDO1 slope_long 4.14 deg, slope_lateral (secret)",
        "inclinometer: TPDO1 (secret), 4 bytes were mapped",
    ]
    shown = json.dumps([e.describe() for e in found])
    assert "1005" not in shown
    assert str(found[1].tags["slope_lateral"]) not in shown
    assert found[0].value == 1005  # a check still has it
    segment = [can(10, "605#4018100400000000"), can(11, "585#4118100408000000"), can(12, "605#6000000000000000")]
    assert [decoder.decode(e).text.endswith("(secret)") for e in (*segment, can(13, "585#0041424344454647"))][1:] == [
        True
    ] * 3
