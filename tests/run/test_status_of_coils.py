"""A live run reads the status of a gateway with coils as outputs, whose values are booleans, and with named values of a float."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from fieldtwin.run.live.options import RunOptions
from fieldtwin.run.live.session import RunSession

FILES = {
    "shed.yaml": """fieldtwin: 1
system: shed
buses: {lan: {url: "tcp://lamp:502", timeout_ms: 500}}
devices: {lamp: {profile: lamp.yaml, bus: lan, unit: 1, writable: [on], poll: {values: {every_ms: 100}}}}
plc:
  cycle_ms: 10
  programs: {light: {source: light.st, outputs: {on: lamp.on}}}
""",
    "shed.prototype.yaml": """prototype_of: shed.yaml
buses: {lan: {listen: "tcp://127.0.0.1:0"}}
devices: {lamp: {model: profile, values: {mode: 2}}}
""",
    "lamp.yaml": """device: own/lamp
source: "this test"
protocol: modbus
numbering: printed
defaults: {poll: values}
tags:
  on: {at: "coil:0", type: bool, access: rw}
  mode: {at: "holding:0", type: float32, values: {2: AUTO}}
""",
    "light.st": "PROGRAM light VAR_OUTPUT on : BOOL; END_VAR on := TRUE; END_PROGRAM\n",
}


@pytest.mark.long
def test_a_coil_that_a_program_commands_and_a_named_value_are_in_the_status(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FIELDTWIN_RUN", str(tmp_path / "r"))
    for name, text in FILES.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    session = RunSession(RunOptions(system=str(tmp_path / "shed.yaml"), prototype=True, duration_s=2.0))

    async def run() -> None:
        async with session:
            await session.wait()

    asyncio.run(run())
    assert session.summary()["errors"] == []
    assert session.gateway_status is not None
    assert [(o.tag, o.wanted, o.held) for o in session.gateway_status.outputs] == [("lamp.on", True, True)]
    assert session.gateway_status.tags["lamp.mode"].text == "AUTO"
