"""Programs that are replaced while they run: their variables, timers and blocks continue, and nothing changes in an unsafe case.

The runner is driven with a manual clock. Expected values of blocks come from IEC 61131-3 (6.6.3.5 and 6.7).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fieldtwin.gateway.core.errors import FileInvalid, Unreachable
from fieldtwin.gateway.core.image.image import INPUTS, OUTPUTS, TagKind, TagSpec
from fieldtwin.gateway.core.values import Quality, TagValue
from fieldtwin.plc.binding import InputBinding, image_for
from fieldtwin.plc.cycle.task import StopReason
from fieldtwin.plc.runtime.config import PlcConfig, ProgramConfig, TaskSpec
from fieldtwin.plc.runtime.online.change import ChangeRefused, OnlineChange, prepare
from fieldtwin.plc.runtime.online.compiling import CompileRequest, compile_elsewhere, compile_programs
from fieldtwin.plc.runtime.runner import TaskRunner
from fieldtwin.plc.runtime.tag_view import TagView
from fieldtwin.plc.st.online.carry import StepRemoved

MS = 1_000_000
PLANT = {
    "d.level": TagSpec("d.level", TagKind.INT),
    "d.pump": TagSpec("d.pump", TagKind.BOOL),
    "d.speed": TagSpec("d.speed", TagKind.INT),
}
BLOCKS = """
FUNCTION_BLOCK Meter
VAR_INPUT on : BOOL; END_VAR
VAR_OUTPUT scans : INT; END_VAR
VAR delay : TON; END_VAR
  IF on THEN scans := scans + 1; END_IF
  delay(IN := on, PT := T#500ms);
END_FUNCTION_BLOCK
TYPE Mode : (idle, run, stop); Point : STRUCT x, y : INT; END_STRUCT; END_TYPE
VAR_GLOBAL total : INT; END_VAR
"""
BODY = """
VAR_INPUT level : INT; END_VAR
VAR_OUTPUT pump : BOOL; END_VAR
VAR n : INT; delay : TON; meters : ARRAY[1..2] OF Meter; mode : Mode; at : Point; END_VAR
  n := n + 1; total := total + 1; at.x := n; mode := Mode#run;
  meters[1](on := TRUE); meters[2](on := n MOD 2 = 0);
  delay(IN := TRUE, PT := T#1s);
  pump := delay.Q;
"""


class Plc:
    """A PLC with one program in Structured Text that runs every 10 ms, and its file."""

    def __init__(self, folder: Path, body: str = BODY, blocks: str = BLOCKS, **more: Any) -> None:
        self.path = folder / "control.st"
        self.write(body, blocks)
        more.setdefault("programs", (program("control"),))
        bound = [p.bind((str(folder),)) for p in more["programs"]]
        layout = image_for(bound, PLANT)
        memory = memoryview(bytearray(layout.size))
        layout.format(memory)
        self.image = layout.attach(memory)
        self.writer, self.reader = self.image.writer(INPUTS), self.image.reader(OUTPUTS)
        self.names = [tag.name for tag in layout.regions[0].tags]
        self.now_ns = 0
        more.setdefault("tasks", (TaskSpec("main", 10),))
        self.config = PlcConfig(
            "", layout.describe(), "", python_path=(str(folder),), retain_path=str(folder / "retain"), **more
        )
        self.feed()
        self.runner = TaskRunner(self.config, self.image, lambda: self.now_ns)
        self.runner.start()

    def write(self, body: str, blocks: str = BLOCKS) -> None:
        self.path.write_text(f"{blocks}\nPROGRAM Control\n{body}\nEND_PROGRAM\n", encoding="utf-8")

    def feed(self, level: int = 7) -> None:
        row = [TagValue(level, Quality.GOOD, t_ns=self.now_ns) for _ in self.names]
        self.writer.publish(row, self.now_ns)

    def until(self, ms: int) -> None:
        while self.runner.running and self.runner.deadline_ns <= ms * MS:
            self.now_ns = max(self.now_ns, self.runner.deadline_ns)
            self.feed()
            self.runner.run_once()

    def prepare(self) -> OnlineChange:
        return prepare(self.runner, compile_programs(CompileRequest(self.config.programs, self.config.python_path)))

    def change(self, body: str, blocks: str = BLOCKS) -> OnlineChange:
        """Write a new version of the file and replace the program between two scans."""
        self.write(body, blocks)
        change = self.prepare()
        self.runner.between_scans(change.commit)
        self.until(self.now_ns // MS + 10)
        return change

    def refused(self, body: str, blocks: str = BLOCKS) -> str:
        """Return why the program cannot be replaced by a version."""
        self.write(body, blocks)
        change = self.prepare()
        before = self.outputs()
        with pytest.raises(ChangeRefused):
            change.commit()
        assert self.outputs() == before
        return "; ".join(reason for one in change.changes for reason in one.refused)

    def outputs(self) -> dict[str, Any]:
        snapshot = self.reader.snapshot()
        return {name: snapshot.value(name).value for name in snapshot.shape.index}

    def value(self, path: str) -> Any:
        found = self.runner.programs[0].program.internal(path)
        assert found is not None, path
        return found.value


def program(
    name: str, source: str = "control.st", outputs: Mapping[str, str] | None = None, **more: Any
) -> ProgramConfig:
    bound = {"pump": "d.pump"} if outputs is None else outputs
    return ProgramConfig(name, source, {"level": InputBinding("d.level")}, dict(bound), **more)


def edited(*changes: tuple[str, str], text: str = BODY) -> str:
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    return text


def test_a_timer_in_mid_run_continues_and_ends_at_its_first_time(tmp_path: Path) -> None:
    """TON (6.6.3.5.5): Q becomes TRUE 1 s after the rise of IN, which is in the first scan, at 10 ms."""
    plc = Plc(tmp_path)
    plc.until(600)
    plc.change(edited(("n := n + 1;", "n := n + 100;")))
    assert plc.now_ns == 610 * MS
    assert plc.value("delay.ET") == 600 * MS
    plc.until(1000)
    assert plc.outputs()["d.pump"] is False
    plc.until(1010)
    assert plc.outputs()["d.pump"] is True
    assert plc.outputs()["control.n"] == 61 + 40 * 100  # 61 scans of the first version, and then 40 of the second one


def test_variables_keep_their_values_and_new_ones_begin_with_their_initial_values(tmp_path: Path) -> None:
    plc = Plc(tmp_path)
    plc.until(100)
    change = plc.change(
        edited(
            ("n : INT;", "count : INT := 5; n : INT;"),
            ("mode : Mode; at : Point;", "mode : INT; at : Point;"),
            ("mode := Mode#run;", "count := count + 1;"),
        )
    )
    [found] = change.changes
    assert found.differences.kept == 7  # level, pump, n, delay, meters, at; and total, which is global
    assert found.differences.new == ["count"]
    assert found.differences.removed == []
    assert found.differences.changed == ["mode (VAR Mode -> VAR INT)"]
    plc.until(120)
    assert plc.value("count") == 6
    assert (plc.outputs()["control.n"], plc.outputs()["control.mode"]) == (12, 0)


def test_members_of_blocks_structures_arrays_and_global_variables_keep_their_values(tmp_path: Path) -> None:
    plc = Plc(tmp_path)
    plc.until(100)
    blocks = edited(
        ("VAR delay : TON; END_VAR", "VAR hours : REAL := 2.5; delay : TON; END_VAR"),
        ("x, y : INT;", "y : INT; x : INT; z : INT := 3;"),
        ("scans := scans + 1;", "scans := scans + 10;"),
        text=BLOCKS,
    )
    change = plc.change(edited(("total := total + 1;", "n := total;")), blocks)
    assert change.changes[0].differences.new == ["Meter.hours", "Point.z"]
    assert [plc.value(f"meters[{at}].scans") for at in (1, 2)] == [11, 5]
    assert plc.value("meters[1].delay.ET") == 100 * MS
    assert (plc.value("at.x"), plc.value("at.z"), plc.value("meters[2].hours")) == (11, 3, 2.5)
    plc.until(120)
    assert plc.outputs()["control.n"] == 11  # the total of the first version
    assert plc.value("meters[1].scans") == 21


UNIONS = f"""{BLOCKS}
TYPE Data : UNION word : WORD; real : REAL; END_UNION END_TYPE
TYPE Pair : STRUCT data : Data; n : INT; END_STRUCT END_TYPE
"""


def test_a_union_keeps_its_bytes_if_its_members_are_the_same(tmp_path: Path) -> None:
    body = edited(
        ("mode : Mode;", "mode : Mode; data : Data; pairs : ARRAY[0..1] OF Pair;"),
        (
            "n := n + 1;",
            "IF n = 0 THEN data.real := 1.5; pairs[1].data.word := 16#1234; pairs[1].n := 4; END_IF n := n + 1;",
        ),
    )
    programs = (program("control", dialect="codesys"),)
    plc = Plc(tmp_path, body, UNIONS, programs=programs)
    plc.until(30)
    plc.change(edited(("n := n + 1;", "n := n + 2;"), text=body), UNIONS)
    assert (plc.value("data.real"), plc.value("pairs[1].data.word"), plc.value("pairs[1].n")) == (1.5, 0x1234, 4)
    change = plc.change(body, edited(("word : WORD; real", "word : WORD; dint : DINT; real"), text=UNIONS))
    assert (plc.value("data.real"), plc.value("pairs[1].data.word"), plc.value("pairs[1].n")) == (0.0, 0, 4)
    assert change.changes[0].differences.changed == [
        "data (the members of Data differ)",
        "Pair.data (the members of Data differ)",
    ]


def test_a_member_whose_kind_of_block_changes_begins_with_its_initial_value(tmp_path: Path) -> None:
    plc = Plc(tmp_path)
    plc.until(100)
    blocks = edited(("VAR_OUTPUT scans : INT; END_VAR", "VAR scans : INT := 50; END_VAR"), text=BLOCKS)
    change = plc.change(edited(("meters[1](on := TRUE); ", "")), blocks)
    assert change.changes[0].differences.changed == ["Meter.scans (VAR_OUTPUT INT -> VAR INT)"]
    assert plc.value("meters[1].scans") == 50


def test_the_new_version_sees_the_quality_of_its_inputs(tmp_path: Path) -> None:
    plc = Plc(tmp_path)
    plc.until(50)
    plc.change(edited(("n := n + 1;", "n := level + 100 * BOOL_TO_INT(IS_GOOD(level));")))
    plc.until(80)
    assert plc.outputs()["control.n"] == 107


def test_a_value_of_an_enumeration_keeps_its_name(tmp_path: Path) -> None:
    """The number of `run` is 1 at first and then 2. The process image does not know the variable, so nothing shows old names."""
    holder = """FUNCTION_BLOCK Holder VAR mode : Mode; END_VAR VAR_INPUT set : BOOL; END_VAR
    IF set THEN mode := Mode#run; END_IF END_FUNCTION_BLOCK
    """
    body = edited(("mode : Mode;", "holder : Holder;"), ("mode := Mode#run;", "holder(set := TRUE);"))
    plc = Plc(tmp_path, body, BLOCKS + holder)
    plc.until(50)
    later = edited(("(idle, run, stop)", "(idle, ready, run, stop)"), text=BLOCKS + holder)
    plc.change(edited(("set := TRUE", "set := FALSE"), text=body), later)
    plc.until(70)
    assert plc.value("holder.mode") == "run"
    gone = edited(
        ("(idle, run, stop)", "(idle, stop)"), ("IF set THEN mode := Mode#run; END_IF", ""), text=BLOCKS + holder
    )
    plc.change(edited(("holder(set := TRUE);", ""), text=body), gone)
    assert plc.value("holder.mode") == "idle"  # a value that no longer exists: the initial one


def test_constants_take_their_new_values(tmp_path: Path) -> None:
    block = """FUNCTION_BLOCK Table VAR_OUTPUT out : INT; END_VAR VAR CONSTANT values : ARRAY[0..1] OF INT := [1, 2]; END_VAR
    out := values[1]; END_FUNCTION_BLOCK VAR_GLOBAL CONSTANT limits : ARRAY[0..1] OF INT := [5, 6]; END_VAR
    """
    body = edited(
        ("n : INT;", "n : INT; table : Table;"), ("n := n + 1;", "table(); n := table.out + 100 * limits[1];")
    )
    plc = Plc(tmp_path, body, BLOCKS + block)
    plc.until(50)
    assert plc.outputs()["control.n"] == 602
    plc.change(body, BLOCKS + edited(("[1, 2]", "[1, 3]"), ("[5, 6]", "[5, 7]"), text=block))
    plc.until(70)
    assert plc.outputs()["control.n"] == 703


def test_a_removed_variable_has_no_value_and_a_new_one_no_tag(tmp_path: Path) -> None:
    plc = Plc(tmp_path)
    plc.until(50)
    plc.change(
        edited(("n : INT;", "m : INT;"), ("n := n + 1;", "m := m + 1;"), ("at.x := n;", ""), ("n MOD 2", "m MOD 2"))
    )
    plc.until(70)
    assert plc.outputs()["control.n"] is None
    assert plc.reader.snapshot().value("control.n").quality is Quality.BAD
    assert "control.m" not in plc.outputs()
    assert plc.value("m") == 1
    plc.change(BODY)
    plc.until(90)
    assert plc.outputs()["control.n"] == 1  # it begins again


def test_a_variable_with_a_type_that_its_tag_cannot_hold_is_shown_without_its_tag(tmp_path: Path) -> None:
    plc = Plc(tmp_path)
    plc.until(50)
    plc.change(edited(("mode : Mode;", "mode : REAL := 1.5;"), ("mode := Mode#run;", "")))
    plc.until(70)
    assert plc.outputs()["control.mode"] is None
    mode, n = TagView(plc.image, plc.runner).describe(["control.mode", "control.n"], plc.now_ns, 0)
    assert (mode["side"], mode["kind"], mode["value"]) == ("internal", "REAL", 1.5)
    assert (n["side"], n["value"]) == ("output", 7)


def test_the_version_before_can_return_with_the_values_of_now(tmp_path: Path) -> None:
    plc = Plc(tmp_path)
    plc.until(100)
    change = plc.change(edited(("n := n + 1;", "n := n + 100;"), ("n : INT;", "n : INT; extra : INT;")))
    plc.until(150)
    back = prepare(plc.runner, change.before)
    assert back.changes[0].differences.removed == ["extra"]
    plc.runner.between_scans(back.commit)
    plc.until(200)
    assert plc.outputs()["control.n"] == 11 + 5 * 100 + 4
    plc.until(1010)
    assert plc.outputs()["d.pump"] is True


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ([("level : INT;", "height : INT;")], "input level is removed, but the system file binds it to d.level"),
        ([("level : INT;", "level, more : INT;")], "input more is new, and the system file has to bind it to a tag"),
        ([("level : INT;", "level : REAL;")], "input level changes (input of kind int -> input of kind real), but"),
        (
            [("VAR_OUTPUT pump : BOOL; END_VAR", "VAR pump : BOOL; END_VAR")],
            "output pump changes (output of kind bool -> local of kind bool), but the system file binds it to d.pump",
        ),
        ([("mode : Mode;", "mode : Other;"), ("Mode#run", "Other#a")], "2 was stop and is c"),
    ],
)
def test_an_unsafe_change_is_refused_with_its_reason(
    tmp_path: Path, changes: list[tuple[str, str]], reason: str
) -> None:
    plc = Plc(tmp_path)
    plc.until(50)
    blocks = BLOCKS + "TYPE Other : (idle, run, c, a); END_TYPE\n"
    assert reason in plc.refused(edited(*changes), blocks)
    plc.until(80)
    assert plc.outputs()["control.n"] == 8


def test_a_reference_is_refused_because_it_refers_to_a_variable_of_the_version_that_runs(tmp_path: Path) -> None:
    body = edited(("n : INT;", "n : INT; ref : REF_TO INT := REF(n);"), ("n := n + 1;", "ref^ := ref^ + 1;"))
    plc = Plc(tmp_path, body)
    plc.until(50)
    assert plc.outputs()["control.n"] == 5
    assert plc.refused(edited(("ref^ + 1", "ref^ + 2"), text=body)) == (
        "ref: a reference refers to a variable of the version that runs and cannot be taken over: restart the programs with "
        "`fieldtwin plc restart`"
    )


def test_the_tasks_of_a_configuration_stay(tmp_path: Path) -> None:
    configuration = """CONFIGURATION Config RESOURCE Res ON PLC
    TASK fast(INTERVAL := T#10ms, PRIORITY := 1); PROGRAM Main WITH fast : Control; END_RESOURCE END_CONFIGURATION
    """
    plc = Plc(tmp_path, BODY, BLOCKS + configuration)
    plc.until(50)
    later = BLOCKS + edited(("T#10ms", "T#20ms"), text=configuration)
    assert plc.refused(BODY, later) == (
        "the tasks of its CONFIGURATION change, which the PLC takes at its start: keep them, or restart the run"
    )
    plc.change(edited(("n := n + 1;", "n := n + 100;")), BLOCKS + "\n" + configuration)
    plc.until(70)
    assert plc.outputs()["control.n"] == 106


def test_an_instance_of_a_derived_function_block_keeps_the_variables_of_its_base(tmp_path: Path) -> None:
    derived = """FUNCTION_BLOCK Derived EXTENDS Meter VAR extra : INT; END_VAR
    METHOD PUBLIC step : INT extra := extra + 1; step := extra; END_METHOD
    SUPER(); END_FUNCTION_BLOCK
    """
    body = edited(("n : INT;", "n : INT; one : Derived;"), ("n := n + 1;", "n := one.step(); one(on := TRUE);"))
    plc = Plc(tmp_path, body, BLOCKS + derived)
    plc.until(100)
    plc.change(body, BLOCKS + edited(("extra + 1", "extra + 10"), text=derived))
    plc.until(120)
    assert plc.outputs()["control.n"] == 21
    assert plc.value("one.scans") == 12
    assert plc.value("one.delay.ET") == 110 * MS


def test_a_variable_that_another_program_reads_stays(tmp_path: Path) -> None:
    (tmp_path / "reader.st").write_text(
        "PROGRAM Reader VAR_INPUT level : INT; END_VAR VAR seen : INT; END_VAR seen := level; END_PROGRAM"
    )
    reader = ProgramConfig("reader", "reader.st", {"level": InputBinding("control.n")})
    plc = Plc(tmp_path, programs=(program("control"), reader))
    plc.until(50)
    renamed = edited(
        ("n : INT;", "m : INT;"), ("n := n + 1;", "m := m + 1;"), ("at.x := n;", ""), ("n MOD 2", "m MOD 2")
    )
    assert plc.refused(renamed) == (
        "local n is removed, but program reader uses it: keep it, or change program reader as well and restart the run"
    )
    plc.change(edited(("n := n + 1;", "n := n + 100;")))
    plc.until(80)  # the reader sees the value of the scan before
    assert (plc.outputs()["reader.seen"], plc.outputs()["control.n"]) == (106, 206)


@pytest.mark.parametrize(
    ("users", "reason"),
    [
        (
            ["alarm high"],
            "local n is removed, but alarm high uses it: keep it, or change alarm high as well and restart the run",
        ),
        (
            ["alarm high", "invariant never 1", "server hmi"],
            "local n is removed, but alarm high, invariant never 1 and server hmi use it: keep it, or change alarm high and "
            "invariant never 1 as well and restart the run",
        ),
        (["server hmi"], "local n is removed, but server hmi uses it: keep it, or restart the run"),
    ],
)
def test_a_variable_that_the_system_file_uses_stays(tmp_path: Path, users: list[str], reason: str) -> None:
    """Defect: an alarm on a variable that a change removed was never raised again."""
    plc = Plc(tmp_path, users={"control.n": users})
    plc.until(50)
    renamed = edited(
        ("n : INT;", "m : INT;"), ("n := n + 1;", "m := m + 1;"), ("at.x := n;", ""), ("n MOD 2", "m MOD 2")
    )
    assert plc.refused(renamed) == reason
    typed = edited(("n : INT;", "n : REAL;"), ("n := n + 1;", "n := 1.0;"), ("at.x := n;", ""), ("n MOD 2 = 0", "TRUE"))
    assert "local n changes (local of kind int -> local of kind real), but" in plc.refused(typed)
    as_output = edited(("VAR n : INT;", "VAR_OUTPUT n : INT := 9; END_VAR VAR"))
    change = plc.change(as_output)
    assert change.changes[0].differences.changed == ["n (VAR INT -> VAR_OUTPUT INT)"]
    plc.until(80)
    assert plc.outputs()["control.n"] == 9 + 2


def test_a_member_that_an_alarm_uses_stays_and_keeps_its_tag(tmp_path: Path) -> None:
    members = ("meters[1].scans", "delay.Q", "at.x")
    users = {"control.meters[1].scans": ["alarm high"]}
    plc = Plc(tmp_path, programs=(program("control", published=members),), users=users)
    plc.until(50)
    assert (plc.outputs()["control.at.x"], plc.outputs()["control.delay.Q"]) == (5, False)
    assert plc.refused(edited(("ARRAY[1..2] OF Meter", "ARRAY[2..3] OF Meter"), ("meters[1]", "meters[3]"))) == (
        "local meters[1].scans is removed, but alarm high uses it: keep it, or change alarm high as well and restart the run"
    )
    plc.change(edited(("n := n + 1;", "n := n + 100;")))
    plc.until(80)
    assert plc.outputs()["control.at.x"] == plc.outputs()["control.n"] > 200


def test_programs_of_one_file_continue_with_one_set_of_global_variables(tmp_path: Path) -> None:
    second = "PROGRAM Second VAR_OUTPUT seen : INT; END_VAR seen := total; END_PROGRAM\n"
    first = program("control", "control.st:Control")
    other = ProgramConfig("second", "control.st:Second")
    plc = Plc(tmp_path, BODY, BLOCKS + second, programs=(first, other))
    plc.until(50)
    plc.change(edited(("total := total + 1", "total := total + 10")), BLOCKS + second)
    plc.until(80)
    assert plc.outputs()["second.seen"] == 6 + 20


def test_a_forced_variable_stays_forced_and_cannot_disappear(tmp_path: Path) -> None:
    plc = Plc(tmp_path)
    plc.until(50)
    plc.runner.force("control.n", 1000)
    plc.runner.force("d.level", 3)
    plc.change(edited(("n := n + 1;", "n := n + level;")))
    plc.until(80)
    assert plc.outputs()["control.n"] == 1000
    plc.write(edited(("n : INT;", "m : INT;"), ("n := n + 1;", ""), ("at.x := n;", ""), ("n MOD 2", "m MOD 2")))
    with pytest.raises(ChangeRefused, match=r"control\.n is forced"):
        plc.prepare().commit()
    plc.runner.forces.unforce("control.n")
    plc.until(100)
    assert plc.outputs()["control.n"] == 1000 + 2 * 3


def test_retained_variables_continue_and_are_saved(tmp_path: Path) -> None:
    retained = edited(
        ("VAR n : INT;", "VAR RETAIN kept : INT; END_VAR VAR n : INT;"), ("n := n + 1;", "kept := kept + 1;")
    )
    plc = Plc(tmp_path, retained)
    plc.until(50)
    plc.change(edited(("kept + 1", "kept + 10"), text=retained))
    plc.until(80)
    assert plc.runner.retained.values() == {"control": {"kept": 6 + 20}}
    plc.runner.restart()
    assert plc.runner.retained.start == "warm start"
    plc.until(100)
    assert plc.outputs()["control.kept"] == 26 + 20


RETAINED = edited(
    ("VAR n : INT;", "VAR RETAIN kept : INT; gone : INT; typed : INT; END_VAR VAR n, plain : INT;"),
    ("n := n + 1;", "n := n + 1; kept := kept + 1; gone := n; typed := n; plain := 100 + n;"),
)
RETAINED_LATER = edited(
    ("kept : INT; gone : INT; typed : INT;", "kept : INT; typed : DINT := 7; added : INT := 40; plain : INT;"),
    ("n, plain : INT;", "n : INT;"),
    ("gone := n; typed := n; plain := 100 + n;", "added := added + 1;"),
    text=RETAINED,
)


def started_again(plc: Plc) -> TaskRunner:
    """Return the PLC of a new process that finds the files as a kill left them."""
    bound = [p.bind(plc.config.python_path) for p in plc.config.programs]
    layout = image_for(bound, PLANT)
    memory = memoryview(bytearray(layout.size))
    layout.format(memory)
    image = layout.attach(memory)
    return TaskRunner(replace(plc.config, layout=layout.describe()), image, lambda: plc.now_ns)


def test_retained_variables_may_be_added_removed_and_change_their_type(tmp_path: Path) -> None:
    plc = Plc(tmp_path, RETAINED)
    plc.until(50)
    assert plc.runner.retained.values() == {"control": {"kept": 5, "gone": 5, "typed": 5}}
    change = plc.change(RETAINED_LATER)
    differences = change.changes[0].differences
    assert (differences.new, differences.removed) == (["added"], ["gone"])
    assert differences.changed == ["typed (VAR INT -> VAR DINT)"]
    plc.until(80)
    now = {"control": {"kept": 8, "typed": 7, "added": 42, "plain": 106}}
    assert plc.runner.retained.values() == now
    # killed: the file is as the last scan left it
    again = started_again(plc)
    assert (again.retained.start, again.retained.values()) == ("warm start", now)


def test_a_kill_between_the_edit_and_the_change_keeps_the_variables_that_are_the_same(tmp_path: Path) -> None:
    plc = Plc(tmp_path, RETAINED)
    plc.until(50)
    plc.write(RETAINED_LATER)
    again = started_again(plc)
    assert again.retained.start == ("warm start; with initial values: control.typed, control.added, control.plain")
    assert again.retained.values() == {"control": {"kept": 5, "typed": 7, "added": 40, "plain": 0}}
    assert (tmp_path / "retain.old").exists()


def test_a_return_to_the_version_before_keeps_what_both_retain(tmp_path: Path) -> None:
    plc = Plc(tmp_path, RETAINED)
    plc.until(50)
    change = plc.change(RETAINED_LATER)
    plc.runner.between_scans(prepare(plc.runner, change.before).commit)
    plc.until(80)
    kept = plc.runner.retained.values()["control"]
    assert (kept["kept"], sorted(kept)) == (8, ["gone", "kept", "typed"])
    # the file still has the later version, which the next start takes
    again = started_again(plc)
    assert again.retained.values()["control"]["kept"] == 8


def test_the_first_and_the_last_retained_variable_may_come_and_go(tmp_path: Path) -> None:
    plc = Plc(tmp_path)
    plc.until(30)
    retained = edited(("VAR n : INT;", "VAR RETAIN n : INT; END_VAR VAR"))
    plc.change(retained)
    plc.until(60)
    assert plc.runner.retained.values() == {"control": {"n": 6}}
    assert started_again(plc).retained.values() == {"control": {"n": 6}}
    saves = plc.runner.retained.status().saves
    plc.change(BODY)
    plc.until(90)
    assert plc.runner.retained.values() == {}
    assert plc.outputs()["control.n"] == 9
    assert not (tmp_path / "retain").exists()
    plc.change(retained)
    plc.until(110)
    assert plc.runner.retained.values() == {"control": {"n": 11}}
    assert plc.runner.retained.status().saves > saves


def test_a_change_of_retained_variables_without_room_for_their_file_changes_nothing(tmp_path: Path) -> None:
    plc = Plc(tmp_path, RETAINED)
    plc.until(50)
    plc.write(RETAINED_LATER)
    change = plc.prepare()
    (tmp_path / "retain.new").mkdir()
    with pytest.raises(Unreachable, match="no file for retained variables"):
        change.commit()
    plc.until(80)
    assert plc.runner.retained.values() == {"control": {"kept": 8, "gone": 8, "typed": 8}}


def test_a_step_continues_and_an_active_step_cannot_be_removed(tmp_path: Path) -> None:
    """A step's T is the time since it became active (6.7.2)."""
    chart = """VAR_INPUT level : INT; END_VAR VAR_OUTPUT pump : BOOL; END_VAR VAR n : INT; END_VAR
    INITIAL_STEP Start: END_STEP
    STEP Fill: END_STEP
    TRANSITION FROM Start TO Fill := TRUE; END_TRANSITION
    TRANSITION FROM Fill TO Start := Fill.T >= T#300ms; END_TRANSITION
    """
    plc = Plc(tmp_path, chart)
    plc.until(100)
    assert plc.value("Fill.X") is True
    began_ms = 100 - plc.value("Fill.T") // MS
    plc.change(edited(("T#300ms", "T#200ms"), text=chart))
    plc.until(began_ms + 190)
    assert plc.value("Fill.X") is True
    plc.until(began_ms + 200)
    assert plc.value("Start.X") is True
    plc.until(began_ms + 250)
    assert plc.value("Fill.X") is True
    plc.write(
        edited(
            ("STEP Fill:", "STEP Other:"),
            ("TO Fill", "TO Other"),
            ("FROM Fill", "FROM Other"),
            ("Fill.T", "Other.T"),
            text=chart,
        )
    )
    with pytest.raises(StepRemoved, match="step Fill is active"):
        plc.prepare().commit()
    plc.until(began_ms + 260)
    assert plc.value("Fill.X") is True


def test_a_restart_by_itself_runs_the_version_that_ran_and_not_the_file(tmp_path: Path) -> None:
    plc = Plc(tmp_path, stop_after=1, restart_after_ms=50)
    plc.until(50)
    change = plc.change(edited(("n := n + 1;", "n := n + 100;")))
    plc.runner.between_scans(prepare(plc.runner, change.before).commit)
    plc.until(70)
    plc.now_ns += 100 * MS  # an overrun, so that the watchdog stops the task
    plc.until(170)
    assert plc.runner.stop_reason is StopReason.WATCHDOG
    plc.until(300)
    assert plc.runner.restarts == 1
    assert 0 < plc.outputs()["control.n"] < 100


def test_a_restart_by_a_user_takes_a_file_with_other_local_variables(tmp_path: Path) -> None:
    """Defect: such a file needed a restart of the whole system."""
    plc = Plc(tmp_path)
    plc.until(50)
    plc.write(edited(("n : INT;", "n : INT; more : INT := 4;")))
    plc.runner.restart()
    plc.until(80)
    assert plc.value("more") == 4
    plc.write(edited(("level : INT;", "height : INT;")))
    with pytest.raises(FileInvalid, match="input level is removed"):
        plc.runner.restart()
    plc.until(100)
    assert plc.outputs()["control.n"] > 1


def test_a_program_that_was_replaced_in_the_meantime_is_not_replaced_again(tmp_path: Path) -> None:
    plc = Plc(tmp_path)
    plc.until(50)
    plc.write(edited(("n := n + 1;", "n := n + 100;")))
    first, second = plc.prepare(), plc.prepare()
    first.commit()
    with pytest.raises(ChangeRefused, match="replaced in the meantime"):
        second.commit()
    plc.runner.stop()
    with pytest.raises(ChangeRefused, match="the PLC has stopped"):
        plc.prepare().commit()


def test_a_separate_process_compiles_the_same(tmp_path: Path) -> None:
    plc = Plc(tmp_path)
    plc.until(50)
    plc.write(edited(("n := n + 1;", "n := n + 100;")))
    change = prepare(plc.runner, compile_elsewhere(CompileRequest(plc.config.programs, plc.config.python_path)))
    plc.runner.between_scans(change.commit)
    plc.until(80)
    assert plc.outputs()["control.n"] == 6 + 200
    [last, *_] = plc.runner.why("control.n")
    assert (
        last["place"]
        == f"{plc.path}:{plc.path.read_text().splitlines().index(BODY.splitlines()[4].replace('n + 1', 'n + 100')) + 1}"
    )
    assert last["decided"]["statement"] == "n := n + 100"
    plc.write(edited(("n := n + 1;", "n := nothing;")))
    with pytest.raises(FileInvalid) as raised:
        compile_elsewhere(CompileRequest(plc.config.programs, plc.config.python_path))
    assert (raised.value.path, raised.value.line, raised.value.column > 0) == (str(plc.path), 17, True)
