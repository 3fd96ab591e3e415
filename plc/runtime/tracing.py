"""The traces of a running PLC: the commands of the control channel that begin, read and end them.

A trace belongs to the client that reads it. One that no client has read for `KEPT_NS` is removed, because it takes time in each
scan. Values are those after a scan, before the next one begins.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.image.image import INPUTS, OUTPUTS
from fieldtwin.plc.program import Program
from fieldtwin.plc.runtime.runner import TaskEntry, TaskRunner
from fieldtwin.plc.runtime.variable_trace import Traced, TracedVariable, TraceSize, VariableTrace

MAX_TRACES = 4
KEPT_NS = 30 * NS_PER_S
_TEXTS = ("STRING", "WSTRING", "ARRAY", "CHAR", "WCHAR")


class RunnerTrace:
    """A trace of variables of the programs of a runner, named as `fieldtwin plc watch` names them.

    `when` is a condition in Structured Text in the scope of the program `of`: that of the first variable that has one.
    Raises `UsageError` for unknown names, a condition that is not valid, and a trace that would be too large.
    """

    def __init__(self, runner: TaskRunner, names: Sequence[str], size: TraceSize, when: str = "") -> None:
        self._runner, self._names, self._when = runner, tuple(names), when
        self._programs = runner.programs
        self._sources = self._resolved()
        self._trigger = self._condition() if when else None
        variables = [
            TracedVariable(name, one.type, self._reading(n), one.unit, one.type.startswith(_TEXTS))
            for n, (name, one) in enumerate(zip(names, self._sources, strict=True))
        ]
        self._scan = runner.entries[self._task()].scan.number
        self.trace = VariableTrace(variables, size, self._fulfilled if when else None)

    def after_scan(self, entry: TaskEntry, t_ns: int) -> None:
        """Record the values if this was a scan of the task that executes the first traced program."""
        if self._runner.programs is not self._programs:
            self._follow_restart()
        if entry is self._runner.entries[self._task()] and entry.scan.number != self._scan:
            self._scan = entry.scan.number
            self.trace.record(t_ns, entry.scan.number)

    def _follow_restart(self) -> None:
        """Read from the programs that were created after a restart."""
        self._programs = self._runner.programs
        self._sources = self._resolved()
        self._trigger = self._condition() if self._when else None

    def _reading(self, n: int) -> Callable[[], Traced]:
        def read() -> Traced:
            try:
                return self._sources[n].read()
            except (AttributeError, IndexError):  # an online change removed it
                return None

        return read

    def _fulfilled(self) -> bool:
        return self._trigger is not None and self._trigger()

    def _task(self) -> int:
        owner = self._owner()
        names = [p.task for p in self._runner.config.programs if p.name == owner]
        return next((n for n, e in enumerate(self._runner.entries) if names and e.spec.name == names[0]), 0)

    def _owner(self) -> str:
        """Return the name of the program of the first variable that belongs to one; "" if all are inputs."""
        programs = {bound.name for bound in self._runner.programs}
        return next((name.partition(".")[0] for name in self._names if name.partition(".")[0] in programs), "")

    def _condition(self) -> Callable[[], bool]:
        owner = self._owner()
        program = next((b.program for b in self._runner.programs if b.name == owner), None)
        if program is None:
            raise UsageError("a condition on variables", expected="a variable of a program among those traced")
        return _condition(program, self._when)

    def _resolved(self) -> list[TracedVariable]:
        return [self._variable(name) for name in self._names]

    def _variable(self, name: str) -> TracedVariable:
        runner = self._runner
        program, _, path = name.partition(".")
        for bound in runner.programs:
            if bound.name == program and (found := bound.program.variable_reader(path)) is not None:
                return TracedVariable(name, found.type, found.read, found.unit)
        specs = {region.name: {tag.name: tag for tag in region.tags} for region in runner.regions}
        if (spec := specs[INPUTS].get(name)) is not None:
            return TracedVariable(name, spec.kind.value, lambda: runner.input(name).value, spec.unit)
        if (spec := specs[OUTPUTS].get(name)) is not None:
            return TracedVariable(name, spec.kind.value, lambda: runner.outputs.last().get(name), spec.unit)
        known = [*specs[INPUTS], *specs[OUTPUTS], *self._internal(program)]
        raise UsageError(
            f"no variable {name!r} that can be traced",
            expected="one that `fieldtwin plc watch` lists",
            hint=did_you_mean(name, known),
        )

    def _internal(self, program: str) -> list[str]:
        programs: dict[str, Program] = {bound.name: bound.program for bound in self._runner.programs}
        return [f"{program}.{path}" for path in programs[program].internal_names()] if program in programs else []


def _condition(program: Program, text: str) -> Callable[[], bool]:
    """Return a function that evaluates a condition on the variables of a program. Raises `UsageError` if it is not valid."""
    from fieldtwin.plc.debug.expressions import compile_expression  # the compiler, which not every PLC needs
    from fieldtwin.plc.st import types as ty
    from fieldtwin.plc.st.program import StProgram

    if not isinstance(program, StProgram):
        raise UsageError(
            "a condition on variables", expected="a program in Structured Text", got=type(program).__name__
        )
    expression = compile_expression(program.st_unit, program.st_declared.name.lower(), text, ty.BOOL)
    resource = program.st_resource
    return lambda: bool(expression.value(resource.space, {"self": program.st_body, "_G": resource.globals}))


@dataclass
class _Kept:
    of: RunnerTrace
    read_ns: int
    """When a client last read it (monotonic)."""


class Traces:
    """The traces of one PLC process. `now_ns` returns its monotonic time."""

    def __init__(self, runner: TaskRunner, now_ns: Callable[[], int]) -> None:
        self._runner, self._now_ns = runner, now_ns
        self._traces: dict[int, _Kept] = {}
        self._number = 0

    async def begin(self, args: dict[str, Any]) -> dict[str, Any]:
        """Begin the trace of the variables ``names``, with ``before`` and ``after`` scans and the condition ``when``."""
        names = args.get("names")
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise UsageError("which variables", expected='a list such as ["pump.timer.ET"]', got=repr(names)[:80])
        sizes = [args.get("before", 0), args.get("after", 0)]
        if not all(type(size) is int for size in sizes):
            raise UsageError("the scans of a trace", expected="whole numbers", got=repr(sizes)[:80])
        self._remove_old()
        if len(self._traces) >= MAX_TRACES:
            raise UsageError("too many traces", expected=f"at most {MAX_TRACES} at a time", hint="end another trace")
        made = RunnerTrace(self._runner, names, TraceSize(*sizes), str(args.get("when", "")))
        self._number += 1
        self._traces[self._number] = _Kept(made, self._now_ns())
        self._runner.on_scan = self._after_scan
        variables = [{"name": v.name, "type": v.type, "unit": v.unit} for v in made.trace.variables]
        return {"number": self._number, "variables": variables, **made.trace.describe()}

    async def read(self, args: dict[str, Any]) -> dict[str, Any]:
        """Return the state of a trace, and its rows from the number ``since`` on, a limited number at a time."""
        kept = self._kept(args)
        since = args.get("since", 0)
        kept.read_ns = self._now_ns()
        rows = kept.of.trace.since(since if type(since) is int else 0)
        return {
            **kept.of.trace.describe(),
            "now_ns": kept.read_ns,
            "rows": [[row.number, row.scan, row.t_ns, *row.values] for row in rows],
        }

    async def end(self, args: dict[str, Any]) -> dict[str, Any]:
        """Remove a trace."""
        self._kept(args)
        del self._traces[args["number"]]
        self._forget_if_none()
        return {}

    def _kept(self, args: dict[str, Any]) -> _Kept:
        found = self._traces.get(args.get("number", 0))
        if found is None:
            hint = f"a trace ends if it is not read for {KEPT_NS // NS_PER_S} s"
            raise UsageError("there is no such trace", got=repr(args.get("number"))[:40], hint=hint)
        return found

    def _after_scan(self, entry: TaskEntry) -> None:
        self._remove_old()
        for number, kept in list(self._traces.items()):
            try:
                kept.of.after_scan(entry, entry.task.began_ns)
            except UsageError:  # a restart removed one of its variables
                del self._traces[number]
        self._forget_if_none()

    def _remove_old(self) -> None:
        now_ns = self._now_ns()
        for number in [n for n, kept in self._traces.items() if now_ns - kept.read_ns > KEPT_NS]:
            del self._traces[number]

    def _forget_if_none(self) -> None:
        if not self._traces:
            self._runner.on_scan = None
