"""What a CAN controller tells of itself, and the error frame that carries it, as Linux lays it out (linux/can/error.h).

An error frame in this sense never was on a wire: it is a message of the controller to its own node. Its identifier has class
bits, its 8 bytes say more: byte 1 what the controller is, byte 2 which violation, bytes 6 and 7 the transmit and receive error
counters. python-can, candump and the kernel's interfaces speak the same, so that a node needs no second language for the
software bus. What a node does about it is not known here.
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
"""Bytes 6 and 7 hold TEC and REC."""

_OVERFLOW, _ACTIVE = 0x01, 0x40
_WARNING = {"rx": 0x04, "tx": 0x08}
_PASSIVE = {"rx": 0x10, "tx": 0x20}
_VIOLATIONS = {"bit": 0x01, "form": 0x02, "stuff": 0x04}


class CanErrorState(Enum):
    """Fault confinement (ISO 11898-1, 12.1.4), and the warning level of 96 that controllers tell besides."""

    ACTIVE = "error-active"
    WARNING = "error-warning"
    PASSIVE = "error-passive"
    BUS_OFF = "bus-off"


def state_frame(state: CanErrorState, tec: int, rec: int, *, restarted: bool = False, t_ns: int = 0) -> CanFrame:
    """The controller has come to `state` with these error counters; `restarted`: by recovering from bus-off."""
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
    """Frames came and were lost, since nobody took them in time."""
    return CanFrame(CLASS_CONTROLLER, bytes((0, _OVERFLOW, 0, 0, 0, 0, 0, 0)), error=True, t_ns=t_ns)


def violation_frame(kind: str, tec: int, rec: int, t_ns: int = 0) -> CanFrame:
    """An error on the wire, as the controller saw it. `kind`: ``bit``, ``stuff``, ``form``, ``crc`` or ``ack``."""
    data = bytearray(8)
    data[2] = _VIOLATIONS.get(kind, 0)
    data[3] = 0x08 if kind == "crc" else 0  # location: CRC sequence
    data[6], data[7] = min(tec, 255), min(rec, 255)
    what = CLASS_NO_ACKNOWLEDGE if kind == "ack" else CLASS_VIOLATION
    return CanFrame(what | CLASS_BUS_ERROR | CLASS_COUNTERS, bytes(data), error=True, t_ns=t_ns)


def told_state(frame: CanFrame) -> CanErrorState | None:
    """The state that an error frame tells; None for a frame that tells none (an overrun, a violation, no error frame)."""
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


def tells_overrun(frame: CanFrame) -> bool:
    """Whether an error frame says that received frames were lost."""
    return bool(frame.error and frame.can_id & CLASS_CONTROLLER and len(frame.data) > 1 and frame.data[1] & _OVERFLOW)
