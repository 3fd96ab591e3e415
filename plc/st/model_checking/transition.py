"""One scan of a program as a relation between its inputs, its state before, and its state afterwards.

The compiled program itself is executed symbolically (decision 0063): Structured Text is not translated a second time.
Every variable is first limited to an interval. The intervals begin with the initial values, and grow until no scan leaves them,
so they hold in every reachable state and help induction.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import z3

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.blocks.timers import TP, _Timer
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.pous.programs import connection
from fieldtwin.plc.st.model_checking.execution import floats
from fieldtwin.plc.st.model_checking.execution.evaluation import Failure
from fieldtwin.plc.st.model_checking.execution.interpreter import Interpreter
from fieldtwin.plc.st.model_checking.execution.mailboxes import (
    LATEST_NS,
    MOST_MESSAGES,
    Evaluation,
    Mailbox,
    Model,
    Outgoing,
    modelled,
)
from fieldtwin.plc.st.model_checking.execution.memory import Memory
from fieldtwin.plc.st.model_checking.execution.merging import merged, options_of
from fieldtwin.plc.st.model_checking.execution.operations import binary, extreme, truth
from fieldtwin.plc.st.model_checking.execution.refusal import NotModelled
from fieldtwin.plc.st.model_checking.execution.sources import Sources
from fieldtwin.plc.st.model_checking.execution.symbolic import (
    UNDEFINED,
    Choice,
    Condition,
    as_condition,
    both,
    compare,
    either,
    is_integer,
    negated,
    subtract,
)
from fieldtwin.plc.st.model_checking.state import Domain, Leaf, integer, leaves, objects
from fieldtwin.plc.st.model_checking.terms import Relaxed
from fieldtwin.plc.st.program import StProgram
from fieldtwin.plc.st.runtime.parts import assign
from fieldtwin.plc.st.syntax.tree import Pos

_START = "_since_ns"
"""The variable that holds the start of a timer."""
LONGEST_NS = 2**63
"""Times further in the past count as this distance in ns, which is longer than any TIME."""
_ROUNDS = 200
_EXACT_GROWTHS = 4
"""How often an interval grows to the values that were found. After that it grows to the next of `_BOUNDS`."""
_ASK_MS = 3000
_BOUNDS = sorted({0, 1, 255, 65535, *(2**n - 1 for n in (7, 15, 31, 32, 40, 48, 56, 63, 64, 66))})
HIDDEN = "0check"
"""The beginning of the names of variables and actions that are added to a program for its properties."""


def action_of(key: str) -> str:
    """Return the action that evaluates an expression and assigns it to the variable `key`."""
    return f"{key}_action"


@dataclass
class Context:
    """The running scan, as compiled code uses it. The scan's own time is 0, and earlier times are negative.

    `scan_ns` is the time of the clock, for SCAN_TIME().
    """

    first_scan: Any = True
    now_ns: int = 0
    scan_ns: Any = 0
    reads_times: bool = False
    """Whether the program reads times of messages."""
    qualities: dict[str, Any] = field(default_factory=dict)
    """By input whose quality the program asks for: whether it is good."""

    def is_good(self, name: str) -> Any:
        return self.qualities.setdefault(name, z3.Bool(f"{name} is good"))

    def number(self) -> int:
        """Return the number of a new instance, which nothing depends on: interface types have no model."""
        return 0

    @modelled
    def message(self, x: Evaluation, box: Mailbox, number: Any) -> Any:
        return box.message(x, number, timed=self.reads_times)

    def __getattr__(self, name: str) -> Any:
        raise NotModelled(name)


@dataclass(frozen=True)
class InputSymbol:
    """An input, or the time since the scan before: its symbolic value, and the condition that limits it."""

    name: str
    value: Any
    limited: Any


@dataclass(frozen=True)
class Transition:
    """One scan. All expressions are over `state` and `inputs`, which are variables of Z3.

    `limited` holds for the variables of the state, `assumed` for the inputs (and the state before); `fails` is true if the scan
    ends with an error. `properties` are evaluated after the scan, in the order in which they were given.
    """

    state: tuple[Any, ...]
    names: tuple[str, ...]
    initial: tuple[Any, ...]
    following: tuple[Any, ...]
    limited: Any
    inputs: tuple[Any, ...]
    symbols: tuple[InputSymbol, ...]
    qualities: Mapping[str, Any]
    assumed: Any
    fails: Any
    failures: tuple[Failure, ...]
    properties: tuple[Any, ...]
    initially: tuple[Any, ...]
    """The properties in the initial state, before the first scan."""
    first: Any
    """The variable that is true in the first scan; None if it is constant."""
    unknowns: tuple[tuple[str, Pos], ...]
    """Operations whose results may have any value, with their places."""


Call = tuple[Sequence[Any], str]
"""The objects whose expression is evaluated (a program, or the instances of a function block), and its variable."""


class Builder:
    """Builds the transition of a program whose unit has actions for its assumptions and properties.

    `interval_ns`: the shortest and the longest time between two scans.
    """

    def __init__(self, program: StProgram, interval_ns: tuple[int, int]) -> None:
        self._program, self._interval_ns = program, interval_ns
        self._resource = program.st_resource
        self._context = Context(reads_times=").t_ns" in program.st_unit.python)
        self._resource.space["_c"] = self._context
        self._resource.space["_G"] = self._resource.globals
        self._sources = Sources(program.st_unit, self._resource.space)
        self._inputs = self._input_symbols()
        for v in program.st_declared.variables:
            if isinstance(v.kind, ty.MessagesOut):
                program.st_assign(v, Outgoing(v.kind.max_bytes, v.kind.depth))
        self._input_places = [
            (v.name, program.st_holder(v), v.attribute) for v in program.st_declared.variables if v.role == "input"
        ]
        self._mailboxes = {v.name for v in program.st_declared.variables if isinstance(v.kind, ty.MessagesIn)}
        inputs = {(id(holder), attribute) for _, holder, attribute in self._input_places}
        roots = ((program.st_body, ""), (self._resource.globals, "global"))
        self._leaves = [Leaf(self._context, "first_scan", "first scan")]
        self._clock = Leaf(self._context, "scan_ns", "time of the clock") if self._resource.absolute else None
        if self._clock is not None:
            self._leaves.append(self._clock)
        for root, name in roots:
            self._leaves += [
                leaf
                for leaf in leaves(root, name)
                if (id(leaf.owner), leaf.key) not in inputs
                and not str(leaf.key).startswith(f"v_{HIDDEN}")
                and not isinstance(leaf.get(), Model)
            ]
        self._timers = [each for root, _ in roots for each in objects(root) if isinstance(each, _Timer)]
        self._initial = [leaf.get() for leaf in self._leaves]

    @property
    def body(self) -> Any:
        return self._program.st_body

    def build(self, assumptions: Sequence[Call], properties: Sequence[Call]) -> Transition:
        """Return the transition. Raises `FileInvalid` for a construct without a model."""
        domains = [self._joined(leaf, Domain(), value) for leaf, value in zip(self._leaves, self._initial, strict=True)]
        if self._clock is not None:
            domains[self._leaves.index(self._clock)] = Domain(low=0, high=LATEST_NS)
        growths = [0] * len(domains)
        for _ in range(_ROUNDS):
            scan = self._scan(domains, assumptions, ())
            grown = [
                self._grown(scan, leaf, domain, value, exact=count < _EXACT_GROWTHS)
                for leaf, domain, value, count in zip(self._leaves, domains, scan.after, growths, strict=True)
            ]
            if grown == domains:
                break
            growths = [n + (new != old) for n, new, old in zip(growths, grown, domains, strict=True)]
            domains = grown
        else:
            raise FileInvalid("the model does not settle", path=self._program.source_path)
        initially = self._initially(properties)
        return self._scan(domains, assumptions, properties).transition(self._initial, initially)

    def _grown(self, scan: _Scan, leaf: Leaf, domain: Domain, value: Any, exact: bool) -> Domain:
        """Return the domain of a leaf, extended by its values after the scan."""
        joined = self._joined(leaf, domain, value)
        if exact or domain.low is None or joined.low is None or domain.high is None or joined.high is None:
            return joined
        found = [(condition, o) for condition, o in options_of(value) if is_integer(o)]
        low, high = domain.low, domain.high

        def exceeded(op: str, bound: int) -> bool:
            return scan.possible(either(*(both(condition, compare(op, option, bound)) for condition, option in found)))

        if joined.high > high:
            bounds = (high, *(bound for bound in _BOUNDS if bound > high))
            high = next(bound for bound in bounds if bound >= joined.high or not exceeded(">", bound))
        if joined.low < low:
            bounds = (low, *(~bound for bound in _BOUNDS if ~bound < low))
            low = next(bound for bound in bounds if bound <= joined.low or not exceeded("<", bound))
        return joined.within(low, high)

    def _joined(self, leaf: Leaf, domain: Domain, value: Any) -> Domain:
        try:
            return domain.joined(Domain.of(value))
        except NotModelled as e:
            raise self._refused(NotModelled(f"{e.message}: {_written(leaf.name)}", e.hint), None) from e

    def _initially(self, properties: Sequence[Call]) -> tuple[Any, ...]:
        self._restore()
        interpreter = Interpreter(self._sources, Memory(), lambda condition: True)
        return tuple(as_condition(self._asked(interpreter, call)) for call in properties)

    def _restore(self) -> None:
        for leaf, value in zip(self._leaves, self._initial, strict=True):
            leaf.put(value)

    # -- inputs -----------------------------------------------------------------------------------------------------------

    def _input_symbols(self) -> list[InputSymbol]:
        low, high = self._interval_ns
        if self._resource.absolute:  # the time before the first scan is that of the clock
            low, high = 0, LATEST_NS
        found = [InputSymbol("", *integer("time since the scan before", low, high))]
        for v in self._program.st_declared.variables:
            if isinstance(v.kind, ty.MessagesIn):
                found.append(InputSymbol(v.name, *integer(v.name, 0, MOST_MESSAGES)))
            elif v.role == "input":
                found.append(InputSymbol(v.name, *_input(v.name, v.kind)))
        return found

    # -- a scan -----------------------------------------------------------------------------------------------------------

    def _scan(self, domains: Sequence[Domain], assumptions: Sequence[Call], properties: Sequence[Call]) -> _Scan:
        """Execute a scan from a state in which each leaf has any value of its domain."""
        symbols = [domain.symbol(leaf.name) for leaf, domain in zip(self._leaves, domains, strict=True)]
        self._context.qualities.clear()
        self._limit_time(symbols[0].value)
        limited = [*(s.limited for s in symbols), *(i.limited for i in self._inputs)]
        scan = _Scan(tuple(self._leaves), tuple(domains), tuple(symbols), tuple(self._inputs), both(*limited))
        interpreter = Interpreter(self._sources, Memory(), scan.possible)
        scan.interpreter = interpreter
        passed = self._inputs[0].value
        for leaf, symbol in zip(self._leaves, symbols, strict=True):
            leaf.put(_earlier(symbol.value, passed) if leaf.is_time else symbol.value)
        for each, (name, holder, attribute) in zip(self._inputs[1:], self._input_places, strict=True):
            assign(holder, attribute, Mailbox(each.value) if name in self._mailboxes else each.value)
        in_time = self._advance_clock(passed)
        try:
            scan.assumed = both(in_time, *(self._asked(interpreter, call) for call in assumptions))
            interpreter.failures.clear()
            self._execute(interpreter)
            for timer in self._timers:
                self._forget_start(interpreter, timer)
            scan.after = [leaf.get() for leaf in self._leaves]
            scan.after[0] = False
            scan.failures = tuple(interpreter.failures)
            scan.properties = [self._asked(interpreter, call) for call in properties]
        except NotModelled as e:
            raise self._refused(e, interpreter) from e
        finally:
            self._restore()
        scan.qualities = dict(self._context.qualities)
        scan.unknowns = tuple((made, what, self._sources.place(line)) for made, what, line in interpreter.unknowns)
        return scan

    def _limit_time(self, first: Any) -> None:
        """Limit the time since the scan before, for a program that uses SCAN_TIME: before the first scan it is any time."""
        passed = self._inputs[0]
        if self._clock is not None:
            low, high = self._interval_ns
            inside = both(compare("<=", low, passed.value), compare("<=", passed.value, high))
            any_time = both(compare("<=", 0, passed.value), compare("<=", passed.value, LATEST_NS))
            self._inputs[0] = InputSymbol(passed.name, passed.value, merged(first, any_time, inside))

    def _advance_clock(self, passed: Any) -> Condition:
        """Set the time of the clock, and return the condition that it can be represented."""
        if self._clock is None:
            return True
        now = binary("+", self._clock.get(), passed)
        in_time = compare("<=", now, LATEST_NS)
        self._clock.put(extreme("<", [now, LATEST_NS]))
        return in_time

    def _execute(self, interpreter: Interpreter) -> None:
        """Execute the program, and copy the variables that a configuration connects, as `StProgram.execute` does."""
        instance, kind = self._program.st_instance, type(self.body)
        if instance:
            interpreter.run(getattr(kind, connection(instance, into=True)), (self.body,))
        interpreter.run(kind.execute, (self.body,))
        if instance:
            interpreter.run(getattr(kind, connection(instance, into=False)), (self.body,))

    def _asked(self, interpreter: Interpreter, call: Call) -> Condition:
        """Return whether an action leaves TRUE in its variable, for each of its objects. An error in it counts as FALSE."""
        owners, key = call
        before = len(interpreter.failures)
        for owner in owners:
            interpreter.run(getattr(type(owner), f"a_{action_of(key)}"), (owner,))
        failed = either(*(failure.condition for failure in interpreter.failures[before:]))
        del interpreter.failures[before:]
        return both(*(truth(getattr(owner, f"v_{key}")) for owner in owners), negated(failed))

    def _forget_start(self, interpreter: Interpreter, timer: _Timer) -> None:
        """Forget the start of a timer that does not run any more, as `fieldtwin.plc.blocks.timers` does in its state."""
        runs = truth(interpreter.run(type(timer)._runs, (timer,)))
        forgotten = 0 if isinstance(timer, TP) else None
        setattr(timer, _START, merged(runs, getattr(timer, _START), forgotten))

    def _refused(self, error: NotModelled, interpreter: Interpreter | None) -> FileInvalid:
        pos = self._sources.place(interpreter.line) if interpreter is not None else None
        return FileInvalid(
            f"plc prove has no model of {error.message}",
            path=pos.path if pos else self._program.source_path,
            line=pos.line if pos else 0,
            column=pos.column if pos else 0,
            hint=error.hint,
        )


@dataclass
class _Scan:
    """A scan that was executed symbolically from a state within `domains`."""

    leaves: tuple[Leaf, ...]
    domains: tuple[Domain, ...]
    symbols: tuple[Any, ...]
    inputs: tuple[InputSymbol, ...]
    limited: Condition
    interpreter: Interpreter | None = None
    assumed: Condition = True
    after: list[Any] = field(default_factory=list)
    failures: tuple[Failure, ...] = ()
    properties: list[Condition] = field(default_factory=list)
    qualities: dict[str, Any] = field(default_factory=dict)
    unknowns: tuple[tuple[Any, str, Pos], ...] = ()
    _asked: Relaxed | None = None
    _excluded: int = 0
    """How many of the failures the question already excludes."""

    def possible(self, condition: Condition) -> bool:
        """Return whether `condition` can be true in a scan without an error; also if the solver finds no answer in time."""
        if isinstance(condition, bool):
            return condition
        if self._asked is None:
            self._asked = Relaxed(_ASK_MS)
            self._asked.add(as_condition(self.limited))
        failures = self.interpreter.failures if self.interpreter is not None else []
        for failure in failures[self._excluded :]:
            self._asked.add(as_condition(negated(failure.condition)))
        self._excluded = len(failures)
        return not self._asked.has_no_answer(as_condition(both(self.assumed, condition)))

    def transition(self, initial: Sequence[Any], initially: tuple[Any, ...]) -> Transition:
        state: list[Any] = []
        names: list[str] = []
        start: list[Any] = []
        following: list[Any] = []
        for leaf, domain, symbol, before, after in zip(
            self.leaves, self.domains, self.symbols, initial, self.after, strict=True
        ):
            old = symbol.value if isinstance(after, type(UNDEFINED)) else after
            state += symbol.variables
            names += [leaf.name] * len(symbol.variables)
            start += domain.encoded(before)
            following += [z3.simplify(each) for each in domain.encoded(old)]
        numbers = [_variables(i.value) for i in self.inputs]
        inputs = [v for found in numbers for v in found] + [
            *self.qualities.values(),
            *(made for made, *_ in self.unknowns),
        ]
        assumed = both(*(i.limited for i in self.inputs), self.assumed)
        return Transition(
            tuple(state), tuple(names), tuple(start), tuple(following),
            as_condition(both(*(s.limited for s in self.symbols))), tuple(inputs), self.inputs, self.qualities,
            z3.simplify(as_condition(assumed)), z3.simplify(as_condition(either(*(f.condition for f in self.failures)))),
            self.failures, tuple(z3.simplify(as_condition(p)) for p in self.properties), initially,
            self.symbols[0].variables[0] if self.symbols[0].variables else None,
            tuple((what, pos) for _, what, pos in self.unknowns),
        )  # fmt: skip


def _variables(value: Any) -> list[Any]:
    expr = value if isinstance(value, z3.BoolRef) else getattr(value, "expr", None)
    return [] if expr is None else [expr]


def _earlier(time: Any, passed: Any) -> Any:
    """Return a time of the clock relative to the present scan, after `passed` ns."""
    if isinstance(time, Choice):
        return Choice(tuple((c, None if o is None else _earlier(o, passed)) for c, o in time.options))
    return None if time is None else extreme(">", [subtract(time, passed), -LONGEST_NS])


def _input(name: str, kind: ty.Type) -> tuple[Any, Any]:
    """Return an input with any value of its type. A REAL is a finite number, and an enumeration has one of its values."""
    if isinstance(kind, ty.Enum):
        numbers = sorted(set(kind.values.values()))
        value, limited = integer(name, numbers[0], numbers[-1])
        gaps = [n for n in numbers if len(numbers) < numbers[-1] - numbers[0] + 1]
        return value, both(limited, either(*(value.expr == n for n in gaps))) if gaps else limited
    if isinstance(kind, ty.Subrange):
        return integer(name, kind.low, kind.high)
    assert isinstance(kind, ty.Elementary)
    if kind.kind == "bool":
        return z3.Bool(name), True
    if kind.kind == "real":
        sort = z3.Float32() if kind.bits == 32 else z3.Float64()
        number = floats.Float(z3.FP(name, sort), kind.bits == 32)
        return number, floats.is_finite(number)
    return integer(name, kind.low, kind.high)


def _written(name: str) -> str:
    """Return the name of a variable as in the source, in lower case."""
    return ".".join(part.removeprefix("v_").removeprefix("m_") for part in name.split("."))
