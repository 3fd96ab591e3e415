"""Select test cases: ``--only`` of `fieldtwin check`, for clients and devices."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Protocol

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.nearest import nearest

_ID = re.compile(r"^((?:MB|CO)-)?(\d{1,3})([a-h]?)$", re.IGNORECASE)


class Named(Protocol):
    """An object with an ID and a row of the test-case list."""

    @property
    def id(self) -> str: ...

    @property
    def row(self) -> str: ...


def only_of(text: str | None, cases: Sequence[Named]) -> frozenset[str]:
    """Parse ``MB-013,15a`` as IDs. An unknown one is a `UsageError` with the nearest match."""
    chosen = set()
    known = {case.id for case in cases} | {case.row for case in cases}
    prefix = cases[0].id[:3]
    for part in (text or "").split(","):
        if not part.strip():
            continue
        match = _ID.match(part.strip())
        id = f"{(match[1] or prefix).upper()}{int(match[2]):03}{match[3].lower()}" if match else part.strip()
        if id not in known:
            near = nearest(id, known)
            raise UsageError(f"no case {part.strip()!r}", expected=near[0] if near else "an id such as " + cases[0].id)
        chosen.add(id)
    return frozenset(chosen)
