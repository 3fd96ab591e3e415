"""Several tasks on one thread: the cause of a late scan, the permitted lateness of each task, steps, and inputs of a stopped
PLC."""

from __future__ import annotations

import importlib
from pathlib import Path

import click
import msgspec
import pytest
from click.testing import CliRunner
from test_plc_runner import MS, Rig

from fieldtwin.cli.options import NegativeNumbers
from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.plc.cycle.task import StopReason
from fieldtwin.plc.runtime.config import TaskSpec
from fieldtwin.plc.runtime.sources import changed, sources

FAST_AND_SLOW = (TaskSpec("fast", 10, 1), TaskSpec("slow", 100, 5))


def takes(rig: Rig, name: str, ms: float) -> None:
    """From now on each scan of this program takes this long."""

    def spend(program: object, scan: object) -> None:
        rig.now_ns += round(ms * MS)

    rig.hook(name, spend)


def test_the_watchdog_names_the_late_task_and_the_one_that_ran(tmp_path: Path) -> None:
    """Defect: it blamed the slow task's own scans ("longest scan 0.126 ms") although a task of 10 ms took 10 ms."""
    rig = Rig(tmp_path, FAST_AND_SLOW, ("Fast", "Slow"), max_restarts=0, stop_after=3)
    takes(rig, "Fast", 9.5)
    rig.runner.start()
    rig.until(1000)
    assert rig.runner.stop_reason is StopReason.WATCHDOG
    told = str(rig.runner.error)
    assert "the watchdog stopped task slow" in told
    assert "a scan every 100 ms, at most 5 ms late" in told
    assert "because task fast (its longest scan took 9.500 ms) ran" in told


def test_a_task_whose_own_scan_is_too_long_is_named_alone(tmp_path: Path) -> None:
    rig = Rig(tmp_path, FAST_AND_SLOW, ("Fast", "Slow"), max_restarts=0, stop_after=3)
    takes(rig, "Fast", 11)
    rig.runner.start()
    rig.until(1000)
    told = str(rig.runner.error)
    assert "the watchdog stopped task fast" in told
    assert "and took 11.000 ms" in told
    assert "because" not in told


def test_each_task_may_be_late_by_its_own_limit(tmp_path: Path) -> None:
    tasks = (TaskSpec("fast", 10, 1), TaskSpec("slow", 100, 5, late_ms=50))
    rig = Rig(tmp_path, tasks, ("Fast", "Slow"), max_restarts=0, stop_after=3)
    takes(rig, "Fast", 9.5)
    rig.runner.start()
    rig.until(1000)
    assert rig.runner.running
    shown = msgspec.to_builtins(rig.runner.status())["tasks"]
    assert (shown["fast"]["late_ms"], shown["slow"]["late_ms"]) == (5.0, 50)


@pytest.mark.parametrize("portions", [[20], [1] * 20, [7, 13], [3, 3, 3, 3, 8]])
def test_steps_keep_the_ratio_of_the_tasks(tmp_path: Path, portions: list[int]) -> None:
    rig = Rig(tmp_path, FAST_AND_SLOW, ("Fast", "Slow"))
    rig.runner.start()
    rig.runner.pause(True)
    rig.until(137)
    at, done = 137, {"fast": 0, "slow": 0}
    for portion in portions:
        for name, scans in rig.runner.step(portion).items():
            done[name] += scans
        while rig.runner.stepping:
            at += 10
            rig.until(at)
    assert done == {"fast": 20, "slow": 2}
    ran = [name for name, _ in rig.ran()]
    assert (ran.count("Fast"), ran.count("Slow")) == (20, 2)


def test_a_step_that_triggers_a_task_runs_it(tmp_path: Path) -> None:
    tasks = (TaskSpec("fast", 10, 1), TaskSpec("event", single="d.go"))
    rig = Rig(tmp_path, tasks, ("Fast", "Event"))
    rig.runner.start()
    rig.until(20)
    rig.runner.pause(True)
    rig.until(40, go=True)
    assert [name for name, _ in rig.ran()].count("Event") == 0  # paused: an edge runs nothing
    rig.until(60)
    rig.runner.step(1)
    rig.until(100, go=True)
    assert [name for name, _ in rig.ran()].count("Event") == 1


