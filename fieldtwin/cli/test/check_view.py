"""`fieldtwin check` on a terminal: the progress and the table of verdicts."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Sequence
from itertools import groupby
from types import TracebackType
from typing import TYPE_CHECKING, Any

from rich import box
from rich.markup import escape
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bar
from rich.table import Table

from fieldtwin.conformance.core.case import OTHER_WIRE, Basis
from fieldtwin.conformance.core.results import FOUND, called, counts_as_failed
from fieldtwin.conformance.devices.device_case import DeviceCase
from fieldtwin.console import stderr, stdout
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.results.model import Verdict

if TYPE_CHECKING:
    from fieldtwin.conformance.core.case import About
    from fieldtwin.conformance.core.results import CaseResult
    from fieldtwin.conformance.devices.checked import Checked
    from fieldtwin.conformance.devices.device_case import Spoken

STYLE = {
    Verdict.PASSED: "green", Verdict.FAILED: "bold red", Verdict.ERROR: "bold red",
    Verdict.INCONCLUSIVE: "yellow", Verdict.SKIPPED: "dim",
}  # fmt: skip
FINDING = {Basis.ROBUSTNESS: "yellow", Basis.FIELD: "magenta"}
"""The colours of failures that do not deviate from the standard. None of them is red."""
BASIS = {Basis.STANDARD: "default", **FINDING}
MARK = {
    Verdict.PASSED: "✓", Verdict.FAILED: "✗", Verdict.ERROR: "!", Verdict.INCONCLUSIVE: "?", Verdict.SKIPPED: "-",
}  # fmt: skip
IMPACT = {"observe": "dim", "read": "cyan", "write": "yellow", "disrupt": "magenta"}


class CheckProgress:
    """A progress bar on a terminal; elsewhere failures are printed as they occur."""

    def __init__(self, most: int, at_first: str = "learning the polling pattern") -> None:
        self._bar = Bar(
            TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed:.0f} cases"), console=stderr,
            transient=True, disable=not stderr.is_terminal,
        )  # fmt: skip
        self._task = self._bar.add_task(at_first, total=most)

    def __enter__(self) -> CheckProgress:
        self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._bar.stop()

    def print_line(self, text: str) -> None:
        """Print a diagnostic line."""
        stderr.print(text, markup=False, soft_wrap=True)

    def add_result(self, result: CaseResult) -> None:
        """Report a finished case."""
        self._bar.update(self._task, advance=1, description=f"{result.case.id} {result.verdict.value}")
        if result.verdict.bad:
            mark = f"[{style_of(result)}]{MARK[result.verdict] if result.deviates else '!'}[/]"
            kind = why(result)
            stderr.print(
                f"{mark} {result.case.id} {escape(result.case.title)} ({escape(kind)}): {escape(result.reason)}",
                soft_wrap=not stderr.is_terminal,
            )


def style_of(result: CaseResult) -> str:
    """Return the colour of a result: red only for a deviation from the standard."""
    return FINDING.get(result.case.basis, STYLE[result.verdict]) if result.verdict.bad else STYLE[result.verdict]


def why(result: CaseResult) -> str:
    """Return why a failure counts, or that it does not: ``required by TG 4.4.1.3``, ``robustness`` or ``field problem``."""
    return f"required by {result.case.required_by}" if result.deviates else called(result)


def print_results(results: Sequence[CaseResult], *, all_wires: bool = False) -> None:
    """Print the results on stdout; without a terminal one uncut line per case.

    Cases for other kinds of bus are only counted, unless `all_wires`.
    """
    elsewhere = [] if all_wires else [r for r in results if r.reason == OTHER_WIRE]
    results = [r for r in results if r not in elsewhere]
    _print_each(results)
    styles = {called(r): style_of(r) for r in results}
    counts = Counter(called(r) for r in results)
    order = ("passed", *FOUND.values(), "error", "inconclusive", "skipped")
    parts = [f"[{styles[word]}]{counts[word]} {word}[/]" for word in order if counts[word]]
    stdout.print(", ".join(parts) or "no case was chosen")
    if elsewhere:
        stderr.print(f"{len(elsewhere)} more test cases are for other kinds of bus", markup=False)


def _print_each(results: Sequence[CaseResult]) -> None:
    if not stdout.is_terminal:
        for r in results:
            reason = f": {r.reason}" if r.reason else ""
            reason += f" ({why(r)})" if r.deviates else ""
            line = f"{called(r):<13} {r.case.id:<7} {r.case.impact.value:<8} {r.case.title}{reason}"
            stdout.print(line, markup=False, soft_wrap=True)
    else:
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
        table.add_column("")
        table.add_column("case", no_wrap=True)
        table.add_column("impact", no_wrap=True)
        table.add_column("request" if _of_devices([r.case for r in results]) else "the device", ratio=2)
        table.add_column("result", ratio=3)
        for r in results:
            style, impact = style_of(r), r.case.impact.value
            found = r.reason or r.verdict.value
            mark = MARK[r.verdict]
            if r.verdict.bad and not r.deviates:
                found, mark = f"{called(r)}: {found}", "!"
            elif r.verdict.bad:
                found = f"{found} ({why(r)})"
            table.add_row(
                f"[{style}]{mark}[/]", f"[{style}]{r.case.id}[/]", f"[{IMPACT[impact]}]{impact}[/]",
                escape(r.case.title), f"[{style}]{escape(found)}[/]",
            )  # fmt: skip
        stdout.print(table)


def print_not_counted(results: Sequence[CaseResult], fail_on: frozenset[Basis]) -> None:
    """Print that the exit code does not count some failures, if there are any that `fail_on` does not contain."""
    if any(r.verdict.bad and not counts_as_failed(r, fail_on) for r in results):
        stderr.print(
            "The standard does not require what robustness and field problem cases ask. "
            "The exit code does not count them: see --fail-on.", markup=False, soft_wrap=not stderr.is_terminal,
        )  # fmt: skip


def _of_devices(cases: Sequence[About]) -> bool:
    return any(case.role == "device" for case in cases)


def print_cases(cases: Sequence[About]) -> None:
    """Print all cases for `--list`: a table, or without a terminal one line per case."""
    if not stdout.is_terminal:
        for case in cases:
            words = f"{case.title}: {case.does}; expected: {case.must} [{case.sources}]"
            line = f"{case.id:<7} {case.bases:<25} {case.impact.value:<8} {words}"
            stdout.print(line, markup=False, soft_wrap=True)
        return
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    heads = ("what is sent", "what the device must do")
    does, must = heads if _of_devices(cases) else ("what the device does", "what the master must do")
    for name in ("case", "basis", "impact", does, must, "source"):
        table.add_column(name, overflow="fold", no_wrap=name == "case")
    for case in cases:
        impact, basis = case.impact.value, BASIS[case.basis]
        table.add_row(
            case.id, f"[{basis}]{escape(case.bases)}[/]", f"[{IMPACT[impact]}]{impact}[/]", escape(case.does),
            escape(case.must), escape(case.sources),
        )  # fmt: skip
    stdout.print(table)


def listed(case: About) -> dict[str, Any]:
    """Return the case for `--list --json`.

    `elsewhere` has its basis and clause on kinds of bus where they differ. A case for devices also has its `wires` and
    `needs`.
    """
    keys = ("id", "title", "clause", "does", "must")
    elsewhere = [{"wire": e.wire, "basis": e.basis.value, "clause": e.clause} for e in case.elsewhere]
    return {k: getattr(case, k) for k in keys} | {
        "basis": case.basis.value, "impact": case.impact.value, "role": case.role, "elsewhere": elsewhere,
    } | ({"wires": case.wires, "needs": case.needs} if isinstance(case, DeviceCase) else {})  # fmt: skip


def print_dry_run(checked: Checked, *, as_json: bool) -> None:
    """Print the frames that a check would send, case by case. Cases that would not be run are left out."""
    played = [r for r in checked.results if r.spoken]
    if as_json:
        cases = [
            {
                "id": "before",
                "title": "its answers and its identification",
                "impact": "read",
                "sent": _sent(checked.before),
            }
        ]
        cases += [
            {"id": r.case.id, "title": r.case.title, "impact": r.case.impact.value, "sent": _sent(r.spoken)}
            for r in played
        ]
        json.dump({"kind": "fieldtwin check dry run", "cases": cases}, sys.stdout, indent=2)
        sys.stdout.write("\n")
        return
    stdout.print("before: its answers and its identification", markup=False)
    _print_sent(_sent(checked.before))
    for r in played:
        impact = r.case.impact.value
        stdout.print(f"{r.case.id} [{IMPACT[impact]}]{impact}[/] {escape(r.case.title)}", soft_wrap=True)
        _print_sent(_sent(r.spoken))
    stderr.print(
        f"{len(played)} cases. A normal read precedes each case as well. The frames are those for a conforming device; "
        "other devices can lead to different frames.", markup=False, soft_wrap=True,
    )  # fmt: skip


def _sent(spoken: Sequence[Spoken]) -> list[str]:
    return [s.text for s in spoken if s.direction is Direction.SENT]


def _print_sent(frames: Sequence[str]) -> None:
    """Print one frame per line; equal consecutive frames are printed once, with their number."""
    for text, same in groupby(frames):
        times = len(list(same))
        stdout.print(f"  {text}" + (f"   x {times}" if times > 1 else ""), markup=False, soft_wrap=True)
