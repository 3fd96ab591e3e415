"""A third-party program with the simulated field devices: it gets the ports, its exit status is ours, and no process remains."""

from __future__ import annotations

import os
import shutil
import signal
import sys
from pathlib import Path

import pytest
from procs import fieldtwin, no_tracebacks, run_to_end, wait_for

STRANGER = """
import os, sys
from pymodbus.client import ModbusTcpClient
from pymodbus.client import ModbusSerialClient
line = ModbusSerialClient(os.environ["FIELDTWIN_LINE1"], baudrate=int(os.environ["FIELDTWIN_LINE1_BAUDRATE"]))
unit = int(os.environ["FIELDTWIN_CTD_UNIT"])
assert line.connect()
line.write_registers(1, [7], device_id=unit)
period = line.read_holding_registers(1, device_id=unit).registers
line.close()
host, _, port = os.environ["FIELDTWIN_LAN"].partition(":")
modem = ModbusTcpClient(host, port=int(port))
assert modem.connect()
there = modem.read_holding_registers(100, device_id=int(os.environ["FIELDTWIN_MODEM_UNIT"]))
modem.close()
print(period, there.isError())
sys.exit(9)
"""


@pytest.mark.interop
def test_a_third_party_program_finds_every_port(tmp_path: Path) -> None:
    pytest.importorskip("pymodbus")
    ended = run_to_end(tmp_path, "with", "observatory", "--", sys.executable, "-c", STRANGER)
    assert ended.process.returncode == 9, ended.err
    assert ended.out == "[7] False\n"
    assert "FIELDTWIN_LINE1=" in ended.err
    assert "FIELDTWIN_LINE1_URL" not in ended.err
    assert not list(tmp_path.glob("with-*")), "the run directory is gone with the run"
    no_tracebacks(tmp_path)


@pytest.mark.interop
@pytest.mark.skipif(shutil.which("mbpoll") is None, reason="mbpoll is not installed")
def test_mbpoll_reads_the_sensor(tmp_path: Path) -> None:
    words = "mbpoll -m rtu -a 1 -b 19200 -P even -o 5 -t 4 -r 1 -1 $FIELDTWIN_LINE1"
    ended = run_to_end(tmp_path, "with", "--quiet", "observatory", "--", "sh", "-c", words)
    assert (ended.process.returncode, ended.err) == (0, "")
    assert "[1]:" in ended.out


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        (["observatory", "--", "no-such-program"], 2, "no such program"),
    ],
)
def test_an_impossible_start_is_reported_before_anything_runs(
    tmp_path: Path, words: list[str], code: int, told: str
) -> None:
    ended = run_to_end(tmp_path, "with", *words)
    assert ended.process.returncode == code
    assert told in ended.err
    assert not [path for path in tmp_path.iterdir() if path.is_dir()]


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.long)])
def test_a_signal_ends_the_program_first_and_then_the_field(tmp_path: Path, number: int) -> None:
    script = "trap 'echo told; exit 5' INT TERM; echo up; while :; do sleep 0.05; done"
    with fieldtwin(tmp_path, "with", "--instance", "w", "observatory", "--", "sh", "-c", script) as started:
        wait_for(lambda: "up" in started.out, 20, started.err)
        field = started.pid_of("w", "field")
        started.signal(number)
        assert started.wait(30) == 5
    assert "told" in started.out
    wait_for(lambda: not Path(f"/proc/{field}").exists(), 5, "the field simulator ended")


def test_a_field_that_dies_is_not_a_success(tmp_path: Path) -> None:
    script = "echo up; while [ ! -e gone ]; do sleep 0.05; done"
    with fieldtwin(tmp_path, "with", "--instance", "w", "observatory", "--", "sh", "-c", script) as started:
        wait_for(lambda: "up" in started.out, 20, started.err)
        field = started.pid_of("w", "field")
        os.kill(field, signal.SIGKILL)
        wait_for(lambda: " Z " in Path(f"/proc/{field}/stat").read_text(), 5, "the field simulator ended")
        (tmp_path / "gone").touch()
        assert started.wait(30) != 0
    assert "field" in started.err
