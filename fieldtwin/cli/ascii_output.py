"""Output where the locale knows no arrows: they are drawn with the letters that there are, and nothing fails for them."""

from __future__ import annotations

import codecs
import io
import sys

_PLAIN = {"→": "->", "←": "<-", "⇄": "<->", "⇅": "<->", "…": "...", "–": "-", "±": "+-", "·": ".", "×": "x"} | {
    **dict.fromkeys("─├└│", "-"), **dict(zip("▁▂▃▄▅▆▇█", "_..--==#", strict=True)), "✓": "y", "✗": "n", "☐": "o"
}  # fmt: skip


def write_plainly() -> None:
    """From now on stdout and stderr put what their encoding lacks into plain letters, unless they are UTF-8."""
    codecs.register_error("fieldtwin-plain", _in_plain_letters)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and not stream.encoding.lower().startswith("utf"):
            stream.reconfigure(errors="fieldtwin-plain")


def _in_plain_letters(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(_PLAIN.get(letter, "?") for letter in error.object[error.start : error.end]), error.end
