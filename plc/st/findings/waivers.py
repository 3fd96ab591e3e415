"""Waivers: comments that accept a warning at one place, with a reason.

    after(IN := run); // fieldtwin: allow ST105: the timer is reset by hand

In a system file, the comment begins with #. A waiver counts for its own line and for the line below it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from fieldtwin.plc.st.dialects import FINDINGS, WARNINGS, StWarning

_TOKEN = re.compile(r"""'(?:\$.|[^'$\n])*'|"(?:\$.|[^"$\n])*"|(?P<comment>//[^\n]*|\(\*.*?\*\)|/\*.*?\*/)""", re.DOTALL)
"""Strings, in which a waiver is only text, and comments."""
_YAML_TOKEN = re.compile(r"""'[^'\n]*'|"(?:\\.|[^"\\\n])*"|(?:^|(?<=\s))(?P<comment>#[^\n]*)""", re.MULTILINE)
"""The same for a file in YAML, where a comment begins with # after a space."""
_WAIVER = re.compile(
    r"\bfieldtwin:[ \t]*allow[ \t]+(\w+)[ \t]*(?::[ \t]*([^\n]*?))?[ \t]*(?:\*\)|\*/|$)", re.IGNORECASE | re.MULTILINE
)


@dataclass(frozen=True, slots=True)
class Waiver:
    """A waiver of the warning `id` at a line, from 1, of a file."""

    id: str
    reason: str
    path: str
    line: int

    def covers(self, warning: StWarning) -> bool:
        return (warning.id, warning.path) == (self.id, self.path) and warning.line in (self.line, self.line + 1)


def waivers_of(path: str) -> list[Waiver]:
    """Return the waivers in the text of a file that was compiled before."""
    return _waivers(path, _TOKEN)


def waivers_in_yaml(path: str) -> list[Waiver]:
    """Return the waivers in the text of a system file that was read before."""
    return _waivers(path, _YAML_TOKEN)


def _waivers(path: str, tokens: re.Pattern[str]) -> list[Waiver]:
    text = Path(path).read_text("utf-8-sig", errors="replace")
    return [
        Waiver(found[1].upper(), found[2] or "", path, 1 + text.count("\n", 0, token.start() + found.start()))
        for token in tokens.finditer(text)
        if token["comment"]
        for found in _WAIVER.finditer(token[0])
    ]


def without_waived(
    warnings: Iterable[StWarning], waivers: Sequence[Waiver]
) -> tuple[list[StWarning], list[tuple[StWarning, Waiver]]]:
    """Return the warnings that no waiver covers, with one for each waiver that is wrong, and the waived warnings."""
    left, waived = [], []
    for warning in warnings:
        covering = next((one for one in waivers if one.reason and one.covers(warning)), None)
        if covering is None:
            left.append(warning)
        else:
            waived.append((warning, covering))
    used = {waiver for _, waiver in waived}
    for waiver in waivers:
        if waiver.id not in WARNINGS and waiver.id not in FINDINGS:
            wrong = f"the waiver names no warning: {waiver.id}"
        elif not waiver.reason:
            wrong = f"the waiver of {waiver.id} has no reason; write `fieldtwin: allow {waiver.id}: REASON`"
        elif waiver not in used:
            wrong = f"the waiver of {waiver.id} matches no warning in its line or the next one"
        else:
            continue
        left.append(StWarning("ST100", wrong, waiver.path, waiver.line, 1))
    return left, waived
