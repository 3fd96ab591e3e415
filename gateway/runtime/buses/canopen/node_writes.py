"""Pending writes to one CANopen node: RPDOs with their newest values, and a queue of SDO downloads.

Values that are written together go in one frame. Process data is never queued: a newer value replaces an older one, and both
callers get the result of the same frame. The caller decides which values to write, and checks whether writing is allowed.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S, Clock
from fieldtwin.gateway.core.errors import ConnectionLost, FieldtwinError, ReplyTimeout, Unreachable
from fieldtwin.gateway.core.values import COMMAND
from fieldtwin.gateway.devices.canopen_device import CanopenDriver
from fieldtwin.gateway.devices.canopen_rpdo import Rpdo
from fieldtwin.gateway.runtime.buses.bus import Ended, not_sent

Done = Callable[[FieldtwinError | None], None]
"""A function that is called once with the result of a write: None, or the error."""
Write = Callable[[CanopenDriver, str, COMMAND, Done], None]
"""A function that starts the write of one tag."""


@dataclass
class _Staged:
    """The values for an RPDO's next frame, and the callbacks that wait for it."""

    values: dict[str, bytes] = field(default_factory=dict)
    waiting: list[Done] = field(default_factory=list)


class NodeWrites:
    """The pending writes to the node of `driver`. `timeout_s` limits the time for the bus to accept a frame.

    The caller starts a write of a tag only when the previous write of that tag has ended. So there are never more pending writes
    than the node has tags.
    """

    def __init__(self, driver: CanopenDriver, clock: Clock, timeout_s: float) -> None:
        self.frames = self.not_sent = 0
        """Counters of the RPDOs that were sent, and of the repetitions that the bus did not accept."""
        self._driver = driver
        self._clock = clock
        self._timeout_s = timeout_s
        self._staged: dict[Rpdo, _Staged] = {}
        self._downloads: deque[tuple[COMMAND, Done]] = deque()
        self._repeat_ns: dict[Rpdo, int] = {}
        self._rpdo_wake, self._download_wake = asyncio.Event(), asyncio.Event()

    def write(self, tag: str, command: COMMAND, done: Done) -> None:
        """Start one write, by RPDO if the tag has one."""
        rpdo = self._driver.rpdo_of(tag)
        if rpdo is None:
            self._downloads.append((command, done))
            self._download_wake.set()
        else:
            staged = self._staged.setdefault(rpdo, _Staged())
            staged.values[tag] = command.data
            staged.waiting.append(done)
            self._rpdo_wake.set()

    def fail(self, error: FieldtwinError) -> None:
        """End all pending writes with `error`, because the node or the bus was lost."""
        waiting = [done for staged in self._staged.values() for done in staged.waiting]
        waiting += [done for _, done in self._downloads]
        self._staged.clear()
        self._downloads.clear()
        self._repeat_ns.clear()
        for done in waiting:
            done(error)

    # -- running --------------------------------------------------------------------------------------------------------

    async def run_downloads(self) -> None:
        """Carry out SDO downloads until cancelled; raises `ConnectionLost`."""
        while True:
            await self._download_wake.wait()
            self._download_wake.clear()
            while self._downloads:
                command, done = item = self._downloads[0]
                error: FieldtwinError | None = None
                self._driver.consumer.observe(command)
                try:
                    await self._driver.send()
                except ConnectionLost:
                    raise  # `fail` reports it to every caller
                except FieldtwinError as e:
                    error = e
                finally:
                    self._driver.consumer.queue.clear()  # a failed command must not be repeated ahead of a newer command
                if self._downloads and self._downloads[0] is item:  # otherwise `fail` has already ended this write
                    self._downloads.popleft()
                    done(error)

    async def run_rpdos(self) -> None:
        """Send RPDOs that changed, and those that are repeated, until cancelled; raises `ConnectionLost`."""
        while True:
            self._rpdo_wake.clear()
            for rpdo in list(self._staged):
                await self._send(rpdo)
            await self._repeat()
            if not self._staged:
                await self._sleep()

    async def _send(self, rpdo: Rpdo) -> None:
        staged = self._staged[rpdo]
        values, waiting = dict(staged.values), len(staged.waiting)
        error = await self._put_on_bus(rpdo, values)
        if self._staged.get(rpdo) is not staged:
            return  # the node was lost meanwhile, and `fail` has reported it to every caller
        ended, staged.waiting = staged.waiting[:waiting], staged.waiting[waiting:]
        staged.values = {tag: data for tag, data in staged.values.items() if values.get(tag) != data}
        if not staged.waiting:
            del self._staged[rpdo]
        for done in ended:
            done(error)

    async def _put_on_bus(self, rpdo: Rpdo, values: dict[str, bytes]) -> FieldtwinError | None:
        """Send an RPDO and return the error, or None. Nothing is sent to a node that would not accept it."""
        if not self._driver.operational or rpdo not in self._driver.rpdos:
            return Unreachable(
                "the node is not OPERATIONAL: it accepts no process data", where=self._driver.config.where
            )
        try:
            async with asyncio.timeout(self._timeout_s):
                await self._driver.send_rpdo(rpdo, values)
        except TimeoutError:
            return ReplyTimeout("the bus accepts no frames", where=self._driver.config.where)
        except ConnectionLost:
            raise
        except FieldtwinError as e:
            return e
        self.frames += 1
        if rpdo.repeat_ms:
            self._repeat_ns[rpdo] = self._clock.monotonic_ns() + rpdo.repeat_ms * NS_PER_MS
        return None

    async def _repeat(self) -> None:
        """Repeat RPDOs that have not changed for their event time: a node may monitor its RPDOs (1400h:05)."""
        now_ns = self._clock.monotonic_ns()
        for rpdo in [r for r, due_ns in self._repeat_ns.items() if due_ns <= now_ns]:
            if rpdo not in self._driver.rpdos or not self._driver.operational:
                del self._repeat_ns[rpdo]  # the repetition starts again with the next change
            elif await self._put_on_bus(rpdo, {}) is not None:
                self.not_sent += 1
                self._repeat_ns[rpdo] = now_ns + rpdo.repeat_ms * NS_PER_MS

    async def _sleep(self) -> None:
        due_ns = min(self._repeat_ns.values(), default=None)
        left_s = None if due_ns is None else max(0.0, (due_ns - self._clock.monotonic_ns()) / NS_PER_S)
        try:
            async with asyncio.timeout(left_s):
                await self._rpdo_wake.wait()
        except TimeoutError:
            pass  # an RPDO is due for repetition


