"""The interface of a Modbus request for framings, transactions and the client.

The concrete requests are in `requests`, `files`, `diagnostics`, `identity` and `user`.

A request encodes itself, states how long its reply has to be, and checks whether a reply answers it. It contains neither
unit ID, framing nor time.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, Generic, TypeVar

from fieldtwin.gateway.core.errors import Desync, UsageError, WrongSize
from fieldtwin.gateway.protocols.modbus.requests.refusals import refusal
from fieldtwin.gateway.protocols.modbus.requests.replies import Reply

R = TypeVar("R", bound=Reply)
R_co = TypeVar("R_co", bound=Reply, covariant=True)

MAX_PDU = 253
"""The number of bytes of the longest protocol data unit, function code included (AP 4.1)."""

NEED_MORE = 0
"""Result of `Request.reply_length`: the head is too short to decide."""

IMPOSSIBLE = -1
"""Result of `Request.reply_length`: no reply to this request starts like this."""


class Request(ABC, Generic[R_co]):
    """One request PDU and everything needed to check its reply.

    Ranges are checked when a request is made (`UsageError`), so every request that exists can be sent.
    """

    __slots__ = ()

    expects_reply: ClassVar[bool] = True
    """Whether a unit that executes the request answers. The few requests without a reply end with `unanswered`."""

    @property
    @abstractmethod
    def function(self) -> int:
        """Return the function code, 1 to 127."""

    @abstractmethod
    def encode(self) -> bytes:
        """Return the request PDU, function code first."""

    @abstractmethod
    def reply_length(self, head: bytes) -> int:
        """Return the number of bytes of the normal reply PDU that begins with `head` (whose first byte is `function`).

        The result is `NEED_MORE` or `IMPOSSIBLE` if `head` does not determine a length.
        """

    @abstractmethod
    def decode(self, pdu: bytes, t_ns: int) -> R_co:
        """Decode a normal reply PDU, complete at `t_ns`. Raises `Desync`, or `VerifyFailed` for a write."""

    def nominal_length(self) -> int:
        """Return the number of bytes of the reply PDU if the request determines it, else `NEED_MORE`."""
        return NEED_MORE

    def line_silent(self) -> None:
        """Note a silence on the line after the last byte. A silence ends a reply of unknown length (SL 2.5.1.1)."""

    def unanswered(self, t_ns: int) -> R_co:
        """Return the result of a request without a reply, sent at `t_ns`. Raises `UsageError` if it reads data (SL 2.1)."""
        raise UsageError(
            f"function {self.function:02X}h cannot be broadcast: no unit answers a broadcast",
            expected="a write, or a unit from 1",
        )


def parse_reply(request: Request[R], pdu: bytes, t_ns: int) -> R:
    """Check a whole reply PDU against its request, and return the decoded reply.

    Raises `ModbusExceptionReply` for an exception reply (some codes have their own types, see `refusals`), `Desync` for a reply
    that does not answer this request, or `VerifyFailed`.
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
    """Return the byte count of a read reply PDU if its length agrees with it (AP 6.1 to 6.4), else 0."""
    return pdu[1] if len(pdu) >= 2 and 1 <= pdu[0] <= 4 and len(pdu) == 2 + pdu[1] else 0


def describe_length(request: Request[Reply]) -> str:
    nominal = request.nominal_length()
    return f"{nominal} bytes after the unit id" if nominal else "a whole reply"


def short_hex(data: bytes | bytearray, most: int = 16) -> str:
    """Return size and first bytes (at most `most`) of `data` as text, for an error message."""
    dots = " ..." if len(data) > most else ""
    return f"{len(data)} bytes: {bytes(data[:most]).hex(' ')}{dots}"
