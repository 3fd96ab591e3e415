"""The output of `fieldtwin plc prove`: what was proved, what was only bounded, and counterexamples scan by scan."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rich.table import Table

from fieldtwin.cli.plc.views import print_table
from fieldtwin.console import stderr, stdout
from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.plc.prove import Proof, SearchResult
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.values import duration_text

if TYPE_CHECKING:  # the solver is not needed for programs in Python
    from fieldtwin.plc.st.model_checking.proof import Report, Result, StateResult
    from fieldtwin.plc.st.model_checking.solving import Answer, Scan

MAX_INPUTS = 12
"""How many inputs a table has. Inputs that never change are listed below it."""


def print_proof(name: str, proof: Proof, result: SearchResult, text: str) -> None:
    seen = f"{result.states} states, {result.transitions} scans, {result.depth} deep"
    if result.proved:
        stdout.print(f"{name}: proved for {seen}", markup=False)
        for invariant in proof.invariants:
            stdout.print(f"  holds: {invariant}", markup=False, soft_wrap=True)
    elif result.broken:
        stdout.print(f"{name}: violated after {len(result.way)} scans: {result.broken}", markup=False, soft_wrap=True)
        stdout.print(text, markup=False, highlight=False, soft_wrap=True, end="")
    else:
        stdout.print(f"{name}: no violation in {seen}, but no proof: {result.reason}", markup=False, soft_wrap=True)
        if result.bounded:
            stderr.print("raise --max-states")


def print_report(report: Report) -> None:
    """Print all answers about a program in Structured Text."""
    shortest, longest = (_time(ns) for ns in report.interval_ns)
    stdout.print(f"{report.program}: a scan follows the scan before after {shortest} to {longest}", markup=False)
    for name, text in report.assumptions:
        stdout.print(f"  assumed: {_named(name, text)}", markup=False, soft_wrap=True)
    for limit in report.limits:
        stdout.print(f"  assumed: {limit}", markup=False, soft_wrap=True)
    for what, pos in report.unknowns:
        where = f"{pos.path}:{pos.line}"
        stdout.print(f"  not exact: {what} may have any result ({where})", markup=False, soft_wrap=True)
    for result in report.invariants:
        _print_result(report, result)
    machine = ""
    for state in report.states:
        title = f"states of {state.pou}" + (f".{state.variable}" if state.variable else "")
        if title != machine:
            machine = title
            stdout.print(title, markup=False)
        stdout.print(f"  {state.state}: {_state_text(state)}", markup=False, soft_wrap=True)


def _print_result(report: Report, result: Result) -> None:
    answer, name = result.answer, _named(result.name, result.expression)
    if answer.way is not None:
        ended = f": {result.failure}" if result.failure else ""
        stdout.print(f"  VIOLATED after {_scans(len(answer.way))}: {name}{ended}", markup=False, soft_wrap=True)
        _print_way(report, answer.way)
        if result.values:
            shown = ", ".join(f"{k} = {st_text(report, k, v)}" for k, v in result.values.items())
            stdout.print(f"    then {shown}", markup=False, soft_wrap=True)
    elif answer.proved is not None:
        stdout.print(f"  PROVED for all scans{_by(answer)}: {name}", markup=False, soft_wrap=True)
    elif answer.scans:
        text = f"no violation within {_scans(answer.scans)}, no proof for later ones ({answer.reason})"
        stdout.print(f"  BOUNDED, {text}: {name}", markup=False, soft_wrap=True)
    else:
        stdout.print(f"  OPEN, neither proved nor violated ({answer.reason}): {name}", markup=False, soft_wrap=True)


def _by(answer: Answer) -> str:
    """Return by how many scans the induction was, if by more than one."""
    return f" (induction over {_scans(answer.proved + 1)})" if answer.proved else ""


def _scans(count: int) -> str:
    return f"{count} scan" + ("" if count == 1 else "s")


def _named(name: str, text: str) -> str:
    return name if not text or name == text else f"{name} ({text})"


def _state_text(state: StateResult) -> str:
    answer = state.answer
    if answer.way is not None:
        return f"reached after {_scans(len(answer.way))}" if answer.way else "the initial state"
    if answer.proved is not None:
        return f"UNREACHABLE, proved for all scans{_by(answer)}"
    return f"OPEN, not reached within {_scans(answer.scans)}, and no proof ({answer.reason})"


def _print_way(report: Report, way: tuple[Scan, ...]) -> None:
    names = [name for name, _ in way[0].values]
    rows = [dict(scan.values) for scan in way]
    qualities = [dict(scan.good) for scan in way]
    varying = [
        name for name in names
        if any(row[name] != rows[0][name] for row in rows) or not all(good.get(name, True) for good in qualities)
    ]  # fmt: skip
    shown = names if len(names) <= MAX_INPUTS else varying[:MAX_INPUTS]
    table = Table(box=None, pad_edge=False)
    for column in ("    scan", "after", *shown):
        table.add_column(column, no_wrap=True)
    for number, scan in enumerate(way, 1):
        cells = []
        for name in shown:
            bad = "" if qualities[number - 1].get(name, True) else " (bad)"
            cells.append(st_text(report, name, rows[number - 1][name]) + bad)
        table.add_row(f"    {number}", _time(scan.after_ns), *cells)
    print_table(table)
    rest = [name for name in names if name not in shown]
    if rest:
        shown_rest = ", ".join(f"{name} = {st_text(report, name, rows[-1][name])}" for name in rest)
        stdout.print(f"    with {shown_rest}", markup=False, soft_wrap=True)


def st_text(report: Report, name: str, value: Any) -> str:
    """Return the value of a variable of a program as Structured Text writes it."""
    kind = next(v.kind for v in report.make.st_declared.variables if v.name == name)
    if isinstance(kind, ty.Enum):
        return next((word for word, number in kind.values.items() if number == value), str(value))
    if isinstance(value, bool):
        return "TRUE" if value else "FALSE"
    if isinstance(value, float):
        return repr(value)
    return _time(value) if ty.is_kind(kind, "duration") else str(value)


def _time(ns: int) -> str:
    return duration_text(ns, "T")


def report_as_data(report: Report) -> dict[str, Any]:
    """Return all answers as data for JSON."""
    return {
        "program": report.program,
        "proved": report.proved,
        "scan_interval_ms": [ns / NS_PER_MS for ns in report.interval_ns],
        "assumptions": [{"name": name, "expression": text} for name, text in report.assumptions],
        "limits": list(report.limits),
        "inexact": [{"operation": what, "path": pos.path, "line": pos.line} for what, pos in report.unknowns],
        "invariants": [
            {
                "name": each.name, "expression": each.expression, "verdict": each.verdict, "failure": each.failure,
                **_answer(each.answer), "values": each.values,
            }
            for each in report.invariants
        ],
        "states": [
            {
                "pou": each.pou, "variable": each.variable, "state": each.state, "verdict": each.verdict,
                **_answer(each.answer),
            }
            for each in report.states
        ],
    }  # fmt: skip


def _answer(answer: Answer) -> dict[str, Any]:
    """Return an answer as data: `induction` is the number of scans before the one for which the proof is made, or None."""
    return {
        "induction": answer.proved,
        "scans": len(answer.way) if answer.way is not None else answer.scans,
        "reason": answer.reason,
        "way": [
            {
                "after_ms": scan.after_ns / NS_PER_MS,
                "inputs": dict(scan.values),
                "bad": [name for name, good in scan.good if not good],
            }
            for scan in answer.way or ()
        ],
    }
