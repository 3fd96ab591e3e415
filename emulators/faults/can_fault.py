"""Faults of a node on a CAN bus: their effect on the node's frames, and the frames that a fault itself sends.

Like all faults, these do no I/O: the input is a frame and a random generator, the output is frames with delays.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from random import Random
from typing import ClassVar

from fieldtwin.emulators.faults.fault import Fault, InjectionPoint
from fieldtwin.emulators.faults.frames import FrameDirection
from fieldtwin.gateway.core.canframe import CanFrame

HEARTBEAT, EMCY, SDO_REPLY, SDO_REQUEST, SYNC = 0x700, 0x80, 0x580, 0x600, 0x80


@dataclass(frozen=True, slots=True)
class CanPiece:
    """A frame to forward, `delay_s` after the frame from which it was made."""

    frame: CanFrame
    delay_s: float = 0.0


class CanFault(Fault):
    """A fault that changes frames which a node sends (REPLY) or receives (REQUEST). `node` is the node ID."""

    kind = InjectionPoint.CAN
    ways = frozenset((FrameDirection.REPLY,))

    def aims_at(self, frame: CanFrame, node: int) -> bool:
        """Return whether the fault applies to this kind of frame."""
        return True

    @abstractmethod
    def apply(self, frame: CanFrame, node: int, random: Random) -> tuple[CanPiece, ...]:
        """Return the frames that replace `frame`."""

    def appears(self, node: int, random: Random) -> tuple[CanPiece, ...]:
        """Return the frames that the node sends when the fault is injected."""
        return ()


def only_sends(kind: type[Fault]) -> bool:
    """Return whether a fault only sends frames when it is injected and changes no frame of the node."""
    return issubclass(kind, CanFault) and kind.appears is not CanFault.appears


class BusFault(Fault):
    """A fault that destroys attempts to send; only a modelled CAN bus supports it."""

    kind = InjectionPoint.CAN
    ways: ClassVar[frozenset[FrameDirection]] = frozenset((FrameDirection.REPLY,))
    attempts: ClassVar[int | None] = None
    """The number of attempts that are destroyed; None: all that match while the fault lasts."""


def as_is(frame: CanFrame) -> tuple[CanPiece, ...]:
    """Return the frame unchanged."""
    return (CanPiece(frame),)
