"""`fieldtwin new` as a process: questions on a terminal, interruptions, scans of emulated devices, real-time runs."""

from __future__ import annotations

import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import yaml

FIELDTWIN = [sys.executable, "-m", "fieldtwin"]
PATIENCE_S = 30.0
SUNSPEC = [
    word
    for value in ("sunspec=SunS", "manufacturer=Acme", "common_header=65602", "inverter_header=6750258")
    for word in ("--values", value)
]
"""The initial values by which the inverter identifies itself: the header, model 1 of 66 registers, model 103 of 50 registers."""
TANK = """\
device: mysite/tank
source: "page 7"
protocol: modbus
tags:
  level: {at: 30001, type: float32, unit: m}
"""


def environment(tmp_path: Path) -> dict[str, str]:
    return {**os.environ, "FIELDTWIN_RUN": str(tmp_path / "run"), "NO_COLOR": "1", "TERM": "dumb"}


class Terminal:
    """A process on a terminal."""

    def __init__(self, tmp_path: Path, *args: str) -> None:
        self._main, end = pty.openpty()
        self.process = subprocess.Popen(
            [*FIELDTWIN, *args], stdin=end, stdout=end, stderr=end, cwd=tmp_path, env=environment(tmp_path),
            start_new_session=True,
        )  # fmt: skip
        os.close(end)
        self.text = ""

    def expect(self, text: str) -> None:
        """Wait until the terminal shows `text` after what was expected before."""
        while text not in self.text:
            ready, _, _ = select.select([self._main], [], [], PATIENCE_S)
            assert ready, f"no {text!r} in {self.text!r}"
            try:
                self.text += os.read(self._main, 4096).decode("utf-8", "replace")
            except OSError as e:  # Linux reports a closed terminal like this
                raise AssertionError(f"ended without {text!r}: {self.text!r}") from e
        self.text = self.text.partition(text)[2]

    def answer(self, text: str) -> None:
        os.write(self._main, f"{text}\n".encode())

    def wait_until_it_waits(self) -> None:
        """Wait until the process sleeps in a system call: a signal just before it would be seen after the next key only."""
        status = Path(f"/proc/{self.process.pid}/stat")
        deadline = time.monotonic() + PATIENCE_S
        while status.read_text().rpartition(")")[2].split()[0] != "S":
            assert time.monotonic() < deadline
            time.sleep(0.01)

    def close(self) -> int:
        """Return the exit code. Output is read until the end, so that the process never waits for this reader."""
        while select.select([self._main], [], [], PATIENCE_S)[0]:
            try:
                os.read(self._main, 4096)
            except OSError:
                break
        try:
            return self.process.wait(PATIENCE_S)
        finally:
            self.process.kill()
            self.process.wait()
            os.close(self._main)


def test_questions_on_a_terminal(tmp_path: Path) -> None:
    terminal = Terminal(tmp_path, "new", "plant")
    terminal.expect("Device [example]: ")
    terminal.answer("eastron-sdm63")
    terminal.expect("did you mean 'eastron-sdm630'")
    terminal.expect("Device [example]: ")
    terminal.answer("meter=eastron-sdm630#5")
    terminal.expect("Next device (Enter: no more): ")
    terminal.answer("")
    terminal.expect("Control (python, st, none, own) [python]: ")
    terminal.answer("st")
    terminal.expect("CI (github, gitlab, none) [github]: ")
    terminal.answer("gitlab")
    terminal.expect("Compose file? [Y/n]: ")
    terminal.answer("n")
    terminal.expect("fieldtwin test")
    assert terminal.close() == 0
    files = {path.name for path in (tmp_path / "plant").iterdir()}
    assert {"plant.st", ".gitlab-ci.yml"} <= files
    assert not {"compose.yaml", "profiles", ".github"} & files
    assert yaml.safe_load((tmp_path / "plant" / "plant.yaml").read_text())["devices"]["meter"]["unit"] == 5


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("question", ["Device", "Control"])
def test_an_interruption_at_a_question_leaves_nothing(tmp_path: Path, question: str, number: signal.Signals) -> None:
    terminal = Terminal(tmp_path, "new", "plant", *(["--device", "example"] if question == "Control" else []))
    terminal.expect(f"{question} ")
    terminal.wait_until_it_waits()
    terminal.process.send_signal(number)
    assert terminal.close() == {signal.SIGINT: 130, signal.SIGTERM: 143}[number]
    assert not (tmp_path / "plant").exists()


