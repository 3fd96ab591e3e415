"""The error frames in which a CAN controller reports its state, in the layout of Linux (linux/can/error.h).

Such an error frame is never sent on the bus: the controller passes it to its own node. The identifier holds class bits.
Of the 8 data bytes, byte 1 holds the controller's state, byte 2 the kind of violation, and bytes 6 and 7 the transmit
and receive error counters. python-can, candump and the kernel's interfaces use the same layout, so a node needs no
second format for the software CAN bus. This module only packs and reads error frames; it does not act on them.
"""

from __future__ import annotations

from enum import Enum

from fieldtwin.gateway.core.canframe import CanFrame

CLASS_CONTROLLER = 0x004
CLASS_VIOLATION = 0x008
CLASS_NO_ACKNOWLEDGE = 0x020
CLASS_BUS_OFF = 0x040
CLASS_BUS_ERROR = 0x080
CLASS_RESTARTED = 0x100
CLASS_COUNTERS = 0x200
"""The class bit which says that bytes 6 and 7 hold TEC and REC."""

_OVERFLOW, _ACTIVE = 0x01, 0x40
_WARNING = {"rx": 0x04, "tx": 0x08}
_PASSIVE = {"rx": 0x10, "tx": 0x20}
_VIOLATIONS = {"bit": 0x01, "form": 0x02, "stuff": 0x04}


class CanErrorState(Enum):
    """The states of fault confinement (ISO 11898-1, 12.1.4), and the warning level (96) that controllers also report."""

    ACTIVE = "error-active"
    WARNING = "error-warning"
    PASSIVE = "error-passive"
    BUS_OFF = "bus-off"


def state_frame(state: CanErrorState, tec: int, rec: int, *, restarted: bool = False, t_ns: int = 0) -> CanFrame:
    """Return the frame for a controller that entered `state` with these error counters.

    `restarted` is true if the controller entered the state by recovering from bus-off.
    """
    data = bytearray(8)
    data[6], data[7] = min(tec, 255), min(rec, 255)
    if state is CanErrorState.BUS_OFF:
        return CanFrame(CLASS_BUS_OFF | CLASS_COUNTERS, bytes(data), error=True, t_ns=t_ns)
    side = "tx" if tec >= rec else "rx"
    match state:
        case CanErrorState.PASSIVE:
            data[1] = _PASSIVE[side]
        case CanErrorState.WARNING:
            data[1] = _WARNING[side]
        case _:
            data[1] = _ACTIVE
    classes = CLASS_CONTROLLER | CLASS_COUNTERS | (CLASS_RESTARTED if restarted else 0)
    return CanFrame(classes, bytes(data), error=True, t_ns=t_ns)


def overrun_frame(t_ns: int = 0) -> CanFrame:
    """Return the frame for received frames that were lost because the node did not read them in time."""
    return CanFrame(CLASS_CONTROLLER, bytes((0, _OVERFLOW, 0, 0, 0, 0, 0, 0)), error=True, t_ns=t_ns)


def violation_frame(kind: str, tec: int, rec: int, t_ns: int = 0) -> CanFrame:
    """Return the frame for a bus error that the controller detected.

    `kind` is ``bit``, ``stuff``, ``form``, ``crc`` or ``ack``.
    """
    data = bytearray(8)
    data[2] = _VIOLATIONS.get(kind, 0)
    data[3] = 0x08 if kind == "crc" else 0  # location: CRC sequence
    data[6], data[7] = min(tec, 255), min(rec, 255)
    what = CLASS_NO_ACKNOWLEDGE if kind == "ack" else CLASS_VIOLATION
    return CanFrame(what | CLASS_BUS_ERROR | CLASS_COUNTERS, bytes(data), error=True, t_ns=t_ns)


def reported_state(frame: CanFrame) -> CanErrorState | None:
    """Return the controller state that an error frame reports.

    Return None for an overrun, for a violation, and for a frame that is not an error frame.
    """
    if not frame.error:
        return None
    if frame.can_id & CLASS_BUS_OFF:
        return CanErrorState.BUS_OFF
    status = frame.data[1] if frame.can_id & CLASS_CONTROLLER and len(frame.data) > 1 else 0
    if status & (_PASSIVE["rx"] | _PASSIVE["tx"]):
        return CanErrorState.PASSIVE
    if status & (_WARNING["rx"] | _WARNING["tx"]):
        return CanErrorState.WARNING
    if status & _ACTIVE or frame.can_id & CLASS_RESTARTED:
        return CanErrorState.ACTIVE
    return None


def reports_overrun(frame: CanFrame) -> bool:
    """Return whether an error frame reports that received frames were lost."""
    return bool(frame.error and frame.can_id & CLASS_CONTROLLER and len(frame.data) > 1 and frame.data[1] & _OVERFLOW)
