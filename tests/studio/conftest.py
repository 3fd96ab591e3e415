"""One server with the observatory's prototype for all tests of a process, because it takes seconds to start."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from studio_rig import Studio, studio

HERE = Path(__file__).parent
RUNNING = ExitStack()
STARTED: list[Studio] = []


@pytest.fixture(scope="module")
def observatory() -> Studio:
    """A running Studio that has started the observatory's prototype. Its tests share it."""
    if not STARTED:
        STARTED.append(RUNNING.enter_context(studio("observatory")))
    return STARTED[0]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> Iterator[None]:
    """Stop the server after the last test of this folder.

    The process may have tests of other folders left for minutes, and a plant that runs in real time takes a sixth of a processor.
    """
    yield
    if nextitem is None or not nextitem.path.is_relative_to(HERE):
        STARTED.clear()
        RUNNING.close()
