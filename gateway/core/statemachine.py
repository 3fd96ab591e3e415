"""The paper's state machine for an ocean observatory, M = (Q, Sigma, delta, q0, F).

Q = {STANDBY, ACTIVE, OFF}, Sigma = Z, q0 = STANDBY, F = {OFF}. delta depends on the sign of the commanded period alone,
from every state, OFF included (docs/explanation/paper.md, ruling 6):

    x > 0  ->  ACTIVE   the sensor samples every x seconds
    x = 0  ->  STANDBY  nothing is sampled
    x < 0  ->  OFF      nothing is sampled; an accepting state, but commands can leave it again

This module uses no clock and no I/O, and is not connected to the plant. The control logic, the digital model and every twin each
hold one instance.
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod

from fieldtwin.gateway.core.errors import Desync
from fieldtwin.gateway.core.values import COMMAND

_PERIOD = struct.Struct(">h")
PERIOD_MIN, PERIOD_MAX = -32768, 32767


class STATE(ABC):
    """A state of the machine; `execute` returns the sampling period in this state."""

    name: str

    @abstractmethod
    def execute(self, period_s: int) -> int:
        """Return the sampling period of this state in seconds, or 0 if nothing is sampled."""


class ACTIVE(STATE):
    name = "ACTIVE"

    def execute(self, period_s: int) -> int:
        return period_s


class STANDBY(STATE):
    name = "STANDBY"

    def execute(self, period_s: int) -> int:
        return 0


class OFF(STATE):
    name = "OFF"

    def execute(self, period_s: int) -> int:
        return 0


STATES: dict[str, STATE] = {s.name: s for s in (STANDBY(), ACTIVE(), OFF())}
"""Q, in the order of the codes 0, 1, 2 that represent a state as a number."""

STATE_CODES = {name: code for code, name in enumerate(STATES)}
ACCEPTING = frozenset({"OFF"})


def delta(period_s: int) -> STATE:
    """Return the state after a command with this period in seconds. Only its sign counts, and every period is valid."""
    if period_s > 0:
        return STATES["ACTIVE"]
    return STATES["STANDBY"] if period_s == 0 else STATES["OFF"]


def encode_period(period_s: int) -> COMMAND:
    """Return a period command: seconds, signed 16 bit, big endian. Raises `Desync` outside -32768..32767."""
    if not PERIOD_MIN <= period_s <= PERIOD_MAX:
        raise Desync("a period command", expected=f"{PERIOD_MIN} to {PERIOD_MAX} s", got=str(period_s))
    return COMMAND(_PERIOD.pack(period_s))


def decode_period(command: COMMAND) -> int:
    """Return the period of a command in seconds. Raises `Desync` if the command is not two bytes."""
    if len(command.data) != _PERIOD.size:
        raise Desync("a period command", expected="2 bytes", got=f"{len(command.data)} bytes {command.data.hex()}")
    (period_s,) = _PERIOD.unpack(command.data)
    return int(period_s)


class EventStateMachine:
    """The paper's EventStateMachine: Init is STANDBY with period 0; ProcessEvent sets period and state."""

    def __init__(self) -> None:
        self.state: STATE = STATES["STANDBY"]
        self.period_s = 0

    def process_event(self, command: COMMAND) -> STATE:
        """Apply a command and return the new state. An invalid command changes nothing and raises `Desync`."""
        period_s = decode_period(command)
        self.period_s = period_s
        self.state = delta(period_s)
        return self.state
