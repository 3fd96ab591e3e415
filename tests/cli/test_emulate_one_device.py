"""One emulated Modbus device: data after the run indicator, any unit ID on TCP, and `emulate` with values and faults.

Defects: function 11h ended with the run indicator, a single device on TCP refused unit IDs except its own, 0 and 255, and
`fieldtwin emulate` of one device accepted neither faults nor values of registers.
"""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from test_cli import invoke as invoke_command

from fieldtwin.emulators.faults.frames import FrameDirection, Framing, understood
from fieldtwin.emulators.faults.on_link import wire_faults
from fieldtwin.emulators.faults.schema import parse_fault
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.emulators.stated import parts_of
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.profile_file import resolve
from fieldtwin.gateway.core.files.yaml_file import parse

METER = """
device: test/meter
source: "a test"
protocol: modbus
numbering: sent
server_id: "4D 54"
server_data: "01 02 03"
tags:
  power: {at: "holding:0", type: int16, scale: 0.1}
  energy: {at: "holding:1", type: uint32}
  mode: {at: "holding:3", values: {1: idle, 2: running}}
  name: {at: "holding:4", type: string, registers: 4}
  on: {at: "coil:0"}
  alarm: {at: "discrete:0"}
"""


def meter() -> DeviceProfile:
    return resolve(parse(METER, "meter.yaml"))


def test_function_11h_has_data_after_the_run_indicator() -> None:
    unit = ModbusUnit(MapBank([CellSpan("holding", 0, 1)]), **parts_of(meter()))
    assert unit.respond(b"\x11", 0) == bytes.fromhex("11 06 4D 54 FF 01 02 03")
    unit.running = False
    assert unit.respond(b"\x11", 0) == bytes.fromhex("11 06 4D 54 00 01 02 03")


def test_a_server_id_and_its_data_have_to_fit_one_reply() -> None:
    ModbusUnit(MapBank([]), server_id=b"a" * 200, server_data=b"b" * 49)
    with pytest.raises(UsageError):
        ModbusUnit(MapBank([]), server_id=b"a" * 200, server_data=b"b" * 50)


def test_one_device_answers_any_unit_id_on_tcp_and_echoes_it() -> None:
    unit = ModbusUnit(MapBank([CellSpan("holding", 0, 1)]))
    request = bytes.fromhex("0001 0000 0006 63 03 0000 0001")
    assert MbapServer({1: unit}).feed(request, 0) == [bytes.fromhex("0001 0000 0003 63 83 0A")]
    assert MbapServer({1: unit}, any_unit=True).feed(request, 0) == [bytes.fromhex("0001 0000 0005 63 03 02 0000")]
    with pytest.raises(UsageError):
        MbapServer({1: unit, 2: unit}, any_unit=True)


@pytest.mark.parametrize(
    ("count", "struck"), [(40, {40}), ("40", {40}), ("65..125", {65, 100, 125}), ("65..", {65, 100, 125})]
)
def test_a_fault_strikes_by_the_number_of_registers_that_the_request_reads(count: str | int, struck: set[int]) -> None:
    faults = wire_faults([{"name": "silence", "registers": count, "direction": "request"}], Framing.MBAP, 1, 0)
    for registers in (1, 39, 40, 41, 64, 65, 100, 125):
        request = bytes.fromhex("0001 0000 0006 01 03 0000") + registers.to_bytes(2)
        assert (faults.decide(understood(FrameDirection.REQUEST, Framing.MBAP, request), 0) is not None) == (
            registers in struck
        )


@pytest.mark.parametrize("count", [0, 2001, "5..4", "x", "..4", -1])
def test_a_count_that_no_request_can_have_is_refused(count: str | int) -> None:
    with pytest.raises(UsageError, match="count of registers"):
        parse_fault({"name": "silence", "registers": count})


invoke = invoke_command  # the fixture
ON = ("--on", "tcp://127.0.0.1:0")
Invoke = Callable[..., tuple[int, str, str]]

# -- the command --------------------------------------------------------------------------------------------------------


