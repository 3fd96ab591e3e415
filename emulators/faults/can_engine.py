"""The effect of the active faults on a CAN frame to or from a node. The caller passes the time."""

from __future__ import annotations

from fieldtwin.emulators.faults.can_fault import SDO_REPLY, SDO_REQUEST, CanFault, CanPiece
from fieldtwin.emulators.faults.engine import WireFaults
from fieldtwin.emulators.faults.fault import Active
from fieldtwin.emulators.faults.frames import FaultFrame, FrameDirection, Framing
from fieldtwin.gateway.core.canframe import CanFrame


def replaced_frames(
    faults: WireFaults, way: FrameDirection, frame: CanFrame, node: int, now_ns: int
) -> list[CanPiece] | None:
    """Return the frames that replace `frame`, or None if no fault changes it.

    Several faults are applied in the order in which they were injected.
    """
    pieces: list[CanPiece] | None = None
    for active in faults.in_at(now_ns):
        fault = active.fault
        if not isinstance(fault, CanFault) or (active.units and node not in active.units):
            continue
        if not aimed(active, frame):
            continue
        if not fault.aims_at(frame, node) or not active.applies_to(seen(way, node), now_ns):
            continue
        before = pieces if pieces is not None else [CanPiece(frame)]
        pieces = [
            CanPiece(after.frame, after.delay_s + piece.delay_s)
            for piece in before
            for after in fault.apply(piece.frame, node, active.random)
        ]
        active.struck += pieces != before
    return pieces


def aimed(active: Active, frame: CanFrame) -> bool:
    """Return whether the `cob_id` and the `index` of the fault match the frame.

    Only SDO requests and replies that name an object have an index; segments do not.
    """
    aim = active.aim
    if aim.cob_id is not None and frame.can_id != aim.cob_id:
        return False
    if aim.index is None:
        return True
    segments = {SDO_REPLY: (0, 1), SDO_REQUEST: (0, 3)}.get(frame.can_id & 0x780)
    if segments is None or len(frame.data) != 8 or frame.data[0] >> 5 in segments:
        return False
    return int.from_bytes(frame.data[1:3], "little") == aim.index


def seen(way: FrameDirection, node: int) -> FaultFrame:
    """Return a frame of a node in the form in which `Active` compares it with the aim of a fault."""
    return FaultFrame(way, Framing.RAW, b"", node)
