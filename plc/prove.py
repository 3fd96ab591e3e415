"""Checks the invariants of a program in every state that it can reach with any inputs, breadth first.

A `Proof` defines the possible inputs (a finite domain per scan: values, qualities, elapsed time), which part of the program's
state matters (the key), and the invariants. The program itself runs, scan by scan; there is no second model. The search is
breadth first, so the path to the first violation has the fewest scans. The search is limited: states that were not visited are
reported, and then there is no proof.

A proof is only as good as its key: if the key leaves out a part of the state that matters, the search ends too soon. Structured
Text needs no key, because all of its state is known. The timers and other blocks of a program are always part of the key. A given
key is tested afterwards by random paths through the program without any key: a state that the search has not seen makes the
result "not proved".
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from random import Random
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.image.image import Message, TagKind
from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.plc.blocks import FunctionBlock
from fieldtwin.plc.program import Outbox, Program, ProgramFailed, Role, ScanInfo
from fieldtwin.plc.states import StateMachine

MAX_STATES = 200_000
WALKS, WALK_SCANS = 64, 64
"""The number of random paths that test a key, and the scans of each."""


@dataclass(frozen=True, slots=True)
class Given:
    """The inputs of one scan.

    They are the values by variable (None: BAD without a value; a `TagValue` has its own quality), the ms since the previous scan,
    and for each message output whether its receiver has emptied the mailbox since then.
    """

    inputs: tuple[tuple[str, Any], ...]
    ms: float
    taken: bool = True

    def describe(self) -> dict[str, Any]:
        """Return the inputs as data for JSON, for a counterexample."""
        shown = {name: _shown(value) for name, value in self.inputs if value is not None}
        return {"after_ms": self.ms, "inputs": shown, "taken": self.taken}


def _shown(value: Any) -> Any:
    if isinstance(value, TagValue):
        return {"value": value.value, "quality": str(value.quality), "reason": str(value.reason)}
    return value.hex() if isinstance(value, bytes) else value


Invariant = Callable[[Any], bool]
"""A function that is called with the program after each scan, and returns whether the invariant holds."""


@dataclass(frozen=True)
class Proof:
    """The definition of a proof about a program.

    `make` creates it; `domain` has for each input the values that a scan may bring (those of a message input are
    payloads, and None for no message; for any other input None is BAD without a value, and a `TagValue` has any
    quality); `steps_ms` are the times between scans; `key` returns the part of the program that matters, as a hashable
    value: two states with one key are the same. Structured Text needs no key: then all of its state matters. `clogs`:
    mailboxes may also be full.
    """

    make: Callable[[], Program]
    domain: Mapping[str, Sequence[Any]]
    invariants: Mapping[str, Invariant]
    key: Callable[[Any], Hashable] | None = None
    steps_ms: tuple[float, ...] = (10.0,)
    clogs: bool = False
    requirement: Mapping[str, str] = field(default_factory=dict)
    """By name of an invariant: the requirement from which it is derived, such as an identifier."""

    def choices(self) -> list[Given]:
        """Return all inputs that one scan can have, the simplest first."""
        names = list(self.domain)
        rows = product(*(self.domain[name] for name in names))
        return [
            Given(tuple(zip(names, row, strict=True)), ms, taken)
            for row, ms, taken in product(list(rows), self.steps_ms, (True, False) if self.clogs else (True,))
        ]


def machine_key(program: StateMachine) -> Hashable:
    """Return the key of a state machine: its state, the phase of its timers, its outputs and locals."""
    phase = min(program.in_state_ms, program.table.longest_ms)
    own = [v.name for v in program.variables.values() if v.role is not Role.INPUT and v.kind is not TagKind.MESSAGE]
    return phase, *(program.__dict__[name] for name in own)


@dataclass(frozen=True, slots=True)
class SearchResult:
    """The result of a search. `broken` is the invariant that does not hold (or the error that a scan raised), and `way` the
    inputs of each scan that lead to it.

    `reason`: why the program is not proved although no invariant is broken.
    """

    states: int
    transitions: int
    depth: int
    complete: bool
    broken: str = ""
    way: tuple[Given, ...] = ()
    reason: str = ""

    @property
    def bounded(self) -> bool:
        """Return whether a limit of the search was reached, so that a larger limit may lead to a proof."""
        return self.reason.startswith("more than")

    @property
    def proved(self) -> bool:
        return self.complete and not self.broken


def prove(proof: Proof, max_states: int = MAX_STATES, max_depth: int = 10_000) -> SearchResult:
    """Visit every reachable state, until an invariant is broken or the limits are reached.

    Raises `UsageError` if `domain` and the program's inputs differ, and if a program in Python has no key.
    """
    choices = proof.choices()
    first = _Point(proof.make(), 0, 0, None, None)
    _check(proof, first.program)
    seen = {_key(proof, first)}
    waiting = deque([first])
    transitions, depth = 0, 0
    while waiting:
        point = waiting.popleft()
        if point.number >= max_depth:
            return SearchResult(len(seen), transitions, depth, complete=False, reason=f"deeper than {max_depth} scans")
        depth = max(depth, point.number + 1)
        for given in choices:
            following = point.after(given)
            transitions += 1
            broken = _broken(proof, following, given)
            if broken:
                return SearchResult(len(seen), transitions, following.number, False, broken, tuple(following.way()))
            key = _key(proof, following)
            if key not in seen:
                if len(seen) >= max_states:
                    return SearchResult(
                        len(seen), transitions, depth, complete=False, reason=f"more than {max_states} states"
                    )
                seen.add(key)
                waiting.append(following)
    whole = SearchResult(len(seen), transitions, depth, complete=True)
    return whole if proof.key is None else _tested(proof, choices, seen, whole)


def _check(proof: Proof, program: Program) -> None:
    inputs = {v.name: v for v in program.variables.values() if v.role is Role.INPUT}
    needed = {name for name, v in inputs.items() if v.needs_tag}
    if not needed <= proof.domain.keys() <= inputs.keys():
        raise UsageError(
            "the domain of a proof names the program's inputs",
            expected=", ".join(sorted(inputs)) or "none",
            got=", ".join(sorted(proof.domain)) or "none",
        )
    if proof.key is None and program.whole_state(0) is None:
        raise UsageError("a proof of a program in Python needs a key", expected="key: what of the program matters")


def _key(proof: Proof, point: _Point) -> Hashable:
    """Return the key of the state of `point`. A given key is extended by the blocks, and by whether this is the first
    scan."""
    program, now_ns = point.program, point.now_ns
    if proof.key is None:
        return point.number == 0, program.whole_state(now_ns)
    blocks = [v.state(now_ns) for v in vars(program).values() if isinstance(v, FunctionBlock)]
    return point.number == 0, proof.key(program), tuple(blocks)


def _tested(proof: Proof, choices: Sequence[Given], seen: set[Hashable], whole: SearchResult) -> SearchResult:
    """Test the key with random paths. Return `whole`, or a failed result if a path breaks an invariant or reaches a state that
    is not in `seen`.
    """
    random = Random(0)
    for _ in range(WALKS):
        point = _Point(proof.make(), 0, 0, None, None)
        way: list[Given] = []
        for _ in range(WALK_SCANS):
            given = random.choice(choices)
            way.append(given)
            point = _Point(point.program, point.now_ns + round(given.ms * NS_PER_MS), point.number + 1, None, None)
            if broken := _broken(proof, point, given):
                return SearchResult(whole.states, whole.transitions, len(way), False, broken, tuple(way))
            if _key(proof, point) not in seen:
                reason = "the key omits a deciding variable: two states with the same key continue differently"
                return SearchResult(whole.states, whole.transitions, whole.depth, complete=False, reason=reason)
    return whole


def shown(proof: Proof, way: Sequence[Given]) -> dict[str, Any]:
    """Return the program's outputs and locals after the scans with the inputs `way`. The last scan may raise an error."""
    point = _Point(proof.make(), 0, 0, None, None)
    for given in way:
        point = point.after(given)
        _broken(proof, point, given)
    program = point.program
    own = [v.name for v in program.variables.values() if v.role is not Role.INPUT and v.kind is not TagKind.MESSAGE]
    return {name: program.__dict__[name] for name in own}


