"""record, emulate, record, compare: nothing is lost over a serial line, TCP and CAN; a tap keeps every byte."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import signal
import subprocess
import sys
from collections.abc import AsyncIterator, Iterable
from pathlib import Path

import pytest
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice
from support import eventually, run

from fieldtwin.capture.formats.pcap import read_capture
from fieldtwin.capture.recordings.comparing import Comparer, Comparison, Rules, pairs_of, request_of
from fieldtwin.capture.recordings.comparing_can import Frames, compare_logs
from fieldtwin.capture.recordings.importing import import_capture
from fieldtwin.capture.recordings.rotating_file import RotatingFile, exchanges_of, part, parts_of
from fieldtwin.capture.recordings.sinks import CanLogSink, ExchangeSink, LineSink
from fieldtwin.commissioning.access.reading import target_of
from fieldtwin.commissioning.record.asking import asker_at
from fieldtwin.commissioning.record.comparing import compare_device
from fieldtwin.commissioning.record.polling import (
    PollCounters,
    ProfileRound,
    Round,
    SameRequests,
    follow_bus,
    record_node,
    record_polls,
)
from fieldtwin.commissioning.record.tapping import LineTap
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.context import EndOfRecording
from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.emulators.endpoints.ports import OsPorts
from fieldtwin.emulators.host import EmulatorHost
from fieldtwin.emulators.models.canopen.emulated_node import emulated_node
from fieldtwin.emulators.replay.can_log import CanLog
from fieldtwin.emulators.replay.replay import NeverRecorded
from fieldtwin.emulators.signals import SignalPlayer, SignalTrack
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Unreachable, UsageError
from fieldtwin.gateway.core.files.candump import read_log
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.files.recording import RecordedExchange, RecordingHeader, encode_exchange, encode_header
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.protocols.modbus.requests.data import ReadRegisters
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.run.emulate.device import as_it_was_recorded, replayed_units, serve_units

ROOT = Path(__file__).parents[3]
HEADER = RecordingHeader(version=1, device="a/b", kind="exchanges", source="measured")
UNTIMED = Rules(latency=None)


def write(path: Path, exchanges: Iterable[RecordedExchange]) -> Path:
    path.write_bytes(encode_header(HEADER) + b"".join(map(encode_exchange, exchanges)))
    return path


def shipped(folder: Path) -> Path:
    """The shipped recording of a drive, followed by results of all kinds; shortened, and without its latencies."""
    drive = [
        RecordedExchange(e.t_s, e.unit, e.request, e.reply)
        for e in exchanges_of(ROOT / "recordings" / "delta-vfd-e.jsonl")
    ][:44]
    more = [
        RecordedExchange(9.0, 1, bytes.fromhex("0300070001"), b"\x83\x02"),
        RecordedExchange(9.1, 1, bytes.fromhex("0300080001"), b"\x83\x06"),
        RecordedExchange(9.2, 1, bytes.fromhex("0300080001"), bytes.fromhex("03020005")),
        RecordedExchange(9.3, 1, b"\x11", bytes.fromhex("110401ff4142")),
        RecordedExchange(9.4, 1, bytes.fromhex("0100000009"), bytes.fromhex("0102ff01")),
        RecordedExchange(9.5, 1, bytes.fromhex("0300000000"), b"\x83\x03"),
    ]  # fmt: skip
    return write(folder / "original.jsonl", drive + more)


@contextlib.asynccontextmanager
async def played(recording: Path, wire: str) -> AsyncIterator[None]:
    """The recording, emulated on that wire."""
    host = EmulatorHost(WallClock(), OsPorts())
    try:
        units = replayed_units(recording, None, NeverRecorded.EXCEPTION, EndOfRecording.HOLD)
        await serve_units(host, Endpoint.parse(wire), units)
        yield
    finally:
        await host.aclose()


async def recorded(url: str, one_round: Round, out: Path, *, rounds: int = 1, part: int = 1 << 20) -> PollCounters:
    counters = PollCounters()
    with RotatingFile(out, encode_header(HEADER), max_bytes=part) as file:
        await record_polls(
            target_of(url),
            one_round,
            ExchangeSink(file),
            every_s=0.001,
            counters=counters,
            stop=asyncio.Event(),
            rounds=rounds,
        )
    return counters


def compared(one: Path, two: Path, rules: Rules = UNTIMED) -> Comparison:
    comparer = Comparer(rules)
    for a, b in pairs_of(exchanges_of(one), exchanges_of(two), request_of):
        comparer.add(a, b)
    return comparer.result()


class AsRecorded:
    """Send every recorded request in order, repeated ones included."""

    def __init__(self, path: Path) -> None:
        self._exchanges = list(exchanges_of(path))

    async def __call__(self, asker: object, sink: ExchangeSink) -> None:
        for e in self._exchanges:
            found = await asker.ask(e.unit, e.request)  # type: ignore[attr-defined]
            assert found is not None
            sink(found)


@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp", "rtu", "ascii"])
def test_recorded_emulated_and_recorded_again_is_the_same(tmp_path: Path, kind: str) -> None:
    original, port = shipped(tmp_path), tmp_path / "port"
    if kind in ("rtu", "ascii"):
        wire = url = f"{kind}:{port}?baudrate=115200"
    else:
        wire = url = f"{kind}://127.0.0.1:{_free_port()}"

    async def main() -> Comparison:
        async with played(original, wire):
            await recorded(url, AsRecorded(original), tmp_path / "again.jsonl")
        async with played(tmp_path / "again.jsonl", wire), asker_at(url) as asker:
            comparer = Comparer(UNTIMED)
            await compare_device(exchanges_of(original), asker, comparer)
            return comparer.result()

    live = run(main())
    again = list(exchanges_of(tmp_path / "again.jsonl"))
    assert [(e.unit, e.request, e.reply) for e in again] == [
        (e.unit, e.request, e.reply) for e in exchanges_of(original)
    ]
    for result in (live, compared(original, tmp_path / "again.jsonl")):
        assert (result.met, result.compared, result.values, result.differences) == (True, 50, 1.0, [])


def _free_port() -> int:
    import socket

    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        found: int = s.getsockname()[1]
        return found


def test_a_third_party_server_is_recorded_and_its_emulator_is_equivalent(tmp_path: Path) -> None:
    """A pymodbus server: 100 registers that count, then exception 02."""
    requests = ["0300000064", "0300000001", "0300630001", "0300640001", "03005f000a"]
    wanted = write(tmp_path / "wanted.jsonl", [RecordedExchange(0, 1, bytes.fromhex(r), b"\x83\x01") for r in requests])
    theirs, ours = _free_port(), _free_port()

    async def main() -> Comparison:
        device = SimDevice(1, [SimData(0, count=100, values=7, datatype=DataType.REGISTERS)])
        server = ModbusTcpServer(device, address=("127.0.0.1", theirs))
        await server.serve_forever(background=True)
        same = SameRequests(exchanges_of(wanted))
        try:
            counters = await recorded(f"tcp://127.0.0.1:{theirs}", same, tmp_path / "r.jsonl", rounds=2)
        finally:
            await server.shutdown()
        assert (counters.exchanges, counters.refused, counters.unanswered) == (10, 4, 0)
        async with played(tmp_path / "r.jsonl", f"tcp://127.0.0.1:{ours}"):
            await recorded(f"tcp://127.0.0.1:{ours}", same, tmp_path / "again.jsonl", rounds=2)
        return compared(tmp_path / "r.jsonl", tmp_path / "again.jsonl")

    result = run(main())
    assert (result.met, result.compared) == (True, 10)


def test_a_planted_difference_of_each_kind_is_found(tmp_path: Path) -> None:
    original = shipped(tmp_path)
    exchanges = list(exchanges_of(original))
    planted = [
        (4, RecordedExchange(0, 1, exchanges[4].request, bytes.fromhex("0302ffff")), "value"),
        (44, RecordedExchange(0, 1, exchanges[44].request, b"\x83\x04"), "exception"),
        (0, RecordedExchange(0, 1, exchanges[0].request, None, error="timeout"), "silence"),
        (47, RecordedExchange(0, 1, exchanges[47].request, exchanges[47].reply + b"\0"), "reply"),
    ]  # fmt: skip
    for at, other, what in planted:
        changed = write(tmp_path / f"{what}.jsonl", [*exchanges[:at], other, *exchanges[at + 1 :]])
        result = compared(original, changed)
        assert (result.met, result.alike, result.by_kind) == (False, 49, {what: 1})
    assert compared(original, write(tmp_path / "less.jsonl", exchanges[1:])).by_kind == {"missing": 1}
    more = compared(write(tmp_path / "less2.jsonl", exchanges[1:]), original)
    assert (more.met, more.extra) == (True, 1)


def test_a_profile_is_polled_in_few_reads_and_refused_reads_are_split(tmp_path: Path) -> None:
    """The device has a gap where the profile reads across it: the exception is recorded too, and requested once."""
    profile_path = tmp_path / "p.yaml"
    profile_path.write_text(
        'device: a/b\nsource: ""\nprotocol: modbus\ntags:\n  one: {at: "holding:0"}\n  two: {at: "holding:4"}\n'
    )
    gap = write(tmp_path / "gap.jsonl", [
        RecordedExchange(0, 1, bytes.fromhex("0300000005"), b"\x83\x02"),
        RecordedExchange(0, 1, bytes.fromhex("0300000001"), bytes.fromhex("03020001")),
        RecordedExchange(0, 1, bytes.fromhex("0300040001"), bytes.fromhex("03020002")),
    ])  # fmt: skip
    url = f"tcp://127.0.0.1:{_free_port()}"

    async def main() -> PollCounters:
        async with played(gap, url):
            return await recorded(url, ProfileRound(load_profile(profile_path), 1), tmp_path / "r.jsonl", rounds=3)

    counters = run(main())
    assert (counters.rounds, counters.exchanges, counters.refused) == (3, 7, 1)
    asked = [e.request.hex() for e in exchanges_of(tmp_path / "r.jsonl")]
    assert asked == ["0300000005", *["0300000001", "0300040001"] * 3]
    with pytest.raises(UsageError, match="no poll group"):
        ProfileRound(load_profile(profile_path), 1, ["other"])


def test_only_reads_are_asked_again(tmp_path: Path) -> None:
    reads = ["0300000001", "08000b0000", "2b0e0100", "11"]
    requests = [*reads, "0600010005", "0f000000010101", "64", "160004000000ff", "0800010000"]
    source = [RecordedExchange(0, 1, bytes.fromhex(r), b"\x83\x01") for r in requests]
    same = SameRequests([*source, *source])
    assert [pdu.hex() for _, pdu in same.requests] == reads
    assert same.left_out == 2 * 5


def test_writes_are_repeated_only_on_request_and_to_wearing_memory_once(tmp_path: Path) -> None:
    write_hex, other_hex, read_hex = "0600010005", "0600020006", "0300010002"
    exchanges = [
        RecordedExchange(n, 1, bytes.fromhex(h), bytes.fromhex(h)) for n, h in enumerate([write_hex, other_hex] * 3)
    ]
    exchanges.append(RecordedExchange(9, 1, bytes.fromhex(read_hex), bytes.fromhex("030400050006")))
    original = write(tmp_path / "w.jsonl", exchanges)
    url = f"tcp://127.0.0.1:{_free_port()}"

    async def main(**how: object) -> Comparison:
        comparer = Comparer(UNTIMED)
        async with played(original, url), asker_at(url) as asker:
            await compare_device(exchanges, asker, comparer, **how)  # type: ignore[arg-type]
        return comparer.result()

    assert [(r.compared, r.left_out, r.met) for r in (run(main()), run(main(writes=True)))] == [
        (1, 6, True),
        (7, 0, True),
    ]
    careful = run(main(writes=True, wearing={("holding", 1)}))
    assert (careful.compared, careful.left_out, careful.met) == (5, 2, True)


def test_a_device_that_is_disconnected_for_a_while_is_recorded_again_when_it_returns(tmp_path: Path) -> None:
    one = write(
        tmp_path / "one.jsonl", [RecordedExchange(0, 1, bytes.fromhex("0300000001"), bytes.fromhex("03020001"))]
    )
    url = f"tcp://127.0.0.1:{_free_port()}"
    counters, stop = PollCounters(), asyncio.Event()

    async def main() -> None:
        with RotatingFile(tmp_path / "r.jsonl", encode_header(HEADER)) as file:
            same = SameRequests(exchanges_of(one))
            async with played(one, url):
                recording = asyncio.ensure_future(
                    record_polls(target_of(url), same, ExchangeSink(file), every_s=0.01, counters=counters, stop=stop)
                )
                await eventually(lambda: counters.exchanges > 2)
            await eventually(lambda: counters.lost > 0)
            before = counters.exchanges
            async with played(one, url):
                await eventually(lambda: counters.exchanges > before + 2)
                stop.set()
                await recording

    run(main())
    errors = [e.error for e in exchanges_of(tmp_path / "r.jsonl")]
    assert set(errors) <= {None, "lost"}
    assert errors[-1] is None
    with pytest.raises(Unreachable):
        run(recorded(f"tcp://127.0.0.1:{_free_port()}", SameRequests(exchanges_of(one)), tmp_path / "nobody.jsonl"))


# -- taps -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["pty", "tcp"])
def test_a_tap_keeps_every_byte_in_both_directions_and_the_framing_is_found(tmp_path: Path, kind: str) -> None:
    original = shipped(tmp_path)
    far = f"rtu:{tmp_path}/far?baudrate=115200" if kind == "pty" else f"tcp://127.0.0.1:{_free_port()}"
    near = f"rtu:{tmp_path}/near?baudrate=115200" if kind == "pty" else f"tcp://127.0.0.1:{_free_port()}"
    seen: dict[Direction, bytes] = {Direction.SENT: b"", Direction.RECEIVED: b""}

    async def main() -> None:
        stop, ready = asyncio.Event(), asyncio.Event()
        with RotatingFile(tmp_path / "t.tap.jsonl") as file:
            sink = LineSink(file, Endpoint.parse(far), WallClock(), "test")
            tap = LineTap(Endpoint.parse(near), Endpoint.parse(far), sink, on_message=lambda text: ready.set())
            async with played(original, far):
                tapping = asyncio.ensure_future(tap.run(stop))
                try:
                    await eventually(lambda: ready.is_set() or tapping.done())
                    connection = await OsConnector().open_bytes(Endpoint.parse(near))
                    connection.on_arrival = lambda chunk: seen.__setitem__(
                        Direction.RECEIVED, seen[Direction.RECEIVED] + chunk
                    )
                    client = ModbusClient.at(Endpoint.parse(near), connection, WallClock())
                    for _ in range(5):
                        await client.execute(1, ReadRegisters("holding", 0x2100, 1))
                    await client.aclose()
                finally:
                    stop.set()
                    await tapping

    run(main())
    captured = list(read_capture(tmp_path / "t.tap.jsonl"))
    received = b"".join(c.item for c in captured if c.direction is Direction.RECEIVED and isinstance(c.item, bytes))
    assert received == seen[Direction.RECEIVED]
    assert all(a.t_ns <= b.t_ns for a, b in itertools.pairwise(captured))
    summary = import_capture(tmp_path / "t.tap.jsonl", tmp_path / "t.jsonl")
    assert (summary.records, summary.pairs.malformed, summary.pairs.strays, summary.pairs.unanswered) == (5, 0, 0, 0)
    wanted = [e.reply for e in exchanges_of(original) if e.request.hex() == "0321000001"][:5]
    found = [e.reply for e in exchanges_of(tmp_path / "t.jsonl")]
    assert found == [*wanted, *[wanted[-1]] * (5 - len(wanted))]


# -- CAN ------------------------------------------------------------------------------------------------------------------


def frames(path: Path) -> Frames:
    return ((t_ns, frame) for t_ns, _, frame in read_log(path))


def test_a_node_is_recorded_emulated_and_compared(tmp_path: Path) -> None:
    profile = load_profile(ROOT / "profiles" / "devices" / "encoder-cia406.yaml")
    track = SignalTrack.load(ROOT / "recordings" / "encoder-cia406.jsonl")
    logs = [tmp_path / "one.log", tmp_path / "two.log"]

    async def record(played: SignalPlayer | CanLog, out: Path) -> Comparison | None:
        clock = WallClock()
        server = await SoftBusServer.open(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), 1_000_000)
        try:
            node = emulated_node(profile, profile.form.factory.node, played, clock.monotonic_ns()).node
            async with Nursery() as nursery:
                nursery.start(serve_node(server.attach("encoder"), node, clock), "node")
                url = f"can:fieldtwin/127.0.0.1:{server.bound.path.rpartition(':')[2]}"
                target, counters = target_of(url, profile_name="encoder-cia406"), PollCounters()
                with RotatingFile(out) as file:
                    await record_node(
                        target,
                        CanLogSink(file, clock),
                        every_s=0.001,
                        counters=counters,
                        stop=asyncio.Event(),
                        rounds=2,
                    )
                return None
        finally:
            await server.aclose()

    run(record(SignalPlayer(track, WallClock().monotonic_ns()), logs[0]))
    run(record(CanLog(logs[0]), logs[1]))
    result = compare_logs(frames(logs[0]), frames(logs[1]), UNTIMED)
    assert result.compared >= 4
    assert (result.met, result.differences) == (True, [])


def test_a_bus_is_followed_frame_by_frame_and_nothing_is_sent(tmp_path: Path) -> None:
    """The log contains foreign frames on the bus, in order; the recorder's own role on the bus does not appear."""
    said = [CanFrame(0x185, bytes([n & 0xFF])) for n in range(300)] + [CanFrame(0x123456, b"x", extended=True)]

    async def main() -> int:
        clock, stop = WallClock(), asyncio.Event()
        server = await SoftBusServer.open(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), 1_000_000)
        try:
            talker, listener = server.attach("talker"), server.attach("listener")
            target = target_of(f"can:fieldtwin/127.0.0.1:{server.bound.path.rpartition(':')[2]}")
            with RotatingFile(tmp_path / "bus.log") as file:
                following = asyncio.create_task(follow_bus(target, CanLogSink(file, clock), stop=stop))
                await eventually(lambda: len(server.bus_stats()["nodes"]) == 3, what="the recorder is on the bus")
                for frame in said:
                    await talker.send(frame)
                await eventually(lambda: file.lines == len(said), what="all frames are in the log")
                stop.set()
                lost = await following
            heard = [await listener.recv() for _ in said]
            assert [(f.can_id, f.data) for f in heard] == [(f.can_id, f.data) for f in said]
            assert not listener.inbound.data_stream
            return lost
        finally:
            await server.aclose()

    assert run(main()) == 0
    logged = [frame for _, frame in frames(tmp_path / "bus.log")]
    assert [(f.can_id, f.extended, f.data) for f in logged] == [(f.can_id, f.extended, f.data) for f in said]


