"""Variables of programs whose names are those of methods of the soft PLC's programs.

Defect: a variable of a PROGRAM could not have the name `check`, `execute`, `place`, `put`, `tag` and others.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from st_bench import program, scan

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.image.image import INPUTS
from fieldtwin.plc.binding import image_for
from fieldtwin.plc.runtime.config import PlcConfig, ProgramConfig, TaskSpec
from fieldtwin.plc.runtime.runner import TaskRunner
from fieldtwin.plc.st.compiler.pous.programs import METHODS

MS = 1_000_000
TEXT = """PROGRAM main
VAR_OUTPUT execute : INT; place : BOOL; END_VAR
VAR RETAIN retained, restore : INT; END_VAR
VAR check : BOOL := TRUE; put, tag : INT; resume : TON; internal : STRING; END_VAR
  IF check THEN execute := execute + 1; END_IF
  put := execute + 1; tag := put; retained := execute; resume(IN := check, PT := T#20ms); place := resume.Q;
END_PROGRAM
"""


def test_a_running_program_has_variables_with_the_names_of_methods(tmp_path: Path) -> None:
    (tmp_path / "main.st").write_text(TEXT)
    configured = ProgramConfig("main", "main.st", task="main")
    layout = image_for([configured.bind((str(tmp_path),))], {})
    memory = memoryview(bytearray(layout.size))
    layout.format(memory)
    image = layout.attach(memory)
    image.writer(INPUTS).publish([], 0)
    now = [0]
    config = PlcConfig(
        "", layout.describe(), "", (configured,), python_path=(str(tmp_path),), tasks=(TaskSpec("main", 10),)
    )
    runner = TaskRunner(config, image, lambda: now[0])
    runner.start()
    while runner.running and runner.deadline_ns <= 40 * MS:
        now[0] = max(now[0], runner.deadline_ns)
        runner.run_once()
    last = dict(runner.outputs.last())
    assert (last["main.execute"], last["main.place"]) == (4, True)


def test_each_name_of_a_method_is_a_name_of_a_variable() -> None:
    names = sorted(name for name in METHODS if not name.startswith("_"))
    assert {"check", "execute", "put"} <= set(names)
    body = " ".join(f"{name} := {name} + {k};" for k, name in enumerate(names))
    made = program(f"PROGRAM p VAR {', '.join(names)} : INT; END_VAR {body} END_PROGRAM")
    scan(made)
    assert [made.variable_reader(name).read() for name in names] == list(range(len(names)))  # type: ignore[union-attr]
    made.put("check", 70)
    made.check("check", 71)
    scan(made, 2)
    assert made.__dict__["check"] == 70 + names.index("check")
    assert made.retained() == {}
    assert [v.name for v in made.variables.values()] == names


def test_a_name_of_the_class_itself_is_refused() -> None:
    with pytest.raises(FileInvalid, match="a PROGRAM's variable needs another name than source_path"):
        program("PROGRAM p VAR source_path : INT; END_VAR END_PROGRAM")