def run(tmp_path: Path, *args: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*FIELDTWIN, *args], cwd=tmp_path, env=environment(tmp_path), stdin=subprocess.DEVNULL, capture_output=True,
        text=True, timeout=PATIENCE_S * 2, check=False,
    )  # fmt: skip


@contextmanager
def emulated(tmp_path: Path, what: str, *args: str) -> Iterator[str]:
    """Emulate a device on TCP, and return its endpoint."""
    process = subprocess.Popen(
        [*FIELDTWIN, "emulate", what, "--on", "tcp://127.0.0.1:0", *args], cwd=tmp_path, env=environment(tmp_path),
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        for line in process.stdout:
            if found := re.search(r"tcp://127\.0\.0\.1:\d+", line):
                yield found[0]
                break
        else:
            raise AssertionError("the emulator ended")
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=PATIENCE_S)


@pytest.mark.long
def test_a_scan_finds_a_device_that_identifies_itself(tmp_path: Path) -> None:
    with emulated(tmp_path, "sunspec-inverter-103", *SUNSPEC) as url:
        done = run(tmp_path, "new", "plant", "--scan", f"{url}#125-126")
    assert done.returncode == 0, done.stderr
    device = yaml.safe_load((tmp_path / "plant" / "plant.yaml").read_text())["devices"]["sunspec_inverter_103"]
    assert (device["profile"], device["unit"]) == ("sunspec-inverter-103", 126)
    assert run(tmp_path, "test", "plant").returncode == 0


@pytest.mark.long
@pytest.mark.timeout(120)
def test_a_scan_drafts_a_profile_for_an_unknown_device(tmp_path: Path) -> None:
    (tmp_path / "tank.yaml").write_text(TANK)
    with emulated(tmp_path, "./tank.yaml", "--values", "level=1.5") as url:
        done = run(tmp_path, "new", "plant", "--scan", f"{url}#1", "--control", "st")
    assert done.returncode == 0, done.stderr
    assert "profiles/unit_1.yaml is a draft" in done.stderr
    draft = yaml.safe_load((tmp_path / "plant" / "profiles" / "unit_1.yaml").read_text())
    assert draft["tags"]["input_0"]["at"] == "input:0"
    assert run(tmp_path, "check", "site", "plant").returncode == 0
    tested = run(tmp_path, "test", "plant")
    assert tested.returncode == 0, tested.stdout
    assert {path.name for path in tmp_path.iterdir()} <= {"plant", "tank.yaml", "run"}, "the dump was temporary"


@pytest.mark.long
def test_a_scan_that_finds_nothing_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "tank.yaml").write_text(TANK)
    with emulated(tmp_path, "./tank.yaml") as url:
        done = run(tmp_path, "new", "plant", "--scan", f"{url}#7")
    assert done.returncode == 4, done.stderr
    assert "found no device" in done.stderr
    assert not (tmp_path / "plant").exists()


@pytest.mark.long
@pytest.mark.parametrize("control", ["python", "st", "none", "own"])
def test_a_new_site_runs_in_real_time(tmp_path: Path, control: str) -> None:
    devices = ("tank=example", "inclinometer-cia410", "ctd-reference@tcp://192.0.2.7")
    chosen = [word for device in devices for word in ("--device", device)]
    assert run(tmp_path, "new", "My plant", *chosen, "--control", control).returncode == 0
    done = run(tmp_path, "run", "My plant/my_plant.yaml", "--prototype", "--for", "5s")
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines()[-1] == "ok"


@pytest.mark.long
def test_a_device_without_readable_registers_is_left_out_and_named(tmp_path: Path) -> None:
    (tmp_path / "far.yaml").write_text(TANK.replace("30001", "35001"))
    with emulated(tmp_path, "./far.yaml") as url:
        done = run(tmp_path, "new", "plant", "--scan", f"{url}#1", "--device", "example")
    assert done.returncode == 0, done.stderr
    assert "unit 1: no profile fits, and no draft is possible" in done.stderr
    assert list(yaml.safe_load((tmp_path / "plant" / "plant.yaml").read_text())["devices"]) == ["tank"]
