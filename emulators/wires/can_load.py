"""The traffic of a CAN bus: totals, and the load of the last second, by identifier and by node.

The load counts every bit for which the bus was busy: frames with their stuff bits and interframe space, and errors. It is
assigned to the identifier and the node that were sending. To limit memory, identifiers beyond the first `MAX_IDS_COUNTED` are
counted together as ``other``.
"""

from __future__ import annotations

from collections import Counter, deque

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S

MAX_IDS_COUNTED = 4096

_SLOT_NS = 100 * NS_PER_MS
_SLOTS = 10  # the load is that of the last second


_EXTENDED = 1 << 29
_OTHER = -1


class BusLoad:
    """The counters of all attempts, successful or not. An identifier is a number, with an additional bit if it is extended.

    Names and sums are computed on access.
    """

    def __init__(self, bitrate: int) -> None:
        self.bits = 0
        self._by_id: dict[int, int] = {}
        self._one_s_bits = bitrate * _SLOTS * _SLOT_NS / NS_PER_S
        self._slots: deque[tuple[int, dict[tuple[int, tuple[int, ...]], int]]] = deque(maxlen=_SLOTS)
        """The last time slots (100 ms each) with traffic: for each, its number and its bits by identifier and senders."""
        self._number = -1
        self._slot: dict[tuple[int, tuple[int, ...]], int] = {}
        """The bits of the newest time slot, by identifier and senders."""

    @property
    def frames(self) -> int:
        """Return the number of whole frames."""
        return sum(self._by_id.values())

    @property
    def by_id(self) -> dict[str, int]:
        """Return the number of whole frames by identifier, in candump's notation."""
        return {_name(key): frames for key, frames in self._by_id.items()}

    def count(self, frame: CanFrame, bits: int, end_ns: int, senders: tuple[int, ...], *, whole: bool) -> None:
        """Count `bits` that were on the bus until `end_ns`. `whole` says that they were a frame and not an error."""
        key = frame.can_id | _EXTENDED if frame.extended else frame.can_id
        by_id = self._by_id
        if key not in by_id and len(by_id) >= MAX_IDS_COUNTED:
            key = _OTHER
        self.bits += bits
        by_id[key] = by_id.get(key, 0) + whole  # an identifier that never succeeded is listed with 0
        number = end_ns // _SLOT_NS
        if self._number != number:
            self._number, self._slot = number, {}
            self._slots.append((number, self._slot))
        by_sender, slot = (key, senders), self._slot
        slot[by_sender] = slot.get(by_sender, 0) + bits

    def total(self, now_ns: int) -> float:
        """Return the load of the bus in the last second, 0 to 1 (or more if frames are instant)."""
        return sum(bits for _, bits in self._last_second(now_ns)) / self._one_s_bits

    def by_identifier(self, now_ns: int) -> dict[str, float]:
        """Return the load of the last second by identifier."""
        summed: Counter[str] = Counter()
        for (key, _), bits in self._last_second(now_ns):
            summed[_name(key)] += bits
        return {name: bits / self._one_s_bits for name, bits in summed.items()}

    def by_node(self, now_ns: int) -> dict[int, float]:
        """Return the load of the last second by node. A frame that several nodes sent together counts for each of them."""
        summed: Counter[int] = Counter()
        for (_, senders), bits in self._last_second(now_ns):
            for node in senders:
                summed[node] += bits
        return {node: bits / self._one_s_bits for node, bits in summed.items()}

    def _last_second(self, now_ns: int) -> list[tuple[tuple[int, tuple[int, ...]], int]]:
        newest = now_ns // _SLOT_NS
        return [carried for number, slot in self._slots if newest - number < _SLOTS for carried in slot.items()]


def _name(key: int) -> str:
    if key == _OTHER:
        return "other"
    return f"{key ^ _EXTENDED:08X}" if key & _EXTENDED else f"{key:03X}"
