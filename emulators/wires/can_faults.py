"""Fault confinement of a CAN node, and how errors are injected into the modelled bus (ISO 11898-1, 12.1.4).

`Confinement` holds one node's transmit and receive error counters and the state that follows from them. With
`Disturbance` and `ErrorRule`, a test or a fault file destroys frames: a rule is called once for each attempt to send and
returns the error. This module depends on neither the bus nor the time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from fieldtwin.gateway.core.can_error import CanErrorState
from fieldtwin.gateway.core.canframe import CanFrame

WARNING_LIMIT, PASSIVE_LIMIT, BUS_OFF_LIMIT = 96, 128, 256
RECOVERY_SEQUENCES, RECOVERY_BITS = 128, 11
"""A node in bus-off recovers after 128 occurrences of 11 recessive bits."""

SUSPEND_BITS = 8
"""The bits that an error-passive node waits after it has transmitted, in addition to the interframe space."""

_REC_MAX = 255
_REC_AFTER_PASSIVE = 119
"""The receive error counter of an error-passive receiver after a correctly received frame: the standard permits 119 to 127."""


class Confinement:
    """The error counters of one node. `state` follows from them; bus-off stays until `recover`."""

    __slots__ = ("rec", "state", "tec")

    def __init__(self) -> None:
        self.tec = 0
        self.rec = 0
        self.state = CanErrorState.ACTIVE

    @property
    def flags_are_dominant(self) -> bool:
        """Return whether this node's error flag destroys a frame: an error-passive node's flag is recessive."""
        return self.state in (CanErrorState.ACTIVE, CanErrorState.WARNING)

    def sent(self) -> None:
        """Count a frame of this node that was acknowledged without an error."""
        if self.tec:
            self.tec -= 1
            self._update_state()

    def received(self) -> None:
        """Count a frame that was received without error."""
        if self.rec:
            self.rec = self.rec - 1 if self.rec < PASSIVE_LIMIT else _REC_AFTER_PASSIVE
            self._update_state()

    def send_failed(self) -> None:
        """Count an error during transmission."""
        self.tec += 8
        self._update_state()

    def not_acknowledged(self) -> None:
        """Count a missing acknowledgement, but only until the node is error-passive (exception 1 of rule c)."""
        if self.state is not CanErrorState.PASSIVE:
            self.send_failed()

    def receive_failed(self, *, first: bool) -> None:
        """Count an error during reception.

        `first` says that the node sent its error flag before the others, and saw their flags after its own.
        """
        self.rec = min(self.rec + (9 if first else 1), _REC_MAX)
        self._update_state()

    def recover(self) -> None:
        """Return to the bus after bus-off."""
        self.tec = self.rec = 0
        self.state = CanErrorState.ACTIVE

    def _update_state(self) -> None:
        worst = max(self.tec, self.rec)
        if self.tec >= BUS_OFF_LIMIT or self.state is CanErrorState.BUS_OFF:
            self.state = CanErrorState.BUS_OFF
        elif worst >= PASSIVE_LIMIT:
            self.state = CanErrorState.PASSIVE
        else:
            self.state = CanErrorState.WARNING if worst >= WARNING_LIMIT else CanErrorState.ACTIVE


@dataclass(frozen=True, slots=True)
class Disturbance:
    """One error on the bus: bit `at_bit` (start of frame is 0, stuff bits count) is read wrongly by `seen_by`.

    `seen_by` are node numbers; empty: all nodes, including the sender. Without `at_bit` the receivers find the checksum
    wrong, and object after the acknowledge delimiter. A bit beyond the frame's end is replaced by the last bit that has
    an effect.
    """

    at_bit: int | None = None
    seen_by: frozenset[int] = frozenset()


class ErrorRule(Protocol):
    """A function that is called once for each attempt to send a frame that won its arbitration. It returns None for no error."""

    def __call__(self, frame: CanFrame, start_ns: int, senders: tuple[int, ...], /) -> Disturbance | None: ...


def spoil(
    what: Disturbance | None = None,
    *,
    match: Callable[[CanFrame], bool] = lambda frame: True,
    skip: int = 0,
    times: int | None = 1,
) -> ErrorRule:
    """Return a rule that destroys attempts to send frames that `match`: after `skip` undisturbed attempts the next `times`.

    If `times` is None, it destroys all further attempts.

    An attempt is not a frame: a destroyed frame is sent again, and the rule is called again. `times=32` takes a sender
    without errors to bus-off.
    """
    disturbance = what or Disturbance()
    seen = 0

    def rule(frame: CanFrame, start_ns: int, senders: tuple[int, ...], /) -> Disturbance | None:
        nonlocal seen
        if not match(frame):
            return None
        seen += 1
        return disturbance if seen > skip and (times is None or seen <= skip + times) else None

    return rule