@contextmanager
def emulated(folder: Path, *options: str) -> Iterator[tuple[int, list[str]]]:
    """Run `fieldtwin emulate meter.yaml` on a port; the lines of its diagnostics are complete after the block."""
    (folder / "meter.yaml").write_text(METER)
    said: list[str] = []
    command = [sys.executable, "-m", "fieldtwin", "emulate", str(folder / "meter.yaml"), *options]
    with subprocess.Popen([*command, "--on", "tcp://127.0.0.1:0"], stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        port = 0
        try:
            for text in process.stderr:
                said.append(text)
                if "tcp://127.0.0.1:" in text:
                    port = int(text.rpartition(":")[2])
                    break
            assert port, said
            yield port, said
        finally:
            process.terminate()
            said += process.stderr
            process.wait()


def ask(port: int, pdu: str, unit: int = 1, within_s: float = 10.0) -> bytes:
    """Return the reply PDU; empty if none arrives."""
    request = bytes.fromhex(pdu)
    with socket.create_connection(("127.0.0.1", port), timeout=within_s) as client:
        client.sendall(b"\0\1\0\0" + (len(request) + 1).to_bytes(2) + bytes([unit]) + request)
        try:
            head = client.recv(7)
            return client.recv(int.from_bytes(head[4:6]) - 1)
        except TimeoutError:
            return b""


def test_emulate_gives_registers_their_values_and_answers_any_unit(tmp_path: Path) -> None:
    (tmp_path / "more.yaml").write_text("energy: 70000\nname: bench\n")
    options = ("--values", "power=-12.5", "--values", str(tmp_path / "more.yaml"), "--values", "mode=running")
    with emulated(tmp_path, *options, "--any-unit") as (port, _):
        assert ask(port, "03 0000 0004", unit=77) == bytes.fromhex("03 08 FF83 0001 1170 0002")
        assert ask(port, "03 0004 0004") == b"\x03\x08bench\0\0\0"


def test_emulate_takes_true_and_false_for_bits(tmp_path: Path) -> None:
    """Defect: only 1 and 0 were taken, although a scenario and `safe` take true and false."""
    (tmp_path / "bits.yaml").write_text("alarm: true\n")
    with emulated(tmp_path, "--values", "on=true", "--values", str(tmp_path / "bits.yaml")) as (port, _):
        assert ask(port, "01 0000 0001") == b"\x01\x01\x01"
        assert ask(port, "02 0000 0001") == b"\x02\x01\x01"


def test_emulate_injects_faults_and_reports_how_often_they_took_effect(tmp_path: Path) -> None:
    (tmp_path / "faults.yaml").write_text(
        "faults:\n"
        "  - {name: fewer-registers, by: 2, registers: 4}\n"
        "  - {name: exception, code: 6, register: mode}\n"
        "  - {name: set, register: power, value: 5}\n"
        "  - {name: silence, registers: '100..'}\n"
    )
    with emulated(tmp_path, "--values", "energy=1", "--faults", str(tmp_path / "faults.yaml")) as (port, said):
        assert ask(port, "03 0000 0004") == bytes.fromhex("03 04 0032 0000")
        assert ask(port, "03 0003 0001") == bytes.fromhex("83 06")
        assert ask(port, "03 0001 0002") == bytes.fromhex("03 04 0000 0001")
    told = "".join(said)
    assert "fewer-registers-1: took effect on 1 of 1 frames" in told
    assert "exception-2: took effect on 1 of 1 frames" in told
    assert "silence-4: took effect on 0 of 0 frames" in told


def test_a_fault_changes_the_values_of_a_device_that_replays_a_recording(tmp_path: Path) -> None:
    """Defect: value faults were refused for all devices without --values, also for those without a recording."""
    header = '{"fieldtwin_recording":1,"device":"test/meter","kind":"exchanges","source":"measured"}\n'
    exchange = '{"t":0.0,"unit":1,"req":"0300000001","rep":"03020032","lat":0.001}\n'
    (tmp_path / "meter.jsonl").write_text(header + exchange)
    (tmp_path / "faults.yaml").write_text("faults:\n  - {name: set, register: power, value: 7}\n")
    recording = ("--recording", str(tmp_path / "meter.jsonl"))
    with emulated(tmp_path, *recording) as (port, _):
        assert ask(port, "03 0000 0001") == bytes.fromhex("03 02 0032")
    with emulated(tmp_path, *recording, "--faults", str(tmp_path / "faults.yaml")) as (port, _):
        assert ask(port, "03 0000 0001") == bytes.fromhex("03 02 0046")


def test_a_value_fault_of_a_recording_alone_is_refused(invoke: Invoke, tmp_path: Path) -> None:
    recording = str(Path(__file__).parents[2] / "recordings" / "delta-vfd-e.jsonl")
    (tmp_path / "f.yaml").write_text("faults:\n  - {name: drift}\n")
    code, _, err = invoke("emulate", recording, "--faults", str(tmp_path / "f.yaml"), *ON)
    assert code == 3
    assert "a recording alone does not describe them" in err
    assert "f.yaml:2" in err


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        ("{name: lost-frame}", "CAN"),
        ("{name: silence, device: meter}", "only one device"),
        ("{name: silence, register: nothing}", "no register"),
        ("{name: silence, registers: 9..1}", "count of registers"),
    ],
)
def test_a_fault_that_one_device_cannot_have_is_refused_with_its_line(
    invoke: Invoke, tmp_path: Path, fault: str, told: str
) -> None:
    (tmp_path / "meter.yaml").write_text(METER)
    (tmp_path / "f.yaml").write_text(f"faults:\n  - {fault}\n")
    code, _, err = invoke("emulate", str(tmp_path / "meter.yaml"), "--faults", str(tmp_path / "f.yaml"), *ON)
    assert code == 3
    assert told in err
    assert "f.yaml:2" in err


@pytest.mark.parametrize("values", ["nothing=1", "mode=flying", "power=1e9", "power=nan", "missing.yaml"])
def test_values_that_the_device_cannot_hold_are_refused_in_one_line(
    invoke: Invoke, tmp_path: Path, values: str
) -> None:
    (tmp_path / "meter.yaml").write_text(METER)
    device = str(tmp_path / "meter.yaml")
    code, _, err = invoke("emulate", device, "--values", values, *ON)
    assert code in (2, 3), err
    assert len(err.strip().splitlines()) <= 2


@pytest.mark.parametrize("options", [("--values", "a=1"), ("--any-unit",)])
@pytest.mark.parametrize("what", ["observatory", "drive-cia402"])
def test_options_of_one_modbus_device_are_refused_for_others(
    invoke: Invoke, what: str, options: tuple[str, ...]
) -> None:
    code, _, err = invoke("emulate", what, *options, *(ON if what != "observatory" else ()))
    assert code == 2
    assert "Modbus device" in err
