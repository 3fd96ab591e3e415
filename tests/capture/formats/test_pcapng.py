"""pcapng files: several interfaces, sections and clocks are read; what is written is read again, also by Wireshark's tools."""

from __future__ import annotations

import shutil
import struct
import subprocess
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from packets import Talk, crc, mbap, pcap, read, values, write

from fieldtwin.capture.formats.packet_file import MAX_BLOCK, MAX_SKIPPED, PacketFile
from fieldtwin.capture.formats.pcap import Packet
from fieldtwin.capture.formats.pcapng import MAX_TEXT, Wire, interface_names, write_pcapng
from fieldtwin.capture.recordings.exporting import export
from fieldtwin.capture.recordings.from_packets import PacketImport
from fieldtwin.capture.recordings.rotating_file import exchanges_of
from fieldtwin.gateway.connections.tap import TapFile
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.candump import read_log

needs_wireshark = pytest.mark.skipif(
    any(shutil.which(tool) is None for tool in ("tshark", "editcap", "mergecap", "dumpcap")),
    reason="Wireshark's tools are not installed",
)
TCP, RTU, CAN = (
    Endpoint.parse(url) for url in ("tcp://10.0.0.7:1502", "rtu:/dev/ttyUSB0?baudrate=9600", "can:socketcan/can1")
)
STARTED_NS = 1_772_366_400 * 10**9  # 2026-03-01T12:00:00Z


def block(kind: int, body: bytes, order: str = "<") -> bytes:
    size = 12 + len(body) + -len(body) % 4
    return struct.pack(f"{order}II", kind, size) + body + bytes(-len(body) % 4) + struct.pack(f"{order}I", size)


def section(order: str = "<", major: int = 1) -> bytes:
    return block(0x0A0D0D0A, struct.pack(f"{order}IHHq", 0x1A2B3C4D, major, 0, -1), order)


def option(code: int, value: bytes, order: str = "<") -> bytes:
    return struct.pack(f"{order}HH", code, len(value)) + value + bytes(-len(value) % 4)


def interface(*options: bytes, link: int = 147, snapshot: int = 0, order: str = "<") -> bytes:
    return block(1, struct.pack(f"{order}HHI", link, 0, snapshot) + b"".join(options), order)


def enhanced(number: int, ticks: int, data: bytes, order: str = "<") -> bytes:
    head = struct.pack(f"{order}IIIII", number, ticks >> 32, ticks & 0xFFFFFFFF, len(data), len(data))
    return block(6, head + data, order)


def contents(path: Path) -> list[tuple[int, int, str, bytes]]:
    """Return (time in ns, link type, interface, bytes) of each packet."""
    with PacketFile(path) as file:
        return [(t_ns, link, file.interface, data) for t_ns, link, data in file]


# -- reading --------------------------------------------------------------------------------------------------------------


def test_every_interface_has_its_clock_and_its_name(tmp_path: Path) -> None:
    whole = (
        section()
        + interface(option(2, b"line1"), option(9, b"\x06"))
        + interface(option(9, b"\x8a"), option(14, struct.pack("<q", 100)))  # 1024 ticks a second, 100 s later
        + interface(option(9, b"\x14"), link=227)  # 10**20 ticks a second
        + enhanced(0, 5_000_000, b"a")
        + enhanced(1, 1536, b"b")
        + enhanced(2, 3 * 10**18, b"c")
        + section(">")
        + interface(option(2, b"other", ">"), order=">")
        + enhanced(0, 7_000_000, b"d", ">")
    )
    assert contents(write(tmp_path / "c.pcapng", whole)) == [
        (5_000_000_000, 147, "line1", b"a"),
        (101_500_000_000, 147, "if1", b"b"),
        (30_000_000, 227, "if2", b"c"),
        (7_000_000_000, 147, "other", b"d"),
    ]


def test_simple_packets_and_obsolete_packets_are_read(tmp_path: Path) -> None:
    old = struct.pack("<HHIIII", 0, 0, 0, 2_000_000, 3, 3) + b"old"
    whole = section() + interface(snapshot=4) + block(3, struct.pack("<I", 9) + b"only four") + block(2, old)
    assert contents(write(tmp_path / "c.pcapng", whole)) == [(0, 147, "", b"only"), (2_000_000_000, 147, "", b"old")]


