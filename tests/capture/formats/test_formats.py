"""Foreign files in and out: CSV, CAN logs of other programs, output of mbpoll, pcap that tshark opens; and damaged files."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import can
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fieldtwin.capture.formats.can_files import SUFFIXES, read_can_file
from fieldtwin.capture.formats.csv_table import import_csv
from fieldtwin.capture.formats.poll_text import read_polls
from fieldtwin.capture.recordings.exporting import export
from fieldtwin.capture.recordings.importing import import_can, import_polls, kind_of
from fieldtwin.capture.recordings.rotating_file import exchanges_of
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid, UsageError
from fieldtwin.gateway.core.files.candump import LeftOut, line_of, read_log
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.files.recording import (
    RecordedExchange,
    RecordingHeader,
    RecordingReader,
    encode_exchange,
    encode_header,
)

ROOT = Path(__file__).parents[3]
TSHARK = shutil.which("tshark")
HEADER = RecordingHeader(
    version=1, device="a/b", kind="exchanges", source="measured", start_utc="2026-03-01T12:00:00.000+00:00"
)
FRAMES = [
    CanFrame(0x585, bytes(range(8))), CanFrame(0x1ABCDEF0, b"\x07", extended=True), CanFrame(0x705, remote=True, dlc=1),
    CanFrame(0x80),
]  # fmt: skip


# -- CSV ------------------------------------------------------------------------------------------------------------------


def table(folder: Path, text: str, name: str = "t.csv") -> Path:
    path = folder / name
    path.write_bytes(text.encode())
    return path


def rows(path: Path) -> list[tuple[float, ...]]:
    with RecordingReader(path) as reader:
        return [(row.t_s, *row.values) for row in reader.rows()]


@pytest.mark.parametrize(
    ("text", "columns", "time"),
    [
        ("t,level (m),flow\n0,1.5,2\n0.5,2.5,3\n", {}, ""),
        ("time_s;flow;level [m]\n100;2;1,5\n100,5;3;2,5\n", {"level": "level", "flow": "flow"}, ""),
        ("clock (ms)\tx\ty\n0\t1.5\t2\n\n500\t2.5\t3\n", {"level": "x", "flow": "#3"}, "clock"),
        ("\ufefftimestamp,level,flow\n2026-03-01T12:00:00Z,1.5,2\n2026-03-01T12:00:00.500Z,2.5,3\n", {}, ""),
    ],
)
def test_tables_of_all_sorts_become_signals(tmp_path: Path, text: str, columns: dict[str, str], time: str) -> None:
    out = tmp_path / "r.jsonl"
    summary = import_csv(table(tmp_path, text), out, columns=columns, time=time)
    assert (summary.rows, summary.seconds, summary.bad_values) == (2, 0.5, 0)
    assert rows(out) == [(0.0, 1.5, 2.0), (0.5, 2.5, 3.0)]
    with RecordingReader(out) as reader:
        assert list(reader.header.signals) == ["level", "flow"]
        assert bool(reader.header.start_utc) == ("T12" in text)


def test_an_error_in_a_table_is_reported_with_its_line_and_leaves_no_file(tmp_path: Path) -> None:
    for text, line in (("t,x\n1,2\n0,3\n", 3), ("t,x\n1,2\nnoon,3\n", 3), ('t,x\n1,"2\n', 2), ("", 1), ("t,x\n", 2)):
        with pytest.raises(FileInvalid) as caught:
            import_csv(table(tmp_path, text), tmp_path / "r.jsonl", columns={})
        assert caught.value.line == line, text
    with pytest.raises(UsageError, match="--time"):
        import_csv(table(tmp_path, "a,b\n1,2\n"), tmp_path / "r.jsonl", columns={})
    with pytest.raises(UsageError, match="no column 'z'"):
        import_csv(table(tmp_path, "t,b\n1,2\n"), tmp_path / "r.jsonl", columns={"b": "z"})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["t.csv"]
    import_csv(table(tmp_path, "t,x\n1,2\n2,-\n"), tmp_path / "r.jsonl", columns={})
    assert rows(tmp_path / "r.jsonl")[0] == (0.0, 2.0)


# -- CAN ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_logs_that_python_can_writes_become_candump_logs(tmp_path: Path, suffix: str) -> None:
    """Except for losses of these formats: .trc has no length of remote frames."""
    path = tmp_path / f"bus{suffix}"
    with can.Logger(path) as log:
        for n, f in enumerate(FRAMES):
            log(can.Message(timestamp=1_700_000_000 + n / 100, arbitration_id=f.can_id, data=f.data, is_extended_id=f.extended,
                            is_remote_frame=f.remote, dlc=f.dlc, channel=0))  # fmt: skip
        log(can.Message(timestamp=1_700_000_001, arbitration_id=5, data=bytes(12), is_fd=True, channel=0))
    summary = import_can(path, tmp_path / "r.log")
    found = [f for _, _, f in read_log(tmp_path / "r.log")]
    wanted = FRAMES if suffix != ".trc" else [f for f in FRAMES if not f.remote]
    assert [f.key() for f in found if suffix != ".trc" or not f.remote] == [f.key() for f in wanted]
    assert summary.left_out.fd <= 1


def test_a_log_of_candump_with_all_that_kernels_add(tmp_path: Path) -> None:
    path = tmp_path / "bus.log"
    path.write_bytes(
        b"".join(line_of(n * 1000, f) for n, f in enumerate(FRAMES))
        + b"(1.000001) can0 20000004#0004000000000000\n(1.000002) vcan1 123##1aabb\n\n(1.000003) can0 123#AABB R\n(1.0000"
    )
    left = LeftOut()
    found = list(read_log(path, left))
    assert [f.key() for _, _, f in found] == [*(f.key() for f in FRAMES), CanFrame(0x123, b"\xaa\xbb").key()]
    assert (left.errors, left.fd, found[-1][0]) == (1, 1, 1_000_003_000)
    path.write_bytes(b"(1.000001) can0 123#AAB\n(1.000002) can0 123#\n")
    with pytest.raises(FileInvalid) as caught:
        list(read_log(path))
    assert caught.value.line == 1


# -- mbpoll ---------------------------------------------------------------------------------------------------------------

POLL = """mbpoll 1.0-0 - FieldTalk(tm) Modbus(R) Master Simulator

