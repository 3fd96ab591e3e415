"""A runner of the pytest plugin and one of its devices, for tests that do not go through the plugin's own fixtures."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from fieldtwin.testing.handles import DeviceHandle
from fieldtwin.testing.runner import WorkerProcess


@contextmanager
def started_runner() -> Iterator[WorkerProcess]:
    """Yield a runner whose threads run already, so that the thread check of a test does not report them."""
    runner = WorkerProcess()
    runner.call("hello")
    yield runner
    runner.close()


@contextmanager
def emulated(runner: WorkerProcess, profile: str, **asked: Any) -> Iterator[DeviceHandle]:
    """Yield an emulated device of `profile`; `asked` has the other arguments of the runner's call `device`."""
    answer = runner.call("device", device=profile, **asked)
    yield DeviceHandle(runner, answer["id"], "device", answer)
    runner.call("end", id=answer["id"])
