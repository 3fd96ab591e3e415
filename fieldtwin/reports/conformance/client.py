"""The conformance report of a client as one HTML file."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from fieldtwin.__about__ import __version__
from fieldtwin.conformance.core.case import Basis
from fieldtwin.conformance.core.evidence import reproduce
from fieldtwin.conformance.core.results import ONLY_REQUIRED, CaseResult
from fieldtwin.reports.conformance.page import render_page
from fieldtwin.reports.file import put


def write_client_html(
    results: Sequence[CaseResult],
    title: str,
    argv: Sequence[str],
    started: str,
    path: Path,
    fail_on: frozenset[Basis] = ONLY_REQUIRED,
) -> None:
    """Write the report; raises `FileInvalid` where that is not possible."""
    put(path, render_client_html(results, title, argv, started, fail_on))


def render_client_html(
    results: Sequence[CaseResult],
    title: str,
    argv: Sequence[str],
    started: str,
    fail_on: frozenset[Basis] = ONLY_REQUIRED,
) -> str:
    """Return the whole page. Each failed or open case comes with its frames and the command that repeats it.

    The headline is failed if a case failed whose basis is one of `fail_on`, as the exit code is.
    """
    return render_page(
        title,
        results,
        [("checked", started), ("fieldtwin", __version__)],
        shlex.join(["fieldtwin", *argv]),
        does="the device",
        frames_of=lambda result: result.wire,
        repeat=lambda id: reproduce(argv, id),
        fail_on=fail_on,
    )
