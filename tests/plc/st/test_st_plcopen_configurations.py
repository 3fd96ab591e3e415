"""Configurations of PLCopen XML files: tasks, programs and located global variables, as OpenPLC Editor and CODESYS write them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.program import load_source

PROJECT = """<?xml version='1.0' encoding='utf-8'?>
<project xmlns="http://www.plcopen.org/xml/tc6_0201" xmlns:xhtml="http://www.w3.org/1999/xhtml">
  <types><dataTypes/><pous>
    <pou name="blink" pouType="program">
      <interface>
        <externalVars><variable name="button"><type><BOOL/></type></variable></externalVars>
        <localVars><variable name="lamp" address="%QX0.0"><type><BOOL/></type></variable></localVars>
      </interface>
      <body><ST><xhtml:p>lamp := button AND %IX0.1;</xhtml:p></ST></body>
    </pou>
    <pou name="count" pouType="program">
      <interface><localVars><variable name="n"><type><INT/></type></variable></localVars></interface>
      <body><ST><xhtml:p>n := n + 1;</xhtml:p></ST></body>
    </pou>
  </pous></types>
  <instances><configurations>
    <configuration name="Config0">
      <resource name="Res0">
        <task name="task0" priority="0" interval="T#20ms"><pouInstance name="instance0" typeName="blink"/></task>
        <task name="edge" priority="7" single="button"><pouInstance name="instance1" typeName="count"/></task>
        <globalVars><variable name="button" address="%IX0.0"><type><BOOL/></type></variable></globalVars>
        <pouInstance name="other" typeName="count"/>
        <pouInstance name="unknown" typeName="not_in_this_file"/>
      </resource>
    </configuration>
  </configurations></instances>
</project>
"""


def tasks(folder: Path, text: str) -> dict[str, tuple[str, int, int, str] | None]:
    """Return the name, interval in ns, priority and trigger of the task of each program of the configuration."""
    (folder / "plc.xml").write_text(text)
    unit = load_source(folder / "plc.xml", "blink").st_unit
    return {
        one.name: one.task and (one.task.name, one.task.interval_ns, one.task.priority, one.task.single)
        for one in unit.instances
    }


def test_the_tasks_of_an_openplc_project(tmp_path: Path) -> None:
    assert tasks(tmp_path, PROJECT) == {
        "instance0": ("task0", 20_000_000, 0, ""),
        "instance1": ("edge", 0, 7, "button"),
        "other": None,
    }
    made: Any = load_source(tmp_path / "plc.xml", "instance0")
    assert {v.name: v.address for v in made.variables.values()} == {
        "lamp": "%QX0.0", "button": "%IX0.0", "IX0_1": "%IX0.1",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("interval", "expected"),
    [
        ("PT0.02S", 20_000_000),
        ("PT1M1.5S", 61_500_000_000),
        ("t#1s200ms", 1_200_000_000),
        ("TIME#0.5s", 500_000_000),
        ("cycle_time", None),
        ("20", None),
    ],
)
def test_the_forms_of_an_interval(tmp_path: Path, interval: str, expected: int | None) -> None:
    found = tasks(tmp_path, PROJECT.replace("T#20ms", interval))["instance0"]
    assert (found and found[1]) == expected


@pytest.mark.parametrize("name", ["my task", "9", "%IX0.0", ""])
def test_a_task_whose_name_is_no_name_is_left_out(tmp_path: Path, name: str) -> None:
    assert tasks(tmp_path, PROJECT.replace('"task0"', f'"{name}"'))["instance0"] is None


def test_a_word_of_the_language_may_be_the_name_of_a_task(tmp_path: Path) -> None:
    assert tasks(tmp_path, PROJECT.replace('"task0"', '"Task"'))["instance0"] == ("Task", 20_000_000, 0, "")


def test_errors_keep_their_lines(tmp_path: Path) -> None:
    (tmp_path / "plc.xml").write_text(PROJECT.replace("n := n + 1;", "n := m;"))
    with pytest.raises(FileInvalid, match=r"plc\.xml:13:\d+: a variable 'm' is not declared"):
        load_source(tmp_path / "plc.xml", "blink")


def test_a_file_in_one_line(tmp_path: Path) -> None:
    assert len(tasks(tmp_path, PROJECT.replace("\n", " "))) == 3
