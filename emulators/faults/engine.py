"""The active faults of a bus, and their effect on each frame.

This module does no I/O and reads no clock: the caller passes the time and carries out the result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from fieldtwin.emulators.faults.fault import Active, ConnectionEffect, DelayedBytes, FaultEffect, WireFault, passed
from fieldtwin.emulators.faults.frames import FaultFrame, FrameDirection, Framing, understood


class WireFaults:
    """The faults of one bus. Each of `listeners` is called when a fault is injected."""

    def __init__(self, framing: Framing) -> None:
        self.framing = framing
        self.active: dict[str, Active] = {}
        self.listeners: list[Callable[[Active], None]] = []
        """Functions that are called with each fault that is injected, in the order in which they were added."""
        self.watch: Callable[[object, FrameDirection, bytes], None] | None = None
        """A function that is called with the bytes that the line or connection carries. Its arguments are the end, the
        direction and the bytes.

        A reply that a fault holds back is not carried; a request is carried even if a fault keeps it from the emulator. The
        callback may not raise.
        """

    def put_in(self, active: Active) -> None:
        self.active[active.id] = active
        for listener in tuple(self.listeners):
            listener(active)

    def take_away(self, id: str) -> bool:
        return self.active.pop(id, None) is not None

    def in_at(self, now_ns: int) -> list[Active]:
        """Return the faults that are active now, in the order in which they were injected, and remove those that are over."""
        over = [id for id, active in self.active.items() if active.until_ns is not None and now_ns >= active.until_ns]
        for id in over:
            del self.active[id]
        return [active for active in self.active.values() if active.from_ns <= now_ns]

    def refuses(self, now_ns: int) -> bool:
        """Return whether a connection that is requested now is refused. Each fault that refuses it counts as having taken
        effect.
        """
        refusing = [
            a for a in self.active.values() if isinstance(a.fault, WireFault) and a.fault.refuses and in_time(a, now_ns)
        ]
        for active in refusing:
            active.struck += 1
        return bool(refusing)

    def decide(self, frame: FaultFrame, now_ns: int) -> FaultEffect | None:
        """Return the effect on the frame, or None if no fault changes it.

        Faults are applied in the order in which they were injected, except that faults which divide the frame come last.
        """
        outcome: FaultEffect | None = None
        if frame.spared:
            return None
        dividing: list[tuple[Active, WireFault]] = []
        for active in self.in_at(now_ns):
            if isinstance(active.fault, WireFault) and active.applies_to(frame, now_ns):
                if active.fault.divides:
                    dividing.append((active, active.fault))
                else:
                    outcome = _struck(outcome, frame, active.fault, active)
        for active, fault in dividing:
            outcome = _struck(outcome, frame, fault, active)
        return outcome


def in_time(active: Active, now_ns: int) -> bool:
    """Return whether the start of a fault has been reached and its end has not."""
    return active.from_ns <= now_ns and (active.until_ns is None or now_ns < active.until_ns)


def _struck(before: FaultEffect | None, frame: FaultFrame, fault: WireFault, active: Active) -> FaultEffect:
    """Apply a fault, and count that it took effect if it changed anything."""
    after = _joined(before, frame, fault, active)
    active.struck += after != (before or passed(frame.data))
    return after


def _joined(before: FaultEffect | None, frame: FaultFrame, fault: WireFault, active: Active) -> FaultEffect:
    if before is None:
        return fault.apply(frame, active.random)
    pieces: list[DelayedBytes] = []
    connection: ConnectionEffect | None = before.connection
    for piece in before.pieces:
        if piece.back or not piece.data:
            pieces.append(piece)
            continue
        seen = understood(frame.way, frame.framing, piece.data)
        after = fault.apply(
            FaultFrame(seen.way, seen.framing, seen.data, seen.unit, seen.pdu, frame.address, frame.count),
            active.random,
        )
        pieces += _later(after.pieces, piece)
        connection = connection or after.connection
    return FaultEffect(tuple(pieces), connection)


def _later(pieces: Iterable[DelayedBytes], behind: DelayedBytes) -> list[DelayedBytes]:
    return [
        DelayedBytes(
            p.data,
            p.delay_s + behind.delay_s,
            p.overtake or behind.overtake,
            p.gather or behind.gather,
            p.back,
            p.gone or behind.gone,
        )
        for p in pieces
    ]
