"""State machines as tables of transitions, each with source and target state, guard, delay and action. The table is the program.

    class Pump(StateMachine):
        start: bool = var_input(TagKind.BOOL)
        valve: bool = var_output(TagKind.BOOL, initial=False)

        table = StateTable(
            Transition("IDLE", "FILLING", when="start", do="open"),
            Transition("FILLING", "FAULT", after_ms=5000),
            Transition(ANY, "IDLE", when="not start", do="close"),
        )

Each scan takes at most one transition: the first in the table's order that starts in the present state, whose guard holds and
whose time in the state has passed. `when` is an expression over the program's variables, `do` a method. Diagrams
(fieldtwin.plc.diagram) and proofs (fieldtwin.plc.prove) read the same table. Times are measured with the time of the scan.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from types import CodeType
from typing import Any, ClassVar

from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.errors import Bug, UsageError
from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.gateway.core.values import Scalar
from fieldtwin.plc.program import Program, ScanInfo, var_local

ANY = "*"
"""As a source: every state except the target."""


@dataclass(frozen=True, slots=True)
class Transition:
    """A transition from `source` to `target`.

    It is taken when the guard `when` holds (an empty guard always holds) and the machine has been in `source` for `after_ms`."""

    source: str
    target: str
    when: str = ""
    after_ms: float = 0.0
    do: str = ""

    @property
    def label(self) -> str:
        """Return the text that a diagram shows at the arrow of this transition."""
        parts = [self.when, f"after {self.after_ms:g} ms" if self.after_ms else "", f"/ {self.do}" if self.do else ""]
        return ", ".join(p for p in parts[:2] if p) + (f" {parts[2]}" if parts[2] else "")


@dataclass(frozen=True)
class StateTable:
    """A state machine: its transitions in order. The first one's source is the initial state, unless `initial` names
    another.

    Raises `Bug` for a state that cannot be reached, or a name that no transition has.
    """

    transitions: tuple[Transition, ...]
    initial: str = ""
    states: tuple[str, ...] = field(default=())
    """The states in the order of their codes 0, 1, 2 and so on."""

    def __init__(self, *transitions: Transition, initial: str = "", states: tuple[str, ...] = ()) -> None:
        named = [s for t in transitions for s in (t.source, t.target) if s != ANY]
        order = states or tuple(dict.fromkeys(([initial] if initial else []) + named))
        object.__setattr__(self, "transitions", transitions)
        object.__setattr__(self, "states", order)
        object.__setattr__(self, "initial", initial or (order[0] if order else ""))
        self._check(named)

    def _check(self, named: list[str]) -> None:
        if not self.transitions:
            raise Bug("a state machine without transitions")
        for name in {*named, self.initial}:
            if name not in self.states:
                raise Bug(f"a state that is not declared: {name}", expected=", ".join(self.states))
        reached, waiting = {self.initial}, [self.initial]
        while waiting:
            for transition in self.leaving(waiting.pop()):
                if transition.target not in reached:
                    reached.add(transition.target)
                    waiting.append(transition.target)
        lost = [s for s in self.states if s not in reached]
        if lost:
            raise Bug("states that cannot be reached", got=", ".join(lost))

    def leaving(self, state: str) -> list[Transition]:
        """Return the transitions that may be taken in `state`, in order."""
        return [t for t in self.transitions if t.source == state or (t.source == ANY and t.target != state)]

    def code(self, state: str) -> int:
        return self.states.index(state)

    @property
    def longest_ms(self) -> float:
        """Return the longest `after_ms` of all transitions. A longer time in a state makes no difference."""
        return max((t.after_ms for t in self.transitions), default=0.0)


class StateMachine(Program):
    """The base class of programs that are a `StateTable`. `state` is the code of the present state.

    ``during_<STATE>`` is called in each scan in that state.

    Guards can use the program's variables by name, and ``in_state_ms``.
    """

    table: ClassVar[StateTable]
    state: int = var_local(TagKind.INT, initial=0)
    _guards: ClassVar[dict[Transition, CodeType | None]] = {}

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        table = cls.__dict__.get("table")
        if table is None:
            return
        names = table.states
        state = replace(cls.variables["state"], limits=(0, len(names) - 1), words=tuple(enumerate(names)))
        cls.variables = {**cls.variables, "state": state}
        cls._guards = {}
        for transition in table.transitions:
            cls._guards[transition] = _compiled(cls, transition)
            if transition.do and not callable(getattr(cls, transition.do, None)):
                raise Bug(
                    f"{cls.__name__} has no method {transition.do}", where=f"{transition.source} to {transition.target}"
                )

    def __init__(self) -> None:
        self.state = self.table.code(self.table.initial)
        self.since_ns: int | None = None
        """The time (monotonic ns) at which the state was entered; None before the first scan."""
        self.in_state_ms = 0.0
        """The time (ms) from the entry into the state to the last scan."""

    @property
    def state_name(self) -> str:
        return self.table.states[self.state]

    def check(self, name: str, value: Scalar) -> None:
        if name == "state" and value not in range(len(self.table.states)):
            named = ", ".join(f"{code} ({state})" for code, state in enumerate(self.table.states))
            raise UsageError("no such state", expected=named, got=repr(value))

    def execute(self, scan: ScanInfo) -> None:
        if self.since_ns is None:
            self.since_ns = scan.now_ns
        in_state_ms = self.in_state_ms = (scan.now_ns - self.since_ns) / NS_PER_MS
        for transition in self.table.leaving(self.state_name):
            if in_state_ms >= transition.after_ms and self._holds(transition, in_state_ms):
                self.state, self.since_ns = self.table.code(transition.target), scan.now_ns
                self.in_state_ms = 0.0
                if transition.do:
                    getattr(self, transition.do)()
                break
        during: Callable[[ScanInfo], None] | None = getattr(self, f"during_{self.state_name}", None)
        if during is not None:
            during(scan)

    def _holds(self, transition: Transition, in_state_ms: float) -> bool:
        guard = self._guards[transition]
        return guard is None or bool(eval(guard, {"__builtins__": _SAFE, "in_state_ms": in_state_ms}, self.__dict__))


_SAFE = {
    "abs": abs,
    "min": min,
    "max": max,
    "len": len,
    "any": any,
    "all": all,
    "True": True,
    "False": False,
    "None": None,
}


def _compiled(cls: type[Program], transition: Transition) -> CodeType | None:
    if not transition.when:
        return None
    where = f"{cls.__name__}, {transition.source} to {transition.target}"
    try:
        code = compile(transition.when, f"<{where}>", "eval")
    except SyntaxError as e:
        raise Bug(f"a guard that is not an expression: {e.msg}", got=transition.when, where=where) from e
    unknown = [n for n in code.co_names if n not in cls.variables and n not in _SAFE and n != "in_state_ms"]
    if unknown:
        raise Bug("a guard without a variable", got=", ".join(unknown), expected=", ".join(cls.variables), where=where)
    return code
