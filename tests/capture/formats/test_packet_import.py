"""Captures of traffic become recordings: TCP in any order, any port, any link; malformed frames are kept and counted."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from packets import CLIENT, SERVER, SYN, Talk, crc, mbap, pcap, pcapng, read, tcp, udp6, values, write

from fieldtwin.capture.formats.packet_file import PacketFile
from fieldtwin.capture.formats.pcap import read_capture
from fieldtwin.capture.recordings.from_packets import PacketImport, PacketSummary
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.files.recording import RecordedExchange, RecordingReader


def exchanges(path: Path) -> list[RecordedExchange]:
    with RecordingReader(path) as reader:
        return list(reader.exchanges())


def imported(folder: Path, capture: bytes, ports: tuple[int, ...] = ()) -> tuple[PacketSummary, list[RecordedExchange]]:
    """Return the summary, and the exchanges of the only recording."""
    summary = PacketImport(write(folder / "c.pcap", capture), folder / "r.jsonl", ports).run()
    assert len(summary.made) == 1, summary
    return summary, exchanges(folder / "r.jsonl")


def polls(port: int = 502, *, opened: bool = True) -> list[bytes]:
    talk = Talk(port, opened=opened)
    for i in range(4):
        talk.say(True, mbap(i, 1, read(10 * i, 2)))
        talk.say(False, mbap(i, 1, values(i, 500 + i)))
        talk.acknowledge(True)
    return talk.packets


WANTED = [(1, read(10 * i, 2), values(i, 500 + i)) for i in range(4)]


def told(found: list[RecordedExchange]) -> list[tuple[int, bytes, bytes | None]]:
    return [(e.unit, e.request, e.reply) for e in found]


@pytest.mark.parametrize(
    "capture",
    [
        pcap(polls()), pcap(polls(), magic=b"\xa1\xb2\xc3\xd4"), pcap(polls(), magic=b"\x4d\x3c\xb2\xa1"),
        pcap(polls(), magic=b"\xa1\xb2\x3c\x4d"), pcapng(polls()), pcapng(polls(), order=">"), gzip.compress(pcap(polls())),
        pcap([p[14:] for p in polls()], 101), pcap([bytes(14) + b"\x08\x00" + p[14:] for p in polls()], 113),
        pcap([struct.pack("<I", 2) + p[14:] for p in polls()], 0), pcap(polls(15_020)), pcap(polls(opened=False)),
        pcap(polls(15_020, opened=False)), pcap([q for p in polls() for q in (p, p)]),
    ],
    ids=["pcap", "big endian", "ns", "ns big endian", "pcapng", "pcapng big endian", "gzip", "raw ip", "sll", "null",
         "any port", "begun before", "any port, begun before", "everything twice"],
)  # fmt: skip
def test_polls_are_found_in_any_file_on_any_port(tmp_path: Path, capture: bytes) -> None:
    summary, found = imported(tmp_path, capture)
    assert told(found) == WANTED
    assert all(e.latency_s in (0.001, 0.002) for e in found)
    assert (summary.pairs.malformed, summary.pairs.strays, summary.packets.lost_bytes) == (0, 0, 0)
    with RecordingReader(tmp_path / "r.jsonl") as reader:
        assert (reader.header.source, reader.header.start_utc[:10]) == ("imported", "2023-11-14")
        assert reader.header.endpoint in ("tcp://10.0.0.2:502", "tcp://10.0.0.2:15020")


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_segments_in_any_order_repeated_and_overlapping_give_the_same(tmp_path: Path, data: st.DataObject) -> None:
    folder = tmp_path / str(len(list(tmp_path.iterdir())))
    folder.mkdir()
    stream = b"".join(mbap(i, 1, read(i)) for i in range(6))
    borders = sorted(data.draw(st.sets(st.integers(1, len(stream) - 1), max_size=10)))
    pieces = list(zip([0, *borders], [*borders, len(stream)], strict=True))
    extra = data.draw(st.lists(st.tuples(st.integers(0, len(stream)), st.integers(1, 30)), max_size=4))
    pieces = data.draw(st.permutations(pieces + [(a, min(a + n, len(stream))) for a, n in extra if a < len(stream)]))
    start = data.draw(st.sampled_from([1, 2**32 - 20]))
    packets = [tcp(CLIENT, SERVER, (50_000, 502), start - 1, b"", SYN)]
    packets += [tcp(CLIENT, SERVER, (50_000, 502), start + a, stream[a:b]) for a, b in pieces]
    _, found = imported(folder, pcap(packets))
    assert [e.request for e in found] == [read(i) for i in range(6)]


def test_losses_of_the_capture_are_reported_and_the_rest_is_found(tmp_path: Path) -> None:
    talk = Talk()
    talk.say(True, mbap(1, 1, read(1)))
    talk.say(False, mbap(1, 1, values(1))[:4])
    talk.lose(False, 7)
    talk.say(True, mbap(2, 1, read(2)))
    talk.say(False, mbap(2, 1, values(2)))
    talk.acknowledge(True)
    summary, found = imported(tmp_path, pcap(talk.packets))
    assert told(found) == [(1, read(1), None), (1, read(2), values(2))]
    assert (summary.packets.lost_bytes, summary.pairs.malformed) == (7, 1)


def test_servers_units_and_framings_are_separate(tmp_path: Path) -> None:
    one, two, web = Talk(502), Talk(4001, 50_001, bytes((10, 0, 0, 3))), Talk(80, 50_002)
    one.say(True, mbap(1, 1, read(1)) + mbap(2, 2, read(1)))
    one.say(False, mbap(2, 2, values(22)) + mbap(1, 1, values(11)))
    two.say(True, crc(b"\x05" + read(7, 1, 4)))
    two.say(False, crc(b"\x05" + values(77, function=4)))
    for _ in range(50):
        web.say(True, b"GET / HTTP/1.1\r\n\r\n")
    udp = [udp6((1, 2), (1234, 502), mbap(1, 9, read(3))), udp6((2, 1), (502, 1234), mbap(1, 9, values(33)))]
    summary = PacketImport(
        write(tmp_path / "c.pcap", pcap(one.packets + two.packets + web.packets + udp)), tmp_path / "r.jsonl"
    ).run()
    made = {m.endpoint: told(exchanges(m.path)) for m in summary.made}
    assert made == {
        "tcp://10.0.0.2:502": [(1, read(1), values(11)), (2, read(1), values(22))],
        "rtu+tcp://10.0.0.3:4001": [(5, read(7, 1, 4), values(77, function=4))],
        "udp://[::2]:502": [(9, read(3), values(33))],
    }
    assert summary.other_conversations == 1
    assert not (tmp_path / "r.jsonl").exists()
    only = PacketImport(tmp_path / "c.pcap", tmp_path / "only.jsonl", [4001]).run()
    assert [m.endpoint for m in only.made] == ["rtu+tcp://10.0.0.3:4001"]


def pieces(packet: bytes, size: int) -> list[bytes]:
    """An IPv4 packet in fragments of `size` bytes."""
    ethernet, head, body = packet[:14], bytearray(packet[14:34]), packet[34 : 14 + int.from_bytes(packet[16:18])]
    out = []
    for at in range(0, len(body), size):
        piece = body[at : at + size]
        head[2:4] = (20 + len(piece)).to_bytes(2)
        head[6:8] = (at // 8 | (0x2000 if at + size < len(body) else 0)).to_bytes(2)
        out.append(ethernet + bytes(head) + piece)
    return out


def test_ip_packets_in_pieces_are_put_together(tmp_path: Path) -> None:
    packets = []
    for n, packet in enumerate(polls()):  # each with a separate identification
        numbered = packet[:18] + n.to_bytes(2) + packet[20:]
        found = pieces(numbered, 24)
        packets += found[::-1] if n % 2 else found
    summary, found = imported(tmp_path, pcap(packets))
    assert told(found) == WANTED
    assert summary.packets.fragments == 0
    (tmp_path / "r.jsonl").unlink()
    assert imported(tmp_path, pcap([*packets, pieces(polls()[2], 24)[0]]))[0].packets.fragments == 1


def test_a_draft_profile_of_each_unit_can_be_loaded(tmp_path: Path) -> None:
    talk = Talk()
    steps = [
        (read(0, 2), values(7, 8)), (read(0, 2), values(7, 9)), (read(40, 2), b"\x83\x02"),
        (bytes.fromhex("06 0001 0005"), bytes.fromhex("06 0001 0005")), (read(3, 1, 1), b"\x01\x01\x01"),
        (bytes.fromhex("06 0063 0005"), bytes.fromhex("06 0063 0005")),
    ]  # fmt: skip
    for i, (request, reply) in enumerate(steps):
        talk.say(True, mbap(i, 3, request))
        talk.say(False, mbap(i, 3, reply))
    summary, _ = imported(tmp_path, pcap(talk.packets))
    [path] = summary.made[0].profiles
    profile = load_profile(path)
    assert {n: t.access for n, t in profile.tags.items()} == {
        "coil_3": "ro", "holding_0": "ro", "holding_1": "rw", "holding_99": "wo",
    }  # fmt: skip
    assert profile.form.limits.functions == [1, 3, 6]
    assert "exception 02" in path.read_text()


def test_malformed_frames_are_kept_as_a_capture(tmp_path: Path) -> None:
    talk = Talk()
    talk.say(True, mbap(1, 1, read(1)))
    talk.say(False, b"\x00\x01\x00\x05garbage!")
    talk.say(True, mbap(2, 1, read(2)))
    talk.say(False, mbap(2, 1, values(2)))
    summary, found = imported(tmp_path, pcap(talk.packets))
    assert told(found) == [(1, read(1), None), (1, read(2), values(2))]
    assert summary.pairs.malformed == 1
    assert summary.bad_file is not None
    assert [c.item for c in read_capture(summary.bad_file)] == [b"\x00\x01\x00\x05garbage!"]


def test_can_frames_become_a_log(tmp_path: Path) -> None:
    frames = [
        struct.pack(">IBxxx", 0x585, 8) + bytes(8), struct.pack(">IBxxx", 0x9ABCDEF0 & 0x1FFFFFFF | 1 << 31, 1) + b"\x07",
        struct.pack(">IBxxx", 0x705 | 1 << 30, 1), struct.pack(">IBBxx", 0x10, 12, 4) + bytes(12), b"\x01",
    ]  # fmt: skip
    summary = PacketImport(write(tmp_path / "c.pcap", pcap(frames, 227)), tmp_path / "r.jsonl").run()
    assert (summary.can_frames, summary.can_left_out) == (3, 2)
    assert [line.split()[2] for line in (tmp_path / "r.log").read_text().splitlines()] == [
        "585#0000000000000000", "1ABCDEF0#07", "705#R1",
    ]  # fmt: skip


def test_a_line_with_unknown_directions(tmp_path: Path) -> None:
    _, found = imported(tmp_path, pcap([crc(b"\x01" + read(1)), crc(b"\x01" + values(5)), crc(b"\x01" + read(2))], 147))
    assert told(found) == [(1, read(1), values(5)), (1, read(2), None)]


def contents(path: Path) -> tuple[list[bytes], int | None]:
    """Return the packets of a file, and the offset at which it is cut off."""
    with PacketFile(path) as file:
        return [data for _, _, data in file], file.cut_off_at


def test_a_capture_that_is_cut_off_anywhere_is_read_up_to_there(tmp_path: Path) -> None:
    for whole in (pcap(polls()), pcapng(polls())):
        for size in range(0, len(whole), 7):
            try:
                got, cut_off_at = contents(write(tmp_path / "c.pcap", whole[:size]))
            except FileInvalid:
                assert size < 28
                continue
            assert got == polls()[: len(got)]
            if cut_off_at is not None:
                assert cut_off_at < size
                assert contents(write(tmp_path / "before.pcap", whole[:cut_off_at])) == (got, None)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_damaged_capture_is_an_error_with_its_offset_or_is_read(tmp_path: Path, data: st.DataObject) -> None:
    whole = bytearray(
        data.draw(
            st.sampled_from([pcap(polls()), pcapng(polls()), pcap([bytes(16)] * 3, 227), gzip.compress(pcap(polls()))])
        )
    )
    for _ in range(data.draw(st.integers(1, 6))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    out = tmp_path / "r.jsonl"
    for old in tmp_path.iterdir():
        old.unlink()
    try:
        PacketImport(write(tmp_path / "c.pcap", bytes(whole)), out).run()
    except FileInvalid as e:
        assert "offset" in str(e)  # noqa: PT017
        assert not list(tmp_path.glob("r.*"))


def test_an_existing_recording_is_not_changed(tmp_path: Path) -> None:
    write(tmp_path / "r.jsonl", b"mine")
    with pytest.raises(FileInvalid, match="exists already"):
        imported(tmp_path, pcap(polls()))
    assert (tmp_path / "r.jsonl").read_bytes() == b"mine"
