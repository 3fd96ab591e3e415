"""What a framing is: request PDU in, frame out; bytes in, the one awaited reply PDU out.

Modules rtu, ascii and mbap (TCP, TLS and UDP) implement it. A framing decides
which bytes are the reply, and whether they arrived whole; what the reply says is the request's to judge. No clock here:
`now_ns` is passed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from fieldtwin.gateway.core.errors import WireError
from fieldtwin.gateway.protocols.modbus.request import Request


class Framer(ABC):
    """One wire's framing. One request at a time: `begin`, then `feed` until it returns, raises, or time is up.

    `late_bytes` counts what belonged to an earlier exchange or came twice, `noise_bytes` what belonged to none and
    `foreign_frames` the whole frames of somebody else. All three only grow.
    """

    confirms_transmission: bool = False
    """Whether a reply names its request, so that a late one needs no quarantine."""

    has_broadcast: bool = False
    """Whether unit 0 addresses everybody and nobody answers (SL 2.1); else it is a unit like any other (TG 4.4.1.2)."""

    datagrams: bool = False
    """Whether the wire keeps the borders of what is sent: then each `feed` gets one datagram, no more and no less."""

    gap_ns: int = 0
    """How long the wire must be silent before `settle` is called; 0: never."""

    t35_ns: int = 0
    """The silence that must precede a frame; 0: none."""

    rest_ns: int = 0
    """How late the rest of a damaged frame may come."""

    def __init__(self) -> None:
        self.late_bytes = 0
        self.noise_bytes = 0
        self.foreign_frames = 0
        self.strays: dict[int, int] = {}
        """Units whose reply came while another one was awaited or none at all, and when that was, in ns; 0: just now."""

    def _stray(self, unit: int, pdu: bytes | bytearray, now_ns: int) -> None:
        """Note a frame of `unit` that nothing awaited. A gateway's 0A or 0B is no sign of life of the unit itself."""
        if not (len(pdu) >= 2 and pdu[0] & 0x80 and pdu[1] in (0x0A, 0x0B)):
            self.strays[unit] = now_ns

    @abstractmethod
    def wire_length(self, pdu_length: int) -> int:
        """Characters on the wire of a frame whose PDU has `pdu_length` bytes."""

    @abstractmethod
    def begin(self, unit: int, request: Request[Any]) -> bytes:
        """The frame of `request`; from now on its reply is awaited. Forgets the exchange before."""

    @abstractmethod
    def feed(self, data: bytes, now_ns: int) -> bytes | None:
        """Take what arrived; the reply PDU as soon as it is complete. Raises `CrcError` or `Desync`."""

    def settle(self) -> bytes | None:
        """The wire has been silent for `gap_ns`: stop waiting for the rest of what is not our reply. As `feed`."""
        return None

    @abstractmethod
    def overdue(self, waited_s: float) -> WireError:
        """Time is up: the error that describes what came instead of a reply. `ReplyTimeout` where nothing did."""

    @abstractmethod
    def drained(self, data: bytes) -> None:
        """Bytes that arrived while no reply was awaited: count them, and keep step with the stream."""
