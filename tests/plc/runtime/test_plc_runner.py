"""All tasks of a PLC under a manual clock: priorities, triggers, restarts, pause and step."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.image.image import INPUTS, OUTPUTS, TagKind, TagSpec
from fieldtwin.gateway.core.values import Quality, TagValue
from fieldtwin.plc.binding import InputBinding, image_for
from fieldtwin.plc.cycle.task import StopReason
from fieldtwin.plc.runtime.config import PlcConfig, ProgramConfig, TaskSpec
from fieldtwin.plc.runtime.runner import TaskRunner

MS = 1_000_000
PLANT = {
    "d.go": TagSpec("d.go", TagKind.BOOL),
    "d.n": TagSpec("d.n", TagKind.INT),
    "d.total": TagSpec("d.total", TagKind.INT),
}
MODULE = """
from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.plc.program import Program, var_input, var_output, var_retain

RAN = []
HOOKS = {}

class Base(Program):
    n = var_input(TagKind.INT)
    count = var_output(TagKind.INT, initial=0)
    kept = var_retain(TagKind.INT, initial=0)

    def execute(self, scan):
        RAN.append((type(self).__name__, scan.now_ns // 1_000_000, scan.first_scan))
        self.count += 1
        self.kept += 1
        HOOKS.get(type(self).__name__, lambda self, scan: None)(self, scan)

class Fast(Base): pass
class Slow(Base): pass
class Event(Base): pass
"""


class Rig:
    def __init__(
        self,
        folder: Path,
        tasks: tuple[TaskSpec, ...],
        used: tuple[str, ...] = ("Fast", "Slow", "Event"),
        outputs: Mapping[str, str] = {},
        **more: object,
    ) -> None:
        self.module = f"runner_{folder.name}".replace("-", "_")
        (folder / f"{self.module}.py").write_text(MODULE)
        known = {t.name for t in tasks}
        self.programs = tuple(
            ProgramConfig(
                name.lower(), f"python: {self.module}:{name}", {"n": InputBinding("d.n", str(more.pop("if_bad", "pass")))},
                dict(outputs),
                name.lower() if name.lower() in known else "",
            )
            for name in used
        )  # fmt: skip
        bound = [p.bind((str(folder),)) for p in self.programs]
        self.layout = image_for(bound, PLANT, ["d.go"])
        self.memory = memoryview(bytearray(self.layout.size))
        self.layout.format(self.memory)
        image = self.layout.attach(self.memory)
        self.writer = image.writer(INPUTS)
        self.names = [t.name for t in self.layout.regions[0].tags]
        self.reader = image.reader(OUTPUTS)
        self.now_ns = 0
        self.config = PlcConfig(
            "", self.layout.describe(), "", self.programs, python_path=(str(folder),), tasks=tasks,
            retain_path=str(folder / "retain"), **more,  # type: ignore[arg-type]
        )  # fmt: skip
        self.feed()
        self.runner = TaskRunner(self.config, image, lambda: self.now_ns)
        self.space = __import__(self.module)
        self.space.RAN.clear()

    def feed(self, go: bool = False, n: TagValue | int = 0) -> None:
        values = {"d.go": go, "d.n": n}
        row = [
            v if isinstance(v := values[name], TagValue) else TagValue(v, Quality.GOOD, t_ns=self.now_ns)
            for name in self.names
        ]
        self.writer.publish(row, self.now_ns)

    def until(self, ms: int, **fed: bool | int) -> None:
        while self.runner.running and self.runner.deadline_ns <= ms * MS:
            self.now_ns = max(self.now_ns, self.runner.deadline_ns)
            self.feed(**fed)  # type: ignore[arg-type]
            self.runner.run_once()
        self.now_ns = max(self.now_ns, ms * MS)

    def ran(self) -> list[tuple[str, int]]:
        return [(name, ms) for name, ms, _ in self.space.RAN]

    def hook(self, name: str, what: Callable[..., None]) -> None:
        self.space.HOOKS[name] = what


TWO = (TaskSpec("slow", 20, 5), TaskSpec("fast", 10, 1))


def test_tasks_run_on_their_intervals_and_the_more_urgent_goes_first(tmp_path: Path) -> None:
    rig = Rig(tmp_path, TWO, ("Fast", "Slow"))
    rig.runner.start()
    rig.until(40)
    assert rig.ran() == [("Fast", 10), ("Fast", 20), ("Slow", 20), ("Fast", 30), ("Fast", 40), ("Slow", 40)]
    firsts = [(name, ms) for name, ms, first in rig.space.RAN if first]
    assert firsts == [("Fast", 10), ("Slow", 20)]
    out = rig.reader.snapshot()
    assert (out.value("fast.count").value, out.value("slow.count").value) == (4, 2)


def test_a_single_task_runs_once_at_each_rising_edge(tmp_path: Path) -> None:
    rig = Rig(tmp_path, (TaskSpec("fast", 10, 5), TaskSpec("event", 0, 1, "d.go")), ("Fast", "Event"))
    rig.runner.start()
    rig.until(20, go=True)  # true from the start: there was no edge
    rig.until(30, go=False)
    rig.until(50, go=True)
    rig.until(60, go=False)
    rig.until(70, go=True)
    assert [ms for name, ms in rig.ran() if name == "Event"] == [40, 70]
    assert rig.runner.status().tasks["event"].single == "d.go"


def test_a_trigger_may_be_an_output_of_another_program(tmp_path: Path) -> None:
    rig = Rig(tmp_path, (TaskSpec("fast", 10, 5), TaskSpec("event", 0, 1, "fast.count")), ("Fast", "Event"))
    rig.hook("Fast", lambda self, scan: setattr(self, "count", int(scan.number in (2, 3, 5))))
    rig.runner.start()
    rig.until(60)
    assert [ms for name, ms in rig.ran() if name == "Event"] == [20, 50]


def test_one_that_raises_stops_all_with_outputs_safe_and_stays(tmp_path: Path) -> None:
    rig = Rig(tmp_path, TWO, ("Fast", "Slow"))

    def fail(self: object, scan: object) -> None:
        raise ValueError("broken")

    rig.hook("Slow", fail)
    rig.runner.start()
    rig.until(100)
    assert rig.ran()[-1] == ("Slow", 20)
    assert rig.reader.snapshot().stopped
    assert (rig.runner.running, rig.runner.stop_reason, rig.runner.restarts) == (False, StopReason.FAILED, 0)
    assert "program slow" in str(rig.runner.error)


def test_the_watchdog_stops_then_restarts_warm_at_most_so_often(tmp_path: Path) -> None:
    rig = Rig(tmp_path, (TaskSpec("fast", 10),), ("Fast",), stop_after=2, max_restarts=2, restart_after_ms=100)
    rig.runner.start()
    rig.until(30)

    def slow(self: object, scan: object) -> None:
        rig.now_ns += 25 * MS

    rig.hook("Fast", slow)
    rig.until(85)
    assert rig.reader.snapshot().stopped
    assert (rig.runner.running, rig.runner.stop_reason) == (True, StopReason.WATCHDOG)
    before = rig.runner.programs[0].program.kept  # type: ignore[attr-defined]
    rig.space.HOOKS.clear()
    rig.until(300)
    assert (rig.runner.restarts, rig.runner.retained.start) == (1, "warm start")
    assert not rig.reader.snapshot().stopped
    program = rig.runner.programs[0].program
    assert program.kept == before - 1 + program.count  # type: ignore[attr-defined]  # the scan that was stopped was not kept
    rig.hook("Fast", slow)
    rig.until(3000)
    assert (rig.runner.running, rig.runner.restarts, rig.runner.stop_reason) == (False, 2, StopReason.WATCHDOG)


def test_paused_tasks_hold_their_outputs_and_step_on_request(tmp_path: Path) -> None:
    rig = Rig(tmp_path, (TaskSpec("fast", 10),), ("Fast",))
    rig.runner.start()
    rig.until(20)
    with pytest.raises(UsageError, match="while it is paused"):
        rig.runner.step(1)
    rig.runner.pause(True)
    rig.until(100)
    out = rig.reader.snapshot()
    assert (out.value("fast.count").value, out.t_ns, out.stopped) == (2, 100 * MS, False)
    rig.runner.step(2)
    rig.until(200)
    assert rig.ran() == [("Fast", 10), ("Fast", 20), ("Fast", 110), ("Fast", 120)]
    assert rig.runner.status().state == "paused"
    rig.runner.pause(False)
    rig.until(230)
    assert len(rig.ran()) == 7


def test_forces_survive_a_restart_and_are_in_every_status(tmp_path: Path) -> None:
    rig = Rig(tmp_path, (TaskSpec("fast", 10),), ("Fast",))
    rig.runner.start()
    rig.until(20)
    rig.runner.force("fast.count", 77, "somebody")
    with pytest.raises(UsageError, match=r"no tag 'fast\.nothing'"):
        rig.runner.force("fast.nothing", 1)
    rig.runner.restart(cold=True)
    rig.until(60)
    assert rig.reader.snapshot().value("fast.count").value == 77
    assert rig.runner.status().forces["fast.count"]["by"] == "somebody"
    assert rig.runner.why("fast.count")[0]["forced"]
    with pytest.raises(UsageError, match=r"'d\.n' is an input, .*`fieldtwin plc watch d\.n --once`"):
        rig.runner.why("d.n")


def test_an_input_that_trips_stops_permanently(tmp_path: Path) -> None:
    rig = Rig(tmp_path, (TaskSpec("fast", 10),), ("Fast",), if_bad="trip")
    rig.runner.start()
    rig.until(20)
    rig.until(40, n=TagValue(1, Quality.BAD))  # type: ignore[arg-type]
    assert (rig.runner.running, rig.runner.stop_reason) == (False, StopReason.TRIPPED)


@pytest.mark.parametrize(
    ("tasks", "told"),
    [
        ((TaskSpec("event", 0, 1, "d.go"),), "only SINGLE tasks"),
        ((TaskSpec("fast", 10), TaskSpec("fast", 20)), "twice"),
        ((TaskSpec("fast", 0),), "interval"),
        ((TaskSpec("fast", 10), TaskSpec("event", 0, 1, "d.nothing")), "d.nothing"),
    ],
)
def test_tasks_that_make_no_sense_are_refused(tmp_path: Path, tasks: tuple[TaskSpec, ...], told: str) -> None:
    with pytest.raises(FileInvalid, match=told):
        Rig(tmp_path, tasks, ("Fast",))


CHAIN = """
from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.plc.program import Program, var_input, var_local

class First(Program):
    n = var_local(TagKind.INT, initial=0)
    def execute(self, scan):
        self.n += 1

class Second(Program):
    seen = var_input(TagKind.REAL)
    doubled = var_local(TagKind.REAL, initial=0.0)
    quality = ""
    def execute(self, scan):
        self.doubled = 2 * self.seen
        self.quality = str(self.tag("seen").quality)
"""


def test_a_program_reads_another_programs_variable(tmp_path: Path) -> None:
    (tmp_path / "chain_programs.py").write_text(CHAIN)
    programs = (
        ProgramConfig("first", "python: chain_programs:First"),
        ProgramConfig("second", "python: chain_programs:Second", {"seen": InputBinding("first.n")}),
    )
    layout = image_for([p.bind((str(tmp_path),)) for p in programs], {})
    memory = memoryview(bytearray(layout.size))
    layout.format(memory)
    image = layout.attach(memory)
    image.writer(INPUTS).publish([], 0)
    now = [0]
    runner = TaskRunner(PlcConfig("", layout.describe(), "", programs), image, lambda: now[0])
    runner.start()
    for _ in range(3):
        now[0] = runner.deadline_ns
        runner.run_once()
    second = runner.programs[1].program
    assert runner.outputs.last()["second.doubled"] == 4.0  # the value of `first` at the scan's start
    assert second.quality == "good"  # type: ignore[attr-defined]


def test_a_question_about_a_bound_output_is_answered_for_its_tag_and_a_misspelt_one_names_the_nearest(
    tmp_path: Path,
) -> None:
    rig = Rig(tmp_path, (TaskSpec("fast", 10),), ("Fast",), outputs={"count": "d.total"})
    rig.runner.start()
    rig.until(20)
    assert rig.runner.why("fast.count") == rig.runner.why("d.total") != []
    with pytest.raises(UsageError, match=r"did you mean 'd\.total'"):
        rig.runner.why("d.totl")
