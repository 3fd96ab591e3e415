"""pymodbus reads and writes the located variables of a running prototype at the registers of OpenPLC's documentation.

%QX0.0 to %QX99.7 are coils 0 to 799, %IX discrete inputs 0 to 799, %IW input registers, and holding registers are %QW (0 to
1023), %MW (1024 to 2047), %MD (2048 to 4095) and %ML (4096 to 8191).
"""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest
from procs import CHECKOUT, Fieldtwin, fieldtwin, wait_for
from pymodbus.client import ModbusTcpClient

PROJECT = """FUNCTION_BLOCK Gain
VAR_INPUT x : INT; END_VAR
VAR factor AT %M* : INT; y AT %Q* : INT; offset AT %I* : INT; END_VAR
  y := factor * x + offset;
END_FUNCTION_BLOCK
PROGRAM Main
VAR
  gain : Gain;
  lamp   AT %QX0.0  : BOOL;
  start  AT %QX99.7 : BOOL;
  spare  AT %IX2.3  : BOOL := TRUE;
  offset AT %IW7    : INT := -2;
  scans  AT %QW3    : UINT;
  limit  AT %MW1023 : INT(0..500) := 150;
  level  AT %MD0    : REAL;
  wanted AT %MD1    : DINT := -5;
  big    AT %ML1023 : ULINT := 16#FFFF_0000_0000_0001;
  twice  AT %MW1    : INT;
END_VAR
VAR_INPUT sensor : REAL; END_VAR
  level := sensor;
  lamp := start;
  scans := scans + 1;
  twice := 2 * limit;
  gain(x := 10);
END_PROGRAM
CONFIGURATION Config0
  RESOURCE Res0 ON PLC
    TASK fast(INTERVAL := T#20ms, PRIORITY := 0);
    PROGRAM inst WITH fast : Main;
  END_RESOURCE
  VAR_CONFIG
    inst.gain.factor AT %MW20 : INT := 3;
    inst.gain.y AT %QW20 : INT;
    inst.gain.offset AT %IW20 : INT := 1;
  END_VAR
END_CONFIGURATION
"""
PLC = """plc:
  programs:
    main: {source: project.st, inputs: {sensor: {tag: sensor.level, if_bad: hold}}, outputs: {lamp: pump.run}}
serve:
  hmi: {url: "tcp://127.0.0.1:1502", addresses: openplc, write: true}
"""
SLAVE_FAILURE, ILLEGAL_ADDRESS, ILLEGAL_VALUE = 4, 2, 3


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Fieldtwin, ModbusTcpClient]]:
    folder = tmp_path_factory.mktemp("st")
    for name in ("level.yaml", "starter.yaml", "tank.yaml", "tank.prototype.yaml"):
        shutil.copy(CHECKOUT / "examples" / "first-bug" / name, folder)
    (folder / "project.st").write_text(PROJECT)
    text = (folder / "tank.yaml").read_text()
    (folder / "tank.yaml").write_text(text[: text.index("plc:")] + PLC)
    runs = folder / "r"
    with fieldtwin(runs, "run", str(folder / "tank.yaml"), "--prototype", "--instance", "p", "--json") as run:
        gateway = run.control("p", "gateway")
        address = wait_for(lambda: gateway("get")["serve"]["hmi"]["listening"], 20, "a server")
        client = ModbusTcpClient("127.0.0.1", port=int(str(address).rpartition(":")[2]))
        assert client.connect()
        wait_for(lambda: not client.read_holding_registers(3, count=1).isError(), 20, "the PLC's first scan")
        yield run, client
        client.close()


def words(client: ModbusTcpClient, address: int, count: int) -> bytes:
    reply = client.read_holding_registers(address, count=count)
    assert not reply.isError(), reply
    return struct.pack(f">{count}H", *reply.registers)


@pytest.mark.long
def test_values_are_at_the_registers_of_openplc(running: tuple[Fieldtwin, ModbusTcpClient]) -> None:
    _, client = running
    assert client.read_discrete_inputs(16, count=8).bits == [False, False, False, True, False, False, False, False]
    assert client.read_input_registers(6, count=3).registers == [0, 0x10000 - 2, 0]
    assert words(client, 1024 + 1023, 1) == struct.pack(">h", 150)
    assert words(client, 2048 + 2, 2) == struct.pack(">i", -5)
    assert words(client, 8188, 4) == bytes.fromhex("FFFF 0000 0000 0001")
    wait_for(lambda: 0.5 < struct.unpack(">f", words(client, 2048, 2))[0] < 2.3, 20, "the level of the simulated tank")
    before = words(client, 3, 1)
    wait_for(lambda: words(client, 3, 1) != before, 5, "another scan")


@pytest.mark.long
def test_registers_without_a_variable_are_0_and_others_do_not_exist(running: tuple[Fieldtwin, ModbusTcpClient]) -> None:
    _, client = running
    assert len(client.read_coils(0, count=800).bits) == 800
    assert words(client, 1900, 100) == bytes(200)
    for refused in (
        client.read_coils(0, count=801),
        client.read_discrete_inputs(800, count=1),
        client.read_input_registers(1024, count=1),
        client.read_holding_registers(8192, count=1),
        client.read_holding_registers(2048, count=1),  # half of %MD0
        client.read_holding_registers(2051, count=2),  # half of %MD1
    ):
        assert refused.exception_code == ILLEGAL_ADDRESS


