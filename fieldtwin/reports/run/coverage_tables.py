"""Coverage as tables of the HTML report. They show which items were accessed and which were not."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from fieldtwin.gateway.core.errors import ModbusExceptionReply
from fieldtwin.gateway.protocols.canopen.sdo.abort_codes import MEANINGS, meaning
from fieldtwin.reports.markup import Markup
from fieldtwin.reports.pages import fill
from fieldtwin.reports.run.coverage import aborts_missing, devices_covered, exceptions_missing
from fieldtwin.results.model import AccessCounts, Machine, Report

MOST_ROWS = 200
"""Largest number of rows of one table; further rows are only counted."""
Cell = tuple[str, str]
"""A cell of a table: its CSS class and its text."""


@dataclass(frozen=True)
class Codes:
    """The codes by which devices refuse: the `seen` codes with their devices, the `missing` codes by name, and their total
    number.
    """

    title: str
    seen: list[str]
    missing: list[str]
    known: int

    @property
    def opened(self) -> bool:
        """Return whether the missing codes are few enough to be shown at once."""
        return len(self.missing) <= len(ModbusExceptionReply.NAMES)


@dataclass(frozen=True)
class Grid:
    """A table of counts. Of the `possible` cells, `done` have a count above 0."""

    name: str
    done: int
    possible: int
    columns: list[str]
    rows: list[tuple[str, list[Cell]]]


def coverage_section(report: Report, counts: AccessCounts) -> Markup:
    """Return the section of the report with all counts."""
    spoken = {b.endpoint.is_can for b in report.system.buses.values()} if report.system is not None else set()
    codes = []
    if False in spoken or counts.exceptions:
        missing = exceptions_missing(counts)
        codes.append(
            _codes("Modbus exception codes", counts.exceptions, _exception, missing, len(ModbusExceptionReply.NAMES))
        )
    if True in spoken or counts.aborts:
        codes.append(_codes("SDO abort codes", counts.aborts, _abort, aborts_missing(counts), len(MEANINGS)))
    return fill(
        "coverage.html.j2",
        devices=devices_covered(report.system, counts) if report.system is not None else None,
        codes=codes,
        counts=counts,
        machines=[_transitions(machine, counts) for machine in report.machines],
        faults=_pairs(report, counts),
        MOST_ROWS=MOST_ROWS,
    )


def _exception(code: int) -> str:
    return f"{code:02X} {ModbusExceptionReply.NAMES.get(code, 'vendor specific')}"


def _abort(code: int) -> str:
    return f"{code:08X}h {meaning(code)}"


def _codes(
    title: str, seen: Counter[tuple[str, int]], name: Callable[[int], str], missing: list[int], known: int
) -> Codes:
    by_code: dict[int, list[str]] = {}
    for (device, code), n in sorted(seen.items(), key=lambda item: (item[0][1], item[0][0])):
        by_code.setdefault(code, []).append(f"{device} {n}x")
    chips = [f"{name(code)}: {', '.join(said[:8])}" for code, said in by_code.items()]
    return Codes(title, chips, [name(code) for code in missing], known)


def _count(n: int) -> Cell:
    return ("passed", str(n)) if n else ("missing", "never")


def _transitions(machine: Machine, counts: AccessCounts) -> Grid:
    """Return the transitions from each state (row) to each state (column): how often, never, or not in the machine's table."""
    taken = {(a, b): n for (variable, a, b), n in counts.transitions.items() if variable == machine.variable}
    known = list(dict.fromkeys([*machine.states, *(s for pair in taken for s in pair)]))

    def cell(pair: tuple[str, str]) -> Cell:
        n = taken.get(pair, 0)
        if pair in machine.transitions:
            return _count(n)
        return ("failed", f"{n}, not in its table") if n else ("none", "–")

    done = sum(pair in taken for pair in machine.transitions)
    rows = [(source, [cell((source, target)) for target in known]) for source in known]
    return Grid(machine.variable, done, len(machine.transitions), ["from \\ to", *known], rows)


def _pairs(report: Report, counts: AccessCounts) -> Grid | None:
    """Return how often each fault was active in each state; None without faults."""
    faults = list(dict.fromkeys([*report.faults, *sorted(counts.faults)]))
    if not faults:
        return None
    known = [(m.variable, s) for m in report.machines for s in m.states]
    states = list(dict.fromkeys([*known, *((v, s) for _, v, s in sorted(counts.pairs))]))

    def row(fault: str) -> tuple[str, list[Cell]]:
        total = counts.faults.get(fault, 0)
        injected = ("", str(total)) if total else ("missing", "never")
        return fault, [injected, *(_count(counts.pairs.get((fault, *state), 0)) for state in states)]

    done = sum((fault, *state) in counts.pairs for fault in faults for state in states)
    columns = ["fault", "injected", *(f"{v.partition('.')[0]} {s}" for v, s in states)]
    return Grid("faults", done, len(faults) * len(states), columns, [row(fault) for fault in faults])
