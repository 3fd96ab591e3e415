"""Tasks of a CONFIGURATION (IEC 61131-3:2013, 6.8.2) are those of the PLC where the system file states no tasks and no cycle."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.image.image import INPUTS
from fieldtwin.gateway.core.values import NEVER
from fieldtwin.plc.runtime.config import PlcConfig, TaskSpec
from fieldtwin.plc.runtime.runner import TaskRunner
from fieldtwin.twin.plant.physical import image_layout, plc_config, program_warnings
from fieldtwin.twin.site.system import load_system

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "first-bug"
PROJECT = """PROGRAM Count
VAR n : INT; lamp AT %QX0.0 : BOOL; END_VAR
  n := n + 1; lamp := %IX0.0;
END_PROGRAM
PROGRAM Watch
VAR n : INT; END_VAR
  n := n + 1;
END_PROGRAM
CONFIGURATION Config0
  RESOURCE Res0 ON PLC
    TASK fast(INTERVAL := T#20ms, PRIORITY := 0);
    TASK slow(INTERVAL := T#100ms, PRIORITY := 40);
    TASK unused(INTERVAL := T#1ms, PRIORITY := 3);
    PROGRAM inst0 WITH fast : Count;
    PROGRAM inst1 WITH slow : Watch;
  END_RESOURCE
END_CONFIGURATION
"""
BOTH = "count: {source: project.st:Count}, watch: {source: project.st:Watch}"


def plc_of(folder: Path, text: str = PROJECT, programs: str = BOTH, keys: str = "") -> PlcConfig:
    """Return the configuration of the PLC of a system with these programs; `keys` are other keys of its section `plc`."""
    for name in ("level.yaml", "starter.yaml"):
        shutil.copy(EXAMPLE / name, folder)
    (folder / "project.st").write_text(text)
    system = (EXAMPLE / "tank.yaml").read_text()
    section = f"plc: {{{keys + ', ' if keys else ''}programs: {{{programs}}}}}\n"
    (folder / "tank.yaml").write_text(system[: system.index("plc:")] + section)
    return plc_config(load_system(str(folder / "tank.yaml")), folder)


def tasks_of(config: PlcConfig) -> tuple[tuple[TaskSpec, ...], dict[str, str]]:
    return config.tasks, {program.name: program.task for program in config.programs}


def test_the_tasks_of_the_programs_are_taken_from_the_configuration(tmp_path: Path) -> None:
    tasks, programs = tasks_of(plc_of(tmp_path))
    assert tasks == (TaskSpec("fast", 20, 0), TaskSpec("slow", 100, 40))
    assert programs == {"count": "fast", "watch": "slow"}


def test_each_task_has_its_own_cycle(tmp_path: Path) -> None:
    config = plc_of(tmp_path)
    layout = config.image_layout()
    memory = memoryview(bytearray(layout.size))
    layout.format(memory)
    image = layout.attach(memory)
    image.writer(INPUTS).publish([NEVER] * len(layout.regions[0].tags), 0)
    now = [0]
    runner = TaskRunner(config, image, lambda: now[0])
    runner.start()
    while runner.deadline_ns <= 1_000_000_000:
        now[0] = runner.deadline_ns
        runner.run_once()
    assert (runner.outputs.last()["count.n"], runner.outputs.last()["watch.n"]) == (50, 10)
    runner.close()


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ("cycle_ms: 50", ()),
        ("tasks: {all: {interval_ms: 40}}", (TaskSpec("all", 40, 10),)),
    ],
)
def test_tasks_or_a_cycle_in_the_system_file_have_precedence(
    tmp_path: Path, keys: str, expected: tuple[TaskSpec, ...]
) -> None:
    config = plc_of(tmp_path, keys=keys)
    assert (config.tasks, {program.task for program in config.programs}) == (expected, {""})
    assert config.cycle_ms == (expected[0].interval_ms if expected else 50)


def test_a_program_without_a_task_has_the_lowest_priority(tmp_path: Path) -> None:
    tasks, programs = tasks_of(plc_of(tmp_path, PROJECT.replace("inst1 WITH slow", "inst1")))
    assert tasks == (TaskSpec("fast", 20, 0), TaskSpec("main", 10, 0xFFFF))
    assert programs == {"count": "fast", "watch": "main"}


def test_the_system_file_may_choose_a_different_task(tmp_path: Path) -> None:
    programs = "count: {source: project.st:inst0}, watch: {source: project.st:inst1, task: fast}"
    assert tasks_of(plc_of(tmp_path, programs=programs))[1] == {"count": "fast", "watch": "fast"}


@pytest.mark.parametrize(
    ("single", "programs", "trigger"),
    [
        ("%QX0.0", BOTH, "count.lamp"),
        ("lamp", BOTH.replace("Count}", "Count, outputs: {lamp: pump.run}}"), "pump.run"),
        ("%IX0.0", BOTH.replace("Count}", "Count, inputs: {IX0_0: {tag: pump.run}}}"), "pump.run"),
    ],
)
def test_single_is_the_tag_of_a_located_variable(tmp_path: Path, single: str, programs: str, trigger: str) -> None:
    text = PROJECT.replace("slow(INTERVAL := T#100ms", f"slow(SINGLE := {single}")
    assert plc_of(tmp_path, text, programs).tasks[1] == TaskSpec("slow", 0, 40, trigger)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("INTERVAL := T#100ms", "INTERVAL := T#100us", "project.st:12.* no usable interval; expected INTERVAL of 1 to"),
        ("INTERVAL := T#100ms, PRIORITY", "PRIORITY", "no usable interval"),
        ("INTERVAL := T#100ms", "SINGLE := TRUE, INTERVAL := T#1s", "SINGLE and INTERVAL"),
        ("INTERVAL := T#100ms", "SINGLE := %IX0.0", "unknown trigger; .*has to be bound to a tag; got %IX0.0"),
    ],
)
def test_a_task_that_cannot_run_is_refused(tmp_path: Path, old: str, new: str, said: str) -> None:
    with pytest.raises(FileInvalid, match=said):
        plc_of(tmp_path, PROJECT.replace(old, new))


def test_an_error_in_the_source_is_found_when_it_is_compiled(tmp_path: Path) -> None:
    plc_of(tmp_path)
    (tmp_path / "project.st").write_text(PROJECT.replace("n + 1", "m + 1"))
    with pytest.raises(FileInvalid, match=r"project\.st:3:8: a variable 'm' is not declared"):
        image_layout(load_system(str(tmp_path / "tank.yaml")))


def test_an_unbound_input_with_an_address_is_a_warning(tmp_path: Path) -> None:
    plc_of(tmp_path)
    (warning,) = program_warnings(load_system(str(tmp_path / "tank.yaml")))
    assert warning == "input IX0_0 (%IX0.0) of program count is bound to no tag, so it keeps its initial value"
