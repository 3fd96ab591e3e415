"""Variables of programs in the trace of a run in virtual time: an event for each scan that changes one of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.image.image import OUTPUTS
from fieldtwin.plc.runtime.runner import TaskEntry
from fieldtwin.plc.runtime.tracing import RunnerTrace
from fieldtwin.plc.runtime.variable_trace import MAX_VARIABLES, TracedVariable, TraceSize
from fieldtwin.results.trace import TraceKind
from fieldtwin.run.benches.virtual_bench import VirtualBench
from fieldtwin.run.virtual.group_kinds import VirtualSystems


class RecordedVariables:
    """The variables `names` of a run of one system, named as `fieldtwin plc trace` names them.

    A published variable is in the trace anyway. The PLC executes every scan, so that each change is an event.
    Raises `UsageError` for unknown names, and for too many.
    """

    def __init__(self, running: VirtualSystems, names: Sequence[str]) -> None:
        if len(names) > MAX_VARIABLES:
            raise UsageError("too many variables", expected=f"at most {MAX_VARIABLES}", got=str(len(names)))
        if len(running.systems) != 1:
            raise UsageError("variables of several systems", expected="the file of one system")
        self._bench: VirtualBench = next(iter(running.systems.values()))
        plc = self._bench.run.plc
        published = {tag.name for region in plc.regions if region.name == OUTPUTS for tag in region.tags}
        by_program: dict[str, list[str]] = {}
        for name in dict.fromkeys(names):
            if name not in published:
                by_program.setdefault(name.partition(".")[0], []).append(name)
        self._traces = [RunnerTrace(plc, some, TraceSize(1)) for some in by_program.values()]
        self._values: dict[str, Any] = {}
        plc.execute_every_scan()
        plc.on_scan = self._after_scan

    @property
    def variables(self) -> list[TracedVariable]:
        """Return the variables that are not in the trace anyway."""
        return [one for made in self._traces for one in made.trace.variables]

    def _after_scan(self, entry: TaskEntry) -> None:
        for made in self._traces:
            made.after_scan(entry, entry.task.began_ns)
            for row in made.trace.rows:
                for one, value in zip(made.trace.variables, row.values, strict=True):
                    known = self._values.get(one.name)
                    if known != value or type(known) is not type(value) or one.name not in self._values:
                        self._values[one.name] = value
                        self._bench.note(TraceKind.STATE, one.name, {"value": value})
