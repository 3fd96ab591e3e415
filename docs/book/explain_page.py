"""Generate the reference page of the codes and words that `fieldtwin explain` knows. Test cases have separate pages."""

from __future__ import annotations

from itertools import groupby

from fieldtwin.explain.explanation import Explanation
from fieldtwin.explain.lookup import everything

HEADINGS = {
    "Modbus exception": "Modbus exceptions",
    "SDO abort code": "SDO abort codes",
    "quality": "Qualities of values",
    "quality reason": "Reasons for a quality",
    "error": "Errors",
    "exit code": "Exit codes",
    "verdict": "Verdicts of test cases",
    "certainty": "Certainty of results of commissioning",
    "warning of Structured Text": "Warnings of Structured Text",
    "fault": "Faults",
}


def explain_page() -> str:
    """Return the page as Markdown. Its anchors are the IDs, such as ``#exit-4`` and ``#exception-02``."""
    parts = [
        "# Codes and words\n",
        "Each entry is what `fieldtwin explain` prints: the meaning, what to do, and the source. Words can be copied from a"
        " message as they are. [Test cases](cases/README.md) have their own pages.\n",
    ]
    for kind, entries in groupby(described(), key=lambda entry: entry.kind):
        parts.append(f"## {HEADINGS[kind]}\n")
        parts += [_entry(entry) for entry in entries]
    return "\n".join(parts)


def described() -> list[Explanation]:
    """Return the entries of this page."""
    return [entry for entry in everything() if not entry.page]


def anchor(entry: Explanation) -> str:
    """Return the anchor of an entry. Words that are also a fault's or an error's name get the kind in front."""
    plain = entry.id.lower().replace(" ", "-").replace("_", "-")
    return f"{entry.kind}-{plain}" if entry.kind in ("fault", "error") else plain


def _entry(entry: Explanation) -> str:
    lines = [
        f"({anchor(entry)})=",
        f"### {entry.id}: {entry.title}\n",
        f"{entry.meaning}\n",
        f"**What to do:** {entry.todo}\n",
    ]
    return "\n".join([*lines, *([f"*Source: {entry.source}*\n"] if entry.source else [])])
