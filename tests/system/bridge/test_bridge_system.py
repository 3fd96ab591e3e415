"""A prototype with `serve` and `bridge` sections: an HMI reads the gateway's values, and clients of the bridge reach the units
of the line while the gateway polls them."""

from __future__ import annotations

import re
import signal
import struct
from pathlib import Path

import pytest
from procs import CHECKOUT, Asking, fieldtwin, no_tracebacks, wait_for
from support import run

from fieldtwin.gateway.connections.sockets.tcp import TcpConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ModbusExceptionReply
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.wallclock import WallClock

SYSTEMS = CHECKOUT / "profiles" / "systems"
SECTIONS = """
serve:
  hmi:
    url: "tcp://127.0.0.1:1502"
    if_bad: nan
    tags:
      ctd.pressure: {input: 0, type: float32, quality: 2}
      ctd.sample_period_s: {holding: 0, quality: 1}
      inclinometer.slope_long: {input: 10, quality: 13}
bridge:
  door:
    url: "tcp://127.0.0.1:1503"
    units: {11: line1/1}
"""


def a_system(folder: Path) -> Path:
    folder.mkdir()
    text = (SYSTEMS / "observatory.yaml").read_text(encoding="utf-8")
    text = re.sub(r"(?m)^(serve|bridge):\n(?:[ \t].*\n|\n)*", "", text)
    (folder / "observatory.yaml").write_text(text + SECTIONS, encoding="utf-8")
    prototype = (SYSTEMS / "observatory.prototype.yaml").read_text(encoding="utf-8")
    (folder / "observatory.prototype.yaml").write_text(prototype, encoding="utf-8")
    return folder / "observatory.yaml"


@pytest.mark.long
def test_an_hmi_and_a_bridge_client_with_a_running_gateway(tmp_path: Path) -> None:
    system = a_system(tmp_path / "systems")
    with fieldtwin(tmp_path / "run", "run", str(system), "--prototype", "--instance", "s") as program:
        gateway = program.control("s", "gateway")
        wait_for(lambda: gateway("get")["serve"]["hmi"]["listening"], 15)
        wait_for(lambda: gateway("get")["tags"]["ctd.pressure"]["quality"] == "good", 20)
        run(ask(gateway), timeout_s=30)
        status = gateway("get")
        assert status["serve"]["hmi"]["counters"]["reads"] > 0
        assert status["bridge"]["door"]["counters"]["no_path"] == 1
        assert status["bridge"]["door"]["counters"]["refused"] == 1
        hmi = status["serve"]["hmi"]["listening"]
        assert not hmi.endswith(":1502")  # a prototype takes free ports
        wait_for(lambda: f"serve hmi  ←  {hmi}" in program.err, 5)
        assert status["buses"]["line1"]["counters"].get("timeouts", 0) == 0
        program.signal(signal.SIGINT)
        assert program.wait(10) == 0
    no_tracebacks(tmp_path / "run")


async def ask(gateway: Asking) -> None:
    status = gateway("get")
    clock = WallClock()
    hmi = ModbusClient(
        await TcpConnection.open(Endpoint.parse(status["serve"]["hmi"]["listening"])), clock, framing="mbap"
    )
    door = ModbusClient(
        await TcpConnection.open(Endpoint.parse(status["bridge"]["door"]["listening"])), clock, framing="mbap"
    )
    try:
        for _ in range(20):
            served = await hmi.read_registers(1, "input", 0, 3)
            bridged = await door.read_registers(11, "input", 0, 2)
            if served.raw[:4] == bridged.raw and served.registers[2] == 0:
                break
        else:
            raise AssertionError(f"the HMI reads {served.raw.hex()}, the device holds {bridged.raw.hex()}")
        pressure = struct.unpack(">f", served.raw[:4])[0]
        assert -10 < pressure < 12_000
        with pytest.raises(ModbusExceptionReply) as no_route:
            await door.read_registers(1, "input", 0, 2)
        assert no_route.value.code == 0x0A
        with pytest.raises(ModbusExceptionReply) as read_only:
            await door.write_register(11, 1, 5)
        assert read_only.value.code == 0x01
    finally:
        await hmi.aclose()
        await door.aclose()