Protocol configuration: Modbus TCP
Slave configuration...: address = [7]
                        start reference = 8449, count = {count}
Communication.........: 127.0.0.1, port 15502, t/o 1.00 s, poll rate 500 ms
Data type.............: {kind}

-- Polling slave 7...
{values}
"""


@pytest.mark.parametrize(
    ("kind", "count", "printed", "request_hex", "reply_hex"),
    [
        ("16-bit register, output (holding) register table", 2, "[8449]: \t3500\n[8450]: \t65531 (-5)",
         "0321000002", "03040dacfffb"),
        ("16-bit register, input register table", 2, "[8449]: \t0x0DAC\n[8450]: \t0xFFFB", "0421000002", "04040dacfffb"),
        ("32-bit integer (little endian), output (holding) register table", 1, "[8449]: \t196608", "0321000002", "030400000003"),
        ("32-bit float (big endian), input register table", 1, "[8449]: \t1.5", "0421000002", "04043fc00000"),
        ("discrete output (coil)", 3, "[8449]: \t1\n[8450]: \t0\n[8451]: \t1", "0121000003", "010105"),
        ("16-bit register, input register table", 1, "Read input register failed: Illegal data address", "0421000001", "8402"),
        ("16-bit register, input register table", 1, "Read input register failed: Connection timed out", "0421000001", None),
    ],
)  # fmt: skip
def test_the_output_of_mbpoll_becomes_exchanges(
    kind: str, count: int, printed: str, request_hex: str, reply_hex: str | None
) -> None:
    text = POLL.format(kind=kind, count=count, values=f"{printed}\n-- Polling slave 7...\n{printed}")
    found = list(read_polls(text.splitlines()))
    wanted = bytes.fromhex(reply_hex) if reply_hex else None
    assert [(e.t_s, e.unit, e.request.hex(), e.reply) for e in found] == [
        (0.0, 7, request_hex, wanted), (0.5, 7, request_hex, wanted),
    ]  # fmt: skip


MODPOLL = """modpoll 3.10 - FieldTalk(tm) Modbus(R) Polling Utility
Protocol configuration: Modbus RTU
Slave configuration...: address = 1, start reference = 100, count = 2
Communication.........: COM1, 19200, 8, 1, even, t/o 1.00 s, poll rate 1000 ms
Data type.............: 16-bit register, input register table

