"""A running PLC, with its gateway, connected to a field simulator: its tags, states and variables; forces, single scans.

This module imports only the standard library, see `fieldtwin.testing.runner`.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from fieldtwin.gateway.core.files.nearest import nearest
from fieldtwin.testing.runner import WorkerProcess

POLL_S = 0.02
WITHIN_S = 10.0


class RunningPlc:
    """A running PLC.

    ``plc["relay.state"]`` is the current value of a program's variable or a device's tag; a state is given by its name. The PLC
    runs in real time; `wait` waits for a value. Commands of a test are recorded like commands of a user, under the name ``test``.
    """

    def __init__(self, runner: WorkerProcess, bench: int, profiles: Sequence[str] = ()) -> None:
        self._runner = runner
        self._bench = bench
        self.names: tuple[str, ...] = tuple(runner.call("control", id=bench, profiles=list(profiles))["names"])

    def tag(self, name: str) -> dict[str, Any]:
        """Return ``value``, ``quality``, ``reason``, ``age_s``, ``unit``, ``forced`` and ``side`` (input or output) of a tag."""
        __tracebackhide__ = True
        if name not in self.names:
            near = nearest(name, self.names, most=3) or self.names[:10]
            raise KeyError(f"no tag or variable {name!r}; there are {', '.join(near)}")
        row: dict[str, Any] = self._runner.call("image", id=self._bench, tag=name)
        return row

    def __getitem__(self, name: str) -> Any:
        __tracebackhide__ = True
        return self.tag(name)["value"]

    def quality(self, name: str) -> str:
        """Return the quality of a tag: ``good``, ``substituted``, ``simulated``, ``uncertain`` or ``bad``."""
        __tracebackhide__ = True
        return str(self.tag(name)["quality"])

    def wait(self, name: str, value: Any = ..., *, quality: str = "", within_s: float = WITHIN_S) -> Any:
        """Wait until the tag has `value`, or `quality`, or both, and return its value.

        Raises `AssertionError` with the current value after `within_s` seconds.
        """
        __tracebackhide__ = True
        until = time.monotonic() + within_s
        while True:
            row = self.tag(name)
            if (value is ... or row["value"] == value) and quality in ("", row["quality"]):
                return row["value"]
            if time.monotonic() >= until:
                wanted = " and ".join([f"{value!r}"] * (value is not ...) + [f"of quality {quality!r}"] * bool(quality))
                raise AssertionError(
                    f"{name} should become {wanted} within {within_s:g} s; it is {row['value']!r}, {row['quality']}"
                )
            time.sleep(POLL_S)

    def send(self, period_s: int) -> None:
        """Send a command with a sample period (s) at the remote end of the system's transmitter, as `fieldtwin topside` does."""
        __tracebackhide__ = True
        self._runner.call("send", id=self._bench, period_s=period_s)

    @contextmanager
    def force(self, tag: str, value: float | str | bool) -> Iterator[None]:
        """Force a tag: ``with plc.force("ctd.pressure", 3.5):``.

        Programs see that value with the quality ``simulated``; the forced value of an output is sent.
        """
        self._steer("force", tag=tag, value=value)
        try:
            yield
        finally:
            self._steer("unforce", tag=tag)

    def pause(self) -> None:
        """Stop executing scans until `go`; outputs keep their values."""
        self._steer("pause")

    def step(self, scans: int = 1) -> None:
        """Run `scans` scans while paused."""
        self._steer("step", count=scans)

    def go(self) -> None:
        self._steer("go")

    def restart(self, *, cold: bool = False) -> None:
        """Create the PLC's programs again, with their retained values; `cold` discards these."""
        self._steer("restart", cold=cold)

    def why(self, tag: str) -> list[dict[str, Any]]:
        """Return the last changes of a tag: the program, the time, and the inputs that it used."""
        __tracebackhide__ = True
        changes: list[dict[str, Any]] = self._steer("why", tag=tag)["changes"]
        return changes

    def _steer(self, command: str, **args: Any) -> dict[str, Any]:
        __tracebackhide__ = True
        answer: dict[str, Any] = self._runner.call("steer", id=self._bench, do=command, args=args)
        return answer
