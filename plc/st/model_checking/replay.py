"""Executes the scans of a counterexample with the compiled program, and shortens the counterexample.

A counterexample of the solver counts only if the program does the same. So a wrong model is noticed.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.errors import Bug, FieldtwinError
from fieldtwin.gateway.core.image.image import Message
from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.plc.program import ScanInfo
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.model_checking.solving import Scan
from fieldtwin.plc.st.model_checking.state import objects
from fieldtwin.plc.st.model_checking.transition import action_of
from fieldtwin.plc.st.program import StProgram
from fieldtwin.plc.st.values import LogicError, real, signed

MAX_TRIES = 400
"""How many shorter or simpler variants of a counterexample are executed."""
MAX_HELD = 20_000
"""How many scans keep the inputs of one scan of a counterexample."""
_SMALL = 1000.0
_VARIANTS = 3
"""The number of simpler variants of a scan, without those of single inputs."""


class ModelDisagrees(Bug):
    """The model of a program and the compiled program do different things, so no result of the model can be trusted."""


@dataclass(frozen=True, slots=True)
class Check:
    """An expression: the variable to which its action assigns it, and the POU to which it belongs ("" for the program)."""

    key: str
    pou: str = ""


class Replay:
    """One execution of a program. `make` creates it, `assumptions` have to hold before each scan."""

    def __init__(self, make: Callable[[], StProgram], assumptions: Sequence[Check] = ()) -> None:
        self._make, self._assumptions = make, assumptions

    def first_violation(self, way: Sequence[Scan], check: Check | None) -> tuple[int, str] | None:
        """Return the number of the first scan after which `check` is FALSE, from 1, and the error if the scan failed.

        If `check` is None, return the first scan that fails. Return None if no scan does, or if an assumption does not hold.
        """
        for number, failed, program in self.scans(way):
            if program is None:
                return None
            if failed:
                return (number, failed) if check is None else None
            if check is not None and not holds(program, check):
                return number, ""
        return None

    def scans(self, way: Sequence[Scan]) -> Any:
        """Execute each scan, and yield its number from 1, its error, and the program; None if an assumption does not hold."""
        program, now_ns = self._make(), 0
        for number, scan in enumerate(way, 1):
            now_ns += scan.after_ns
            self._hand_in(program, scan, now_ns)
            if not all(holds(program, check) for check in self._assumptions):
                yield number, "", None
                return
            failed = ""
            try:
                program.execute(ScanInfo(now_ns, number, number == 1))
            except FieldtwinError as e:
                failed = str(e)
            yield number, failed, program

    def _hand_in(self, program: StProgram, scan: Scan, now_ns: int) -> None:
        good = dict(scan.good)
        known = {}
        for name, value in scan.values:
            if isinstance(program.st_variables[name].kind, ty.MessagesIn):
                messages = tuple(Message(number, now_ns, b"") for number in range(1, value + 1))
                program.__dict__[name] = messages
                program.st_assign(program.st_variables[name], messages)
                continue
            tag = tag_value(program, name, value)
            program.__dict__[name] = tag
            quality, reason = (Quality.GOOD, Reason.NONE) if good.get(name, True) else (Quality.BAD, Reason.TIMEOUT)
            known[name] = TagValue(tag, quality, reason, now_ns)
            program.st_assign(program.st_variables[name], value)
        program._lookup = known.__getitem__
        program.st_resource.begin(ScanInfo(now_ns, 0, False), program.tag)

    def shortened(self, way: tuple[Scan, ...], check: Check | None, shortest_ns: int) -> tuple[Scan, ...]:
        """Return a counterexample with fewer scans, shorter waits and fewer changes of inputs, as far as it still is one."""
        tries = 0

        def violated(candidate: Sequence[Scan]) -> tuple[Scan, ...] | None:
            nonlocal tries
            tries += 1
            found = self.first_violation(candidate, check) if tries <= MAX_TRIES else None
            return tuple(candidate[: found[0]]) if found else None

        way = violated(way) or way
        at = len(way) - 1
        while at >= 0:
            way = violated((*way[:at], *way[at + 1 :])) or way
            at = min(at, len(way)) - 1
        for at in range(len(way)):
            way = self._sooner(way, at, violated)
            for n in range(_VARIANTS + 2 * len(way[0].values)):
                if at >= len(way):
                    return way
                simpler = _simpler(way, at, n, shortest_ns)
                if simpler != way[at]:
                    way = violated((*way[:at], simpler, *way[at + 1 :])) or way
        return way

    @staticmethod
    def _sooner(
        way: tuple[Scan, ...], at: int, violated: Callable[[Sequence[Scan]], tuple[Scan, ...] | None]
    ) -> tuple[Scan, ...]:
        """Return the counterexample with the shortest of some round times before the scan `at` with which it still is one."""
        for unit in (1, 10, 100, 1000, 10_000, 60_000, 600_000):
            for count in (1, 2, 3, 4, 5, 6, 8):
                after_ns = count * unit * NS_PER_MS
                if at < len(way) and after_ns < way[at].after_ns:
                    sooner = violated((*way[:at], replace(way[at], after_ns=after_ns), *way[at + 1 :]))
                    if sooner is not None:
                        return sooner
        return way


def held(way: Sequence[Scan], hold_ns: int, cycle_ns: int) -> tuple[Scan, ...]:
    """Return scans every `cycle_ns` that keep the inputs of each scan of `way` for `hold_ns`, or until the next one comes."""
    found: list[Scan] = []
    for number, scan in enumerate(way):
        following_ns = way[number + 1].after_ns if number + 1 < len(way) else hold_ns
        count = max(1, round(max(hold_ns, following_ns) / cycle_ns))
        found += [replace(scan, after_ns=cycle_ns)] * min(count, MAX_HELD)
    return tuple(found)


def _simpler(way: tuple[Scan, ...], at: int, number: int, shortest_ns: int) -> Scan:
    """Return a variant of a scan: with the inputs of the scan before, after the shortest time, or with one of its inputs.

    Further variants have one number that is rounded.
    """
    scan = way[at]
    before = (
        way[at - 1] if at else Scan(0, tuple((name, type(value)()) for name, value in scan.values), _all_good(scan))
    )
    if number == 0:
        return replace(scan, values=before.values, good=before.good)
    if number == 1:
        return replace(scan, after_ns=shortest_ns)
    if number == 2:
        return replace(scan, good=_all_good(scan))
    n = number - _VARIANTS
    if n >= len(scan.values):
        n -= len(scan.values)
        name, value = scan.values[n]
        return replace(scan, values=(*scan.values[:n], (name, _rounded(value)), *scan.values[n + 1 :]))
    return replace(scan, values=(*scan.values[:n], before.values[n], *scan.values[n + 1 :]))


def _rounded(value: Any) -> Any:
    """Return a number with fewer digits: the next tenth for a small one, else the next whole number."""
    if not isinstance(value, float) or not math.isfinite(value):
        return value
    return real(math.ceil(value * 10) / 10) if abs(value) < _SMALL else float(math.ceil(value))


def _all_good(scan: Scan) -> tuple[tuple[str, bool], ...]:
    return tuple((name, True) for name, _ in scan.good)


def tag_value(program: StProgram, name: str, value: Any) -> Any:
    """Return the value of an input as its tag has it."""
    kind = program.st_variables[name].kind
    unsigned = getattr(kind, "bits", 0) == 64 and getattr(kind, "low", 0) == 0 and getattr(kind, "high", 0) > 0
    return signed(value, 64) if unsigned else value


def holds(program: StProgram, check: Check) -> bool:
    """Return whether an expression is TRUE, for all instances of its POU. The program is not changed."""
    own = copy.deepcopy(program)
    try:
        for owner in instances(own, check.pou):
            getattr(owner, f"a_{action_of(check.key)}")()
            if not getattr(owner, f"v_{check.key}"):
                return False
    except LogicError:
        return False
    return True


def instances(program: StProgram, pou: str) -> list[Any]:
    """Return the instances of a function block in a program and in the global variables; the program itself if `pou` is ""."""
    if not pou:
        return [program.st_body]
    roots = (program.st_body, program.st_resource.globals)
    return [each for root in roots for each in objects(root) if type(each).__name__ == f"B_{pou.lower()}"]
