"""The conformance report of a master as one HTML file."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from fieldtwin.__about__ import __version__
from fieldtwin.conformance.core.evidence import reproduce
from fieldtwin.conformance.core.results import CaseResult
from fieldtwin.reports.conformance.page import render_page
from fieldtwin.reports.file import put


def write_master_html(results: Sequence[CaseResult], title: str, argv: Sequence[str], started: str, path: Path) -> None:
    """Write the report; raises `FileInvalid` where that is not possible."""
    put(path, render_master_html(results, title, argv, started))


def render_master_html(results: Sequence[CaseResult], title: str, argv: Sequence[str], started: str) -> str:
    """Return the whole page. Each failed or open case comes with its frames and the command that repeats it."""
    return render_page(
        title,
        results,
        [("checked", started), ("fieldtwin", __version__)],
        shlex.join(["fieldtwin", *argv]),
        does="the device",
        frames_of=lambda result: result.wire,
        repeat=lambda id: reproduce(argv, id),
    )
