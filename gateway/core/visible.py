"""Text from elsewhere as a terminal may be shown it: what would move the cursor or change colours stands as an escape."""

from __future__ import annotations


def visible(text: str) -> str:
    """`text` with its lines and tabs as they are, and every other character that cannot be seen as Python writes it."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in "\n\t" else c.encode("unicode_escape").decode() for c in text)
