"""What a modelled CAN bus tells: frames that ended, controllers that changed their state, errors on the wire. Values only."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec

from fieldtwin.gateway.core.can_error import CanErrorState
from fieldtwin.gateway.core.canframe import CanFrame


class Delivery(msgspec.Struct, frozen=True, gc=False):
    """One frame that went over the bus. `frame.t_ns` is its end of frame.

    `senders` have more than one node only where identical frames overlapped. `receivers` were on the bus at its start.
    """

    frame: CanFrame
    start_ns: int
    bits: int
    senders: tuple[int, ...]
    receivers: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Notice:
    """A node's controller changed its state, with the error counters that made it."""

    t_ns: int
    node: int
    before: CanErrorState
    state: CanErrorState
    tec: int
    rec: int


@dataclass(frozen=True, slots=True)
class WireFault:
    """An error frame: an attempt to send `frame` that came to nothing and is made again.

    `kind` is ``bit`` (the sender read another level than it sent, a collision included), ``crc``, ``stuff`` (a receiver objected
    there) or ``ack``. `t_ns` is when the first flag began, `bits` what the attempt cost until the bus was free.
    """

    t_ns: int
    kind: str
    frame: CanFrame
    start_ns: int
    bits: int
    senders: tuple[int, ...]
    counters: tuple[tuple[int, int, int], ...]
    """Node, TEC and REC of all that took part, after it."""
