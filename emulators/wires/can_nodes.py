"""The data of a modelled CAN bus: its nodes, their transmit queues, and the nodes in bus-off.

It makes no decisions; `can_bus` does.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import msgspec

from fieldtwin.emulators.wires.can_faults import RECOVERY_BITS, RECOVERY_SEQUENCES, Confinement
from fieldtwin.gateway.core.canframe import CanFrame


class Pending(msgspec.Struct, frozen=True, gc=False):
    """A frame in a transmit queue. `sequence` is its age among all submitted frames, `key` its priority."""

    frame: CanFrame
    ready_ns: int
    sequence: int
    key: int


class Start(msgspec.Struct, frozen=True, gc=False):
    """The next attempt, if no node submits a frame before its start.

    `rivals` are the nodes that share the winning arbitration field. `bits` is the length from the start to the end of the longest
    of their frames; at `end_ns` the attempt can be evaluated.
    """

    start_ns: int
    end_ns: int
    bits: int
    winner: Pending
    rivals: tuple[int, ...]


@dataclass(slots=True)
class Node:
    """The state of a node on the bus.

    The node may not start a frame before `hold_ns`, because its transmission is suspended or it has just left bus-off.
    """

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
        """Return whether an error flag of this node destroys a frame."""
        return self.faults.flags_are_dominant and not self.listen_only

    def as_dict(self, number: int, load: float) -> dict[str, Any]:
        """Return the values for `CanBus.stats`."""
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


class BusOffNodes(dict[int, int]):
    """The nodes in bus-off, each with the number of recessive sequences that it still waits for."""

    def enter(self, number: int) -> None:
        """Add a node, which counts from the end of the error frame that put it into bus-off."""
        self[number] = RECOVERY_SEQUENCES

    def attempt_passed(self, idle_bits: int) -> None:
        """Count the recessive sequences of an attempt after `idle_bits` of idle bus.

        The end of the attempt is one more sequence.
        """
        for number in self:
            self[number] = max(0, self[number] - idle_bits // RECOVERY_BITS - 1)

    def bits_to_recovery(self) -> int:
        """Return the number of bits for which the bus must be idle until the first node recovers."""
        return min(self.values()) * RECOVERY_BITS

    def take_recovered(self) -> int:
        """Remove and return the first node that recovers."""
        number = min(self, key=lambda n: (self[n], n))
        del self[number]
        return number

    def forget(self, number: int) -> None:
        """Remove a node that has left the bus."""
        self.pop(number, None)
