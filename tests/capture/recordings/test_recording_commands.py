"""The recording commands from the command line: a device is recorded, emulated and compared; output and exit codes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from fieldtwin.cli.recordings.compare_command import command as compare
from fieldtwin.cli.recordings.export_command import command as export
from fieldtwin.cli.recordings.record_command import command as record
from fieldtwin.gateway.core.errors import FileInvalid, NotAllowed, Unreachable, UsageError
from fieldtwin.gateway.core.files.recording import (
    RecordedExchange,
    RecordingHeader,
    RecordingReader,
    encode_exchange,
    encode_header,
)

ROOT = Path(__file__).parents[3]


@contextmanager
def emulated(*words: str) -> Iterator[None]:
    """Start `fieldtwin emulate` with these arguments; yields when it serves."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    emulate = [sys.executable, "-m", "fieldtwin", "emulate", *words]
    process = subprocess.Popen(emulate, stderr=subprocess.PIPE, cwd=ROOT, env=environment)
    assert process.stderr is not None
    try:
        while line := process.stderr.readline():
            if b" on " in line:
                break
        yield
    finally:
        process.send_signal(signal.SIGINT)
        process.stderr.read()
        process.stderr.close()
        assert process.wait() == 0


def called(command: Any, *words: object) -> tuple[int, dict[str, Any]]:
    """Return the exit code, and the output with --json."""
    done = CliRunner().invoke(command, [*map(str, words), "--json"], standalone_mode=False)
    if done.exception is not None:
        raise done.exception
    return done.return_value, json.loads(done.stdout.splitlines()[-1])


@pytest.mark.long
def test_a_device_is_recorded_emulated_and_compared(tmp_path: Path) -> None:
    device, twin, out = (
        f"rtu:{tmp_path}/dev?baudrate=115200",
        f"rtu:{tmp_path}/twin?baudrate=115200",
        tmp_path / "r.jsonl",
    )
    with emulated("delta-vfd-e", "--on", device):
        code, said = called(
            record, device, "--profile", "delta-vfd-e", "--rounds", 3, "--every", "10ms", "--emulated", "-o", out
        )
    assert (code, said["rounds"], said["exchanges"], said["unanswered"]) == (0, 3, 9, 0)
    with RecordingReader(out) as reader:
        header = reader.header
        assert (header.device, header.source, header.prototype) == ("delta/vfd-e", "measured", True)
        assert all(e.latency_s > 0 for e in reader.exchanges())
    with emulated(str(out), "--on", twin):
        code, said = called(compare, out, twin, "--profile", "delta-vfd-e", "--latency", "any")
    assert (code, said["met"], said["compared"], said["values"]) == (0, True, 9, 1.0)
    assert 0 < said["timing"] <= 1
    changed = tmp_path / "changed.jsonl"
    lines = out.read_bytes().splitlines(keepends=True)
    changed.write_bytes(b"".join([*lines[:-1], lines[-1].replace(b'"rep":"03', b'"rep":"83')]))
    code, said = called(compare, out, changed)
    assert (code, said["met"]) == (1, False)
    code, said = called(compare, out, changed, "--least", 80, "--latency", "any")
    assert (code, said["met"]) == (0, True)


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (("-o", "x.jsonl"), "the source of the recording is missing"),
        (("tcp://127.0.0.1:1", "-o", "x.jsonl"), "the requests are not defined"),
        (("--tap", "rtu:a", "can:socketcan/can0", "-o", "x.jsonl"), "only a byte stream can be tapped"),
        (("can:socketcan/can0", "--like", "w.jsonl", "-o", "x.log"), "--like is for Modbus"),
        (("tcp://127.0.0.1:1", "--like", "w.jsonl", "-o", "x.jsonl"), "has no requests that may be repeated"),
    ],
)  # fmt: skip
def test_unrecordable_items_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], error: str
) -> None:
    monkeypatch.chdir(tmp_path)
    _write(tmp_path / "w.jsonl", "0600010005")
    with pytest.raises(UsageError, match=error):
        called(record, *words)


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("site.pcapng", "has packets, not a recording .*fieldtwin import .*site.pcapng"),
        ("site.PCAP", "has packets, not a recording"),
        ("run.mcap", "is an MCAP file, which fieldtwin only writes; expected a recording"),
    ],
)
def test_an_export_of_a_packet_capture_names_the_import(tmp_path: Path, name: str, error: str) -> None:
    (tmp_path / name).write_bytes(b"\n\r\r\n")
    with pytest.raises(UsageError, match=error):
        called(export, tmp_path / name, tmp_path / "out.csv")


