"""A run in virtual time that a caller advances step by step, setting values of devices and reading tags between two steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import msgspec

from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.values import Quality
from fieldtwin.plc.cycle.task import StopReason
from fieldtwin.run.benches.virtual_bench import VirtualBench
from fieldtwin.run.fmu_export.interface import FmuPort
from fieldtwin.run.virtual.run import PIECE_S, VirtualOptions, VirtualRun
from fieldtwin.scenarios.bench import Bench

Value = float | int | bool | str


class Advance(msgspec.Struct, frozen=True):
    """A step: the values of devices from now on (None: the device's own value), and the time in ns since the start at which it
    ends.
    """

    until_ns: int
    set: dict[str, float | None]


class Shown(msgspec.Struct, frozen=True):
    """The outputs at the end of a step: value and whether it is good, in the order of the ports. The value is None until it
    has been good once.
    """

    values: list[Value | None]
    good: list[bool]


class SteppedRun(VirtualRun):
    """A run of one system. ``next_step(shown)`` gets the outputs and returns the next step, or None to end the run.

    All events of the instant at which a step ends have happened when the outputs are read. Without set values, the events
    before the last instant are those of `VirtualRun` with the same options, however the time is divided into steps.
    """

    def __init__(
        self, options: VirtualOptions, outputs: Sequence[FmuPort], next_step: Callable[[Shown], Advance | None]
    ) -> None:
        super().__init__(options)
        if self.group.kind:
            raise UsageError("an FMU of several systems", expected="one system", got=options.system)
        self._outputs = outputs
        self._next_step = next_step
        self._values: list[Value | None] = [None] * len(outputs)
        self._shown: Shown | None = None
        self._step: Advance | None = None

    def run_steps(self) -> None:
        """Run until `next_step` returns None. Raises what `VirtualRun.run` raises."""
        self.run(self._paused)

    def _paused(self, elapsed_s: float) -> None:
        """Ask for the next step. The loop has stopped, so the caller may wait here."""
        if self._shown is not None:
            shown, self._shown = self._shown, None
            self._step = self._next_step(shown)

    async def _through(self, bench: Bench, loop: VirtualLoop, judge: Callable[[], None]) -> None:
        assert isinstance(bench, VirtualBench)
        while True:
            self._shown = self._read(bench)
            await self.pause(loop)
            step = self._step
            if step is None:
                return
            for name, value in step.set.items():
                device, _, tag = name.partition(".")
                await bench.set_value(device, tag, value)
            until_s = step.until_ns / NS_PER_S
            while (left_s := until_s - bench.now_s()) > 0:
                await bench.sleep_until_s(bench.now_s() + min(left_s, PIECE_S))
                self.elapsed_s = bench.now_s()
                judge()
            await loop.sleeper(loop.now_ns)  # the other events of this instant come first

    def _read(self, bench: VirtualBench) -> Shown:
        tags, now_ns = bench.run.gateway.tags, bench.loop.now_ns
        variables = bench.run.plc.outputs.last()
        plc_runs = bench.run.plc.stop_reason is StopReason.NONE
        good = []
        for place, port in enumerate(self._outputs):
            if port.of_plc:
                value = variables.get(port.source)
                is_good = plc_runs and value is not None
            else:
                seen = tags.current(port.source, now_ns)
                value, is_good = seen.value, seen.quality is Quality.GOOD
            if isinstance(value, float) and not math.isfinite(value):
                is_good = False
            if is_good:
                self._values[place] = value.hex() if isinstance(value, bytes) else value
            good.append(is_good)
        return Shown(list(self._values), good)