class _Point:
    """A program in a state that was reached, and the path to it."""

    def __init__(self, program: Program, now_ns: int, number: int, before: _Point | None, given: Given | None) -> None:
        self.program, self.now_ns, self.number = program, now_ns, number
        self.before, self.given = before, given

    def after(self, given: Given) -> _Point:
        now_ns = self.now_ns + round(given.ms * NS_PER_MS)
        return _Point(copy.deepcopy(self.program), now_ns, self.number + 1, self, given)

    def way(self) -> Iterator[Given]:
        if self.before is not None and self.given is not None:
            yield from self.before.way()
            yield self.given


def _broken(proof: Proof, point: _Point, given: Given) -> str:
    program = point.program
    _hand_in(program, given, point.now_ns)
    try:
        program.execute(ScanInfo(point.now_ns, point.number, point.number == 1))
    except ProgramFailed as e:
        return f"a scan failed: {e}"
    except Exception as e:  # the logic is the user's: any error that it raises is a counterexample
        return f"a scan raised {type(e).__name__}: {e}"
    for name, holds in proof.invariants.items():
        if not holds(program):
            return name
    return ""


def _hand_in(program: Program, given: Given, now_ns: int) -> None:
    qualities = {}
    for name, value in given.inputs:
        variable = program.variables[name]
        if variable.kind is TagKind.MESSAGE:
            program.__dict__[name] = () if value is None else (Message(1, now_ns, value),)
            continue
        if isinstance(value, TagValue):
            program.__dict__[name] = value.value
            qualities[name] = TagValue(value.value, value.quality, value.reason, now_ns)
            continue
        program.__dict__[name] = value
        quality, reason = (Quality.BAD, Reason.TIMEOUT) if value is None else (Quality.GOOD, Reason.NONE)
        qualities[name] = TagValue(value, quality, reason, now_ns)
    program._lookup = qualities.__getitem__
    for name in program.variables:
        box = program.__dict__[name]
        if isinstance(box, Outbox):
            box.outstanding = 0 if given.taken else box.outstanding + len(box.pending)
            box.pending = []
