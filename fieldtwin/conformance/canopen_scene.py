"""The inputs of a CANopen reply function, and the CANopen test case. Pure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

from fieldtwin.conformance.case import TRAIL_S, Case
from fieldtwin.gateway.core.canframe import CanFrame

SDO_REPLY = 0x580


@dataclass(frozen=True, slots=True)
class SayFrame:
    """Send `frame`, `after_s` seconds behind the request."""

    frame: CanFrame
    after_s: float = 0.0
    good: bool = False


@dataclass(frozen=True, slots=True)
class CanScene:
    """One SDO request that is to be misanswered: eight bytes to `node`.

    `true` are the honest replies, `false` is an expedited one with the poisoned word. `nth` counts the transfers of the
    case from 0; `opens` is whether the request begins one. `memory` is the transfer's own, for plays that go on over
    its segments.
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

    def reply(self, data: bytes, after_s: float = 0.0, *, good: bool = False) -> SayFrame:
        """An SDO reply of this node."""
        return SayFrame(CanFrame(SDO_REPLY + self.node, data), after_s, good)

    def honest(self, after_s: float = 0.0) -> list[SayFrame]:
        """The honest replies, in plain frames."""
        return [self.reply(data, after_s, good=True) for data in self.true]

    def frame(self, base: int, data: bytes) -> SayFrame:
        """A frame with an identifier of the predefined connection set."""
        return SayFrame(CanFrame(base + self.node, data))


CanPlay = Callable[[CanScene], list[SayFrame]]
CanWants = Literal["upload", "download", "block upload", "block download", "guard request", "nothing"]


@dataclass(frozen=True, slots=True)
class CanopenCase:
    """As `scene.ModbusCase`, of SDO transfers. `misses`: the segment of a block download that the node does not hear, 0 for none;
    `early`: the one behind which it acknowledges the sub-block although more were to come; `mutes`: what of the node stays away
    for `mute_s` from the first strike on: ``heartbeat``, ``all``, or ``sdo``, since it is STOPPED; `boots`: it boots when that
    is over; `beat_late_s`: its next heartbeat comes so late."""

    about: Case
    play: CanPlay
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