def test_inputs_of_a_stopped_plc_are_bad(tmp_path: Path) -> None:
    rig = Rig(tmp_path, FAST_AND_SLOW, ("Fast", "Slow"))
    rig.runner.start()
    rig.until(50, n=7)
    assert rig.runner.input("d.n").quality is Quality.GOOD
    rig.runner.stop()
    seen = rig.runner.input("d.n")
    assert (seen.value, seen.quality, seen.reason) == (7, Quality.BAD, Reason.NOT_OPERATIONAL)
    assert {value.quality for value in rig.runner.inputs().values()} == {Quality.BAD}
    assert rig.runner.substituted_values("d.n") == {}


def test_inputs_are_good_again_after_a_restart(tmp_path: Path) -> None:
    rig = Rig(tmp_path, FAST_AND_SLOW, ("Fast", "Slow"))
    rig.runner.start()
    rig.until(50)
    rig.runner.stop()
    rig.runner.restart()
    rig.until(200)
    assert rig.runner.input("d.n").quality is Quality.GOOD


def test_a_changed_module_that_a_program_imports_from_its_folder_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Defect: `reload` ignored it, and the PLC went on with the old module."""
    helper = tmp_path / "gains_of_the_pump.py"
    helper.write_text("GAIN = 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    importlib.import_module("gains_of_the_pump")
    rig = Rig(tmp_path, FAST_AND_SLOW, ("Fast", "Slow"))
    assert changed(rig.runner.sources) == []
    assert {Path(s.path).stem for s in sources(rig.runner.programs, modules=False)} == {rig.module}
    helper.write_text("GAIN = 2\n")
    assert [(s.program, Path(s.path).name) for s in changed(rig.runner.sources)] == [
        ("fast", helper.name), ("slow", helper.name),
    ]  # fmt: skip


def test_a_program_file_that_changed_is_known(tmp_path: Path) -> None:
    rig = Rig(tmp_path, FAST_AND_SLOW, ("Fast", "Slow"))
    path = tmp_path / f"{rig.module}.py"
    assert changed(rig.runner.sources) == []
    path.write_text(path.read_text() + "\n")
    assert [source.program for source in changed(rig.runner.sources)] == ["fast", "slow"]
    rig.runner.restart()  # a Python module is not imported again
    assert [source.program for source in changed(rig.runner.sources)] == ["fast", "slow"]
    path.unlink()
    assert changed(sources(rig.runner.programs)) == []  # content that could never be read cannot have changed


@click.command(cls=NegativeNumbers)
@click.argument("tag")
@click.argument("value")
@click.option("--yes", is_flag=True)
@click.option("--instance", default="")
def command(tag: str, value: str, yes: bool, instance: str) -> None:
    click.echo(f"{tag} {value} {yes} {instance}")


@pytest.mark.parametrize("number", ["-1", "-1.5", "-.5", "-0x10", "-1e3", "-inf", "5"])
@pytest.mark.parametrize("yes", [True, False])
def test_a_negative_number_is_a_value_at_any_position(number: str, yes: bool) -> None:
    for args in (["t", number, "--yes"], ["--yes", "t", number], ["t", "--yes", "--instance", "x", "--", number]):
        given = [a for a in args if yes or a != "--yes"]
        done = CliRunner().invoke(command, given)
        assert done.output.split()[:3] == ["t", number, str(yes)], (given, done.output)


@pytest.mark.parametrize("args", [["t", "-1", "--yess"], ["t", "-x"], ["t", "-1", "-2"], ["t", "-1", "--instance"]])
def test_an_unknown_option_is_still_refused(args: list[str]) -> None:
    assert CliRunner().invoke(command, args).exit_code == 2
