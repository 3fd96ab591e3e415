"""What a Modbus request is to framings, transactions and the client.

The concrete ones are in `requests`, `files`, `diagnostics`, `identity` and `user`.

A request knows its own bytes, how long its reply has to be, and whether a reply is its answer. It knows neither unit
id, framing nor time.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, Generic, TypeVar

from fieldtwin.gateway.core.errors import Desync, UsageError, WrongSize
from fieldtwin.gateway.protocols.modbus.refusals import refusal
from fieldtwin.gateway.protocols.modbus.replies import Reply

R = TypeVar("R", bound=Reply)
R_co = TypeVar("R_co", bound=Reply, covariant=True)

MAX_PDU = 253
"""Bytes of the longest protocol data unit, function code included (AP 4.1)."""

NEED_MORE = 0
"""`Request.reply_length`: the head is too short to tell."""

IMPOSSIBLE = -1
"""`Request.reply_length`: no reply to this request starts like this."""


class Request(ABC, Generic[R_co]):
    """One request PDU and everything needed to judge its reply.

    Ranges are checked when a request is made (`UsageError`), so whatever exists can be sent.
    """

    __slots__ = ()

    expects_reply: ClassVar[bool] = True
    """Whether a unit that executes it answers; the few that are answered by nobody end with `unanswered`."""

    @property
    @abstractmethod
    def function(self) -> int:
        """The function code, 1 to 127."""

    @abstractmethod
    def encode(self) -> bytes:
        """The request PDU, function code first."""

    @abstractmethod
    def reply_length(self, head: bytes) -> int:
        """Bytes of the normal reply PDU that begins with `head` (whose first byte is `function`).

        `NEED_MORE` or `IMPOSSIBLE` where `head` does not tell a length.
        """

    @abstractmethod
    def decode(self, pdu: bytes, t_ns: int) -> R_co:
        """The reply in a normal reply PDU, complete at `t_ns`. Raises `Desync`, or `VerifyFailed` for a write."""

    def nominal_length(self) -> int:
        """Bytes of the reply PDU where the request alone tells, else `NEED_MORE`."""
        return NEED_MORE

    def heard_out(self) -> None:
        """A line has been silent since the last byte: a reply whose length nothing tells ends here (SL 2.5.1.1)."""

    def unanswered(self, t_ns: int) -> R_co:
        """What a broadcast of this request returns; raises `UsageError` where it asks for data (SL 2.1)."""
        raise UsageError(
            f"function {self.function:02X}h cannot be broadcast: nobody answers", expected="a write, or a unit from 1"
        )


def parse_reply(request: Request[R], pdu: bytes, t_ns: int) -> R:
    """Judge a whole reply PDU against its request.

    Raises `ModbusExceptionReply` (any code, raw; types in `refusals`), `Desync` for what is no answer to this request,
    `VerifyFailed`.
    """
    function = request.function
    if not pdu:
        raise Desync("an empty reply", expected=f"function {function:02X}h")
    if pdu[0] == function | 0x80:
        if len(pdu) != 2:
            raise Desync("an exception reply of the wrong size", expected="2 bytes", got=pdu.hex(" "))
        raise refusal(function, pdu[1])
    if pdu[0] != function:
        raise Desync("a reply to another function", expected=f"{function:02X}h", got=f"{pdu[0]:02X}h")
    length = request.reply_length(pdu)
    if length != len(pdu):
        raise WrongSize(
            "a reply of the wrong size",
            expected=describe_length(request),
            got=short_hex(pdu),
            got_bytes=counted_bytes(pdu),
        )
    return request.decode(pdu, t_ns)


def counted_bytes(pdu: bytes) -> int:
    """The byte count of a read reply PDU whose length agrees with it (AP 6.1 to 6.4), else 0."""
    return pdu[1] if len(pdu) >= 2 and 1 <= pdu[0] <= 4 and len(pdu) == 2 + pdu[1] else 0


def describe_length(request: Request[Reply]) -> str:
    nominal = request.nominal_length()
    return f"{nominal} bytes after the unit id" if nominal else "a whole reply"


def short_hex(data: bytes | bytearray, most: int = 16) -> str:
    """`data` for an error message: its size and first bytes."""
    dots = " ..." if len(data) > most else ""
    return f"{len(data)} bytes: {bytes(data[:most]).hex(' ')}{dots}"
