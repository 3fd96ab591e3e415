"""Every test must leave no thread, process or open socket; warnings are errors (pyproject.toml)."""

from __future__ import annotations

import gc
import os
import re
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from property_examples import has_examples, reduce_examples

# jsonschema imports it for the format "iri", which no test checks, and it then builds 38 parsers: five seconds in each process.
sys.modules["rfc3987_syntax"] = None  # type: ignore[assignment]

TESTS = Path(__file__).parent
RIGS = sorted(folder for folder in (TESTS / "rigs").iterdir() if folder.is_dir() and folder.name != "__pycache__")
"""The folders of set-ups that tests of several folders import."""
sys.path[:0] = [str(folder) for folder in (TESTS, *RIGS, TESTS / "system")]

# The time per example depends on the host's load. In CI, the examples are the same each time.
settings.register_profile("fieldtwin", deadline=None, derandomize=bool(os.environ.get("CI")))
settings.load_profile("fieldtwin")


@pytest.fixture(autouse=True)
def leaves_no_threads() -> Iterator[None]:
    """Fail a test that leaves a thread running."""
    before = set(threading.enumerate())
    yield
    leaked = [t for t in threading.enumerate() if t not in before and t.is_alive()]
    for thread in leaked:
        thread.join(timeout=2.0)
    assert not [t for t in leaked if t.is_alive()], f"leaked threads: {leaked}"


@pytest.fixture(autouse=True, scope="module")
def leaves_nothing_to_the_collector() -> Iterator[None]:
    """Collect garbage after each file, so that an unclosed resource in a reference cycle warns in its own file.

    There are thousands of tests, so this does not happen after each of them. The remaining objects (modules, tests and
    their reports) are frozen: with everything imported, each collection took a quarter of a second, which was a fifth
    of the suite's time.
    """
    yield
    gc.collect()
    gc.freeze()


def pytest_collection() -> None:
    """Collect no garbage while tests are imported and collected, because nearly all new objects remain: this takes a sixth of
    the processor's time.
    """
    gc.disable()


def pytest_collection_finish() -> None:
    """Collect the garbage of the collection of tests at once, as after each file."""
    gc.enable()
    gc.collect()
    gc.freeze()


ONE_MARK = re.compile(r"(socketcan|long)( and not \w+)*")
"""A selection whose tests all have one mark."""


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Skip files without the mark that all selected tests have.

    The import of all files takes half a minute of processor time in each process, and minutes in the virtual machine of
    scripts/test-vcan. Tests have these marks in their own file (tests/project/test_folders.py).
    """
    selected = ONE_MARK.fullmatch(str(config.getoption("markexpr")))
    if selected is None or collection_path.suffix != ".py":
        return None
    text = collection_path.read_text("utf-8")
    return True if f"mark.{selected[1]}" not in text and not (selected[1] == "long" and "@given" in text) else None


def pytest_itemcollected(item: pytest.Item) -> None:
    """Let property tests try a third of their examples in the fast tests, and all of them among the long tests."""
    if isinstance(item, pytest.Function) and has_examples(item.obj):
        if are_long(item.config):
            item.add_marker(pytest.mark.long)
        elif "not long" in str(item.config.getoption("markexpr")):
            reduce_examples(item.obj)


LINES = {
    "tests/studio/": "studio",
    "tests/system/runs/": "runs",
    "tests/system/": "systems",
    "tests/interop/": "interop",
    "tests/spec/": "programs",
    "tests/docs/": "programs",
}
"""Folders whose tests start many processes, and the queue that they share, because parallel ones would only wait for
each other.

The tests of a queue mostly wait for plants that run in real time. All queues begin at once, each in its own process, because the
run would otherwise wait for the last of them at its end; the sixth process begins with the other tests, which compute.
"""
QUEUES = list(dict.fromkeys(LINES.values()))
KILLS = "tests/system/failures/test_hundred_kills.py"
"""Each of its tests takes minutes, and they share nothing."""


def are_long(config: pytest.Config) -> bool:
    """Return whether only the long tests were selected."""
    return str(config.getoption("markexpr")).startswith("long")


def line_of(nodeid: str, long: bool) -> str:
    """Return the tests' group, which shares a process: a queue of `LINES`, or else the file.

    The long tests of systems are too many for one queue: any process may run any file of them.
    """
    file = nodeid.partition("::")[0]
    if long and file.startswith("tests/system/"):
        return nodeid if file == KILLS else file
    return next((queue for folder, queue in LINES.items() if file.startswith(folder)), file)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """In a process of pytest-xdist, put the groups that may take longest first, so that none of them runs alone at the end:
    the queues, then the files with the most tests. The time limit of a group of long tests stands for its duration.
    """
    if not hasattr(config, "workerinput"):
        return
    long = are_long(config)
    groups = {item: line_of(item.nodeid, long) for item in items}
    counts = Counter(groups.values())
    weights = {queue: float(len(QUEUES) - place) for place, queue in enumerate(QUEUES)}
    if long:
        weights = {}
        for item, group in groups.items():
            mark = item.get_closest_marker("timeout")
            weights[group] = max(weights.get(group, 0.0), float(mark.args[0]) if mark else 0.0)
    items.sort(key=lambda item: (-weights.get(groups[item], 0.0), -counts[groups[item]], groups[item]))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Distribute tests over the processes of pytest-xdist in the order of the collection: each queue in one process, one test
    after the other, and all other tests file by file, so that fixtures of a file are created once.

    The marker `xdist_group` cannot be used: pytest 9.2 no longer lets xdist 3.8 change the id of a test, so tests run
    in any process.
    """
    from xdist.scheduler import LoadScopeScheduling

    class Lines(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return line_of(nodeid, are_long(config))

    config.option.loadscopereorder = False
    return Lines(config, log)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Tests marked `socketcan` need a kernel with CAN and the interface vcan0; scripts/test-vcan provides both."""
    if item.get_closest_marker("socketcan") and not Path("/sys/class/net/vcan0").exists():
        pytest.skip("no vcan0 here: scripts/test-vcan runs this")