def _write(path: Path, *requests: str) -> Path:
    header = RecordingHeader(version=1, device="a/b", kind="exchanges", source="measured")
    lines = [encode_exchange(RecordedExchange(0.0, 1, bytes.fromhex(r), bytes.fromhex(r))) for r in requests]
    path.write_bytes(encode_header(header) + b"".join(lines))
    return path


def test_a_plant_is_not_written_to_by_the_way(tmp_path: Path) -> None:
    path, nobody = _write(tmp_path / "w.jsonl", "0600010005"), "tcp://127.0.0.1:1"
    with pytest.raises(NotAllowed, match="were not confirmed"):
        called(compare, path, nobody, "--writes")
    with pytest.raises(Unreachable):
        called(compare, path, nobody, "--writes", "--yes")
    restart = _write(tmp_path / "d.jsonl", "0800010000")
    with pytest.raises(NotAllowed, match="diagnostics"):
        called(compare, restart, nobody, "--writes", "--yes")


def test_a_dry_run_prints_the_frames_and_opens_nothing(tmp_path: Path) -> None:
    def printed(command: Any, *words: object) -> list[str]:
        done = CliRunner().invoke(command, list(map(str, words)), standalone_mode=False)
        assert done.return_value == 0, done.exception
        return done.stdout.split("\n")[:-1]

    path = _write(tmp_path / "r.jsonl", "0300010001", "0600010005", "0300010001")
    url, out = "tcp://127.0.0.1:1", tmp_path / "x.jsonl"
    asked, written = "00 01 00 00 00 06 01 03 00 01 00 01", "00 01 00 00 00 06 01 06 00 01 00 05"
    assert printed(record, url, "--like", path, "--dry-run", "-o", out) == [asked]
    assert printed(compare, path, url, "--dry-run") == [asked, asked]
    assert printed(compare, path, url, "--dry-run", "--writes", "--yes") == [asked, written, asked]
    assert printed(record, "rtu:/dev/nobody", "--profile", "delta-vfd-e", "--dry-run", "-o", out)[0].startswith(
        "01 03 20 00"
    )
    log = tmp_path / "bus.log"
    log.write_text(
        "(1.0) can0 605#4041600000000000\n(1.000001) can0 605#4041600000000000\n(1.000002) can0 585#4B41600050020000\n"
    )
    log.write_text(log.read_text().replace("(1.0)", "(1.000000)"))
    assert printed(compare, log, "can:fieldtwin/127.0.0.1:1", "--dry-run") == ["605#4041600000000000"] * 2
    assert not out.exists()


def test_invalid_tolerances_and_missing_files(tmp_path: Path) -> None:
    path = _write(tmp_path / "w.jsonl", "0300010001")
    for tolerance in ("x", "-1", "nan%", "1,5"):
        with pytest.raises(UsageError, match="tolerance"):
            called(compare, path, path, f"--tolerance={tolerance}")
    with pytest.raises(UsageError, match="several tolerances without a tag"):
        called(compare, path, path, "--tolerance=1", "--tolerance=2")
    with pytest.raises(FileInvalid, match="cannot read"):
        called(compare, path, tmp_path / "no.jsonl")
    with pytest.raises(UsageError, match="cannot export"):
        called(export, path, tmp_path / "x.xls")
    code, said = called(compare, path, path)
    assert (code, said["compared"], said["values"], said["timing"], said["differences"]) == (0, 1, 1.0, 1.0, [])


def test_compare_names_the_missing_profile_and_latencies_that_no_line_has(tmp_path: Path) -> None:
    """Two halves of a float were compared as registers, and a recording from a pseudo-terminal has latencies of 0."""
    for name, reply, latency_s in (("a", b"\x04\x04\x41\x20\0\0", 0.0), ("b", b"\x04\x04\x41\x21\0\0", 0.2)):
        header = RecordingHeader(version=1, device="acme/meter", kind="exchanges", source="measured")
        exchanges = [RecordedExchange(float(i), 1, b"\x04\0\0\0\x02", reply, latency_s) for i in range(3)]
        lines = [encode_header(header), *map(encode_exchange, exchanges)]
        (tmp_path / f"{name}.jsonl").write_bytes(b"".join(lines))
    words = [str(tmp_path / "a.jsonl"), str(tmp_path / "b.jsonl")]
    said = CliRunner().invoke(compare, words, standalone_mode=False).output
    assert "--profile with the profile of acme/meter compares its values" in said
    assert "(--latency any)" in said
    swapped = CliRunner().invoke(compare, [*reversed(words), "--tolerance", "1"], standalone_mode=False).output
    assert "--profile with" not in swapped
    assert "--latency any" not in swapped
