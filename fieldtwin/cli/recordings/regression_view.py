"""Comparisons of two runs, as text and as JSON: `fieldtwin trace --against`, `fieldtwin simulate --compare`."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import click
from rich.markup import escape

from fieldtwin.capture.decoding.trace_file import read_events
from fieldtwin.cli.recordings.regression_options import ToleranceOptions
from fieldtwin.console import stderr, stdout
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.scenarios.language.file_name import SUFFIX
from fieldtwin.scenarios.regression.as_scenario import ScenarioOptions, as_scenario
from fieldtwin.scenarios.regression.comparing import Allowed, RunComparison, compare
from fieldtwin.scenarios.regression.run_history import run_history
from fieldtwin.twin.site.system import System

SHOWN = 30
LENGTHS_S = 1.0
"""A difference between the lengths of two runs that is larger than this (seconds) is reported."""


def allowed_of(options: ToleranceOptions) -> Allowed:
    """Parse ``2%`` for all fields or ``ctd.pressure=0.5`` for one. Raises `UsageError`."""
    share, amounts = Allowed().share, {}
    for text in options.tolerances:
        name, equals, amount = text.rpartition("=")
        try:
            number = float(amount.removesuffix("%"))
        except ValueError:
            number = -1.0
        if number < 0 or bool(equals) == amount.endswith("%"):
            raise UsageError(f"cannot read --tolerance {text!r}", expected="2%, or DEVICE.TAG=0.5")
        if equals:
            amounts[name] = number
        else:
            share = number / 100
    return Allowed(options.window_s, share, amounts, ignored=frozenset(options.ignored))


def judged(system: System, old: Path, new: Path, allowed: Allowed) -> RunComparison:
    """Compare the run in the file `new` with the run in the file `old`. Raises `FileInvalid`."""
    return compare(
        run_history(system, read_events(old, system)), run_history(system, read_events(new, system)), allowed
    )


def show(verdict: RunComparison, old: Path, *, as_json: bool) -> int:
    """Print the comparison and return the exit code: 0 if the runs are the same, else 1."""
    if as_json:
        json.dump(
            {
                "against": str(old),
                "same": verdict.same,
                "compared": verdict.compared,
                "compared_s": verdict.common_s,
                "old_s": verdict.old_s,
                "new_s": verdict.new_s,
                "differences": [{k: getattr(d, k) for k in d.__slots__} for d in verdict.differences],
            },
            sys.stdout,
            indent=2,
        )
        click.echo()
        return 0 if verdict.same else 1
    for difference in verdict.differences[:SHOWN]:
        stdout.print(f"[red]{difference.what:<8}[/red] {escape(str(difference))}", soft_wrap=True, highlight=False)
    more = len(verdict.differences) - SHOWN
    if more > 0:
        stdout.print(f"... and {more} more (--json has all)")
    if verdict.same:
        said = f"[green]the same[/green] as {escape(old.name)}"
    elif not verdict.compared:
        said = "[red]nothing in these runs can be compared[/red]"
    else:
        said = f"[red]{len(verdict.differences)} differences[/red] from {escape(old.name)}"
    stdout.print(
        f"{said}: {verdict.compared} fields and services compared over {verdict.common_s:.1f} s",
        highlight=False,
        soft_wrap=True,
    )
    if abs(verdict.old_s - verdict.new_s) > LENGTHS_S:
        stdout.print(
            f"  not compared: what one run has after that (lengths {verdict.old_s:.1f} s and {verdict.new_s:.1f} s)",
            highlight=False,
            soft_wrap=True,
        )
    return 0 if verdict.same else 1


def write_scenario(
    system: System, run: Path, out: Path, named: str, *, allowed: Allowed, seed: int | None, values: bool
) -> int:
    """Write the run in the file `run` as a scenario to `out`; `named` is the system as the user named it. Return the exit
    code.

    Raises `UsageError` if the file exists.
    """
    if not out.name.endswith(SUFFIX):
        raise UsageError("a scenario's name", expected=f"NAME{SUFFIX}", got=out.name)
    beside = Path(named).is_file()
    wanted = ScenarioOptions(
        f"{system.name}, as in {run.name}",
        os.path.relpath(system.path.resolve(), out.resolve().parent) if beside else f"{system.name}.yaml",
        allowed.share,
        allowed.window_s,
        seed,
        values,
        run.name,
    )
    text = as_scenario(system, run_history(system, read_events(run, system)), wanted)
    try:
        with out.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise UsageError(
            "the file already exists", got=str(out), hint="choose another name, or remove the file"
        ) from None
    except OSError as e:
        raise UsageError(f"cannot write: {e.strerror or e}", got=str(out)) from e
    steps = text.count("\n  - ")
    stderr.print(f"{steps} steps  →  {escape(str(out))}; run it: fieldtwin test {escape(str(out))}", soft_wrap=True)
    return 0
