"""Captures as pcap files: the content of a tap is complete, and the generated headers around it are valid."""

from __future__ import annotations

import shutil
import struct
import subprocess
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.capture.formats.pcap import (
    LINKTYPE_CAN_SOCKETCAN,
    LINKTYPE_ETHERNET,
    LINKTYPE_USER0,
    internet_checksum,
    packets,
    read_capture,
    write_pcap,
)
from fieldtwin.gateway.connections.tap import Captured, TapFile
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FileInvalid

RTU, TCP, CAN = (Endpoint.parse(u) for u in ("rtu:/dev/ttyS0", "tcp://modem:502", "can:socketcan/can0"))
S, R = Direction.SENT, Direction.RECEIVED
FRAMES = [
    CanFrame(0x705, b"\x7f"),
    CanFrame(0x605, remote=True, dlc=8),
    CanFrame(0x18FF50E5, bytes(range(8)), extended=True),
    CanFrame(0x20000004 & 0x1FFFFFFF, bytes(8), error=True),
    CanFrame(0x000),
]


def test_the_content_of_a_tap_is_complete(tmp_path: Path) -> None:
    tap = TapFile(tmp_path / "capture.jsonl")
    tap.on_bytes(RTU, S, 10, b"\x01\x02")
    tap.on_bytes(TCP, R, 11, b"")
    for frame in FRAMES:
        tap.on_frame(CAN, R, 12, frame)
    tap.close()
    first, second, *frames = read_capture(tap.path)
    assert (first, second) == (Captured(10, RTU, S, b"\x01\x02"), Captured(11, TCP, R, b""))
    assert [f.item.key() if isinstance(f.item, CanFrame) else f.item for f in frames] == [f.key() for f in FRAMES]


@pytest.mark.parametrize(
    "line",
    [
        "{}",
        "[1]",
        "nonsense",
        "\xff",
        '{"t_ns":1,"endpoint":"rtu:x","direction":"sent","hex":"0"}',
        '{"t_ns":1,"endpoint":"nowhere","direction":"sent","hex":"00"}',
        '{"t_ns":1,"endpoint":"rtu:x","direction":"up","hex":"00"}',
        '{"t_ns":"1","endpoint":"rtu:x","direction":"sent","hex":"00"}',
        '{"t_ns":1,"endpoint":"can:socketcan/can0","direction":"sent","hex":"00","frame":"FFF#00"}',
    ],
)
def test_a_flaw_is_refused_with_its_line_and_a_cut_off_line_is_not(line: str, tmp_path: Path) -> None:
    good = '{"t_ns":1,"endpoint":"rtu:x","direction":"sent","hex":"00"}\n'
    path = tmp_path / "capture.jsonl"
    path.write_text(good + line + "\n" + good)
    with pytest.raises(FileInvalid, match="not a line of a capture") as e:
        list(read_capture(path))
    assert e.value.line == 2
    path.write_text(good + line)
    assert len(list(read_capture(path))) == 1


def test_a_missing_capture_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid, match="cannot read the capture"):
        list(read_capture(tmp_path / "nothing.jsonl"))
    with pytest.raises(FileInvalid, match="cannot write the pcap file"):
        write_pcap(tmp_path / "no" / "such.pcap", [], RTU)


def read_pcap(path: Path) -> tuple[int, list[tuple[int, bytes]]]:
    """Return link type, and times in ns with packets, read by the format's own description."""
    data = path.read_bytes()
    magic, major, minor, _, _, _, link = struct.unpack_from(">IHHiIII", data)
    assert (magic, major, minor) == (0xA1B23C4D, 2, 4)
    at, found = 24, []
    while at < len(data):
        seconds, ns, kept, size = struct.unpack_from(">IIII", data, at)
        assert kept == size
        found.append((seconds * 1_000_000_000 + ns, data[at + 16 : at + 16 + kept]))
        at += 16 + kept
    return link, found


def test_a_serial_line_becomes_a_packet_a_frame(tmp_path: Path) -> None:
    captured = [
        Captured(2, RTU, S, b"ask"),
        Captured(3, TCP, S, b"another wire"),
        Captured(4, RTU, R, b"ans"),
        Captured(5, RTU, R, b"wer"),
        Captured(6, RTU, S, b"again"),
        Captured(7, RTU, S, b"and again"),
        Captured(8, RTU, R, b"late"),
    ]
    assert write_pcap(tmp_path / "line.pcap", captured, RTU, utc_offset_ns=1_700_000_000_999_999_999) == 5
    link, found = read_pcap(tmp_path / "line.pcap")
    assert link == LINKTYPE_USER0
    assert [data for _, data in found] == [b"ask", b"answer", b"again", b"and again", b"late"]
    assert [t - 1_700_000_000_999_999_999 for t, _ in found] == [2, 4, 6, 7, 8]


