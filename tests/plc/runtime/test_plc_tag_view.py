"""The process image as shown to users: value, quality, source time, age, unit, limits, force, and the programs' values."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from fieldtwin.gateway.core.errors import Unreachable, UsageError
from fieldtwin.gateway.core.image.image import INPUTS, TagKind, TagSpec
from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.gateway.runtime.plc_variables import writes_tag
from fieldtwin.plc.binding import BoundProgram, InputBinding, image_for
from fieldtwin.plc.runtime.about import describe_programs
from fieldtwin.plc.runtime.acts import Acts
from fieldtwin.plc.runtime.config import PlcConfig, ProgramConfig
from fieldtwin.plc.runtime.runner import TaskRunner
from fieldtwin.plc.runtime.tag_view import TagView, matches
from fieldtwin.plc.st.program import WRITES
from fieldtwin.plc.states import ANY, StateMachine, StateTable, Transition

MS = 1_000_000
UTC_NS = 1_700_000_000_000_000_000
PLANT = {
    "tank.level": TagSpec("tank.level", TagKind.REAL, "m", limits=(0.0, 4.0)),
    "pump.speed": TagSpec("pump.speed", TagKind.INT, "rpm", limits=(0, 1500)),
}
MODULE = """
from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.plc.program import Program, var_input, var_local, var_output

class Pump(Program):
    level = var_input(TagKind.REAL)
    speed = var_output(TagKind.INT, initial=0)
    load = var_local(TagKind.REAL, unit="%", limits=(0, 100))

    def execute(self, scan):
        self.speed = 900
