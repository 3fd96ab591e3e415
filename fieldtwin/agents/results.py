"""The results of tools as text of a limited length. A long result is kept, and an agent reads it in parts."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

import msgspec

from fieldtwin.gateway.core.errors import UsageError

MOST_CHARACTERS = 24_000
"""Length of one answer in characters."""
PART_CHARACTERS = MOST_CHARACTERS - 200
"""Length of a part, which leaves room for the note about the rest."""
MOST_KEPT = 8
"""Number of long results that are kept, the latest ones."""
MOST_KEPT_CHARACTERS = 8 << 20


class Results:
    """Texts of results. `shown` returns the first part of a long one, and `part` the rest."""

    def __init__(self) -> None:
        self._kept: OrderedDict[int, str] = OrderedDict()
        self._count = 0

    def shown(self, result: Any) -> str:
        """Return a result as text: a string as it is, and other data as JSON."""
        text = result if isinstance(result, str) else msgspec.json.encode(result, enc_hook=str).decode()
        if len(text) <= MOST_CHARACTERS:
            return text
        self._count += 1
        self._kept[self._count] = text[:MOST_KEPT_CHARACTERS]
        while len(self._kept) > MOST_KEPT:
            self._kept.popitem(last=False)
        return self.part(self._count, 0)

    def part(self, number: int, offset: int) -> str:
        """Return a part of a kept result. Raises `UsageError` for one that is not kept."""
        if offset < 0:
            raise UsageError("the offset", expected="0 or more", got=str(offset))
        text = self._kept.get(number)
        if text is None:
            raise UsageError(
                f"result {number} is not kept",
                expected=", ".join(map(str, self._kept)) or "none is kept",
                hint="call the tool again",
            )
        end = offset + PART_CHARACTERS
        part = text[offset:end]
        if end >= len(text):
            return part
        note = f"[characters {offset} to {end} of {len(text)}; the rest: read_rest(result={number}, offset={end})]"
        return f"{part}\n{note}"
