"""A hundred seeded hours of the observatory at a scan of 100 ms, under random faults: no wrong value is published as good, and
nothing is lost or blocked.

`scripts/test --long` runs this; FIELDTWIN_LONG_HOURS changes the number of hours.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from fieldtwin.run.campaigns.many_seeds import run_seeds
from fieldtwin.run.virtual.fault_schedule import RandomFaults
from fieldtwin.run.virtual.run import VirtualOptions

pytestmark = [pytest.mark.long, pytest.mark.timeout(3600)]
HOURS = int(os.environ.get("FIELDTWIN_LONG_HOURS", "100"))
RUN_HOURS = 2
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


def run_hours(path: Path, hours: int, *, random_faults: bool) -> None:
    options = VirtualOptions(
        str(path), RUN_HOURS * 3600.0, commands=(1, 2, 0, -1), random_faults=RandomFaults() if random_faults else None
    )
    results = run_seeds(options, range(1, max(1, hours // RUN_HOURS) + 1), jobs=2)
    failed = {r.seed: r.errors for r in results if not r.ok}
    assert not failed
    assert sum(r.wrong for r in results) == 0
    assert sum(r.checked for r in results) > len(results) * RUN_HOURS * 3600 / 2


@pytest.fixture(autouse=True, scope="module")
def behind_all_else() -> Iterator[None]:
    """Run with low priority, because tests in other processes depend on real time."""
    os.setpriority(os.PRIO_PROCESS, 0, 10)
    yield
    with contextlib.suppress(PermissionError):  # only root may raise the priority again
        os.setpriority(os.PRIO_PROCESS, 0, 0)


def test_hours_without_faults(tmp_path: Path) -> None:
    run_hours(slow_scan(tmp_path), HOURS // 10, random_faults=False)


def test_hours_under_random_faults(tmp_path: Path) -> None:
    """Two minutes after the last fault, every device is good again."""
    run_hours(slow_scan(tmp_path), HOURS, random_faults=True)
