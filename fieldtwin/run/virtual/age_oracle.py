"""The strict check of a run in virtual time: the device held every value that was published as good within the value's age.

Gateway and emulators share one clock in virtual time, so the check is exact: between the moment of the request (for an
unrequested value: the value's own time) and the publication the device must have held exactly these bytes at least once.
History older than `KEPT_NS` is dropped, so that memory is bounded.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_S

KEPT_NS = 600 * NS_PER_S
EXAMPLES = 10


@dataclass
class _Held:
    """The history of a tag's raw value: `raws[i]` was valid from `times_ns[i]` on."""

    times_ns: list[int] = field(default_factory=list)
    raws: list[bytes] = field(default_factory=list)

    def was(self, raw: bytes, from_ns: int, to_ns: int) -> bool:
        """Return whether the device held `raw` at any time in the interval, both ends included.

        A value that was replaced at `from_ns` counts as held at that instant.
        """
        first = bisect_left(self.times_ns, from_ns)
        last = bisect_right(self.times_ns, to_ns, first)
        return raw in self.raws[first - 1 if first else 0 : last]

    def forget(self, before_ns: int) -> None:
        gone = bisect_right(self.times_ns, before_ns) - 1
        if gone > 0:
            del self.times_ns[:gone], self.raws[:gone]


class AgeOracle:
    """The check of one system. The caller reports `published` and `held` values in order of time, and then calls `check`."""

    def __init__(self) -> None:
        self.checked = 0
        self.wrong_count = 0
        self.wrong: list[str] = []
        self._held: dict[str, _Held] = {}
        self._waiting: list[tuple[int, str, bytes, object, int]] = []
        self._still_good: list[tuple[int, str, bytes, object, int]] = []

    def held(self, tag: str, raw: bytes, t_ns: int) -> None:
        """Record that the device holds `raw` for DEVICE.TAG from `t_ns` on."""
        held = self._held.get(tag)
        if held is None:
            held = self._held[tag] = _Held()
        held.times_ns.append(t_ns)
        held.raws.append(raw)

    def published(self, tag: str, raw: bytes, value: object, source_ns: int, now_ns: int) -> None:
        """Record that DEVICE.TAG was published as good at `now_ns`; its value may not be older than `source_ns`."""
        self._waiting.append((now_ns, tag, raw, value, source_ns))

    def still_good(self, tag: str, raw: bytes, value: object, source_ns: int, now_ns: int) -> None:
        """Record that DEVICE.TAG is still good at `now_ns`; checked like `published`, but not counted as a published value."""
        self._still_good.append((now_ns, tag, raw, value, source_ns))

    def check(self, emulated: frozenset[str]) -> None:
        """Compare the values published since the last call with the devices' histories. Skip devices that are not `emulated`."""
        histories: dict[str, _Held | None] = {}
        """The history of each tag that is checked; None for a tag of a device that is not emulated."""

        def history(tag: str) -> _Held | None:
            known = histories[tag] = self._held.setdefault(tag, _Held()) if tag.partition(".")[0] in emulated else None
            return known

        for now_ns, tag, raw, value, source_ns in self._waiting:
            held = histories[tag] if tag in histories else history(tag)
            if held is None:
                continue
            self.checked += 1
            if not held.was(raw, source_ns, now_ns):
                age_s = (now_ns - source_ns) / NS_PER_S
                self._refuse(
                    f"{tag} was published as {value!r} ({raw.hex()}), {age_s:.3f} s old: the device never had this value"
                )
        for now_ns, tag, raw, value, source_ns in self._still_good:
            held = histories[tag] if tag in histories else history(tag)
            if held is not None and not held.was(raw, source_ns, now_ns):
                limit_s = (now_ns - source_ns) / NS_PER_S
                self._refuse(
                    f"{tag} was still good as {value!r} ({raw.hex()}): the device had no such value in the last {limit_s:.3f} s"
                )
        self._still_good.clear()
        if self._waiting:
            oldest_ns = self._waiting[-1][0] - KEPT_NS
            for held in self._held.values():
                held.forget(oldest_ns)
        self._waiting.clear()

    def _refuse(self, text: str) -> None:
        self.wrong_count += 1
        if len(self.wrong) < EXAMPLES:
            self.wrong.append(text)

    def describe(self) -> dict[str, Any]:
        return {"checked": self.checked, "wrong": self.wrong_count, "examples": list(self.wrong)}
