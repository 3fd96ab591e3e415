"""Seeded hours of the observatory at a scan of 100 ms, with and without random faults: no wrong value is published as good,
and nothing is lost or blocked.

A fault begins every 15 s on average, eight times as often as by default: 12 hours have as many faults as 96 hours would have.
`scripts/test --long` runs this; FIELDTWIN_LONG_HOURS changes the number of hours with faults.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from fieldtwin.run.campaigns.many_seeds import SeedResult, run_seed
from fieldtwin.run.virtual.fault_schedule import RandomFaults
from fieldtwin.run.virtual.run import VirtualOptions

pytestmark = [pytest.mark.long, pytest.mark.timeout(3600)]
HOURS = int(os.environ.get("FIELDTWIN_LONG_HOURS", "12"))
FAULTS = RandomFaults(mean_s=15.0)
SHIPPED = Path(__file__).resolve().parents[2] / "profiles" / "systems"


SLOWER = (
    ("cycle_ms: 10\n", "cycle_ms: 100\n"),
    ("{values: {every_ms: 500}, status: {every_ms: 1000}}", "{values: {every_ms: 1000}, status: {every_ms: 5000}}"),
    ("stale_after_ms: 1500", "stale_after_ms: 3500"),
    ("event_ms: 100}", "event_ms: 1000}"),
    ("stale_after_ms: 500\n", "stale_after_ms: 3500\n"),
    ("{inbox: {every_ms: 200}, status: {every_ms: 2000}}", "{inbox: {every_ms: 500}, status: {every_ms: 5000}}"),
)


def slow_scan(folder: Path) -> Path:
    """The shipped system with a scan of 100 ms and sensors polled every second."""
    text = (SHIPPED / "observatory.yaml").read_text()
    for old, new in SLOWER:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path = folder / "observatory.yaml"
    path.write_text(text)
    (folder / "observatory.prototype.yaml").write_text((SHIPPED / "observatory.prototype.yaml").read_text())
    return path


def run_hours(folder: Path, hours: int, seed: int, faults: RandomFaults | None) -> SeedResult:
    options = VirtualOptions(
        str(slow_scan(folder)), hours * 3600.0, commands=(1, 2, 0, -1), random_faults=faults, seed=seed
    )
    result = run_seed(options)
    assert result.ok, result.errors
    assert result.wrong == 0
    assert result.checked > hours * 3600 / 2
    return result


@pytest.fixture(autouse=True, scope="module")
def behind_all_else() -> Iterator[None]:
    """Run with low priority, because tests in other processes depend on real time."""
    os.setpriority(os.PRIO_PROCESS, 0, 10)
    yield
    with contextlib.suppress(PermissionError):  # only root may raise the priority again
        os.setpriority(os.PRIO_PROCESS, 0, 0)


def test_two_hours_without_faults(tmp_path: Path) -> None:
    run_hours(tmp_path, 2, 1, None)


@pytest.mark.parametrize("seed", range(1, max(1, HOURS) + 1))
def test_an_hour_under_random_faults(tmp_path: Path, seed: int) -> None:
    """Two minutes after the last fault, every device is good again."""
    faults = run_hours(tmp_path, 1, seed, FAULTS).faults
    assert sum(injected for _, injected, _ in faults) > 3600 / FAULTS.mean_s / 2
