"""Make text from files and devices safe for a terminal: escape characters that would move the cursor or change colours."""

from __future__ import annotations


def escape_controls(text: str) -> str:
    """Return `text` with its line breaks and tabs unchanged, and every other unprintable character escaped as Python does."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in "\n\t" else c.encode("unicode_escape").decode() for c in text)