def test_other_blocks_are_skipped_even_if_they_are_long(tmp_path: Path) -> None:
    secrets = block(10, bytes(MAX_BLOCK + 4))
    names = block(4, struct.pack("<HH", 0, 0))
    whole = (
        section() + secrets + interface() + names + enhanced(0, 1, b"x") + block(5, bytes(12)) + block(0x40000BAD, b"?")
    )
    assert contents(write(tmp_path / "c.pcapng", whole)) == [(1_000, 147, "", b"x")]


@pytest.mark.parametrize(
    ("whole", "message"),
    [
        (section()[:20], "offset 20: the section header is cut off"),
        (section(major=2), "offset 12: a different version"),
        (section() + enhanced(0, 0, b"x"), "offset 28: a packet of an interface that was not described"),
        (section() + interface() + enhanced(1, 0, b"x"), "offset 48: a packet of an interface that was not described"),
        (section() + struct.pack("<II", 9, MAX_SKIPPED + 4), "offset 28: a block of impossible length"),
        (section() + struct.pack("<II", 6, MAX_BLOCK + 4), "offset 28: a block of impossible length"),
        (section() + interface()[:-4] + b"\x18\0\0\0", "offset 44: a block whose two lengths differ"),
        (section() + interface() + enhanced(0, 1 << 63, b"x"), "offset 48: a packet with an impossible time"),
        (section() + block(1, b""), "offset 28: an interface block that is too short"),
        (section() + interface() + block(6, bytes(8)), "offset 48: a packet block that is too short"),
        (b"\x0a\x0d\x0d\x0a" + struct.pack("<I", 28) + bytes(20), "offset 8: no byte-order magic"),
    ],
)
def test_damage_is_reported_with_its_offset(tmp_path: Path, whole: bytes, message: str) -> None:
    with pytest.raises(FileInvalid, match=message):
        contents(write(tmp_path / "c.pcapng", whole))


def test_two_serial_lines_in_one_capture_become_two_recordings(tmp_path: Path) -> None:
    frames = [crc(b"\x01" + read(1)), crc(b"\x01" + read(2)), crc(b"\x01" + values(5)), crc(b"\x01" + values(6))]
    whole = section() + interface(option(2, b"rtu:/dev/ttyS0")) + interface()
    for n, frame in enumerate(frames):  # the requests overlap, as they do on two lines
        whole += enhanced(n % 2, 1_700_000_000_000_000 + n * 1000, frame)
    made = PacketImport(write(tmp_path / "c.pcapng", whole), tmp_path / "r.jsonl").run().made
    assert {m.path.name: [(e.request, e.reply) for e in exchanges_of(m.path)] for m in made} == {
        "r.rtu-dev-ttyS0.jsonl": [(read(1), values(5))],
        "r.if1.jsonl": [(read(2), values(6))],
    }


# -- writing --------------------------------------------------------------------------------------------------------------

texts = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=40)
bodies = st.binary(max_size=300)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(st.tuples(texts, st.lists(st.tuples(st.integers(0, 2**62), bodies, texts), max_size=5)), max_size=4), texts
)
def test_what_is_written_is_read_again(
    tmp_path: Path, described: list[tuple[str, list[tuple[int, bytes, str]]]], comment: str
) -> None:
    wires = [
        Wire(227, name.strip(), name, [Packet(t, data, Direction.SENT, said) for t, data, said in sorted(found)])
        for name, found in described
    ]
    path = tmp_path / "c.pcapng"
    wanted = sorted((t, number, data) for number, (_, found) in enumerate(described) for t, data, _ in found)
    assert write_pcapng(path, wires, comment=comment) == len(wanted)
    names = [wire.name or (f"if{number}" if number else "") for number, wire in enumerate(wires)]
    found = contents(path)
    assert [t for t, *_ in found] == [t for t, *_ in wanted]
    assert sorted((t, name, data) for t, _, name, data in found) == sorted((t, names[n], data) for t, n, data in wanted)


