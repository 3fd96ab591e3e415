"""What a CAN bus carried: totals, and the load of the last second, per identifier and per node.

The load counts every bit that kept the bus busy: frames with their stuff bits and interframe space, and what errors cost. It is
charged to the identifier and the node that were sending. Bounded: beyond `MAX_IDS_COUNTED` identifiers the rest is ``other``.
"""

from __future__ import annotations

from collections import Counter, deque

from gateway.core.canframe import CanFrame
from gateway.core.clock import NS_PER_MS, NS_PER_S

MAX_IDS_COUNTED = 4096

_SLOT_NS = 100 * NS_PER_MS
_SLOTS = 10  # the load is that of the last second


class _Slot:
    __slots__ = ("bits", "by_id", "by_node", "number")

    def __init__(self, number: int) -> None:
        self.number = number
        self.bits = 0
        self.by_id: Counter[str] = Counter()
        self.by_node: Counter[int] = Counter()


class BusLoad:
    """Counts attempts of any outcome. `by_id` counts whole frames, named as candump writes identifiers."""

    def __init__(self, bitrate: int) -> None:
        self.frames = 0
        self.bits = 0
        self.by_id: Counter[str] = Counter()
        self._one_s_bits = bitrate * _SLOTS * _SLOT_NS / NS_PER_S
        self._slots: deque[_Slot] = deque(maxlen=_SLOTS)

    def count(self, frame: CanFrame, bits: int, end_ns: int, senders: tuple[int, ...], *, whole: bool) -> None:
        """`bits` were on the wire until `end_ns`; `whole`: they were a frame, not an error."""
        name = f"{frame.can_id:08X}" if frame.extended else f"{frame.can_id:03X}"
        if name not in self.by_id and len(self.by_id) >= MAX_IDS_COUNTED:
            name = "other"
        self.bits += bits
        self.by_id[name] += whole  # an identifier that never got through is listed with 0
        self.frames += whole
        number = end_ns // _SLOT_NS
        if not self._slots or self._slots[-1].number != number:
            self._slots.append(_Slot(number))
        slot = self._slots[-1]
        slot.bits += bits
        slot.by_id[name] += bits
        for node in senders:
            slot.by_node[node] += bits

    def total(self, now_ns: int) -> float:
        """Share of the last second's bits that carried something, 0 to 1 (more is possible where frames are instant)."""
        return sum(slot.bits for slot in self._last_second(now_ns)) / self._one_s_bits

    def by_identifier(self, now_ns: int) -> dict[str, float]:
        """The same, by identifier."""
        summed: Counter[str] = Counter()
        for slot in self._last_second(now_ns):
            summed.update(slot.by_id)
        return {name: bits / self._one_s_bits for name, bits in summed.items()}

    def by_node(self, now_ns: int) -> dict[int, float]:
        """The same, by node. Where nodes sent one frame together, it counts for each."""
        summed: Counter[int] = Counter()
        for slot in self._last_second(now_ns):
            summed.update(slot.by_node)
        return {node: bits / self._one_s_bits for node, bits in summed.items()}

    def _last_second(self, now_ns: int) -> list[_Slot]:
        newest = now_ns // _SLOT_NS
        return [slot for slot in self._slots if newest - slot.number < _SLOTS]