-- Polling slave... (Ctrl-C to stop)
[100]: 7
[101]: -8
-- Polling slave... (Ctrl-C to stop)
Reply time-out!
-- Polling slave... (Ctrl-C to stop)
Illegal Data Address exception response!
"""


def test_the_output_of_modpoll_becomes_exchanges() -> None:
    request = bytes.fromhex("0400630002")
    assert [(e.t_s, e.request, e.reply) for e in read_polls(MODPOLL.splitlines())] == [
        (0.0, request, bytes.fromhex("04040007fff8")), (1.0, request, None), (2.0, request, b"\x84\x02"),
    ]  # fmt: skip


def test_a_poll_session_becomes_a_recording_with_a_draft(tmp_path: Path) -> None:
    text = POLL.format(kind="16-bit register, input register table", count=1, values="[8449]: 7")
    path = table(tmp_path, text, "poll.txt")
    assert kind_of(path) == "polls"
    summary = import_polls(path, tmp_path / "r.jsonl")
    assert list(load_profile(summary.profiles[0]).tags) == ["input_8448"]
    with pytest.raises(FileInvalid) as caught:
        import_polls(table(tmp_path, text.replace(": 7", ": seven"), "bad.txt"), tmp_path / "b.jsonl")
    assert caught.value.line
    assert not list(tmp_path.glob("b.*"))


# -- export -----------------------------------------------------------------------------------------------------------------


def recording(folder: Path) -> Path:
    exchanges = [
        RecordedExchange(0.0, 1, bytes.fromhex("0300000002"), bytes.fromhex("030400070008"), 0.012),
        RecordedExchange(1.0, 1, b"\x11", None, error="timeout"),
        RecordedExchange(2.0, 2, bytes.fromhex("0300000002"), b"\x83\x02", 0.01),
        RecordedExchange(3.0, 0, bytes.fromhex("0600010005"), b""),
    ]  # fmt: skip
    path = folder / "r.jsonl"
    path.write_bytes(encode_header(HEADER) + b"".join(map(encode_exchange, exchanges)))
    return path


def test_a_table_of_exchanges_and_of_tags(tmp_path: Path) -> None:
    path = recording(tmp_path)
    assert export(path, tmp_path / "r.csv") == 4
    assert (tmp_path / "r.csv").read_text().splitlines()[1:3] == [
        "0.0,1,ok,12.0,read holding registers,holding,0,2,7 8,0300000002,030400070008", "1.0,1,timeout,,report server id,,,,,11,",
    ]  # fmt: skip
    (tmp_path / "p.yaml").write_text(
        'device: a/b\nsource: ""\nprotocol: modbus\ntags:\n  x: {at: "holding:1", scale: 0.5, access: rw}\n'
    )
    export(path, tmp_path / "tags.csv", profile=load_profile(tmp_path / "p.yaml"))
    assert [line.split(",")[-1] for line in (tmp_path / "tags.csv").read_text().splitlines()] == [
        "x",
        "4.0",
        "",
        "",
        "",
    ]
    with pytest.raises(FileInvalid, match="exists already"):
        export(path, tmp_path / "r.csv")
    with pytest.raises(UsageError):
        export(path, tmp_path / "r.log")


def test_signals_come_back_from_csv_as_they_were(tmp_path: Path) -> None:
    source = ROOT / "recordings" / "incl.jsonl"
    export(source, tmp_path / "x.csv")
    import_csv(tmp_path / "x.csv", tmp_path / "x.jsonl", columns={})
    assert (tmp_path / "x.jsonl").read_bytes().splitlines()[1:] == source.read_bytes().splitlines()[1:]


def test_exchanges_are_exported_to_parquet(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    export(recording(tmp_path), tmp_path / "r.parquet")
    found = parquet.read_table(tmp_path / "r.parquet").to_pylist()
    assert [(r["t_s"], r["unit"], r["outcome"], r["address"], r["values"]) for r in found] == [
        (0.0, 1, "ok", 0, "7 8"), (1.0, 1, "timeout", None, ""), (2.0, 2, "exception 02", 0, ""), (3.0, 0, "ok", 1, "5"),
    ]  # fmt: skip


@pytest.mark.skipif(TSHARK is None, reason="tshark is not installed")
def test_tshark_opens_exported_files(tmp_path: Path) -> None:
    def tshark(path: Path, *fields: str) -> list[list[str]]:
        command = [str(TSHARK), "-r", str(path), "-T", "fields", "-E", "occurrence=a"]
        done = subprocess.run(
            [*command, *(w for f in fields for w in ("-e", f))], capture_output=True, text=True, check=True
        )
        return [line.split("\t") for line in done.stdout.splitlines()]

    export(recording(tmp_path), tmp_path / "r.pcap")
    said = [
        row
        for row in tshark(tmp_path / "r.pcap", "mbtcp.unit_id", "modbus.func_code", "modbus.exception_code")
        if row[0]
    ]
    assert said == [["1", "3", ""], ["1", "3", ""], ["1", "17", ""], ["2", "3", ""], ["2", "3", "2"], ["0", "6", ""]]
    log = tmp_path / "bus.log"
    log.write_bytes(b"".join(line_of(10**9 + n * 1000, f) for n, f in enumerate(FRAMES)))
    export(log, tmp_path / "bus.pcap")
    ids = [int(row[0], 0) for row in tshark(tmp_path / "bus.pcap", "can.id")]
    assert ids == [f.can_id for f in FRAMES]


# -- damage -----------------------------------------------------------------------------------------------------------------


def made(folder: Path, kind: str) -> bytes:
    """Return a valid file of that kind."""
    if kind in (".asc", ".blf", ".trc"):
        path = folder / f"good{kind}"
        if not path.exists():
            with can.Logger(path) as log:
                for n in range(20):
                    log(
                        can.Message(
                            timestamp=1_700_000_000 + n,
                            arbitration_id=n,
                            data=bytes(n % 9),
                            is_extended_id=False,
                            channel=0,
                        )
                    )
        return path.read_bytes()
    if kind == ".log":
        return b"".join(line_of(n, f) for n, f in enumerate(FRAMES * 4))
    if kind == ".csv":
        return b"t,a (m),b\n" + b"".join(b"%d,1.5,2\n" % n for n in range(20))
    if kind == ".txt":
        return POLL.format(
            kind="16-bit register, input register table", count=2, values="[8449]: 1\n[8450]: 2"
        ).encode()
    return recording(folder).read_bytes()


@pytest.mark.parametrize("kind", [".asc", ".blf", ".trc", ".log", ".csv", ".txt", ".jsonl"])
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(data=st.data())
def test_a_damaged_file_is_a_clear_error_or_is_read(tmp_path: Path, kind: str, data: st.DataObject) -> None:
    whole = bytearray(made(tmp_path, kind))
    for _ in range(data.draw(st.integers(1, 5))):
        at, what = (
            data.draw(st.integers(0, max(len(whole) - 1, 0))),
            data.draw(st.sampled_from(["set", "cut", "insert"])),
        )
        if what == "set" and whole:
            whole[at] = data.draw(st.integers(0, 255))
        elif what == "cut":
            del whole[at : at + data.draw(st.integers(1, 40))]
        else:
            whole[at:at] = data.draw(st.binary(max_size=20))
    path = tmp_path / f"damaged{kind}"
    path.write_bytes(whole)
    out = tmp_path / "out"
    out.unlink(missing_ok=True)
    try:
        if kind in SUFFIXES:
            assert len(list(read_can_file(path, LeftOut()))) <= 200
        elif kind == ".log":
            list(read_log(path))
        elif kind == ".csv":
            import_csv(path, out, columns={})
        elif kind == ".txt":
            list(read_polls(path.read_text("utf-8", "replace").splitlines(), str(path)))
        else:
            list(exchanges_of(path))
    except FieldtwinError as e:
        assert isinstance(e, FileInvalid | UsageError)  # noqa: PT017
        assert str(path) in str(e) or isinstance(e, UsageError)  # noqa: PT017


def test_packed_blocks_and_lines_without_an_end_take_no_memory(tmp_path: Path) -> None:
    import struct
    import zlib

    bomb = zlib.compress(bytes(40_000_000))
    head = b"LOGG" + struct.pack("<I", 144) + bytes(136)
    body = b"LOBJ" + struct.pack("<HHIIHHIII", 16, 1, 32 + len(bomb), 10, 2, 0, 0, 40_000_000, 0) + bomb
    (tmp_path / "bomb.blf").write_bytes(head + body)
    with pytest.raises(FileInvalid, match="too large"):
        list(read_can_file(tmp_path / "bomb.blf", LeftOut()))
    for suffix in (".asc", ".trc"):
        (tmp_path / f"long{suffix}").write_bytes(b"x" * 100_000)
        with pytest.raises(FileInvalid, match="too long"):
            list(read_can_file(tmp_path / f"long{suffix}", LeftOut()))


def test_the_summary_of_an_import_as_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from click.testing import CliRunner

    from fieldtwin.cli.recordings.import_command import command

    path = table(tmp_path, "t,a\n0,1\n1,2\n")
    result = CliRunner().invoke(command, [str(path), "-o", str(tmp_path / "r.jsonl"), "--json"], standalone_mode=False)
    assert json.loads(result.output)["rows"] == 2
    for wrong in (["--time", "t"], ["--column", "a=b"]):
        other = CliRunner().invoke(command, [str(recording(tmp_path)), *wrong], standalone_mode=False)
        assert isinstance(other.exception, UsageError)