def test_a_long_text_is_cut_at_a_character(tmp_path: Path) -> None:
    write_pcapng(tmp_path / "c.pcapng", [Wire(147, "x" + "ü" * MAX_TEXT, "", [Packet(-5, b"a")])])
    ((t_ns, _, name, _),) = contents(tmp_path / "c.pcapng")
    assert (t_ns, name) == (0, "x" + "ü" * ((MAX_TEXT - 1) // 2))
    with pytest.raises(FileInvalid, match="cannot write the pcapng file"):
        write_pcapng(tmp_path / "no" / "c.pcapng", [])


def test_names_of_interfaces_are_short_and_unique() -> None:
    urls = [
        "rtu:/dev/ttyUSB0",
        "rtu:/tmp/ttyUSB0",
        "tcp://a:502",
        "can:socketcan/can0",
        "can:fieldtwin/127.0.0.1:29536",
    ]
    names = interface_names([Endpoint.parse(url) for url in urls])
    assert names == ["ttyUSB0", "ttyUSB0-2", "a-502", "can0", "127.0.0.1_29536"]


def captured(folder: Path) -> Path:
    """A capture of a run with two Modbus TCP servers, a serial line and a CAN bus, started at `STARTED_NS`."""
    path = folder / "run.jsonl"
    tap = TapFile(path, head={"started": "2026-03-01T12:00:00+00:00", "t_ns": 5_000})
    other = Endpoint.parse("tcp://10.0.0.8:502")
    for n, endpoint in enumerate((TCP, other)):
        tap.on_bytes(endpoint, Direction.SENT, 10_000 + n, mbap(1, 1, read(n)))
        tap.on_bytes(endpoint, Direction.RECEIVED, 20_000 + n, mbap(1, 1, values(n)))
    tap.on_bytes(RTU, Direction.SENT, 30_000, crc(b"\x02" + read(7)))
    tap.on_bytes(RTU, Direction.RECEIVED, 40_000, crc(b"\x02" + values(77))[:4])
    tap.on_bytes(RTU, Direction.RECEIVED, 41_000, crc(b"\x02" + values(77))[4:])
    tap.on_frame(CAN, Direction.RECEIVED, 50_000, CanFrame(0x185, b"\x01\x02"))
    tap.close()
    return path


def test_a_capture_with_all_its_endpoints_becomes_one_file(tmp_path: Path) -> None:
    assert export(captured(tmp_path), tmp_path / "run.pcapng") == 13  # two handshakes
    made = {m.path.name: m for m in PacketImport(tmp_path / "run.pcapng", tmp_path / "r.jsonl").run().made}
    assert {name: m.exchanges for name, m in made.items()} == {
        "r.192.0.2.2-502.jsonl": 1, "r.192.0.2.3-502.jsonl": 1, "r.ttyUSB0.jsonl": 1, "r.log": 1,
    }  # fmt: skip
    ((t_ns, channel, frame),) = read_log(tmp_path / "r.log")
    assert (t_ns, channel, frame.can_id) == (STARTED_NS + 45_000, "can1", 0x185)
    export(tmp_path / "run.jsonl", tmp_path / "one.pcapng", url=str(RTU))
    assert [(t, name) for t, _, name, _ in contents(tmp_path / "one.pcapng")] == [
        (STARTED_NS + 25_000, "ttyUSB0"), (STARTED_NS + 35_000, "ttyUSB0"),
    ]  # fmt: skip


def test_the_channels_of_a_can_log_come_back(tmp_path: Path) -> None:
    log = tmp_path / "bus.log"
    log.write_text("(5.000001) can0 123#AABB\n(5.000002) vcan1 1ABCDEF0#07\n(5.000003) can0 705#R1\n")
    assert export(log, tmp_path / "bus.pcapng") == 3
    PacketImport(tmp_path / "bus.pcapng", tmp_path / "again.jsonl").run()
    assert (tmp_path / "again.log").read_bytes() == log.read_bytes()


def test_more_interfaces_than_one_file_holds_are_refused(tmp_path: Path) -> None:
    log = tmp_path / "bus.log"
    log.write_text("".join(f"({n}.000001) can{n} 123#\n" for n in range(65)))
    with pytest.raises(UsageError, match="too many interfaces"):
        export(log, tmp_path / "bus.pcapng")
    assert not (tmp_path / "bus.pcapng").exists()


# -- Wireshark's tools ----------------------------------------------------------------------------------------------------


def told(path: Path, *fields: str) -> list[list[str]]:
    """Return these fields of every packet as tshark dissects it; packets that it finds faulty fail the test."""
    wanted = [*fields, "_ws.malformed"]
    rtu = 'uat:user_dlts:"User 0 (DLT=147)","mbrtu","0","","0",""'
    command = ["tshark", "-n", "-r", str(path), "-o", rtu, "-T", "fields", "-E", "separator=|", "-E", "occurrence=f"]
    done = subprocess.run(
        [*command, *(a for f in wanted for a in ("-e", f))], capture_output=True, text=True, check=True, timeout=60
    )
    rows = [line.split("|") for line in done.stdout.splitlines()]
    assert not any(row[-1] for row in rows), rows
    return [row[:-1] for row in rows]


@needs_wireshark
def test_tshark_reads_interfaces_times_and_comments(tmp_path: Path) -> None:
    export(captured(tmp_path), tmp_path / "run.pcapng")
    fields = (
        "frame.interface_name",
        "frame.interface_description",
        "tcp.stream",
        "modbus.func_code",
        "frame.time_epoch",
    )
    rows = [row for row in told(tmp_path / "run.pcapng", *fields) if row[3]]
    assert [row[:3] for row in rows] == [
        ["10.0.0.7-1502", str(TCP), "0"], ["10.0.0.8-502", "tcp://10.0.0.8:502", "1"],
        ["10.0.0.7-1502", str(TCP), "0"], ["10.0.0.8-502", "tcp://10.0.0.8:502", "1"],
        ["ttyUSB0", str(RTU), ""], ["ttyUSB0", str(RTU), ""],
    ]  # fmt: skip
    assert [float(row[4]) for row in rows[-2:]] == pytest.approx([1_772_366_400.000025, 1_772_366_400.000035], abs=1e-7)
    directions = told(tmp_path / "run.pcapng", "frame.packet_flags_direction", "can.id")
    assert directions[-3:] == [["0x00000002", ""], ["0x00000001", ""], ["0x00000001", "389"]]

    recording = tmp_path / "meter.jsonl"
    recording.write_text(
        '{"fieldtwin_recording":1,"device":"a/b","kind":"exchanges","source":"measured","start_utc":"2026-03-01T12:00:00Z"}\n'
        '{"t":0.0,"unit":1,"req":"0300000001","rep":"03020007","lat":0.01}\n{"t":1.0,"unit":1,"req":"0400000001","err":"timeout"}\n'
    )
    for framing in ("mbap", "rtu"):
        export(recording, tmp_path / f"{framing}.pcapng", framing=framing)
        rows = told(tmp_path / f"{framing}.pcapng", "modbus.func_code", "frame.comment")
        assert [row for row in rows if row[0]] == [["3", ""], ["3", ""], ["4", "no reply: timeout"]]


@needs_wireshark
def test_files_of_wiresharks_tools_are_read(tmp_path: Path) -> None:
    talk = Talk(502)
    talk.say(True, mbap(1, 1, read(1)))
    talk.say(False, mbap(1, 1, values(11)))
    lan = write(tmp_path / "lan.pcap", pcap(talk.packets))
    bus = write(tmp_path / "bus.pcap", pcap([struct.pack(">IBxxx", 0x185, 1) + b"\x07"], 227))
    merged, edited, dumped = (tmp_path / f"{name}.pcapng" for name in ("merged", "edited", "dumped"))
    subprocess.run(["mergecap", "-F", "pcapng", "-w", merged, lan, bus], check=True, timeout=60)
    subprocess.run(["editcap", "-F", "pcapng", "-a", "1:a comment", lan, edited], check=True, timeout=60)
    dumpcap = ["dumpcap", "-q", "-i", "-", "-w", str(dumped)]
    subprocess.run(dumpcap, input=lan.read_bytes(), check=True, timeout=60, capture_output=True)

    plain = contents(lan)
    assert [(t, data) for t, link, _, data in contents(merged) if link == 1] == [(t, d) for t, _, _, d in plain]
    assert [data[-1] for _, link, _, data in contents(merged) if link == 227] == [7]
    assert [(t, d) for t, _, _, d in contents(edited)] == [(t, d) for t, _, _, d in plain]
    assert [(t, d) for t, _, _, d in contents(dumped)] == [(t, d) for t, _, _, d in plain]
    for path in (merged, edited, dumped):
        made = PacketImport(path, path.with_suffix(".jsonl")).run().made
        assert [m.exchanges for m in made if m.endpoint != "can"] == [1]


@needs_wireshark
def test_editcap_reads_what_is_written(tmp_path: Path) -> None:
    export(captured(tmp_path), tmp_path / "run.pcapng")
    again = tmp_path / "again.pcapng"
    subprocess.run(["editcap", "-F", "pcapng", tmp_path / "run.pcapng", again], check=True, timeout=60)
    assert contents(again) == contents(tmp_path / "run.pcapng")
