"""`fieldtwin reload` and SIGHUP replace programs of a running prototype between two scans; timers and counters continue.

The program measures itself: it counts its scans, and takes the time of its timer with SCAN_TIME().
"""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import Any

import pytest
from click.testing import CliRunner
from drive_station import SYSTEM
from drive_station import written as station_files
from procs import Fieldtwin, fieldtwin, run_to_end, wait_for

from fieldtwin.cli.main import cli
from fieldtwin.plc.st.compiler.compile import compile_text

pytestmark = pytest.mark.long

CYCLE_NS = 20_000_000
PRESET_NS = 12_000_000_000
BLOCKS = "".join(
    f"""FUNCTION_BLOCK Part{n}
VAR_INPUT x : REAL; END_VAR VAR_OUTPUT y : REAL; END_VAR VAR i : INT; values : ARRAY[0..9] OF REAL; END_VAR
FOR i := 0 TO 9 DO values[i] := values[i] * 0.5 + x; END_FOR;
IF x > 1.0 THEN y := values[3]; ELSIF x > 0.5 THEN y := values[4]; ELSE y := 0.0; END_IF;
CASE i OF 0: y := 1.0; 1, 2: y := 2.0; ELSE y := y + 1.0; END_CASE;
END_FUNCTION_BLOCK
"""
    for n in range(100)
)
"""Many blocks that are not executed, so that a compilation takes about as long as a hundred scans."""
PROGRAM = """\
PROGRAM pump
VAR_INPUT pressure : REAL; END_VAR
VAR_OUTPUT speed : REAL; go : INT; END_VAR
VAR n, version : INT; delay : TON; now, began, took : LTIME; END_VAR
n := n + 1; version := 1;
now := SCAN_TIME();
IF n = 1 THEN began := now; END_IF;
delay(IN := TRUE, PT := T#12s);
IF delay.Q AND took = T#0s THEN took := now - began; END_IF;
speed := SEL(G := delay.Q, IN0 := 20.0, IN1 := 40.0);
END_PROGRAM
"""
WATCHDOG = "  cycle_ms: 20\n  watchdog: {late_ms: 1000, stop_after: 100, restarts: 0}\n"


def status() -> Any:
    done = CliRunner().invoke(cli, ["plc", "status", "--json"], standalone_mode=False)
    assert done.exception is None, (done.exception, done.output)
    return json.loads(done.stdout)


def variables() -> dict[str, Any]:
    found: dict[str, Any] = status()["variables"]
    return found


@contextmanager
def station(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Fieldtwin]:
    monkeypatch.setenv("FIELDTWIN_RUN", str(folder))
    path = station_files(folder, BLOCKS + PROGRAM, system=SYSTEM.replace("  cycle_ms: 50\n", WATCHDOG))
    with fieldtwin(
        folder, "run", str(path), "--prototype", "--log", "json", "--instance", "p", "--json", "--for", "300s"
    ) as run:
        run.control("p", "plc")
        wait_for(lambda: variables()["pump.n"] or 0, 30, "the program runs")
        yield run


def write(folder: Path, *changes: tuple[str, str]) -> None:
    text = PROGRAM
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "pump.st").write_text(BLOCKS + text, encoding="utf-8")


@pytest.mark.timeout(240)
def test_a_timer_in_mid_run_continues_through_a_reload_and_no_scan_waits_for_the_compiler(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    began_s = perf_counter()
    compile_text(BLOCKS + PROGRAM, "pump.st")
    compiling_scans = (perf_counter() - began_s) * 1e9 / CYCLE_NS
    with station(tmp_path, monkeypatch) as run:
        before = variables()
        write(tmp_path, ("version := 1", "version := 2"), ("n, version", "added, n, version"))
        done = run_to_end(tmp_path, "reload", "p", name="reload")
        assert done.process.returncode == 0, done.err
        assert "plc.programs.pump: 9 variables keep their values; new: added" in done.out
        wait_for(lambda: variables()["pump.version"] == 2, 30, "the new version runs")
        after = variables()
        assert before["pump.took"] == after["pump.took"] == 0, "the timer is in mid-run"
        due = (after["pump.now"] - before["pump.now"]) / CYCLE_NS
        missed = due - (after["pump.n"] - before["pump.n"])
        assert missed < compiling_scans / 4, f"{missed} of {due} scans; compiling takes {compiling_scans} of them"

        wait_for(lambda: run.err.count('"reloaded"') == 1, 20, "an event")
        write(tmp_path, ("version := 1", "version := 3"))
        run.signal(signal.SIGHUP)
        wait_for(lambda: variables()["pump.version"] == 3, 60, "SIGHUP also replaces programs")
        wait_for(lambda: variables()["pump.took"], 60, "the timer ends")
        ended = variables()
        lateness_ns = status()["lateness_us"]["max"] * 1000
        assert PRESET_NS <= ended["pump.took"] <= PRESET_NS + CYCLE_NS + lateness_ns
        wait_for(lambda: variables()["pump.speed"] == 40.0, 20, "the output")
        wait_for(lambda: run.err.count('"reloaded"') == 2, 20, "a second event")
    noted = [json.loads(line) for line in (tmp_path / "p" / "audit.jsonl").read_text().splitlines()]
    changes = [entry for entry in noted if entry["action"] == "change"]
    assert [entry["by"].split()[0] for entry in changes] == ["reload", "SIGHUP"]
    assert changes[0]["programs"] == ["plc.programs.pump: 9 variables keep their values; new: added"]


@pytest.mark.timeout(240)
def test_a_reload_can_be_checked_refused_and_reversed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def reload(*args: str, expected: int = 0) -> str:
        done = run_to_end(tmp_path, "reload", "p", *args, name="reload")
        assert done.process.returncode == expected, (done.out, done.err)
        return done.out + done.err

    with station(tmp_path, monkeypatch):
        assert "no earlier version" in reload("--back", expected=2)
        assert "The files have not changed" in reload()
        write(tmp_path, ("version := 1", "version := nothing"))
        line = (BLOCKS + PROGRAM).splitlines().index("n := n + 1; version := 1;") + 1
        assert f"{tmp_path}/pump.st:{line}:24: a variable 'nothing' is not declared" in reload(expected=3)
        write(tmp_path, ("go : INT;", "went : INT;"))
        refused = reload(expected=1)
        assert "output go is removed, but the system file binds it to drive.run: keep it, or change" in refused
        assert "(needs a restart)" in refused
        assert "Nothing was changed" in refused
        write(tmp_path, ("version := 1", "version := 2"))
        assert "1 change, which can be applied at run time" in reload("--check")
        assert variables()["pump.version"] == 1
        system = tmp_path / "station.yaml"
        text = system.read_text()
        system.write_text(text.replace("tcp://drive:502", "tcp://drive:503"))
        assert "Nothing was changed: 1 of 2 changes needs a restart" in reload(expected=1)
        system.write_text(text.replace("every_ms: 100", "every_ms: 200"))
        assert "2 changes applied" in reload()
        wait_for(lambda: variables()["pump.version"] == 2, 30, "the new version runs")
        n = variables()["pump.n"]
        assert "removed" not in reload("--back")
        wait_for(lambda: variables()["pump.version"] == 1, 30, "the version before")
        assert variables()["pump.n"] > n
        assert "1 change applied" in reload()  # the file still has the new version
        wait_for(lambda: variables()["pump.version"] == 2, 30, "the new version again")
        assert status()["changes"]["count"] == 3
