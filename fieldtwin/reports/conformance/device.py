"""The conformance report of a device as one HTML file.

write_html(subject, results, reproduce, path)
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fieldtwin.conformance.core.case import Basis
from fieldtwin.conformance.core.evidence import Line
from fieldtwin.conformance.core.results import ONLY_REQUIRED
from fieldtwin.conformance.devices.device_case import DeviceResult
from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.reports.conformance.page import render_page
from fieldtwin.reports.file import put
from fieldtwin.results.subject import Subject

MOST_LINES = 60
"""Maximum number of lines that show the bytes of one case."""


def write_html(
    subject: Subject,
    results: Sequence[DeviceResult],
    reproduce: str,
    path: Path,
    fail_on: frozenset[Basis] = ONLY_REQUIRED,
) -> None:
    """Write the report; raises `FileInvalid` where that is not possible."""
    put(path, render_html(subject, results, reproduce, fail_on))


def render_html(
    subject: Subject, results: Sequence[DeviceResult], reproduce: str, fail_on: frozenset[Basis] = ONLY_REQUIRED
) -> str:
    """Return the whole page. `reproduce` is the command that repeats all cases.

    The headline is failed if a case failed whose basis is one of `fail_on`, as the exit code is.
    """
    facts = [
        ("device", subject.name),
        *subject.identity.items(),
        ("checked", subject.started),
        ("by", f"{subject.by} on {subject.host}" if subject.by else subject.host),
        ("impact", f"up to {subject.at_most}" + (f", writing to {', '.join(subject.wrote)}" if subject.wrote else "")),
        ("reply timeout", f"{subject.timeout_s:g} s"),
        ("fieldtwin", subject.fieldtwin),
    ]
    return render_page(
        subject.name,
        results,
        facts,
        reproduce,
        does="sent",
        frames_of=_frames,
        repeat=lambda id: f"{reproduce} --only {id}",
        fail_on=fail_on,
    )


def _frames(result: DeviceResult) -> list[Line]:
    lines = [
        Line(s.t_ns / NS_PER_MS, "sent" if s.direction is Direction.SENT else "received", s.text, "")
        for s in result.spoken[:MOST_LINES]
    ]
    more = len(result.spoken) - MOST_LINES
    return [*lines, Line(lines[-1].t_ms, "", "", f"and {more} more")] if more > 0 else lines
