"""Which faults are in on a bus, and what they make of each frame. Pure: told the time, tells what shall happen."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from fieldtwin.emulators.faults.fault import Active, Hang, Outcome, Piece, WireFault
from fieldtwin.emulators.faults.frames import Frame, Framing, Way, understood


class WireFaults:
    """The faults of one bus. `on_change` is told when a fault is put in or taken away (its ends look again)."""

    def __init__(self, framing: Framing) -> None:
        self.framing = framing
        self.active: dict[str, Active] = {}
        self.listeners: list[Callable[[Active], None]] = []
        """Told of each fault that is put in, in the order of their subscription."""
        self.watch: Callable[[object, Way, bytes], None] | None = None
        """Told what is on the wire: who carries it (an end), which way, the bytes. What a fault keeps back is no reply on the
        wire; what an emulator never gets to hear is a request on it all the same. It may not raise."""

    def put_in(self, active: Active) -> None:
        self.active[active.id] = active
        for listener in tuple(self.listeners):
            listener(active)

    def take_away(self, id: str) -> bool:
        return self.active.pop(id, None) is not None

    def in_at(self, now_ns: int) -> list[Active]:
        """Those whose time has come, in the order in which they were put in. Those whose time is over are forgotten."""
        over = [id for id, active in self.active.items() if active.until_ns is not None and now_ns >= active.until_ns]
        for id in over:
            del self.active[id]
        return [active for active in self.active.values() if active.from_ns <= now_ns]

    def refuses(self, now_ns: int) -> bool:
        """Return whether a connection that is asked for now is refused. Each fault that refuses it has struck."""
        refusing = [
            a for a in self.active.values() if isinstance(a.fault, WireFault) and a.fault.refuses and in_time(a, now_ns)
        ]
        for active in refusing:
            active.struck += 1
        return bool(refusing)

    def decide(self, frame: Frame, now_ns: int) -> Outcome | None:
        """What becomes of the frame; None: nothing happens to it. Several faults strike in the order in which they were put in,
        those that divide it after the others."""
        outcome: Outcome | None = None
        if frame.spared:
            return None
        dividing: list[tuple[Active, WireFault]] = []
        for active in self.in_at(now_ns):
            if isinstance(active.fault, WireFault) and active.strikes(frame, now_ns):
                if active.fault.divides:
                    dividing.append((active, active.fault))
                else:
                    outcome = _joined(outcome, frame, active.fault, active)
        for active, fault in dividing:
            outcome = _joined(outcome, frame, fault, active)
        return outcome


def in_time(active: Active, now_ns: int) -> bool:
    """Whether a fault's time has come and is not over."""
    return active.from_ns <= now_ns and (active.until_ns is None or now_ns < active.until_ns)


def _joined(before: Outcome | None, frame: Frame, fault: WireFault, active: Active) -> Outcome:
    if before is None:
        return fault.strike(frame, active.random)
    pieces: list[Piece] = []
    hang: Hang | None = before.hang
    for piece in before.pieces:
        if piece.back or not piece.data:
            pieces.append(piece)
            continue
        seen = understood(frame.way, frame.framing, piece.data)
        after = fault.strike(
            Frame(seen.way, seen.framing, seen.data, seen.unit, seen.pdu, frame.address, frame.count), active.random
        )
        pieces += _later(after.pieces, piece)
        hang = hang or after.hang
    return Outcome(tuple(pieces), hang)


def _later(pieces: Iterable[Piece], behind: Piece) -> list[Piece]:
    return [
        Piece(
            p.data, p.delay_s + behind.delay_s, p.overtake or behind.overtake, p.gather or behind.gather, p.back, p.gone
        )
        for p in pieces
    ]