@pytest.mark.long
def test_a_write_takes_effect_in_the_next_scan(running: tuple[Fieldtwin, ModbusTcpClient]) -> None:
    run, client = running
    assert not client.write_coil(799, True).isError()
    assert client.read_coils(799, count=1).bits[0] is True
    assert client.read_coils(0, count=1).bits[0] is True  # the program copies start to lamp
    gateway = run.control("p", "gateway")
    wait_for(lambda: gateway("get")["tags"]["pump.run"]["value"] == 1, 10, "the device has the output")
    assert not client.write_register(1024 + 1023, 44).isError()
    assert struct.unpack(">h", words(client, 1025, 1)) == (88,)
    assert not client.write_registers(2050, list(struct.unpack(">2H", struct.pack(">i", -70_000)))).isError()
    assert struct.unpack(">i", words(client, 2050, 2)) == (-70_000,)
    assert not client.write_coils(792, [False] * 8).isError()
    assert client.read_coils(0, count=1).bits[0] is False


@pytest.mark.long
def test_an_output_that_the_program_assigns_keeps_the_programs_value(
    running: tuple[Fieldtwin, ModbusTcpClient],
) -> None:
    _, client = running
    assert not client.write_coils(792, [False] * 8).isError()
    assert not client.write_coil(0, True).isError()
    assert client.read_coils(0, count=1).bits[0] is False


@pytest.mark.long
def test_writes_that_fit_no_variable_are_refused(running: tuple[Fieldtwin, ModbusTcpClient]) -> None:
    _, client = running
    assert client.write_register(1024 + 1023, 501).exception_code == ILLEGAL_VALUE  # INT(0..500)
    assert client.write_register(2050, 1).exception_code == ILLEGAL_ADDRESS  # half of %MD1
    assert client.write_register(100, 1).exception_code == ILLEGAL_ADDRESS  # no variable at all
    assert client.write_coil(800, True).exception_code == ILLEGAL_ADDRESS


@pytest.mark.long
def test_writes_are_in_the_audit_log(running: tuple[Fieldtwin, ModbusTcpClient]) -> None:
    run, client = running
    assert not client.write_register(1024 + 1023, 45).isError()
    entries = [json.loads(line) for line in (run.root / "p" / "audit.jsonl").read_text().splitlines()]
    assert any((e["action"], e["device"], e.get("pdu")) == ("write", "hmi", "0607ff002d") for e in entries)


@pytest.mark.long
def test_a_paused_plc_takes_no_writes(running: tuple[Fieldtwin, ModbusTcpClient]) -> None:
    run, client = running
    plc = run.control("p", "plc")
    plc("pause", by="test")
    try:
        assert client.write_register(1024 + 1023, 46).exception_code == SLAVE_FAILURE
    finally:
        plc("go", by="test")
    wait_for(lambda: not client.write_register(1024 + 1023, 47).isError(), 5, "writes again")
    assert struct.unpack(">h", words(client, 2047, 1)) == (47,)


@pytest.mark.long
def test_the_variables_of_an_instance_have_the_registers_of_var_config(
    running: tuple[Fieldtwin, ModbusTcpClient],
) -> None:
    run, client = running
    assert client.read_input_registers(20, count=1).registers == [1]
    assert struct.unpack(">h", words(client, 20, 1)) == (31,)
    assert not client.write_register(1024 + 20, 5).isError()
    assert struct.unpack(">h", words(client, 20, 1)) == (51,)
    plc = run.control("p", "plc")
    assert [row["value"] for row in plc("image", tags=["main.gain.y", "main.gain.x"])["tags"]] == [51, 10]


@pytest.mark.long
def test_a_plc_without_field_devices_serves_its_variables(tmp_path: Path) -> None:
    (tmp_path / "main.st").write_text("PROGRAM Main VAR scans AT %QW3 : INT; END_VAR scans := scans + 1; END_PROGRAM")
    (tmp_path / "line.yaml").write_text(
        "fieldtwin: 1\nsystem: line\nplc:\n  programs:\n    main: {source: main.st}\n"
        'serve:\n  hmi: {url: "tcp://127.0.0.1:1502", addresses: openplc, write: true}\n'
    )
    with fieldtwin(
        tmp_path / "r", "run", str(tmp_path / "line.yaml"), "--prototype", "--instance", "p", "--json"
    ) as run:
        gateway = run.control("p", "gateway")
        address = wait_for(lambda: gateway("get")["serve"]["hmi"]["listening"], 20, "a server")
        client = ModbusTcpClient("127.0.0.1", port=int(str(address).rpartition(":")[2]))
        assert client.connect()
        wait_for(lambda: not client.read_holding_registers(3, count=1).isError(), 20, "the PLC's first scan")
        before = words(client, 3, 1)
        wait_for(lambda: words(client, 3, 1) != before, 5, "another scan")
        client.close()
