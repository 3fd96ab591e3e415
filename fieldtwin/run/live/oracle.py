"""The check of a prototype run: the device held every value that was published as good.

It fetches the values that the gateway published and those that the emulators held, by journal number, so that none is compared
twice and memory stays bounded. A value is right if the device held exactly these bytes for this tag at or before the time of
the value.
"""

from __future__ import annotations

from collections import defaultdict, deque
from typing import Any

from fieldtwin.gateway.core.control import ControlClient

KEPT = 100_000
"""Maximum number of held values per tag; the oldest are dropped first."""
EXAMPLES = 10


class Oracle:
    """The check: call `update` about once a second and once at the end."""

    def __init__(self) -> None:
        self.checked = 0
        self.wrong: list[str] = []
        self.wrong_count = 0
        self.unknown = 0
        """Number of values that cannot be checked, because the field simulator was away at their time and the values that its
        devices held then are lost.
        """
        self._published = 0
        self._held_numbers: dict[str, int] = {}
        self._held: dict[str, set[str]] = defaultdict(set)
        self._order: dict[str, deque[str]] = defaultdict(deque)
        self._emulated: set[str] = set()
        self._unjudged: list[Any] = []
        self._gap = False

    async def update(self, gateway: ControlClient, field: ControlClient) -> None:
        """Fetch the next published values, then the held values, and compare them. In this order the held values cover the
        published ones.

        Both are fetched in pieces.
        """
        while len(self._unjudged) < KEPT:  # the next call checks the rest
            piece = (await gateway.call("published", since=self._published))["entries"]
            if not piece:
                break
            self._unjudged += piece
            self._published = piece[-1][0]
        while await self._fetch_held(field):
            pass
        for _, tag, raw, _, value in self._unjudged:
            self._judge(tag, raw, value)
        self._unjudged.clear()
        self._gap = False

    def begin_again(self) -> None:
        """Start again with a new process of the field simulator, whose journals begin at 1. The last entries of the old
        journals were not read.
        """
        self._held_numbers.clear()
        self._gap = True

    async def _fetch_held(self, field: ControlClient) -> bool:
        """Fetch the next piece of the devices' held values; return False when there was none."""
        new = False
        for device, entries in (await field.call("held", since=self._held_numbers)).items():
            self._emulated.add(device)
            for number, tag, raw, _ in entries:
                self._held_numbers[device] = number
                self._keep(f"{device}.{tag}", raw)
                new = True
        return new

    def _keep(self, tag: str, raw: str) -> None:
        if raw in self._held[tag]:
            return
        self._held[tag].add(raw)
        self._order[tag].append(raw)
        if len(self._order[tag]) > KEPT:
            self._held[tag].discard(self._order[tag].popleft())

    def _judge(self, tag: str, raw: str, value: Any) -> None:
        if tag.split(".", 1)[0] not in self._emulated:
            return  # in a prototype with real devices, the register values of a real device are not known
        if raw not in self._held[tag] and self._gap:
            self.unknown += 1
            return
        self.checked += 1
        if raw not in self._held[tag]:
            self.wrong_count += 1
            if len(self.wrong) < EXAMPLES:
                self.wrong.append(f"{tag} was published as {value!r} ({raw}); the device never had this value")

    def describe(self) -> dict[str, Any]:
        return {
            "checked": self.checked, "wrong": self.wrong_count, "unknown": self.unknown, "examples": list(self.wrong)
        }  # fmt: skip
