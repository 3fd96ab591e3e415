"""A short-lived cache of read replies, so that ten HMIs cause no more traffic on the bus than one.

The cache is limited in size. A reply older than `age_ms` is never returned, and a write to a unit deletes the replies of that
unit. This module does no I/O.
"""

from __future__ import annotations

from collections import OrderedDict

from fieldtwin.gateway.core.clock import NS_PER_MS

MOST = 1024
CACHED_FUNCTIONS = frozenset({0x01, 0x02, 0x03, 0x04})


class ReplyCache:
    """A cache of reply PDUs by bus, unit and request PDU. If `age_ms` is 0, it keeps nothing."""

    def __init__(self, age_ms: int) -> None:
        self._age_ns = age_ms * NS_PER_MS
        self._kept: OrderedDict[tuple[str, int, bytes], tuple[bytes, int]] = OrderedDict()
        self.hits = 0
        self.evicted = 0

    def get(self, bus: str, unit: int, pdu: bytes, now_ns: int) -> bytes | None:
        """Return a reply that was received within the last `age_ms`, or None."""
        found = self._kept.get((bus, unit, pdu)) if self._age_ns else None
        if found is None or now_ns - found[1] > self._age_ns:
            return None
        self.hits += 1
        return found[0]

    def put(self, bus: str, unit: int, pdu: bytes, reply: bytes, t_ns: int) -> None:
        """Keep a normal reply that was complete at `t_ns`."""
        if not self._age_ns or pdu[0] not in CACHED_FUNCTIONS:
            return
        key = (bus, unit, pdu)
        self._kept[key] = (reply, t_ns)
        self._kept.move_to_end(key)
        if len(self._kept) > MOST:
            self._kept.popitem(last=False)
            self.evicted += 1

    def forget(self, bus: str, unit: int) -> None:
        """Delete the replies of a unit that was written to; unit 0 means every unit of the bus."""
        for key in [k for k in self._kept if k[0] == bus and unit in (k[1], 0)]:
            del self._kept[key]
