"""A trace of variables in a run in virtual time."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.plc.runtime.runner import TaskEntry
from fieldtwin.plc.runtime.tracing import RunnerTrace
from fieldtwin.plc.runtime.variable_trace import TraceSize, VariableTrace
from fieldtwin.run.virtual.group_kinds import VirtualSystems
from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun


class TracedRun(VirtualRun):
    """A run of one system that records variables after each scan. It executes every scan, so that each has its row."""

    def __init__(self, options: VirtualOptions, names: Sequence[str], size: TraceSize, when: str = "") -> None:
        super().__init__(options)
        if len(self.group.members) != 1:
            raise UsageError("a trace of several systems", expected="the file of one system", got=options.system)
        self._make: Callable[[VirtualSystems], RunnerTrace] = lambda running: RunnerTrace(
            next(iter(running.systems.values())).run.plc, names, size, when
        )
        self.recorded: VariableTrace | None = None

    def attach(self, running: VirtualSystems) -> None:
        plc = next(iter(running.systems.values())).run.plc
        made = self._make(running)
        self.recorded = made.trace
        plc.execute_every_scan()

        def after(entry: TaskEntry) -> None:
            made.after_scan(entry, entry.task.began_ns)

        plc.on_scan = after
        super().attach(running)