# -- long recordings and interruptions -----------------------------------------------------------------------------------


def test_a_killed_recorder_loses_the_last_record_at_most(tmp_path: Path) -> None:
    """Records are counted by their content; the recorder prints each number before it writes the record."""
    program = (
        "import sys; from pathlib import Path\n"
        "from fieldtwin.capture.recordings.rotating_file import RotatingFile\n"
        "from fieldtwin.gateway.core.files.recording import *\n"
        "head = encode_header(RecordingHeader(version=1, device='a/b', kind='exchanges', source='measured'))\n"
        "file = RotatingFile(Path(sys.argv[1]), head, max_bytes=20_000)\n"
        "for n in range(10**9):\n"
        "    exchange = RecordedExchange(n / 1000, 1, b'\\x03' + n.to_bytes(4, 'big'), b'\\x83\\x02')\n"
        "    file.line(n / 1000, encode_exchange(exchange))\n"
        "    sys.stdout.buffer.write(n.to_bytes(4, 'big')); sys.stdout.buffer.flush()\n"
    )
    out = tmp_path / "r.jsonl"
    process = subprocess.Popen([sys.executable, "-c", program, str(out)], stdout=subprocess.PIPE, cwd=ROOT)
    assert process.stdout is not None
    said = process.stdout.read(4 * 3000)
    os.kill(process.pid, signal.SIGKILL)
    said += process.stdout.read()
    process.stdout.close()
    process.wait()
    written = [int.from_bytes(e.request[1:]) for e in exchanges_of(out)]
    last = int.from_bytes(said[len(said) // 4 * 4 - 4 :][:4])
    assert written == list(range(len(written)))
    assert last <= written[-1] <= last + 1
    assert len(parts_of(out)) > 3


def test_parts_are_bounded_and_the_oldest_go(tmp_path: Path) -> None:
    out = tmp_path / "r.jsonl"
    head = encode_header(HEADER)
    lines = [encode_exchange(RecordedExchange(float(n), 1, b"\x11", b"\x91\x01")) for n in range(200)]
    with RotatingFile(out, head, max_bytes=1000, keep=3) as file:
        for n, line in enumerate(lines):
            file.line(float(n), line)
    assert len(parts_of(out)) == 3
    assert all(path.stat().st_size <= 1000 and path.read_bytes().startswith(head) for path in parts_of(out))
    times = [e.t_s for e in exchanges_of(out)]
    assert times == [float(n) for n in range(200 - len(times), 200)]
    part(out, 9999).touch()  # a recorder was killed after it created the next part and before it wrote to it
    assert [e.t_s for e in exchanges_of(out)] == times
    assert file.removed > 3
    with RotatingFile(tmp_path / "t.jsonl", head, max_s=10.0) as file:
        for n, line in enumerate(lines[:35]):
            file.line(float(n), line)
    assert len(file.parts) == 4


@pytest.mark.parametrize(
    ("wire", "recorded", "settings"),
    [
        ("rtu:/tmp/x", "rtu:/dev/ttyUSB0?baudrate=9600&frame=8N1", (9600, "8N1")),
        ("rtu:/tmp/x?baudrate=38400", "rtu:/dev/ttyUSB0?baudrate=9600&frame=8N1", (38400, "8N1")),
        ("rtu:/tmp/x", "tcp://10.0.0.1:502", (19200, "8E1")), ("rtu:/tmp/x", "", (19200, "8E1")),
        ("rtu:/tmp/x", "ascii:/dev/ttyUSB0?baudrate=9600", (19200, "8E1")),
    ],
)  # fmt: skip
def test_a_virtual_port_is_as_fast_as_the_recorded_one(wire: str, recorded: str, settings: tuple[int, str]) -> None:
    serial = as_it_was_recorded(Endpoint.parse(wire), recorded).serial
    assert (serial.baudrate, serial.frame) == settings
