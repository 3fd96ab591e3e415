"""``--fail-on`` of `fieldtwin check`, for devices and masters: which failed cases give exit code 1."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from fieldtwin.conformance.core.case import Basis
    from fieldtwin.conformance.core.results import CaseResult

FAIL_ON = {"standard": 1, "robustness": 2, "field": 3}
"""The number of bases, in the order of `Basis`, that decide the exit code."""
fail_on_option = click.option(
    "--fail-on", type=click.Choice(tuple(FAIL_ON)), default="standard", show_default=True,
    help="Failed cases that cause exit code 1: those required by the standard, also robustness, or also known field "
         "problems.",
)  # fmt: skip


def bases_of(choice: str) -> frozenset[Basis]:
    """Return the bases whose failed cases decide the exit code."""
    from fieldtwin.conformance.core.case import Basis

    return frozenset(list(Basis)[: FAIL_ON[choice]])


def print_not_counted(results: Sequence[CaseResult], fail_on: frozenset[Basis]) -> None:
    """Print that failures are not counted, if there are any."""
    from fieldtwin.conformance.core.results import counts_as_failed
    from fieldtwin.console import stderr

    if any(r.verdict.bad and not counts_as_failed(r, fail_on) for r in results):
        stderr.print(
            "The standard does not require what robustness and field problem cases ask. "
            "The exit code does not count them: see --fail-on.", markup=False, soft_wrap=not stderr.is_terminal,
        )  # fmt: skip
