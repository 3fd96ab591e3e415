"""A small system for tests of the first writes: a temperature sensor, and a fan whose mode a program commands."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from fieldtwin.emulators.virtual.chance import seeded
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.emulators.virtual.seal import sealed
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.prototype.virtual import VirtualPrototype
from fieldtwin.twin.site.system import load_system

THERMOMETER = """
device: test/thermometer
source: "a test"
protocol: modbus
tags:
  temperature: {at: "holding:0", type: float32, poll: values, unit: degC}
"""
FAN = """
device: test/fan
source: "a test"
protocol: modbus
tags:
  mode:  {at: "holding:0", type: uint16, poll: status, access: rw}
  speed: {at: "holding:1", type: uint16, poll: status, access: rw}
  lamp:  {at: "holding:5", type: uint16, poll: status, access: wo}
"""
ST = """
PROGRAM Fan
VAR_INPUT temperature : REAL; END_VAR
VAR_OUTPUT mode : INT; END_VAR
  IF temperature > 10.0 THEN mode := 2; ELSE mode := 1; END_IF
END_PROGRAM
"""
PYTHON = """
from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.plc.program import Program, var_input, var_output

class Fan(Program):
    temperature = var_input(TagKind.REAL)
    mode = var_output(TagKind.INT, initial=1)

    def execute(self, scan):
        self.mode = 2 if (self.temperature or 0.0) > 10.0 else 1
"""
SYSTEM = """
fieldtwin: 1
system: hall
buses:
  lan: {url: "tcp://127.0.0.1:{port}"}
devices:
  sensor: {profile: thermometer.yaml, bus: lan, unit: 1, poll: {values: {every_ms: {every}}}}
  fan:
    profile: fan.yaml
    bus: lan
    unit: 2
    poll: {status: {every_ms: {every}}}
    writable: [{writable}]
    safe: {SAFE}
plc:
  programs:
    control:
      source: "{source}"
      inputs: {temperature: {tag: sensor.temperature, if_bad: {if_bad}}}
      outputs: {mode: fan.mode}
"""
PROTOTYPE = """
prototype_of: hall.yaml
buses:
  lan: {listen: "tcp://127.0.0.1:{port}"}
devices:
  sensor: {model: profile, values: {temperature: 21.6}}
  fan: {model: profile, values: {mode: {mode}, speed: 3}}
"""
SOURCES = {"st": "fan.st", "python": "python: hall_fan:Fan"}


def hall(
    folder: Path,
    *,
    port: int = 1502,
    language: str = "st",
    if_bad: str | float = "pass",
    mode: int = 2,
    every_ms: int = 500,
    writable: str = "mode",
    safe: str = "",
) -> Path:
    """Write the files; return the system file."""

    def fill(text: str, **values: object) -> str:
        for name, value in values.items():
            text = text.replace("{" + name + "}", str(value))
        return text

    (folder / "thermometer.yaml").write_text(THERMOMETER)
    (folder / "fan.yaml").write_text(FAN)
    (folder / "fan.st").write_text(ST)
    (folder / "hall_fan.py").write_text(PYTHON)
    values = {"port": port, "source": SOURCES[language], "if_bad": if_bad, "every": every_ms, "writable": writable}
    values["SAFE"] = "{" + safe + "}"
    (folder / "hall.yaml").write_text(fill(SYSTEM, safe=safe, **values))
    (folder / "hall.prototype.yaml").write_text(fill(PROTOTYPE, port=port, mode=mode))
    return folder / "hall.yaml"


def writes(folder: Path) -> list[tuple[str, Any, Any, str]]:
    """Return every write in the audit log: tag, old and new value, and its requester."""
    lines = [json.loads(line) for line in (folder / "audit.jsonl").read_text(encoding="utf-8").splitlines()]
    return [(e["tag"], e["old"], e["new"], e["by"]) for e in lines if (e["action"], e["result"]) == ("write", "asked")]


class VirtualHall:
    """Run the system in virtual time for so many seconds; `during` runs at the end, before anything is stopped."""

    def __init__(self, system: Path, run_dir: Path) -> None:
        self.system = load_system(str(system))
        self.prototype = load_prototype(self.system, system.with_name("hall.prototype.yaml"))
        self.run_dir = run_dir
        self.loop = VirtualLoop()

    def run(self, seconds: float, during: Any = None) -> None:
        async def main() -> None:
            async with VirtualPrototype(self.system, self.prototype, self.loop, self.run_dir) as run:
                await run.clock.sleep_until_ns(run.started_ns + round(seconds * 1e9))
                if during is not None:
                    await during(run)

        with seeded(1), sealed():
            self.loop.run_until_complete(main())
