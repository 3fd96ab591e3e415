"""`fieldtwin check` on a terminal: how far it is, and the table of verdicts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from types import TracebackType
from typing import TYPE_CHECKING

from rich import box
from rich.markup import escape
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bar
from rich.table import Table

from fieldtwin.cli.talk import data, talk
from fieldtwin.report.model import Verdict

if TYPE_CHECKING:
    from fieldtwin.conformance.case import Case
    from fieldtwin.conformance.results import CaseResult

STYLE = {
    Verdict.PASSED: "green", Verdict.FAILED: "bold red", Verdict.ERROR: "bold red",
    Verdict.INCONCLUSIVE: "yellow", Verdict.SKIPPED: "dim",
}  # fmt: skip
MARK = {
    Verdict.PASSED: "✓", Verdict.FAILED: "✗", Verdict.ERROR: "!", Verdict.INCONCLUSIVE: "?", Verdict.SKIPPED: "-",
}  # fmt: skip
DANGER = {"observe": "dim", "read": "cyan", "write": "yellow", "disrupt": "magenta"}


class Progress:
    """A bar on a terminal; where there is none, only what fails is said as it comes."""

    def __init__(self, most: int) -> None:
        self._bar = Bar(
            TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed:.0f} cases"), console=talk,
            transient=True, disable=not talk.is_terminal,
        )  # fmt: skip
        self._task = self._bar.add_task("learning how it polls", total=most)

    def __enter__(self) -> Progress:
        self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._bar.stop()

    def say(self, text: str) -> None:
        """A line of talk."""
        talk.print(text, markup=False, soft_wrap=True)

    def tell(self, result: CaseResult) -> None:
        """A case is done."""
        self._bar.update(self._task, advance=1, description=f"{result.case.id} {result.verdict.value}")
        if result.verdict.bad:
            talk.print(
                f"[bold red]✗[/] {result.case.id} {escape(result.case.title)}: {escape(result.reason)}", soft_wrap=True
            )


def print_results(results: Sequence[CaseResult]) -> None:
    """The table on stdout; without a terminal one line a case, nothing cut."""
    if not data.is_terminal:
        for r in results:
            reason = f": {r.reason}" if r.reason else ""
            line = f"{r.verdict.value:<12} {r.case.id:<7} {r.case.danger.value:<8} {r.case.title}{reason}"
            data.print(line, markup=False, soft_wrap=True)
    else:
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
        table.add_column("")
        table.add_column("case", no_wrap=True)
        table.add_column("danger", no_wrap=True)
        table.add_column("the device", ratio=2)
        table.add_column("what was found", ratio=3)
        for r in results:
            style, danger = STYLE[r.verdict], r.case.danger.value
            found = r.reason or r.verdict.value
            table.add_row(
                f"[{style}]{MARK[r.verdict]}[/]", f"[{style}]{r.case.id}[/]", f"[{DANGER[danger]}]{danger}[/]",
                escape(r.case.title), f"[{style}]{escape(found)}[/]",
            )  # fmt: skip
        data.print(table)
    counts = Counter(r.verdict for r in results)
    parts = [f"[{STYLE[v]}]{counts[v]} {v.value}[/]" for v in STYLE if counts[v]]
    data.print(", ".join(parts) or "no case was chosen")


def print_cases(cases: Sequence[Case]) -> None:
    """All cases, for `--list`."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for name in ("case", "danger", "what the device does", "what the master must do", "source"):
        table.add_column(name, overflow="fold")
    for case in cases:
        danger = case.danger.value
        table.add_row(
            case.id, f"[{DANGER[danger]}]{danger}[/]", escape(case.does), escape(case.must), escape(case.clause)
        )
    data.print(table)
