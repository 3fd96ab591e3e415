"""Faults of a node on a CAN bus: what becomes of its frames, and what it sends that nobody asked for.

Pure, as the others: a frame and a random generator in, frames with delays out.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from random import Random
from typing import ClassVar

from fieldtwin.emulators.faults.fault import Fault, Kind
from fieldtwin.emulators.faults.frames import Way
from fieldtwin.gateway.core.canframe import CanFrame

HEARTBEAT, EMCY, SDO_REPLY, SDO_REQUEST, SYNC = 0x700, 0x80, 0x580, 0x600, 0x80


@dataclass(frozen=True, slots=True)
class CanPiece:
    """A frame that goes on, `delay_s` after the one that it comes of."""

    frame: CanFrame
    delay_s: float = 0.0


class CanFault(Fault):
    """Strikes frames that a node sends (REPLY) or hears (REQUEST). `node`: its id."""

    kind = Kind.CAN
    ways = frozenset((Way.REPLY,))

    def aims_at(self, frame: CanFrame, node: int) -> bool:
        """Whether a frame is of the kind that this fault is about."""
        return True

    @abstractmethod
    def strike(self, frame: CanFrame, node: int, random: Random) -> tuple[CanPiece, ...]:
        """What becomes of `frame`."""

    def appears(self, node: int, random: Random) -> tuple[CanPiece, ...]:
        """What the node sends when the fault is put in."""
        return ()


class BusFault(Fault):
    """Spoils attempts to send on the modelled wire; only a bus that is modelled here has it."""

    kind = Kind.CAN
    ways: ClassVar[frozenset[Way]] = frozenset((Way.REPLY,))
    attempts: ClassVar[int | None] = None
    """How many attempts are spoilt; None: all that match while it lasts."""


def as_is(frame: CanFrame) -> tuple[CanPiece, ...]:
    """The frame, untouched."""
    return (CanPiece(frame),)
