"""A site with one tank, which has a level and a valve, and a program that does nothing; the tests check it from outside."""

from __future__ import annotations

from pathlib import Path

FILES = {
    "shed.yaml": """fieldtwin: 1
system: shed
buses: {lan: {url: "tcp://tank:502", timeout_ms: 500}}
devices: {tank: {profile: tank.yaml, bus: lan, unit: 1, poll: {values: {every_ms: 100}}, writable: [valve]}}
plc: {programs: {idle: {source: idle.st, inputs: {level: {tag: tank.level, if_bad: hold}}}}}
""",
    "idle.st": """PROGRAM idle
  VAR_INPUT level : REAL; END_VAR
  VAR high : BOOL; END_VAR
  high := level > 100.0;
END_PROGRAM
""",
    "tank.yaml": """device: own/tank
source: "this test"
protocol: modbus
numbering: printed
defaults: {poll: values}
tags:
  level: {at: 30001, type: uint16, range: [0, 500]}
  valve: {at: 40001, type: uint16, access: rw, range: [0, 1]}
""",
    "shed.prototype.yaml": """prototype_of: shed.yaml
buses: {lan: {listen: "tcp://127.0.0.1:0"}}
devices: {tank: {model: profile, values: {level: 20}}}
""",
}


def write_shed(folder: Path) -> None:
    """Write the program, the profile, the system file and the prototype file."""
    for name, text in FILES.items():
        (folder / name).write_text(text)
