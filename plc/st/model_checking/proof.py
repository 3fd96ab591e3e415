"""Proves properties of a program in Structured Text, and reports what was proved, what was only bounded, and what is violated."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import z3

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.compile import CompiledUnit
from fieldtwin.plc.st.compiler.configurations.instances import declared_name
from fieldtwin.plc.st.dialects import STANDARD, Dialect
from fieldtwin.plc.st.model_checking.execution.mailboxes import MOST_MESSAGES
from fieldtwin.plc.st.model_checking.properties import Asked, Expression, State, asked
from fieldtwin.plc.st.model_checking.replay import Check, ModelDisagrees, Replay, held, instances
from fieldtwin.plc.st.model_checking.solving import FAILS, Answer, Limits, Scan, solve
from fieldtwin.plc.st.model_checking.transition import HIDDEN, Builder, Transition
from fieldtwin.plc.st.program import StProgram, program_class
from fieldtwin.plc.st.syntax import tree as t

_HOLDS_NS = tuple(round(seconds * 1e9) for seconds in (10, 5, 2, 1, 0.5, 0.2, 0.1, 0.05, 0.02))
NO_FAILURE = "no scan ends with an error"
"""The name of the invariant that is always examined: no division by zero, no index outside of its array, and so on."""


@dataclass(frozen=True, slots=True)
class Question:
    """A question about a program of a unit.

    `invariants` and `assumptions` are names with expressions over the variables of the program. The time between two scans is
    any time from `interval_ns[0]` to `interval_ns[1]`. `instance` is the program of a configuration that is meant, if there are
    several of the PROGRAM.
    """

    unit: t.SourceUnit
    path: str
    program: str
    dialect: Dialect = STANDARD
    invariants: tuple[tuple[str, str], ...] = ()
    assumptions: tuple[tuple[str, str], ...] = ()
    interval_ns: tuple[int, int] = (1_000_000, 3_600_000_000_000)
    states: bool = True
    instance: str = ""


@dataclass(frozen=True, slots=True)
class Result:
    """The answer about an invariant. `failure` is the error of the scan that violates it, if that scan ended with one.

    `values` are the program's variables after the last scan of a counterexample.
    """

    name: str
    expression: str
    check: Check | None
    answer: Answer
    failure: str = ""
    values: dict[str, Any] = field(default_factory=dict)

    @property
    def verdict(self) -> str:
        """Return ``proved``, ``violated`` or ``bounded``."""
        return "violated" if self.answer.way is not None else "bounded" if self.answer.proved is None else "proved"


@dataclass(frozen=True, slots=True)
class StateResult:
    """The answer about a state: it is reached by the scans of the answer (none: it is the initial state), or proved to be
    unreachable, or neither is known."""

    pou: str
    variable: str
    state: str
    answer: Answer

    @property
    def verdict(self) -> str:
        """Return ``reached``, ``unreachable`` or ``open``."""
        return "reached" if self.answer.way is not None else "open" if self.answer.proved is None else "unreachable"


@dataclass(frozen=True, slots=True)
class Report:
    """All answers about a program. `unknowns` are the operations whose results may have any value in the model."""

    program: str
    invariants: tuple[Result, ...]
    states: tuple[StateResult, ...]
    assumptions: tuple[tuple[str, str], ...]
    interval_ns: tuple[int, int]
    unknowns: tuple[tuple[str, t.Pos], ...]
    limits: tuple[str, ...]
    """The assumptions of the model itself, as sentences."""
    make: type[StProgram]

    replay: Replay

    @property
    def proved(self) -> bool:
        """Return whether all invariants are proved."""
        return all(result.verdict == "proved" for result in self.invariants)

    def held(self, result: Result, cycle_ns: int) -> tuple[Scan, ...] | None:
        """Return scans every `cycle_ns` that violate an invariant, and keep the inputs of its counterexample as long as possible.

        None if the counterexample needs inputs that change in certain scans, or scans at other times.
        """
        for hold_ns in (*_HOLDS_NS, cycle_ns):
            way = held(result.answer.way or (), hold_ns, cycle_ns)
            if hold_ns >= cycle_ns and (found := self.replay.first_violation(way, result.check)):
                return way[: found[0]]
        return None


def prove(question: Question, limits: Limits) -> Report:
    """Answer a question within limits.

    Raises `FileInvalid` for an error in the program or a construct without a model, `UsageError` for an error in an
    expression, and `ModelDisagrees` if the program does not do what the model does.
    """
    found = asked(
        question.unit, question.program, question.path, question.dialect, question.invariants, question.assumptions
    )
    _refuse_shared(question, found.unit)
    kind = program_class(found.unit, question.instance or question.program)
    return _Proof(question, found, kind).report(limits)


def _refuse_shared(question: Question, compiled: CompiledUnit) -> None:
    """Refuse a program whose global variables another program may change, because the model contains one program.

    The programs that it calls are part of it.
    """
    others = [p.name for p in compiled.programs if p.declared_name.lower() != question.program.lower()]
    blocks = [block for block in question.unit.globals if "CONSTANT" not in block.qualifiers and block.variables]
    if others and blocks:
        shared = blocks[0].variables[0]
        raise FileInvalid(
            f"plc prove examines one program, and {others[0]} may change the global variable {shared.name}",
            path=shared.pos.path, line=shared.pos.line, column=shared.pos.column,
            hint="pass values between programs through their inputs and outputs",
        )  # fmt: skip
    own = [one.name for one in compiled.instances if declared_name(one.program).lower() == question.program.lower()]
    if len(own) > 1 and compiled.globals:
        other = next(name for name in own if name.lower() != question.instance.lower())
        variable = next(iter(compiled.globals.values())).name
        raise FileInvalid(
            f"plc prove examines one program, and {other} may change the global variable {variable}",
            path=question.path,
            hint="pass values between programs through their inputs and outputs, and give each its own addresses",
        )


class _Proof:
    def __init__(self, question: Question, found: Asked, kind: type[StProgram]) -> None:
        self._question, self._found, self._kind = question, found, kind
        own = kind()
        self._states: list[State] = [
            state for state in found.states if question.states and instances(own, self._pou(state.away))
        ]
        self._checked: list[Expression] = [*found.invariants, *(state.away for state in self._states)]
        self._replay = Replay(kind, [self._check(each) for each in found.assumptions])

    def _pou(self, expression: Expression) -> str:
        return "" if expression.pou.lower() == self._question.program.lower() else expression.pou

    def _check(self, expression: Expression) -> Check:
        return Check(expression.key, self._pou(expression))

    def report(self, limits: Limits) -> Report:
        program = self._kind()
        builder = Builder(program, self._question.interval_ns)
        calls = [
            [(instances(program, self._pou(e)), e.key) for e in each]
            for each in (self._found.assumptions, self._checked)
        ]
        transition = builder.build(*calls)
        numbers = [FAILS, *range(len(self._checked))]
        initial = [n for n in numbers if n != FAILS and not _is_true(transition.initially[n])]
        first_state = len(self._found.invariants)
        started = [n for n in initial if n >= first_state]
        answers = solve(
            transition,
            [n for n in numbers if n not in started],
            limits,
            lambda number, way: self._accepts(transition, number, way),
        )
        answers.update({n: Answer(way=()) for n in started})
        return Report(
            program=self._question.program,
            invariants=(
                *(
                    self._result(e.name, e.text, self._check(e), answers[n])
                    for n, e in enumerate(self._found.invariants)
                ),
                self._result(NO_FAILURE, "", None, answers[FAILS]),
            ),
            states=tuple(
                StateResult(
                    s.machine.pou, s.machine.variable, s.state, self._shortened(self._check(s.away), answers[n])
                )
                for n, s in enumerate(self._states, first_state)
            ),
            assumptions=self._question.assumptions,
            interval_ns=self._question.interval_ns,
            unknowns=tuple(dict.fromkeys(transition.unknowns)),
            limits=tuple(_limits_of(program)),
            make=self._kind,
            replay=self._replay,
        )

    def _accepts(self, transition: Transition, number: int, way: tuple[Scan, ...]) -> str:
        """Execute a counterexample. Return "" if the program does the same. Raises `ModelDisagrees` if the model is wrong."""
        check = None if number == FAILS else self._check(self._checked[number])
        found = self._replay.first_violation(way, check)
        if found is not None and found[0] == len(way):
            return ""
        if transition.unknowns:
            what, pos = transition.unknowns[0]
            return f"the model has no exact result of {what} in line {pos.line}, and the counterexample depends on it"
        name = NO_FAILURE if number == FAILS else self._checked[number].name
        raise ModelDisagrees(
            f"the model and the program {self._question.program} disagree about {name!r}",
            expected=f"a violation in scan {len(way)}",
            got=f"one in scan {found[0]}" if found else "none",
            where=self._question.path,
            hint="this is a defect of fieldtwin; please report it with the program",
        )

    def _shortened(self, check: Check | None, answer: Answer) -> Answer:
        if answer.way:
            answer.way = self._replay.shortened(answer.way, check, self._question.interval_ns[0])
        return answer

    def _result(self, name: str, text: str, check: Check | None, answer: Answer) -> Result:
        answer = self._shortened(check, answer)
        failure, values = "", {}
        for _, failed, program in self._replay.scans(answer.way or ()):
            failure = failed
            values = {
                v.name: program.__dict__[v.name]
                for v in program.variables.values()
                if v.name not in dict((answer.way or ())[0].values)
                and not v.name.startswith(HIDDEN)
                and v.kind is not TagKind.MESSAGE
            }
        return Result(name, text, check, answer, failure, values)


def _limits_of(program: StProgram) -> Iterator[str]:
    """Yield the assumptions that the model makes about mailboxes and the clock."""
    for v in program.st_declared.variables:
        if isinstance(v.kind, ty.MessagesIn):
            yield f"{v.name} brings at most {MOST_MESSAGES} messages in a scan, with any content"
        elif isinstance(v.kind, ty.MessagesOut):
            yield f"{v.name} has room for any number of messages up to {v.kind.depth}, at any time"
    if program.st_resource.absolute:
        yield "the first scan is at any time of the clock, and SCAN_TIME() stays below 146 years"


def _is_true(condition: Any) -> bool:
    return bool(z3.is_true(z3.simplify(condition)))


__all__ = ["Limits", "Question", "Report", "Result", "StateResult", "prove"]
