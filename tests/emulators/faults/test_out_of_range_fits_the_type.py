"""The fault `out-of-range` gives a value that the tag's type can carry and that its range excludes, or it is refused.

Defects: its value was 1e9 for every tag. A 16-bit register was limited to 32767, and a part of a register (`bits`)
wrapped, so the "value out of range" was inside the range. An explicit value without `register` was unchecked, also in
`emulate --faults`. Random value faults had a key that no value fault accepts.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.emulators.device_faults import DeviceFaults, check_device
from fieldtwin.emulators.faults.schema import load_faults, parse_fault
from fieldtwin.emulators.models.modbus.recorded_device import RecordedDevice
from fieldtwin.emulators.replay.replay import ExchangeReplay
from fieldtwin.emulators.stated import cells_of
from fieldtwin.gateway.core.connection import RS232Connection
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.files.recording import RecordedExchange
from fieldtwin.results.model import Verdict
from fieldtwin.run.targets.scenario_targets import ScenarioTarget, run_scenario
from fieldtwin.run.virtual.fault_schedule import RandomFaults, random_schedule
from fieldtwin.scenarios.language.form import load_scenario
from fieldtwin.twin.prototype.fault_aims import target
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.prototype.group import one_system

PROFILE = """device: fieldtwin/tank
source: "made for this test"
protocol: modbus
numbering: sent
tags:
  level:  {at: "holding:0", type: int16, scale: 0.1, unit: m, range: [-10, 100], poll: all}
  valve:  {at: "holding:1", bits: [4, 6], range: [0, 5], poll: all}
  full:   {at: "holding:2", type: uint16, sentinels: [65535, 65534], poll: all}
  weight: {at: "holding:3", type: float32, unit: kg, range: [0, 50], poll: all}
  mass:   {at: "holding:5", type: float32, range: [0, 2e9], poll: all}
  cold:   {at: "holding:7", type: int16, range: [-100, 32767], poll: all}
  step:   {at: "holding:8", bits: [0, 1], range: [0, 3], poll: all}
  count:  {at: "holding:9", type: bcd16, range: [0, 5000], poll: all}
  on:     {at: "holding:10", bits: [3, 3], poll: all}
"""
PLANT = """fieldtwin: 1
system: plant
buses:
  lan: {url: "tcp://192.0.2.1:502"}
devices:
  tank: {profile: tank.yaml, bus: lan, unit: 1, poll: {all: {every_ms: 100}}}
plc:
  cycle_ms: 100
  programs:
    pump: {source: pump.st, inputs: {level: {tag: tank.level}}}
"""
PROTOTYPE = """prototype_of: plant.yaml
buses:
  lan: {listen: "tcp://127.0.0.1:0"}
devices:
  tank: {model: profile, values: {level: 1}}
"""
LOGIC = """PROGRAM Pump
VAR_INPUT
  level : REAL;
END_VAR
VAR
  full : BOOL;
END_VAR
  full := level > 50.0;
