"""Failed runs of a campaign are grouped by cause, and shrinking in several processes gives the same result as in one."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import partial
from itertools import cycle
from pathlib import Path

import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from tank_plant import write_plant

from fieldtwin.cli.main import cli
from fieldtwin.run.campaigns.causes import MOST_CAUSES, causes, of_shape, shape_of, shape_text
from fieldtwin.run.campaigns.shrink import MOST_RUNS, FurtherRuns, shrunk_run, smallest

PLANT = """fieldtwin: 1
system: plant
buses:
  lan: {url: "tcp://192.0.2.1:502", timeout_ms: 200}
devices:
  sensor: {profile: tank.yaml, bus: lan, unit: 1, poll: {level: {every_ms: 500}}, stale_after_ms: 2000}
plc:
  cycle_ms: 100
  programs:
    pump: {source: pump.st, inputs: {level: {tag: sensor.level}}}
"""
CRASHES_ON_BAD_LEVEL = """PROGRAM Pump
VAR_INPUT
  level : INT;
END_VAR
VAR
  zero  : INT;
  share : INT;
END_VAR
  IF NOT IS_GOOD(level) THEN share := 3 / zero; END_IF;
END_PROGRAM
"""
Run = tuple[str, frozenset[str]]
"""A failed run: its error, and the faults of which each alone is enough."""


def found(runs: Sequence[Run], seeds: int = 1000) -> tuple[list[tuple[str, int]], int]:
    """Return the shape and the number of runs of each cause, and the number of runs without a cause."""
    grouped = causes(
        runs,
        lambda run: [run[0]],
        lambda run: min(run[1]),
        lambda small, others: [small in run[1] for run in others],
        FurtherRuns(seeds),
    )
    counts = [(cause.small, len(cause.runs)) for cause in grouped]
    return counts, len(runs) - sum(count for _, count in counts)


def test_runs_with_the_same_check_and_shape_have_one_cause() -> None:
    silence, reset = frozenset({"silence"}), frozenset({"reset"})
    runs = [("level at 4 s", silence), ("level at 5 s", reset), ("level at 6 s", silence | reset), ("other", silence)]
    assert found(runs) == ([("silence", 2), ("reset", 1), ("silence", 1)], 0)


def test_the_number_of_causes_is_limited_and_the_other_runs_are_returned() -> None:
    runs = [("level", frozenset({f"fault {n}"})) for n in range(MOST_CAUSES + 3)]
    grouped, left = found(runs)
    assert (len(grouped), left) == (MOST_CAUSES, 3)


def test_the_number_of_compared_runs_is_limited() -> None:
    assert found([("level", frozenset({"silence"}))] * 100, seeds=80) == ([("silence", 81)], 19)
    assert found([("level", frozenset({"silence"}))] * 100, seeds=2) == ([("silence", MOST_RUNS + 1)], 39)


def test_a_search_takes_only_the_runs_that_a_campaign_has_left() -> None:
    further = FurtherRuns(0)
    further.used(MOST_RUNS - 3)
    left, minimal, _, _ = shrunk_run(range(12), echo, {3, 8}.issubset, further)
    assert ({3, 8} < set(left), minimal, further.left) == (True, False, 0)


def test_a_shape_has_kinds_and_targets_only() -> None:
    one = {"id": "f1", "name": "silence", "device": "sensor", "from": 1.0, "until": 2.0}
    later = {**one, "id": "f9", "from": 7.0, "until": 8.0, "probability": 0.5}
    other = {**one, "device": "valve"}
    assert shape_of([one]) == shape_of([later, one]) != shape_of([other])
    assert of_shape([one, other, later], shape_of([one])) == [one, later]
    assert (shape_text([one, later, other]), shape_text([])) == ("silence on sensor, silence on valve", "no fault")


def echo(parts: Sequence[Sequence[int]]) -> list[frozenset[int]]:
    """Return the items of each part; they stand for the result of a run."""
    return [frozenset(part) for part in parts]


@given(st.sets(st.integers(0, 19), min_size=1, max_size=4), st.integers(1, 25), st.integers(1, 7))
@settings(max_examples=80, deadline=None)
def test_tests_of_several_parts_at_a_time_change_neither_result_nor_limit(
    needed: set[int], most_runs: int, together: int
) -> None:
    def fails(part: Sequence[int]) -> bool:
        return needed <= set(part)

    def first_of(parts: Sequence[Sequence[int]]) -> int | None:
        for begin in range(0, len(parts), together):
            answers = [fails(part) for part in parts[begin : begin + together]]
            if any(answers):
                return begin + answers.index(True)
        return None

    assert smallest(range(20), fails, most_runs, first_of) == smallest(range(20), fails, most_runs)


@given(
    st.sets(st.integers(0, 19), min_size=1, max_size=4),
    st.lists(st.integers(1, 30), min_size=1, max_size=6),
    st.integers(0, 80),
)
@settings(max_examples=80, deadline=None)
def test_the_number_of_workers_changes_neither_the_schedule_nor_the_count_of_runs(
    needed: set[int], workers: list[int], used: int
) -> None:
    def shrunk(parallel: Callable[[], int]) -> tuple[object, int]:
        further = FurtherRuns(0)
        further.used(used)
        return shrunk_run(range(20), echo, needed.issubset, further, parallel), further.left

    assert shrunk(partial(next, cycle(workers))) == shrunk(lambda: 1)


def test_no_more_parts_run_at_a_time_than_there_are_workers_and_none_runs_twice() -> None:
    asked: list[list[tuple[int, ...]]] = []

    def results_of(parts: Sequence[Sequence[int]]) -> list[frozenset[int]]:
        asked.append([tuple(part) for part in parts])
        return echo(parts)

    assert shrunk_run(range(12), results_of, {3, 8}.issubset, FurtherRuns(0), lambda: 3)[:2] == ([3, 8], True)
    runs = [part for parts in asked for part in parts]
    assert len(runs) == len(set(runs))
    assert max(map(len, asked)) == 3


@pytest.mark.long
@pytest.mark.timeout(300)
@pytest.mark.parametrize("jobs", ["1", "2"])
def test_ctrl_c_during_the_search_ends_the_campaign_with_the_failures_that_are_known(tmp_path: Path, jobs: str) -> None:
    write_plant(tmp_path, PLANT)
    (tmp_path / "pump.st").write_text(CRASHES_ON_BAD_LEVEL)
    words = ["plant.yaml", "--for", "1h", "--faults", "random", "--fault-kinds", "silence", "--seeds", "1..2"]
    campaign = subprocess.Popen(
        [sys.executable, "-m", "fieldtwin", "simulate", *words, "--jobs", jobs],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    assert campaign.stdout is not None
    said = ""
    while "searching the causes of 2 failed seeds" not in said:
        said += (line := campaign.stdout.readline())
        assert line, said
    os.killpg(campaign.pid, signal.SIGINT)
    rest, _ = campaign.communicate(timeout=120)  # it ends when the last process with this output has ended
    assert campaign.returncode == 130, rest
    assert "seeds         2, 2 failed" in rest
    assert "interrupted: the search for causes has not ended" in rest
    assert "Traceback" not in rest


@pytest.mark.long
@pytest.mark.timeout(300)
def test_a_campaign_names_each_cause_with_its_seeds_and_scenario(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_plant(tmp_path, PLANT)
    (tmp_path / "pump.st").write_text(CRASHES_ON_BAD_LEVEL)
    monkeypatch.chdir(tmp_path)
    words = [
        "simulate",
        "plant.yaml",
        "--for",
        "6min",
        "--faults",
        "random",
        "--fault-kinds",
        "silence,reset",
        "--seeds",
        "1..4",
    ]
    told = json.loads(CliRunner().invoke(cli, [*words, "--json"]).stdout)
    assert sorted(seed for group in told["groups"] for seed in group["seeds"]) == told["failed"]
    assert sum(group["count"] for group in told["groups"]) == len(told["failed"]) > len(told["groups"])
    for group in told["groups"]:
        assert group["faults"].endswith("on sensor")
        assert (tmp_path / group["scenario"]).exists()
    shown = CliRunner().invoke(cli, words).stdout
    assert shown.count("cause  ") == len(told["groups"])
