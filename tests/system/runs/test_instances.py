"""Two prototypes of one system at once, one of them serving an imported cast; the same instance twice; Ctrl-C."""

from __future__ import annotations

import json
import signal
import sqlite3
import struct
import time
from bisect import bisect_right
from contextlib import closing
from pathlib import Path

import pytest
from procs import (
    Asking,
    Fieldtwin,
    command_from_far,
    every_device_online,
    fieldtwin,
    held_by,
    no_tracebacks,
    run_to_end,
    wait_for,
)

PROTOTYPE = ("run", "observatory", "--prototype", "--commands", "none", "--json")
ROWS = 2400
STEP_S = 0.25


def write_cast(path: Path) -> list[tuple[float, float, float]]:
    """A synthetic Sea-Bird cast; its rows (pressure dbar, temperature deg C, conductivity S/m), 4 a second."""
    rows = [(2 + 0.31 * i, round(19.5 - 0.0041 * i, 4), round(4.9 - 0.00033 * i, 6)) for i in range(ROWS)]
    lines = [
        "* Sea-Bird SBE 9 Data File:",
        "# nquan = 4",
        f"# nvalues = {ROWS}",
        "# units = specified",
        "# name 0 = prDM: Pressure, Digiquartz [db]",
        "# name 1 = t090C: Temperature [ITS-90, deg C]",
        "# name 2 = c0S/m: Conductivity [S/m]",
        "# name 3 = flag: flag",
        f"# interval = seconds: {STEP_S}",
        "# bad_flag = -9.990e-29",
        "*END*",
    ]
    lines += [f"{p:11.3f}{t:11.4f}{c:11.6f}  0.0000e+00" for p, t, c in rows]
    path.write_text("\r\n".join(lines) + "\r\n", encoding="latin-1")
    return [(round(p, 3), t, c) for p, t, c in rows]


def expected_at(rows: list[tuple[float, float, float]], time_ms: int) -> tuple[float, ...]:
    """Interpolate the cast between its rows at an instrument time, from the file's numbers alone."""
    t_s = time_ms / 1000
    before = min(bisect_right([i * STEP_S for i in range(len(rows))], t_s) - 1, len(rows) - 2)
    part = (t_s - before * STEP_S) / STEP_S
    return tuple(a + (b - a) * part for a, b in zip(rows[before], rows[before + 1], strict=True))


def samples(gateway: Asking) -> dict[int, dict[str, bytes]]:
    """Return every complete sample published as good, by its instrument time in ms. A sample is one transaction."""
    by_time: dict[int, dict[str, bytes]] = {}
    for _, tag, raw, t_ns, _ in gateway("published")["entries"]:
        if tag.startswith("ctd."):
            by_time.setdefault(t_ns, {})[tag.removeprefix("ctd.")] = bytes.fromhex(raw)
    whole = [s for s in by_time.values() if {"pressure", "temperature", "conductivity", "instrument_time"} <= set(s)]
    return {int.from_bytes(s["instrument_time"]): s for s in whole}


def make_active(run: Fieldtwin, instance: str) -> None:
    gateway, field = run.control(instance, "gateway"), run.control(instance, "field")
    every_device_online(gateway)
    command_from_far(field("get")["far"]["modem"], 1, 1)
    wait_for(lambda: held_by(field, "ctd", "sample_period_s")[-1] == "0001", 10, "the sensor samples")


@pytest.mark.long
def test_two_instances_an_imported_cast_and_an_interrupt(tmp_path: Path) -> None:
    rows = write_cast(tmp_path / "sta1.cnv")
    imported = run_to_end(tmp_path, "import", "sta1.cnv", "-o", "sta1.jsonl", "--json", name="import")
    assert imported.process.returncode == 0, imported.err
    assert imported.summary["rows"] == ROWS
    recording = ("--recording", f"ctd={tmp_path / 'sta1.jsonl'}", "--speed", "10")
    with (
        fieldtwin(tmp_path, *PROTOTYPE, *recording, "--instance", "one", name="one") as one,
        fieldtwin(tmp_path, *PROTOTYPE, "--instance", "two", name="two") as two,
    ):
        make_active(one, "one")
        make_active(two, "two")
        again = run_to_end(tmp_path, *PROTOTYPE, "--instance", "two", name="again")
        assert again.process.returncode == 4
        assert "the instance 'two' is running already" in again.err
        assert again.out == ""
        gateway = one.control("one", "gateway")
        wait_for(lambda: len(samples(gateway)) >= 4, 10, "samples of the cast")
        for time_ms, sample in samples(gateway).items():
            assert time_ms > 5000  # ten times as fast: one second of real time is ten of the cast
            for name, value in zip(
                ("pressure", "temperature", "conductivity"), expected_at(rows, time_ms), strict=True
            ):
                single = struct.unpack(">f", struct.pack(">f", value))[0]
                published = struct.unpack(">f", sample[name])[0]
                assert abs(published - single) <= abs(single) * 2**-23, (name, time_ms)

        held = two.control("two", "field")
        before = time.monotonic()
        two.signal(signal.SIGINT)  # while ACTIVE
        last = ""
        while two.process.poll() is None:  # the last values of the device, while the field simulator still runs
            try:
                last = held_by(held, "ctd", "sample_period_s")[-1]
            except OSError:
                break
        two.wait(4)
        assert time.monotonic() - before < 4
        assert last == "0000"
        assert two.summary["outputs_safe"] is True
        assert one.process.poll() is None  # the other one continues
        one.signal(signal.SIGINT)
        one.wait(4)
    for instance in ("one", "two"):
        entries = [json.loads(line) for line in (tmp_path / instance / "audit.jsonl").read_text().splitlines()]
        assert entries[-1]["result"] in ("done", "asked")
        with closing(sqlite3.connect(tmp_path / instance / "store.sqlite")) as db:
            assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    for run in (one, two):
        assert run.process.returncode == 0, run.err
        assert run.summary["errors"] == []
        assert run.summary["published"]["wrong"] == 0
    no_tracebacks(tmp_path)


@pytest.mark.long
def test_a_recording_that_was_cut_off_is_used_up_to_its_last_whole_row(tmp_path: Path) -> None:
    """A killed recorder leaves half a line; the lines before it are valid, and the emulated device replays them."""
    write_cast(tmp_path / "sta1.cnv")
    assert run_to_end(tmp_path, "import", "sta1.cnv", name="import").process.returncode == 0
    whole = (tmp_path / "sta1.jsonl").read_bytes()
    (tmp_path / "cut.jsonl").write_bytes(whole[: len(whole) // 2])
    with fieldtwin(tmp_path, "emulate", "ctd-reference", "--recording", str(tmp_path / "cut.jsonl"),
                   "--on", "tcp://127.0.0.1:0") as device:  # fmt: skip
        wait_for(lambda: "units 1 on tcp://127.0.0.1:" in device.err, 10, "it listens")
        device.signal(signal.SIGTERM)
        assert device.wait(4) == 0
    middle = whole.splitlines(keepends=True)
    broken = b"".join([*middle[:100], b'{"t": 1, "v"\n', *middle[100:]])
    (tmp_path / "broken.jsonl").write_bytes(broken)
    refused = run_to_end(tmp_path, *PROTOTYPE, "--recording", f"ctd={tmp_path / 'broken.jsonl'}", "--instance", "b")
    assert refused.process.returncode == 3, refused.err
    assert "broken.jsonl:101" in refused.err
    no_tracebacks(tmp_path)
