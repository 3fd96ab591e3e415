"""The interface of a framing: it turns a request PDU into a frame, and received bytes into the PDU of the awaited
reply.

The modules rtu, ascii and mbap (TCP, TLS and UDP) implement it. A framing decides which bytes are the reply, and whether the
reply is complete and undamaged; the request checks the reply's content. A framing has no clock; the caller passes the time.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from fieldtwin.gateway.core.errors import WireError
from fieldtwin.gateway.protocols.modbus.requests.request import Request


class Framer(ABC):
    """The framing of one link. It handles one request at a time: call `begin`, then `feed` until it returns a reply, raises an
    error, or the time is over.

    `late_bytes` counts bytes of earlier exchanges and duplicates, `noise_bytes` those that belong to no exchange, and
    `foreign_frames` complete frames of other devices. All three only increase.
    """

    confirms_transmission: bool = False
    """Whether a reply identifies its request. If not, a failed exchange is followed by a quarantine, see `LineSilence`."""

    has_broadcast: bool = False
    """Whether unit ID 0 is a broadcast, which no unit answers (SL 2.1); otherwise 0 is an ordinary unit ID (TG 4.4.1.2)."""

    datagrams: bool = False
    """Whether the link preserves message boundaries: then each `feed` gets exactly one datagram."""

    gap_ns: int = 0
    """The silence of the link in ns after which the caller calls `settle`; 0: it never calls `settle`."""

    t35_ns: int = 0
    """The silence in ns that must precede a frame; 0: none."""

    rest_ns: int = 0
    """The longest delay with which the rest of a damaged frame may arrive, in ns."""

    def __init__(self) -> None:
        self.late_bytes = 0
        self.noise_bytes = 0
        self.foreign_frames = 0
        self.strays: dict[int, int] = {}
        """By unit ID: the time in ns at which a frame of this unit arrived while the client awaited no reply, or awaited the
        reply of a different unit. 0 means that it arrived just now.
        """

    def _stray(self, unit: int, pdu: bytes | bytearray, now_ns: int) -> None:
        """Note in `strays` a frame of `unit` that is not the awaited reply.

        Exception 0A or 0B comes from a gateway and does not show that the unit is alive.
        """
        if not (len(pdu) >= 2 and pdu[0] & 0x80 and pdu[1] in (0x0A, 0x0B)):
            self.strays[unit] = now_ns

    @abstractmethod
    def wire_length(self, pdu_length: int) -> int:
        """Return the number of characters of a frame whose PDU has `pdu_length` bytes."""

    @abstractmethod
    def begin(self, unit: int, request: Request[Any]) -> bytes:
        """Return the frame of `request` and await its reply from now on. The previous exchange is forgotten."""

    @abstractmethod
    def feed(self, data: bytes, now_ns: int) -> bytes | None:
        """Take the bytes that arrived; return the reply PDU when it is complete. Raises `CrcError` or `Desync`."""

    def settle(self) -> bytes | None:
        """Stop waiting for the rest of a frame that is not the awaited reply, because the link was silent for `gap_ns`.

        Return the reply PDU if it follows in the bytes received so far, else None. Raises the errors of `feed`.
        """
        return None

    @abstractmethod
    def overdue(self, waited_s: float) -> WireError:
        """Return the error for a reply that did not arrive in time: `ReplyTimeout`, or an error that describes what arrived
        instead.
        """

    @abstractmethod
    def drained(self, data: bytes) -> None:
        """Count bytes that arrived while no reply was awaited, and stay synchronised with the stream."""