END_PROGRAM
"""
EXPECTED = {
    "level": 3276.7, "valve": 7, "full": 65533, "weight": 1e9, "mass": 3.4028234663852886e38, "cold": -32768, "count": 9999,
}  # fmt: skip
NEVER = {"step": r"step cannot be out of its range 0 to 3.*0 to 3 \(uint16, bits 0 to 1\)", "on": "on is a bit"}


def scenario(folder: Path, steps: str) -> Path:
    (folder / "tank.yaml").write_text(PROFILE)
    (folder / "plant.yaml").write_text(PLANT)
    (folder / "plant.prototype.yaml").write_text(PROTOTYPE)
    (folder / "pump.st").write_text(LOGIC)
    path = folder / "x.scenario.yaml"
    path.write_text(f"scenario: a test\nsystem: plant.yaml\nsteps:\n{steps}")
    return path


@pytest.mark.parametrize("aimed", [True, False])
def test_the_default_is_outside_of_the_range_and_carried_by_the_type(tmp_path: Path, aimed: bool) -> None:
    steps = "  - pause: 1s\n"
    for name in EXPECTED if aimed else ("all",):
        at = f", register: {name}" if aimed else ""
        steps += f"  - fault: {{name: out-of-range, device: tank, id: {name}{at}}}\n"
    for name, value in EXPECTED.items():
        quality = "good" if name == "full" else "uncertain"  # it has no declared range
        steps += (
            f"  - expect: {{tag: tank.{name}, value: {value:.12e}, tolerance: {abs(value) * 1e-6:.3e}, within: 2s}}\n"
        )
        steps += f"  - expect: {{tag: tank.{name}, quality: {quality}}}\n"
    steps += "".join(f"  - expect: {{tag: tank.{name}, value: 0, quality: good}}\n" for name in NEVER)
    result = run_scenario(load_scenario(scenario(tmp_path, steps)), ScenarioTarget())
    assert result.verdict is Verdict.PASSED, result.checks[-1]


@pytest.mark.parametrize("tag", NEVER)
def test_a_tag_whose_type_carries_nothing_outside_of_its_range_is_refused(tmp_path: Path, tag: str) -> None:
    steps = f"  - fault: {{name: out-of-range, device: tank, register: {tag}}}\n  - pause: 1s\n"
    with pytest.raises(FileInvalid, match=NEVER[tag]) as refused:
        load_scenario(scenario(tmp_path, steps))
    assert "x.scenario.yaml:4" in str(refused.value)


EXPLICIT = [
    ("register: level, value: 4000", r"tank.level cannot hold 4000; expected -3276.8 to 3276.7 m \(int16\)"),
    ("register: valve, value: 9", r"tank.valve cannot hold 9; expected 0 to 7 \(uint16, bits 4 to 6\)"),
    ("register: count, value: -1", r"tank.count cannot hold -1; expected 0 to 9999 \(bcd16\)"),
    ("register: weight, value: 1.0e+39", r"tank.weight cannot hold 1e\+39; expected .* \(float32\)"),
    ("value: 4000", r"tank.level cannot hold 4000.*without it the fault affects every tag"),
]


@pytest.mark.parametrize("name", ["out-of-range", "set"])
@pytest.mark.parametrize(("said", "message"), EXPLICIT)
def test_an_explicit_value_that_does_not_fit_is_refused(tmp_path: Path, name: str, said: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message):
        load_scenario(scenario(tmp_path, f"  - fault: {{name: {name}, device: tank, {said}}}\n"))
    file = tmp_path / "faults.yaml"
    file.write_text(f"faults:\n  - {{name: {name}, {said}}}\n")
    profile = load_profile(tmp_path / "tank.yaml")
    with pytest.raises(FileInvalid, match=message.replace("tank.", "")) as refused:  # fieldtwin emulate --faults
        load_faults(file, lambda spec: check_device(spec, profile))
    assert "faults.yaml:2" in str(refused.value)
    with pytest.raises(UsageError):
        check_device(parse_fault({"name": "out-of-range", "register": "step"}), profile)


def test_a_value_too_large_for_bits_of_a_register_is_limited_and_does_not_wrap(tmp_path: Path) -> None:
    scenario(tmp_path, "")
    valve = load_profile(tmp_path / "tank.yaml").tags["valve"]
    assert [cells_of(valve, value) for value in (7, 8, 1e9, -1)] == [[0x70], [0x70], [0x70], [0]]


def test_random_value_faults_are_all_accepted(tmp_path: Path) -> None:
    system = load_scenario(scenario(tmp_path, "  - pause: 1s\n")).system
    wanted = RandomFaults(20.0, kinds=("out-of-range", "stuck", "nan"))
    group = one_system(system, load_prototype(system))
    chosen = [fault for seed in range(5) for fault in random_schedule(group, seed, 3600, wanted)]
    for fault in chosen:
        target(system, parse_fault(fault))  # raises if the value does not fit
    assert {fault["name"] for fault in chosen} == set(wanted.kinds)
    hit = {fault["register"] for fault in chosen if fault["name"] == "out-of-range"}
    assert hit == set(EXPECTED)


def test_a_fault_of_a_part_of_a_recorded_register_leaves_its_other_bits(tmp_path: Path) -> None:
    scenario(tmp_path, "")
    profile = load_profile(tmp_path / "tank.yaml")
    read = bytes.fromhex("03 0001 0001")
    replay = ExchangeReplay([RecordedExchange(0.0, 1, read, bytes.fromhex("03 02 8001"), 0.0)])
    device = RecordedDevice(profile, replay, 1, RS232Connection, {})
    said = ({"name": "out-of-range", "register": "valve"},)
    DeviceFaults(said, profile, 1, 0).on_values(device.distortions)
    assert device.respond(read, 0) == bytes.fromhex("03 02 8071")
