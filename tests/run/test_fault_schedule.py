"""Faults chosen by a seed, and the minimal set that causes a failure."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.emulators.faults.schema import parse_fault
from fieldtwin.gateway.core.files.yaml_file import parse
from fieldtwin.run.campaigns.shrink import as_scenario, smallest
from fieldtwin.run.virtual.fault_schedule import CALM_S, MOST, UNSEEN_ON_TCP, RandomFaults, random_schedule
from fieldtwin.twin.prototype.fault_aims import target
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.prototype.group import one_system
from fieldtwin.twin.site.system import load_system

SYSTEM = load_system("observatory", [])
GROUP = one_system(SYSTEM, load_prototype(SYSTEM))


@given(st.integers(0, 10_000), st.floats(10.0, 100_000.0))
@settings(max_examples=60, deadline=None)
def test_a_seed_chooses_possible_faults_and_none_at_the_end(seed: int, duration_s: float) -> None:
    faults = random_schedule(GROUP, seed, duration_s)
    assert faults == random_schedule(GROUP, seed, duration_s)
    assert len(faults) <= MOST
    for number, said in enumerate(faults, 1):
        spec = parse_fault(dict(said), number=number)
        assert spec.until_s is not None
        assert 0 <= spec.from_s < spec.until_s <= duration_s - min(CALM_S, duration_s / 2) + 0.001
        assert not (said["device"] == "modem" and spec.kind.name in UNSEEN_ON_TCP)


@given(st.sets(st.integers(0, 39), min_size=1, max_size=4), st.integers(4, 40))
@settings(max_examples=80, deadline=None)
def test_exactly_the_necessary_faults_are_left(needed: set[int], count: int) -> None:
    needed = {n % count for n in needed}
    asked = 0

    def fails(part: Sequence[int]) -> bool:
        nonlocal asked
        asked += 1
        return needed <= set(part)

    left, minimal = smallest(range(count), fails, 2_000)
    assert (set(left), minimal) == (needed, True)
    assert asked <= 2_000


def test_it_ends_after_so_many_runs() -> None:
    asked: list[int] = []

    def fails(part: Sequence[int]) -> bool:
        asked.append(len(part))
        return False

    assert smallest(range(1000), fails, 50) == (list(range(1000)), False)
    assert len(asked) == 50


def test_a_schedule_reads_as_a_scenario_again() -> None:
    fault = {"id": "f1", "name": "silence", "device": "ctd", "from": 1.5, "until": 3.0, "probability": 0.5}
    acts = [(6.0, {"send": {"period_s": 1}}), (45.0, {"send": {"period_s": -1}})]
    file = parse(as_scenario('it "fails"', "observatory.yaml", 7, 60.0, [fault], ["a wrong value"], acts), "x.yaml")
    assert file.data["scenario"] == 'it "fails"'
    assert file.data["judge"] == "run"
    sent = [{"pause": "6s"}, {"send": {"period_s": 1}}, {"pause": "39s"}, {"send": {"period_s": -1}}, {"pause": "15s"}]
    assert file.data["steps"] == [{"fault": fault}, *sent]
    assert parse_fault(file.data["steps"][0]["fault"]).until_s == 3.0


@pytest.mark.parametrize("seed", range(5))
def test_no_random_fault_is_without_effect_at_its_target(seed: int) -> None:
    found = random_schedule(GROUP, seed, 24 * 3600.0, RandomFaults(mean_s=60.0))
    assert {"boot-storm", "corrupt-length"} <= {fault["name"] for fault in found}
    for said in found:
        target(SYSTEM, parse_fault(dict(said)))
