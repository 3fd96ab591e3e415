"""The state machine of a CiA 402 drive, as a table.

A power drive system goes through these states (CiA 402-2, 7.1; IEC 61800-7-201, figure "FSA"). The controlword 6040h commands
a transition, the statusword 6041h reports the state. There are sixteen transitions; all other commands are ignored::

    NOT READY --1--> SWITCH ON DISABLED --2--> READY TO SWITCH ON --3--> SWITCHED ON --4--> OPERATION ENABLED
                            ^   ^ <--------7----------/  ^ <------6--------/    ^ <---------5--------/ | |
                            |   | <--------------10----- | -----------------/   |                      | |
                            |   |                        \\-----------------8--- | --------------------/ |
                            |   \\----9------------------------------------------|-----------------------/
                         12 |                                                   |                       | 11
                            \\--------- QUICK STOP ACTIVE <-------------------------------------------- /  (16: back)
    any --13--> FAULT REACTION ACTIVE --14--> FAULT --15--> SWITCH ON DISABLED

This module contains only the table: no motion, no objects, no time.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, IntEnum


class DriveState(Enum):
    """The states; the value is the statusword's bits under `STATE_MASK`."""

    NOT_READY = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP = 0x07
    FAULT_REACTION = 0x0F
    FAULT = 0x08

    @property
    def powered(self) -> bool:
        """Return whether the drive function is on: the motor follows set-points or a ramp."""
        return self in (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP, DriveState.FAULT_REACTION)


STATE_MASK = 0x6F
"""Bits 0 to 3, 5 and 6 of the statusword. Bit 5 is not part of the pattern in states where the standard leaves it open."""


class TransitionCause(Enum):
    """The causes of a transition: the commands of the controlword, and events inside the drive."""

    SHUTDOWN = "shutdown"
    SWITCH_ON = "switch on"  # from OPERATION ENABLED the same bits are "disable operation"
    ENABLE_OPERATION = "enable operation"
    DISABLE_VOLTAGE = "disable voltage"
    QUICK_STOP = "quick stop"
    FAULT_RESET = "fault reset"
    INITIALISED = "self-test done"
    STOPPED = "quick stop completed"
    ERROR = "error"
    REACTED = "fault reaction completed"


class ControlBit(IntEnum):
    """Bits of the controlword that the state machine reads."""

    SWITCH_ON = 1 << 0
    ENABLE_VOLTAGE = 1 << 1
    QUICK_STOP = 1 << 2
    ENABLE_OPERATION = 1 << 3
    FAULT_RESET = 1 << 7


@dataclass(frozen=True, slots=True)
class DriveTransition:
    """One transition, with the standard's `number`.

    The drive takes the transitions 1, 12, 13 and 14 by itself; a command can also cause 12.
    """

    number: int
    source: DriveState
    cause: TransitionCause
    target: DriveState


_S, _C = DriveState, TransitionCause
TRANSITIONS = (
    DriveTransition(1, _S.NOT_READY, _C.INITIALISED, _S.SWITCH_ON_DISABLED),
    DriveTransition(2, _S.SWITCH_ON_DISABLED, _C.SHUTDOWN, _S.READY),
    DriveTransition(3, _S.READY, _C.SWITCH_ON, _S.SWITCHED_ON),
    # the same controlword then also causes transition 4
    DriveTransition(3, _S.READY, _C.ENABLE_OPERATION, _S.SWITCHED_ON),
    DriveTransition(4, _S.SWITCHED_ON, _C.ENABLE_OPERATION, _S.OPERATION_ENABLED),
    DriveTransition(5, _S.OPERATION_ENABLED, _C.SWITCH_ON, _S.SWITCHED_ON),
    DriveTransition(6, _S.SWITCHED_ON, _C.SHUTDOWN, _S.READY),
    DriveTransition(7, _S.READY, _C.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED),
    DriveTransition(7, _S.READY, _C.QUICK_STOP, _S.SWITCH_ON_DISABLED),
    DriveTransition(8, _S.OPERATION_ENABLED, _C.SHUTDOWN, _S.READY),
    DriveTransition(9, _S.OPERATION_ENABLED, _C.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED),
    DriveTransition(10, _S.SWITCHED_ON, _C.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED),
    DriveTransition(10, _S.SWITCHED_ON, _C.QUICK_STOP, _S.SWITCH_ON_DISABLED),
    DriveTransition(11, _S.OPERATION_ENABLED, _C.QUICK_STOP, _S.QUICK_STOP),
    DriveTransition(12, _S.QUICK_STOP, _C.STOPPED, _S.SWITCH_ON_DISABLED),
    DriveTransition(12, _S.QUICK_STOP, _C.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED),
    *(
        DriveTransition(13, state, _C.ERROR, _S.FAULT_REACTION)
        for state in _S
        if state not in (_S.FAULT, _S.FAULT_REACTION)
    ),
    DriveTransition(14, _S.FAULT_REACTION, _C.REACTED, _S.FAULT),
    DriveTransition(15, _S.FAULT, _C.FAULT_RESET, _S.SWITCH_ON_DISABLED),
    DriveTransition(
        16, _S.QUICK_STOP, _C.ENABLE_OPERATION, _S.OPERATION_ENABLED
    ),  # only if the option code permits the drive to stay in QUICK STOP ACTIVE
)

_BY_CAUSE = {(t.source, t.cause): t for t in TRANSITIONS}


def transition(state: DriveState, cause: TransitionCause, *, stays_stopped: bool = False) -> DriveTransition | None:
    """Return the transition that `cause` triggers in `state`; None if there is none, so that nothing happens.

    `stays_stopped`: the quick stop option code is 5 to 8, so the drive stays in QUICK STOP ACTIVE after it has stopped.
    """
    found = _BY_CAUSE.get((state, cause))
    if found is not None and found.number == 16 and not stays_stopped:
        return None
    if found is not None and cause is TransitionCause.STOPPED and stays_stopped:
        return None
    return found


def command_of(controlword: int, before: int) -> TransitionCause | None:
    """Return the command in a controlword; `before` is the previous controlword (fault reset is an edge of bit 7).

    While bit 7 is set, the word contains no other command (CiA 402-2, table "Command coding").
    """
    if controlword & ControlBit.FAULT_RESET:
        return None if before & ControlBit.FAULT_RESET else TransitionCause.FAULT_RESET
    if not controlword & ControlBit.ENABLE_VOLTAGE:
        return TransitionCause.DISABLE_VOLTAGE
    if not controlword & ControlBit.QUICK_STOP:
        return TransitionCause.QUICK_STOP
    if not controlword & ControlBit.SWITCH_ON:
        return TransitionCause.SHUTDOWN
    return TransitionCause.ENABLE_OPERATION if controlword & ControlBit.ENABLE_OPERATION else TransitionCause.SWITCH_ON
