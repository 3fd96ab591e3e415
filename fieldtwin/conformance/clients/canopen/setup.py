"""The inputs of a CANopen reply function, the frames that it returns, and the CANopen test case."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

from fieldtwin.conformance.core.case import TRAIL_S, ClientCase
from fieldtwin.gateway.core.canframe import CanFrame

SDO_REPLY = 0x580


@dataclass(frozen=True, slots=True)
class SendFrame:
    """A step of a hostile node: send `frame`, `after_s` seconds after the request."""

    frame: CanFrame
    after_s: float = 0.0
    good: bool = False


@dataclass(frozen=True, slots=True)
class SdoRequestContext:
    """One SDO request that receives a wrong reply: eight bytes to `node`.

    `true` are the correct replies, `false` is an expedited reply with the poison word (a value that no correct answer holds).
    `nth` counts the transfers of the case from 0; `opens` is whether the request begins one. `memory` belongs to the transfer,
    for replies that depend on earlier segments.
    """

    node: int
    request: bytes
    true: tuple[bytes, ...]
    false: bytes
    poison: bytes
    opens: bool
    nth: int = 0
    timeout_s: float = 1.0
    memory: dict[str, int] = field(default_factory=dict)

    def reply(self, data: bytes, after_s: float = 0.0, *, good: bool = False) -> SendFrame:
        """Return an SDO reply of this node, to be sent `after_s` seconds after the request; `good` marks it as correct."""
        return SendFrame(CanFrame(SDO_REPLY + self.node, data), after_s, good)

    def honest(self, after_s: float = 0.0) -> list[SendFrame]:
        """Return the correct replies, in plain frames."""
        return [self.reply(data, after_s, good=True) for data in self.true]

    def frame(self, base: int, data: bytes) -> SendFrame:
        """Return a frame with an identifier of the predefined connection set: `base` plus the node ID."""
        return SendFrame(CanFrame(base + self.node, data))


SdoReplyFunction = Callable[[SdoRequestContext], list[SendFrame]]
CanWants = Literal["upload", "download", "block upload", "block download", "guard request", "nothing"]


@dataclass(frozen=True, slots=True)
class CanopenCase:
    """The CANopen counterpart of `fieldtwin.conformance.clients.modbus.setup.ModbusCase`, for SDO transfers.

    `misses`: number of the segment of a block download that the node ignores, 0 for none; `early`: number of the segment
    after which the node acknowledges the sub-block although more segments follow, 0 for none; `mutes`: the messages that
    the node does not send for `mute_s` seconds, from its first faulty reply on: ``heartbeat``, ``all``, or ``sdo``, as if
    it were STOPPED; `boots`: the node sends a boot-up message afterwards; `beat_late_s`: the delay in seconds of the node's
    next heartbeat.
    """

    about: ClientCase
    play: SdoReplyFunction
    wants: CanWants = "upload"
    strikes: int = 2
    holds_good: bool = False
    framings: tuple[str, ...] = ("can",)
    needs: str = ""
    misses: int = 0
    early: int = 0
    mutes: Literal["", "heartbeat", "all", "sdo"] = ""
    mute_s: float = 4.0
    boots: bool = False
    beat_late_s: float = 0.0
    trail_s: float = TRAIL_S
    least: int = 1

    def on(self, **changes: object) -> CanopenCase:
        return replace(self, **changes)  # type: ignore[arg-type]
