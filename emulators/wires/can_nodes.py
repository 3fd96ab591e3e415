"""The bookkeeping of a modelled CAN bus: its nodes, their transmit queues, and those of them that are in bus-off.

Nothing is decided here; `can_bus` does that.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import msgspec

from fieldtwin.emulators.wires.can_faults import RECOVERY_BITS, RECOVERY_SEQUENCES, Confinement
from fieldtwin.gateway.core.canframe import CanFrame


class Pending(msgspec.Struct, frozen=True, gc=False):
    """A frame in a transmit queue. `sequence` is its age among all that were submitted, `key` its priority."""

    frame: CanFrame
    ready_ns: int
    sequence: int
    key: int


class Start(msgspec.Struct, frozen=True, gc=False):
    """The next attempt, if nobody else submits anything before its start. `rivals` have one arbitration field, the winning one.

    `bits` go from its start to the end of the longest of their frames, `end_ns`: the attempt can be judged then.
    """

    start_ns: int
    end_ns: int
    bits: int
    winner: Pending
    rivals: tuple[int, ...]


@dataclass(slots=True)
class Node:
    """What the bus knows of a node. `hold_ns`: it may not start before, being suspended or just back from bus-off."""

    name: str
    joined_ns: int
    queue: deque[Pending] = field(default_factory=deque)
    faults: Confinement = field(default_factory=Confinement)
    hold_ns: int = 0
    left: bool = False
    listen_only: bool = False
    sent: int = 0
    received: int = 0
    overruns: int = 0
    refused: int = 0
    errors: int = 0

    @property
    def flags_are_dominant(self) -> bool:
        """Whether this node's objection destroys a frame."""
        return self.faults.flags_are_dominant and not self.listen_only

    def as_dict(self, number: int, load: float) -> dict[str, Any]:
        """For `CanBus.stats`."""
        return {
            "node": number,
            "name": self.name,
            "sent": self.sent,
            "received": self.received,
            "overruns": self.overruns,
            "refused": self.refused,
            "queued": len(self.queue),
            "load": load,
            "errors": self.errors,
            "state": self.faults.state.value,
            "tec": self.faults.tec,
            "rec": self.faults.rec,
        }


class BusOff(dict[int, int]):
    """The nodes in bus-off, each with the recessive sequences that it still waits for."""

    def enter(self, number: int) -> None:
        """The count begins when the error frame that took it off has passed."""
        self[number] = RECOVERY_SEQUENCES

    def attempt_passed(self, idle_bits: int) -> None:
        """An attempt of any outcome ended, after `idle_bits` of idle bus: its end is one more recessive sequence."""
        for number in self:
            self[number] = max(0, self[number] - idle_bits // RECOVERY_BITS - 1)

    def bits_to_recovery(self) -> int:
        """Bits of idle bus until the first of them is back."""
        return min(self.values()) * RECOVERY_BITS

    def take_recovered(self) -> int:
        """The first of them; it is no longer here."""
        number = min(self, key=lambda n: (self[n], n))
        del self[number]
        return number

    def forget(self, number: int) -> None:
        """It left for good."""
        self.pop(number, None)
