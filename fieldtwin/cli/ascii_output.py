"""Output for terminals whose encoding has no arrows: they are replaced by ASCII letters, so printing never fails."""

from __future__ import annotations

import codecs
import io
import sys

_PLAIN = {"→": "->", "←": "<-", "⇄": "<->", "⇅": "<->", "…": "...", "–": "-", "±": "+-", "·": ".", "×": "x"} | {
    **dict.fromkeys("─├└│", "-"), **dict(zip("▁▂▃▄▅▆▇█", "_..--==#", strict=True)), "✓": "y", "✗": "n", "☐": "o"
}  # fmt: skip


def write_plainly() -> None:
    """Make stdout and stderr replace characters that their encoding lacks, unless they use UTF-8."""
    codecs.register_error("fieldtwin-plain", _in_plain_letters)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and not stream.encoding.lower().startswith("utf"):
            stream.reconfigure(errors="fieldtwin-plain")


def _in_plain_letters(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(_PLAIN.get(letter, "?") for letter in error.object[error.start : error.end]), error.end
