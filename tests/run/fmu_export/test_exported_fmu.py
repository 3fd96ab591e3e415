"""An exported FMU in a simulation tool: it equals `simulate`, its inputs drive the PLC, and its failures are statuses."""

from __future__ import annotations

import bisect
import json
import shutil
import zipfile
from pathlib import Path

import pytest
from fmpy import read_model_description
from fmpy.validation import validate_fmu
from fmu_rig import needs_gcc, tank_site
from fmu_tool import drive_site, export, in_tool

from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun

pytestmark = [pytest.mark.long, pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an FMU whose input is the level."""
    folder = tmp_path_factory.mktemp("exported")
    done = export(drive_site(folder / "site"), folder / "plc.fmu")
    assert done.exit_code == 0, done.output
    return folder / "plc.fmu"


@pytest.fixture
def tool(tmp_path: Path, exported: Path) -> Path:
    """Return a folder with ``plc.fmu``."""
    shutil.copy(exported, tmp_path)
    return tmp_path


@needs_gcc
@pytest.mark.parametrize("step_s", [0.1, 0.37, 12.5])
def test_fmu_without_set_inputs_equals_simulate_step_by_step(tmp_path: Path, step_s: float) -> None:
    system, ends_s = tank_site(tmp_path / "site"), 40.0003
    assert export(system, tmp_path / "plc.fmu", "--seed", "7").exit_code == 0
    names = ["sensor.level", "sensor.outflow", "pump.run", "fill.run"]
    code = f"""
one, rows, t = Instance(trace="fmu.jsonl"), [], 0.0
while t < {ends_s}:
    dt = min({step_s}, {ends_s} - t)
    one.step(t, dt)
    t += dt
    rows.append([t, *(one.get(n) if one.get(n + ".good") else None for n in {names})])
one.fmu.terminate()
result = rows
"""
    rows, messages = in_tool(tmp_path, code)

    run = VirtualRun(VirtualOptions(str(system), ends_s, seed=7, trace=tmp_path / "simulate.jsonl"))
    run.run()
    simulated = (tmp_path / "simulate.jsonl").read_bytes()
    assert run.trace.count > 1000
    assert (tmp_path / "fmu.jsonl").read_bytes() == simulated  # every byte on the bus at its ns
    assert f"seed 7, {run.trace.count} events, SHA-256 {run.trace.hexdigest()}: ok" in messages
    told = [json.loads(line) for line in simulated.splitlines()]
    for place, (name, kind) in enumerate(zip(names, ["tag", "tag", "tag", "state"], strict=True), 1):
        where = "pump.run" if name == "fill.run" else name
        events = [(t_ns, data["value"]) for t_ns, of, at, data in told if (of, at) == (kind, where)]
        times = [t_ns for t_ns, _ in events]
        expected = [
            events[i - 1][1] if (i := bisect.bisect_right(times, round(row[0] * 1e9))) else None for row in rows
        ]
        found = [row[place] for row in rows]
        first = next(i for i, value in enumerate(expected) if value is not None)
        assert found[first:] == expected[first:], name


def test_inputs_drive_the_plc(tool: Path) -> None:
    code = """
one, result = Instance(), []
for number, level in enumerate([1.5, 0.5, 1.5, 2.5]):
    one.set("set.sensor.level", level)
    one.step(2.0 * number, 2.0)
    result.append([one.get("sensor.level"), one.get("sensor.level.good"), one.get("fill.run"), one.get("pump.run")])
"""
    found, _ = in_tool(tool, code)
    assert found == [
        [1.5, True, False, False],
        [0.5, True, True, True],
        [1.5, True, True, True],
        [2.5, True, False, False],
    ]


def test_input_that_is_set_to_its_start_value_replaces_the_value_of_the_device(tmp_path: Path) -> None:
    system = drive_site(tmp_path / "site")
    prototype = system.with_name("tank.prototype.yaml")
    text = prototype.read_text().replace("sensor: {model: profile}", "sensor: {model: profile, values: {level: 3}}")
    prototype.write_text(text)
    assert export(system, tmp_path / "plc.fmu").exit_code == 0
    code = """
one, result = Instance(), []
one.step(0.0, 2.0)
result.append(one.get("sensor.level"))
one.set("set.sensor.level", 0.0)
one.step(2.0, 2.0)
result.append(one.get("sensor.level"))
"""
    assert in_tool(tmp_path, code)[0] == [3.0, 0.0]


def test_two_instances_in_one_tool_are_independent_and_end_with_it(tool: Path) -> None:
    code = """
a, b = Instance("a", seed=1), Instance("b", seed=2)
for number in range(20):
    a.set("set.sensor.level", 0.5)
    b.set("set.sensor.level", 3.0)
    a.step(number * 0.1, 0.1)
    b.step(number * 0.1, 0.1)
result = {"a": [a.get("sensor.level"), a.get("fill.run")], "b": [b.get("sensor.level"), b.get("fill.run")]}
result["running"] = len(children())
a.fmu.terminate()
a.fmu.freeInstance()
result["one left"] = len(children())
b.fmu.freeInstance()
result["none left"] = len(children())
"""
    found, messages = in_tool(tool, code)
    assert found == {"a": [0.5, True], "b": [3.0, False], "running": 2, "one left": 1, "none left": 0}
    assert "seed 1" in messages


def test_reset_begins_again_and_leaves_no_process(tool: Path) -> None:
    code = """
one = Instance()
one.set("set.sensor.level", 0.5)
one.step(0.0, 2.0)
first = [one.get("sensor.level"), len(children())]
one.fmu.reset()
after = [len(children())]
one.begin(100.0)
one.step(100.0, 2.0)
result = [first, after, [one.get("sensor.level"), len(children())]]
"""
    assert in_tool(tool, code)[0] == [[0.5, 1], [0], [0.0, 1]]


FAILURES = {
    'one.set("set.sensor.level", float("nan"))': "the value of set.sensor.level is nan, which is not a number",
    '(one.set("set.sensor.level", 1e300), one.step(0.0, 1.0))': "sensor.level cannot hold 1e+300; expected",
    "one.step(5.0, 1.0)": "a step of 1.0 s at 5.0 s is impossible: the last step ended at 0.0 s",
    "one.step(0.0, -1.0)": "a step of -1.0 s at 0.0 s is impossible",
    'one.set("sensor.level", 1.0)': "sensor.level is an output",
    "(os.kill(mine(), signal.SIGKILL), one.step(0.0, 1.0))": "has ended during the step to 1 s, exit code -9",
    "(os.kill(mine(), signal.SIGSTOP), one.step(0.0, 1.0))": "the step to 1 s took more than 2 s of real time (parameter",
}


def test_failure_is_a_status_with_a_message_and_ends_only_its_instance(tool: Path) -> None:
    code = f"""
other, result = Instance("other"), []
others = children()
def mine():
    [found] = set(children()) - set(others)
    return found
for number, work in enumerate({list(FAILURES)}):
    one = Instance("one", step_limit=2.0)
    status = one.refusal(lambda: eval(work))
    left = children() == others
    again = one.refusal(lambda: one.step(0.0, 1.0))
    other.step(float(number), 1.0)
    one.fmu.freeInstance()
    result.append([left, status, again])
other.fmu.terminate()
other.fmu.freeInstance()
"""
    found, messages = in_tool(tool, code)
    for (left, status, again), message in zip(found, FAILURES.values(), strict=True):
        assert left, message
        assert "failed with status 4 (fatal)" in status
        assert "failed with status 4 (fatal)" in again
        assert message in messages


@pytest.mark.parametrize(
    ("python", "message"),
    [
        ("/nowhere/python", "cannot be started: /nowhere/python"),
        ("/bin/false", "set FIELDTWIN_PYTHON to a Python that has"),
    ],
)
def test_missing_fieldtwin_is_a_status_with_a_message(tool: Path, python: str, message: str) -> None:
    code = """
result = []
for name in "abc":
    one = Instance(name, begin=False)
    result.append(one.refusal(one.begin))
    one.fmu.freeInstance()
"""
    found, messages = in_tool(tool, code, FIELDTWIN_PYTHON=python)
    assert found == ["fmi2ExitInitializationMode failed with status 4 (fatal)."] * 3
    assert message in messages


def test_description_is_valid_and_has_types_and_units(tool: Path) -> None:
    assert validate_fmu(str(tool / "plc.fmu")) == []
    said = read_model_description(str(tool / "plc.fmu"))
    found = {v.name: (v.type, v.causality, v.unit) for v in said.modelVariables}
    assert found["set.sensor.level"] == ("Real", "input", "m")
    assert found["sensor.level"] == ("Real", "output", "m")
    assert found["sensor.level.good"] == ("Boolean", "output", None)
    assert found["sensor.full"] == ("Boolean", "output", None)
    assert found["fill.run"] == ("Boolean", "output", None)
    assert found["seed"] == ("Integer", "parameter", None)
    with zipfile.ZipFile(tool / "plc.fmu") as archive:
        names = archive.namelist()
    assert [name for name in names if name.startswith("binaries/")] == ["binaries/linux64/fieldtwin_tank.so"]


def test_equal_files_give_an_equal_fmu(tmp_path: Path) -> None:
    system = drive_site(tmp_path / "site")
    for name in ("one.fmu", "two.fmu"):
        assert export(system, tmp_path / name).exit_code == 0
    assert (tmp_path / "one.fmu").read_bytes() == (tmp_path / "two.fmu").read_bytes()
