"""The site acceptance document: one HTML file to print and sign, without network access or scripts.

It is designed for paper: A4, readable in black and white, without hidden content. Its text is in templates/site.html.j2.
"""

from __future__ import annotations

from pathlib import Path

from fieldtwin.reports.file import put
from fieldtwin.reports.pages import fill
from fieldtwin.reports.site.document import SiteDocument, Weight

MOST_DEVIATIONS = 1000
HEADINGS = {"check": "Conformance check", "dump": "Dump", "comparison": "Comparison", "difference": "Difference"}
WORDS = {
    "deviation": "deviation", "open": "open point", "robustness": "robustness", "field problem": "known field problem",
    "waived": "waived",
}  # fmt: skip
NOTED: dict[Weight, str] = {"robustness": "robustness finding", "field problem": "known field problem"}
"""The words with which the result counts findings that do not deviate from the standard."""


def write_html(document: SiteDocument, path: Path) -> None:
    """Write the page. Raises `FileInvalid` if it cannot be written."""
    put(path, render_html(document))


def render_html(document: SiteDocument) -> str:
    """Return the whole page."""
    deviations, opened, waived = document.count("deviation"), document.count("open"), document.count("waived")
    result = [plural(deviations, "deviation"), plural(opened, "open point")]
    result += [plural(count, word) for weight, word in NOTED.items() if (count := document.count(weight))]
    result += [f"{waived} waived"] if waived else []
    facts = [
        ("site", document.site),
        ("for", document.customer),
        ("carried out by", document.by),
        ("checked", _span(document)),
        ("prepared", day(document.prepared)),
        ("devices", str(len(document.devices))),
    ]
    return fill(
        "site.html.j2", document=document, facts=facts, result=", ".join(result), to_decide=deviations or opened,
        found=document.deviations, day=day, HEADINGS=HEADINGS, WORDS=WORDS, MOST_DEVIATIONS=MOST_DEVIATIONS,
    )  # fmt: skip


def day(when: str) -> str:
    """Return an ISO 8601 time as text, such as ``2026-11-21 11:33 UTC``."""
    if len(when) < 16 or when[10:11] != "T":
        return when
    return f"{when[:10]} {when[11:16]}" + (" UTC" if when.endswith(("+00:00", "Z")) else "")


def plural(count: int, word: str) -> str:
    """Return a count with its word, such as ``no deviation``, ``1 deviation`` or ``2 deviations``."""
    return f"{count or 'no'} {word}{'' if count in (0, 1) else 's'}"


def _span(document: SiteDocument) -> str:
    """Return the time from the first to the last action."""
    times = sorted(piece.when for device in document.devices for piece in device.pieces if piece.when)
    if not times:
        return ""
    first, last = day(times[0]), day(times[-1])
    return first if first == last else f"{first} to {last}"
