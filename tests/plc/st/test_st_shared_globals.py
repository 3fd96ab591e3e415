"""VAR_GLOBAL is one set of variables for all programs of a file that one PLC runs (IEC 61131-3, 6.5.2.2 and 6.8.1).

Defect: each program had its own copy: A counted to 3 while B still saw 0, contrary to docs/reference/plc.md.
"""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

from st_bench import scan

from fieldtwin.gateway.core.image.image import INPUTS
from fieldtwin.plc.binding import image_for, load_program
from fieldtwin.plc.runtime.config import PlcConfig, ProgramConfig, TaskSpec
from fieldtwin.plc.runtime.runner import TaskRunner

MS = 1_000_000
TEXT = """
TYPE Point : STRUCT x, y : INT; END_STRUCT; END_TYPE
FUNCTION_BLOCK Stamp VAR_OUTPUT at : LTIME; END_VAR VAR inside : TON; END_VAR
  at := SCAN_TIME(); inside(IN := TRUE, PT := T#25ms); END_FUNCTION_BLOCK
VAR_GLOBAL n : INT; p : Point; a : ARRAY[1..3] OF INT; stamp : Stamp; END_VAR
PROGRAM a
VAR_EXTERNAL n : INT; END_VAR
VAR_OUTPUT mine : INT; END_VAR
  n := n + 1; p.x := n; a[2] := 10 * n; mine := n; stamp();
END_PROGRAM
PROGRAM b
VAR_OUTPUT seen, x, element : INT; at : LTIME; END_VAR
  seen := n; x := p.x; element := a[2]; at := stamp.at;
END_PROGRAM
"""


def plc(folder: Path, tasks: tuple[TaskSpec, ...], where: dict[str, str]) -> tuple[TaskRunner, list[int]]:
    (folder / "two.st").write_text(TEXT)
    programs = tuple(ProgramConfig(name, f"two.st:{name[0]}", task=task) for name, task in where.items())
    layout = image_for([p.bind((str(folder),)) for p in programs], {})
    memory = memoryview(bytearray(layout.size))
    layout.format(memory)
    image = layout.attach(memory)
    now = [0]
    image.writer(INPUTS).publish([], 0)
    config = PlcConfig("", layout.describe(), "", programs, python_path=(str(folder),), tasks=tasks)
    return TaskRunner(config, image, lambda: now[0]), now


def until(runner: TaskRunner, now: list[int], ms: int) -> dict[str, Any]:
    while runner.running and runner.deadline_ns <= ms * MS:
        now[0] = max(now[0], runner.deadline_ns)
        runner.run_once()
    return dict(runner.outputs.last())


def test_programs_of_one_file_share_its_global_variables(tmp_path: Path) -> None:
    runner, now = plc(tmp_path, (TaskSpec("main", 10),), {"a": "main", "b": "main"})
    runner.start()
    seen = until(runner, now, 30)
    assert (seen["a.mine"], seen["b.seen"], seen["b.x"], seen["b.element"]) == (3, 3, 3, 30)
    assert seen["b.at"] == 30 * MS


def test_programs_in_different_tasks_share_them_too(tmp_path: Path) -> None:
    tasks = (TaskSpec("fast", 10, 1), TaskSpec("slow", 40, 5))
    runner, now = plc(tmp_path, tasks, {"a": "fast", "b": "slow"})
    runner.start()
    seen = until(runner, now, 80)
    assert (seen["a.mine"], seen["b.seen"]) == (8, 8)


def test_a_program_that_runs_twice_has_the_same_globals(tmp_path: Path) -> None:
    runner, now = plc(tmp_path, (TaskSpec("main", 10),), {"a1": "main", "a2": "main", "b": "main"})
    runner.start()
    assert until(runner, now, 20)["b.seen"] == 4


def test_a_restart_begins_with_the_initial_values(tmp_path: Path) -> None:
    runner, now = plc(tmp_path, (TaskSpec("main", 10),), {"a": "main", "b": "main"})
    runner.start()
    until(runner, now, 30)
    runner.restart()
    seen = until(runner, now, 50)
    assert (seen["a.mine"], seen["b.seen"]) == (2, 2)


def test_two_plcs_in_one_process_have_separate_globals(tmp_path: Path) -> None:
    one, now = plc(tmp_path, (TaskSpec("main", 10),), {"a": "main", "b": "main"})
    other, then = plc(tmp_path, (TaskSpec("main", 10),), {"a": "main", "b": "main"})
    one.start()
    other.start()
    until(one, now, 50)
    assert until(other, then, 10)["b.seen"] == 1
    assert one.outputs.last()["b.seen"] == 5


def test_a_copy_of_a_program_has_separate_globals(tmp_path: Path) -> None:
    (tmp_path / "two.st").write_text(TEXT)
    together: dict[Any, Any] = {}
    a, b = (load_program(f"two.st:{name}", (str(tmp_path),), together) for name in "ab")
    scan(a, 1)  # type: ignore[arg-type]
    twin = copy.deepcopy(a)
    for number in range(2, 5):
        scan(twin, number)  # type: ignore[arg-type]
    scan(b, 2)  # type: ignore[arg-type]
    assert (twin.mine, a.mine, b.seen) == (4, 1, 1)  # type: ignore[attr-defined]
