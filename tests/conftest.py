"""Every test must leave no thread, process or open socket behind; warnings are errors (pyproject.toml)."""

from __future__ import annotations

import gc
import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

sys.path.insert(0, str(Path(__file__).parent))

# How long an example takes is the host's load. Where a change is judged (CI), the examples are the same each time.
settings.register_profile("fieldtwin", deadline=None, derandomize=bool(os.environ.get("CI")))
settings.load_profile("fieldtwin")


@pytest.fixture(autouse=True)
def leaves_no_threads() -> Iterator[None]:
    """Fail the test that leaves a thread running."""
    before = set(threading.enumerate())
    yield
    leaked = [t for t in threading.enumerate() if t not in before and t.is_alive()]
    for thread in leaked:
        thread.join(timeout=2.0)
    assert not [t for t in leaked if t.is_alive()], f"leaked threads: {leaked}"


@pytest.fixture(autouse=True, scope="module")
def leaves_nothing_to_the_collector() -> Iterator[None]:
    """Collect after each file, so that an unclosed resource caught in a cycle warns in the file that left it.

    Not after each test: there are thousands. What is left when a file has ended, which is modules, tests and their reports,
    is never looked at again: with everything imported, going through it took a quarter of a second each time, a fifth of the
    whole suite.
    """
    yield
    gc.collect()
    gc.freeze()


def pytest_collection_finish() -> None:
    """The same for all that collecting the tests has imported and made."""
    gc.collect()
    gc.freeze()


LINES = {"system": "systems", "spec": "programs", "docs": "programs", "interop": "programs"}
"""Folders whose tests start many processes, and the line that they stand in: more at once would only wait for each other.

Each of the two takes about as long as all else: three processes."""


def line_of(nodeid: str) -> str:
    """What shares a process with what: a line of `LINES`, else a file."""
    file = nodeid.partition("::")[0]
    return LINES.get(Path(file).parent.name, file)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """With several processes (pytest-xdist): whole systems in one of them, one after the other, programs of users and strangers
    in another; all else file by file, so that what a file's tests share is made once.

    Not by the marker `xdist_group`: pytest 9.2 no longer lets xdist 3.8 change a test's id, and then each test goes anywhere.
    """
    from xdist.scheduler import LoadScopeScheduling

    class Lines(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return line_of(nodeid)

    return Lines(config, log)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Tests marked `socketcan` want a kernel with CAN and its vcan0; scripts/test-vcan provides both."""
    if item.get_closest_marker("socketcan") and not Path("/sys/class/net/vcan0").exists():
        pytest.skip("no vcan0 here: scripts/test-vcan runs this")