"""


class Rig:
    def __init__(self, folder: Path, if_bad: str | float = "pass") -> None:
        module = f"view_{folder.name}".replace("-", "_")
        (folder / f"{module}.py").write_text(MODULE)
        program = ProgramConfig(
            "pump", f"python: {module}:Pump", {"level": InputBinding("tank.level", if_bad)}, {"speed": "pump.speed"}
        )
        layout = image_for([program.bind((str(folder),))], PLANT)
        memory = memoryview(bytearray(layout.size))
        layout.format(memory)
        self.image = layout.attach(memory)
        self.writer = self.image.writer(INPUTS)
        self.now_ns = 0
        config = PlcConfig("", layout.describe(), "", (program,), python_path=(str(folder),))
        self.runner = TaskRunner(config, self.image, lambda: self.now_ns)
        self.view = TagView(self.image, self.runner)
        self.runner.start()

    def scan(self, level: TagValue) -> None:
        self.now_ns = self.runner.deadline_ns
        self.writer.publish([level], self.now_ns)
        self.runner.run_once()

    def rows(self, later_ms: int = 0) -> dict[str, dict[str, Any]]:
        names = self.view.names()
        return {r["tag"]: r for r in self.view.describe(names, self.now_ns + later_ms * MS, UTC_NS)}


def test_every_tag_has_the_details_for_an_engineer(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    rig.scan(TagValue(1.5, Quality.GOOD, t_ns=4 * MS))
    rows = rig.rows(later_ms=2)
    assert rows["tank.level"] == {
        "tag": "tank.level", "side": "input", "kind": "real", "value": 1.5, "quality": "good", "reason": "none", "age_s": 0.008,
        "time": "2023-11-14T22:13:19.992+00:00", "unit": "m", "words": {}, "value_names": {}, "limits": [0.0, 4.0],
        "forced": None, "seen": {},
    }  # fmt: skip
    pump = rows["pump.speed"]
    assert (pump["side"], pump["value"], pump["quality"], pump["age_s"]) == ("output", 900, "good", 0.002)
    assert (pump["unit"], pump["limits"]) == ("rpm", [0.0, 1500.0])
    load = rows["pump.load"]
    assert (load["value"], load["quality"], load["unit"], load["limits"]) == (None, "bad", "%", [0.0, 100.0])
    assert rig.view.names() == ["tank.level", "pump.speed", "pump.load"]
    with pytest.raises(UsageError, match="at most 64"):
        rig.view.describe(["tank.level"] * 65, 0, 0)
    with pytest.raises(UsageError, match=r"no tag or variable 'tank\.\*'"):
        rig.view.describe(["tank.*"], 0, 0)


def test_the_input_for_the_writes_of_servers_is_not_shown(tmp_path: Path) -> None:
    """Defect: users saw the message input `st_writes` of a program, which their source does not declare."""
    (tmp_path / "count.st").write_text("PROGRAM count VAR n AT %MW0 : INT; END_VAR n := n + 1; END_PROGRAM")
    writes = writes_tag("count")
    program = ProgramConfig("count", "count.st", {WRITES: InputBinding(writes.name)}, takes_writes=True)
    layout = image_for([program.bind((str(tmp_path),))], {writes.name: writes})
    memory = memoryview(bytearray(layout.size))
    layout.format(memory)
    image = layout.attach(memory)
    config = PlcConfig("", layout.describe(), "", (program,), python_path=(str(tmp_path),))
    now = [0]
    runner = TaskRunner(config, image, lambda: now[0])
    runner.start()
    image.writer(INPUTS).publish([TagValue(0, Quality.GOOD) for _ in layout.regions[0].tags], 0)
    runner.run_once()
    assert TagView(image, runner).names() == ["count.n"]
    assert runner.hidden_tags() == {"count.st_writes", "count.st_writes.consumed"}
    (change,) = runner.why("count.n")
    assert change["inputs"] == {}
    assert list(describe_programs(runner.programs, runner.sources)["count"]["variables"]) == ["n"]


def test_patterns_select_tags() -> None:
    for pattern in ("pump.speed", "pump.*", "*.speed", "pump", "*"):
        assert matches("pump.speed", pattern)
    for pattern in ("pum", "speed", "pump.spee", "Pump"):
        assert not matches("pump.speed", pattern)


@pytest.mark.parametrize(
    ("if_bad", "seen"),
    [
        ("pass", {}),
        ("hold", {"pump.level": {"value": 1.5, "quality": "uncertain"}}),
        (2.5, {"pump.level": {"value": 2.5, "quality": "substituted"}}),
    ],
)
def test_the_programs_value_of_a_bad_input_is_shown_next_to_it(
    tmp_path: Path, if_bad: str | float, seen: dict[str, object]
) -> None:
    rig = Rig(tmp_path, if_bad)
    rig.scan(TagValue(1.5, Quality.GOOD, t_ns=4 * MS))
    rig.scan(TagValue(1.5, Quality.BAD, Reason.TIMEOUT, t_ns=4 * MS))
    row = rig.rows()["tank.level"]
    assert (row["value"], row["quality"], row["reason"], row["seen"]) == (1.5, "bad", "timeout", seen)


def test_a_forced_tag_is_simulated_and_names_user_and_time(tmp_path: Path) -> None:
    rig = Rig(tmp_path, if_bad=2.5)
    rig.scan(TagValue(1.5, Quality.GOOD, t_ns=4 * MS))
    rig.runner.force("tank.level", 9.0, "ada")  # beyond its limits, to see how the logic reacts to such a sensor value
    rig.runner.force("pump.speed", 1500, "ada")
    rig.scan(TagValue(1.5, Quality.BAD, t_ns=4 * MS))
    rows = rig.rows()
    for tag, value in (("tank.level", 9.0), ("pump.speed", 1500)):
        assert (rows[tag]["value"], rows[tag]["quality"]) == (value, "simulated")
        assert rows[tag]["forced"] == {"value": value, "by": "ada", "age_s": 0.01}
        assert rows[tag]["seen"] == {}
    with pytest.raises(UsageError, match="expected 0 to 1500 rpm"):
        rig.runner.force("pump.speed", 1501)
    with pytest.raises(UsageError, match="expected 0 to 100 %"):
        rig.runner.force("pump.load", -1)


class Door(StateMachine):
    table = StateTable(Transition("SHUT", "OPEN"), Transition(ANY, "SHUT"))


def test_a_machine_is_forced_into_states_that_it_has() -> None:
    Door().check("state", 1)
    state = image_for([BoundProgram("door", Door())], {}).regions[1].tags[0]
    assert (state.name, state.words, state.limits) == ("door.state", ((0, "SHUT"), (1, "OPEN")), (0, 1))
    with pytest.raises(UsageError, match=r"expected 0 \(SHUT\), 1 \(OPEN\); got 2"):
        Door().check("state", 2)


def test_operator_actions_are_recorded_before_they_are_executed(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    path.write_text('{"by":"gateway"}\n')
    acts = Acts(str(path))
    acts.note("force", "ada", UTC_NS, tag="pump.speed", old=0, new=9)
    acts.note("force", "", UTC_NS, tag="pump.speed", old=9, new=10)
    acts.note("pause", "ada", UTC_NS)
    acts.close()
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert lines[1] == {
        "utc_ns": UTC_NS, "action": "force", "device": "plc", "by": "ada", "result": "asked",
        "tag": "pump.speed", "old": 0, "new": 9,
    }  # fmt: skip
    assert [line["by"] for line in lines] == ["gateway", "ada", "unknown", "ada"]
    assert acts.counts == {"force": 2, "pause": 1}
    with pytest.raises(Unreachable, match="audit log"):
        Acts(str(tmp_path / "nowhere" / "audit.jsonl"))
    nowhere = Acts("")
    nowhere.note("force", "ada", UTC_NS)
    assert nowhere.counts == {"force": 1}
    full = Acts("/dev/full")
    with pytest.raises(Unreachable, match="cannot write the audit log: No space left"):
        full.note("force", "ada", UTC_NS)
    full.close()
    assert full.counts == {}
