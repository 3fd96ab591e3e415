"""Every test must leave no thread, process or open socket behind; warnings are errors (pyproject.toml)."""

from __future__ import annotations

import gc
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

sys.path.insert(0, str(Path(__file__).parent))

settings.register_profile("fieldtwin", deadline=None)  # how long an example takes is the host's load
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


GROUPS = {"system": "systems", "spec": "systems", "docs": "systems", "interop": "strangers"}
"""Folders whose tests start many processes, and the line that they stand in: more at once would only wait for each other."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """With several processes (pytest-xdist): whole systems in one of them, one after the other, programs of strangers in another;
    all else file by file."""
    if not config.pluginmanager.hasplugin("xdist"):
        return
    here = Path(__file__).parent
    for item in items:
        folder = item.path.relative_to(here.parent).parts[1]  # of tests/, or of examples/
        item.add_marker(pytest.mark.xdist_group(GROUPS.get(folder, item.path.name)))


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Tests marked `socketcan` want a kernel with CAN and its vcan0; scripts/test-vcan provides both."""
    if item.get_closest_marker("socketcan") and not Path("/sys/class/net/vcan0").exists():
        pytest.skip("no vcan0 here: scripts/test-vcan runs this")
