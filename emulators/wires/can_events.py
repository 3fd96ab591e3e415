"""The events of a modelled CAN bus, as values: frames that ended, state changes of controllers, errors on the bus."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec

from fieldtwin.gateway.core.can_error import CanErrorState
from fieldtwin.gateway.core.canframe import CanFrame


class Delivery(msgspec.Struct, frozen=True, gc=False):
    """One frame that was sent on the bus. `frame.t_ns` is its end of frame.

    `senders` has more than one node only if identical frames overlapped. `receivers` were on the bus at its start.
    """

    frame: CanFrame
    start_ns: int
    bits: int
    senders: tuple[int, ...]
    receivers: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Notice:
    """A state change of a node's controller, with the error counters that caused it."""

    t_ns: int
    node: int
    before: CanErrorState
    state: CanErrorState
    tec: int
    rec: int


@dataclass(frozen=True, slots=True)
class CanErrorFrame:
    """An error frame: an attempt to send `frame` that failed and is repeated.

    `kind` is ``bit`` (the sender read a different level than it sent, including collisions), ``crc`` or ``stuff`` (a receiver
    detected an error), or ``ack``. `t_ns` is the time at which the first error flag began, `bits` the length of the attempt until
    the bus was free.
    """

    t_ns: int
    kind: str
    frame: CanFrame
    start_ns: int
    bits: int
    senders: tuple[int, ...]
    counters: tuple[tuple[int, int, int], ...]
    """The node number, TEC and REC of each participant after the error."""