class InOrder:
    """A sequence of writes to one node: tags that share an RPDO are written together, the others one after another.

    After a failed write the remaining tags are not sent; their error is `HeldBack`. `write` starts one write."""

    def __init__(
        self, driver: CanopenDriver, writes: Sequence[tuple[str, COMMAND]], write: Write, ended: Ended
    ) -> None:
        self._driver = driver
        self._write = write
        self._ended = ended
        self._steps: list[list[tuple[str, COMMAND]]] = []
        frames: dict[Rpdo, list[tuple[str, COMMAND]]] = {}
        for tag, command in writes:
            rpdo = driver.rpdo_of(tag)
            step = frames.get(rpdo) if rpdo is not None else None
            if step is None:
                self._steps.append(step := [])
                if rpdo is not None:
                    frames[rpdo] = step
            step.append((tag, command))
        self._open = 0
        self._error: FieldtwinError | None = None

    def next(self) -> None:
        """Start the next step, or end the remaining steps after a failure."""
        if self._error is not None:
            rest, self._steps = self._steps, []
            for tag, _ in (item for step in rest for item in step):
                self._ended(tag, not_sent(self._driver.config.where))
        elif self._steps:
            step = self._steps.pop(0)
            self._open = len(step)
            for tag, command in step:
                self._write(self._driver, tag, command, partial(self._done, tag))

    def _done(self, tag: str, error: FieldtwinError | None) -> None:
        self._error = self._error or error
        self._ended(tag, error)
        self._open -= 1
        if not self._open:
            self.next()