def test_can_frames_become_socketcan_packets(tmp_path: Path) -> None:
    captured = [Captured(i, CAN, R, f) for i, f in enumerate(FRAMES)]
    write_pcap(tmp_path / "can.pcap", captured, CAN)
    link, found = read_pcap(tmp_path / "can.pcap")
    assert link == LINKTYPE_CAN_SOCKETCAN
    assert [data.hex() for _, data in found] == [
        "00000705 01 000000 7f".replace(" ", ""),
        "40000605 08 000000".replace(" ", ""),
        "98ff50e5 08 000000 0001020304050607".replace(" ", ""),
        "20000004 08 000000 0000000000000000".replace(" ", ""),
        "00000000 00 000000".replace(" ", ""),
    ]


chunks = st.lists(st.tuples(st.sampled_from([S, R]), st.binary(min_size=1, max_size=4000)), min_size=1, max_size=8)


@given(chunks)
def test_a_tcp_stream_survives_its_segments(said: list[tuple[Direction, bytes]]) -> None:
    """Reassembled by sequence numbers, every byte is present, in order, with correct checksums."""
    captured = [Captured(1000 * i + 10, TCP, d, data) for i, (d, data) in enumerate(said)]
    streams: dict[bytes, bytes] = {}
    next_sequence: dict[bytes, int] = {}
    last_ns = 0
    for packet in packets(captured, TCP):
        ip, tcp = packet.data[14:34], packet.data[34:]
        source, target = ip[12:16], ip[16:20]
        assert internet_checksum(ip) == 0
        assert internet_checksum(source + target + struct.pack(">BBH", 0, 6, len(tcp)) + tcp) == 0
        assert struct.unpack_from(">H", ip, 2)[0] == len(ip) + len(tcp) <= 1500
        sequence, acknowledged = struct.unpack_from(">II", tcp, 4)
        syn = tcp[13] & 2
        assert sequence == next_sequence.get(source, sequence)
        assert not tcp[13] & 16 or acknowledged == next_sequence[target]
        next_sequence[source] = sequence + len(tcp) - 20 + bool(syn)
        streams[source] = streams.get(source, b"") + tcp[20:]
        assert packet.t_ns >= last_ns
        last_ns = packet.t_ns
    sent, received = (b"".join(data for d, data in said if d is direction) for direction in (S, R))
    assert list(streams.values()) == [sent, received]


@pytest.mark.interop
@pytest.mark.skipif(shutil.which("tshark") is None, reason="tshark is not installed")
def test_tshark_reads_each_kind(tmp_path: Path) -> None:
    requests = [
        Captured(10, TCP, S, bytes.fromhex("000100000006010300000001")),
        Captured(20, TCP, R, bytes.fromhex("0001000000050103")),
        Captured(30, TCP, R, bytes.fromhex("020000")),  # a reply in two pieces is one reply
    ]
    write_pcap(tmp_path / "lan.pcap", requests, TCP)
    assert read_pcap(tmp_path / "lan.pcap")[0] == LINKTYPE_ETHERNET
    assert tshark(tmp_path / "lan.pcap", "mbtcp.trans_id", "modbus.func_code", "tcp.len") == [
        ["", "", "0"],
        ["", "", "0"],
        ["", "", "0"],
        ["1", "3", "12"],
        ["", "", "8"],
        ["1", "3", "3"],
    ]
    write_pcap(tmp_path / "can.pcap", [Captured(10, CAN, R, f) for f in FRAMES], CAN)
    assert tshark(tmp_path / "can.pcap", "can.id", "can.flags.xtd", "can.flags.rtr", "can.flags.err", "can.len") == [
        [str(0x705), "0", "0", "0", "1"],
        [str(0x605), "0", "1", "0", "8"],
        [str(0x18FF50E5), "1", "0", "0", "8"],
        ["", "", "", "1", "8"],  # an error frame has no identifier
        ["0", "0", "0", "0", "0"],
    ]


def tshark(path: Path, *fields: str) -> list[list[str]]:
    command = ["tshark", "-n", "-r", str(path), "-T", "fields", "-E", "separator=|"]
    out = subprocess.run(
        [*command, *(a for f in fields for a in ("-e", f))], capture_output=True, text=True, check=True, timeout=50
    )
    return [line.split("|") for line in out.stdout.splitlines()]
