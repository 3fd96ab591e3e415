"""The outcome of one attempt to send, bit by bit (ISO 11898-1, 10.11 and 12.1).

In a collision, several nodes won the arbitration with one identifier and different content. All of them send until the first bit
that differs. There the bus is dominant, and each node that sent the recessive bit has a bit error. The flag of an error-active
node destroys the frame for all nodes. An error-passive node stops sending, and the others continue to the next bit that differs.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

from fieldtwin.emulators.wires.can_faults import Disturbance
from fieldtwin.emulators.wires.can_timing import (
    ERROR_DELIMITER_BITS,
    ERROR_FLAG_BITS,
    INTERFRAME_BITS,
    acknowledge_bit,
    crc_objection_bit,
    error_flag_bits,
    last_errant_bit,
    wire_bits,
)
from fieldtwin.gateway.core.canframe import CanFrame


@dataclass(frozen=True, slots=True)
class CollisionOutcome:
    """The outcome of a collision: the `senders` that remain all send the same frame.

    If `error_bit` is set, an error in that bit destroys the frame. `losers` stopped sending, the last of them at `lost_bit`.
    """

    senders: tuple[int, ...]
    losers: tuple[int, ...]
    error_bit: int | None
    lost_bit: int


@dataclass(frozen=True, slots=True)
class FailedAttempt:
    """An attempt that ended in an error frame.

    `CanErrorFrame` describes `kind`. The first flag begins at bit `flag_at`, and the attempt occupies the bus for `bits` bits.
    `first` are the receivers that sent their error flag before all others; their counters increase by more.
    """

    kind: str
    flag_at: int
    bits: int
    first: frozenset[int] = frozenset()


def collide(frames: Mapping[int, CanFrame], destroys: Callable[[int], bool]) -> CollisionOutcome:
    """Resolve a collision of `frames` by node, with one arbitration field.

    `destroys` returns whether a node's error flag is dominant.
    """
    bits = {number: wire_bits(frame) for number, frame in frames.items()}
    left = dict(bits)
    losers: list[int] = []
    lost_bit = -1
    for at in range(min(len(wire) for wire in bits.values())):
        if len({wire[at] for wire in left.values()}) == 1:
            continue
        in_error = [number for number, wire in left.items() if wire[at] == "1"]
        left = {number: wire for number, wire in left.items() if wire[at] == "0"}
        if any(destroys(number) for number in in_error):
            return CollisionOutcome(tuple(left), tuple(losers), at, lost_bit)
        losers += in_error
        lost_bit = at
        if len(set(left.values())) == 1:
            break
    return CollisionOutcome(tuple(left), tuple(losers), None, lost_bit)


def collided(frame: CanFrame, error_bit: int) -> FailedAttempt:
    """Return the outcome if a sender read a dominant bit at `error_bit`, where it sent a recessive bit."""
    return _flagged("bit", frame, wire_bits(frame)[: error_bit + 1])


def unacknowledged(frame: CanFrame) -> FailedAttempt:
    """Return the outcome without an acknowledgement: the sender's flag follows the acknowledge slot and overlaps no other."""
    at = acknowledge_bit(frame) + 1
    return FailedAttempt("ack", at, at + ERROR_FLAG_BITS + ERROR_DELIMITER_BITS + INTERFRAME_BITS)


def disturbed(what: Disturbance, frame: CanFrame, victims: Collection[int], *, at_sender: bool) -> FailedAttempt:
    """Return the outcome if `what` destroys the frame, at the sender (and all nodes) or by error flags of `victims`."""
    wire = wire_bits(frame)
    first = frozenset() if at_sender else frozenset(victims)
    if what.at_bit is None:
        return _flagged("crc", frame, wire[: crc_objection_bit(frame)], first)
    at = max(0, min(what.at_bit, last_errant_bit(frame)))
    if not at_sender:
        return _flagged("stuff", frame, wire[: at + 1], first)
    return _flagged("bit", frame, wire[:at] + ("0" if wire[at] == "1" else "1"), first)


def _flagged(kind: str, frame: CanFrame, seen: str, first: frozenset[int] = frozenset()) -> FailedAttempt:
    flags = error_flag_bits(frame, seen)
    return FailedAttempt(kind, len(seen), len(seen) + flags + ERROR_DELIMITER_BITS + INTERFRAME_BITS, first)
