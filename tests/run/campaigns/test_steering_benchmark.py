"""The search of benchmarks/steering.py makes valid schedules, and depends on the ended runs only."""

from __future__ import annotations

import importlib.util
import sys
from functools import lru_cache
from pathlib import Path
from random import Random
from types import ModuleType
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.emulators.faults.schema import parse_fault
from fieldtwin.run.virtual.fault_schedule import CALM_S, RandomFaults, random_schedule
from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun, load_one

BENCHMARKS = Path(__file__).resolve().parents[3] / "benchmarks"
PLANT = str(BENCHMARKS / "steering_bugs" / "plant.yaml")
LENGTH_S = 600.0
LAST_S = LENGTH_S - CALM_S


def _loaded(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, BENCHMARKS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


search = _loaded("steered_choice")
GROUP = load_one(VirtualOptions(PLANT, LENGTH_S))


@lru_cache
def draw(seed: int) -> tuple[dict[str, Any], ...]:
    return random_schedule(GROUP, seed, LENGTH_S, RandomFaults(mean_s=30.0))


@given(st.integers(0, 9), st.lists(st.integers(0, 9), max_size=8))
@settings(max_examples=50, deadline=None)
def test_a_mutated_schedule_is_valid_and_the_same_each_time(seed: int, mutations: list[int]) -> None:
    def made() -> tuple[dict[str, Any], ...]:
        faults = draw(seed)
        for number in mutations:
            faults = search.mutated(faults, draw(number), Random(number), LAST_S)
        return faults

    faults = made()
    assert faults == made()
    assert len({fault["id"] for fault in faults}) == len(faults)
    GROUP.place(faults)
    for said in faults:
        spec = parse_fault(dict(said))
        GROUP.check_fault(spec)
        assert spec.until_s is not None
        assert 0 <= spec.from_s < spec.until_s <= LAST_S + 0.001


def test_generations_contain_each_run_once() -> None:
    assert [n for generation in search.generations(range(5, 205)) for n in generation] == list(range(5, 205))


def test_a_rare_situation_is_mutated_more_often_than_a_frequent_one() -> None:
    steering = search.Steering(draw, LAST_S)
    for number in range(1, 33):
        steering.add(search.Planned(number, number, draw(number)), frozenset({1, 2} if number == 7 else {1}))
    seeds = [steering.plan(number).seed for number in range(100, 150)]
    assert seeds.count(7) > 12
    assert seeds == [steering.plan(number).seed for number in range(100, 150)]


def test_the_programs_of_the_benchmark_run() -> None:
    run = VirtualRun(VirtualOptions(PLANT, 30.0, seed=1))
    run.run()
    assert run.summary()["ok"]
