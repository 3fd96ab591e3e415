"""The results of plans, as tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from fieldtwin.run.what_if.outcome import PlanOutcome

_SHOWN = 40


def show(console: Console, outcomes: Sequence[PlanOutcome], units: Mapping[str, str]) -> None:
    """Print each plan: its verdict, requirements, states and variables. `units` maps tag names to units."""
    for outcome in outcomes:
        console.print()
        console.print(f"[bold]{escape(outcome.plan)}[/]: {'met' if outcome.met else 'not met'}", soft_wrap=True)
        if outcome.error:
            console.print(f"  error  {outcome.error}", markup=False, soft_wrap=True)
        for r in outcome.requirements:
            when = "" if r.broken_s is None else f"  from {_time(r.broken_s)} on: {r.seen}"
            console.print(
                f"  {'met    ' if r.broken_s is None else 'not met'}  {r.kind} {r.text}{when}",
                markup=False,
                soft_wrap=True,
            )
        for program, seen in outcome.states.items():
            told = " → ".join(f"{state} at {_time(t)}" for t, state in seen[:8])
            console.print(f"  {program}  {told}{' …' if len(seen) > 8 else ''}", markup=False, soft_wrap=True)
        if outcome.not_taken:
            console.print(
                f"  started without the present state of: {', '.join(outcome.not_taken)}", markup=False, soft_wrap=True
            )
        console.print(_table(outcome, units))


def _table(outcome: PlanOutcome, units: Mapping[str, str]) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 1, 0, 0))
    table.add_column("variable", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    for column in ("first", "last", "min", "max", "mean", "new", "bad"):
        table.add_column(column, justify="right", overflow="fold")
    shown = sorted(outcome.variables.items())
    for name, variable in shown[:_SHOWN]:
        v = variable.described()
        numbers = [_number(v.get(key)) for key in ("first", "last", "min", "max", "mean")]
        bad = v["updates"] - v["good"]
        table.add_row(name, units.get(name, ""), *numbers, str(v["updates"]), str(bad) if bad else "")
    if len(shown) > _SHOWN:
        table.add_row(f"and {len(shown) - _SHOWN} more: --json")
    return table


def _number(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.0f}" if 1e5 <= abs(value) < 1e9 else f"{value:.5g}"
    text = str(value)
    return text if len(text) <= 24 else f"{text[:23]}…"


def _time(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min" if seconds < 7200 else f"{seconds / 3600:.2f} h"
