"""User-defined functions (AP 5: 41h to 48h and 64h to 6Eh; devices also use other codes, such as 78h).

On a serial line only its length determines where a reply ends, so the caller has to state the length of the reply: a fixed
number of bytes, or the position of its byte count.
"""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.gateway.protocols.modbus.requests.data import check_range
from fieldtwin.gateway.protocols.modbus.requests.replies import UserReply
from fieldtwin.gateway.protocols.modbus.requests.request import IMPOSSIBLE, MAX_PDU, NEED_MORE, Request


@dataclass(frozen=True, slots=True)
class FixedShape:
    """A reply with `length` data bytes after its function code."""

    length: int

    def __post_init__(self) -> None:
        check_range("data bytes of a reply", self.length, 0, MAX_PDU - 1)

    def reply_length(self, head: bytes) -> int:
        return 1 + self.length


@dataclass(frozen=True, slots=True)
class CountedShape:
    """A reply with a byte count: `at` data bytes before it, and `size` bytes of count (high byte first).

    `after` is the number of bytes that follow the counted bytes and are not counted.
    """

    at: int = 0
    size: int = 1
    after: int = 0

    def __post_init__(self) -> None:
        check_range("data bytes before a byte count", self.at, 0, MAX_PDU - 2)
        check_range("bytes of a byte count", self.size, 1, 2)
        check_range("data bytes after the counted ones", self.after, 0, MAX_PDU - 2)

    def reply_length(self, head: bytes) -> int:
        start = 1 + self.at
        end = start + self.size
        if len(head) < end:
            return NEED_MORE
        length = end + int.from_bytes(head[start:end], "big") + self.after
        return length if length <= MAX_PDU else IMPOSSIBLE


@dataclass(frozen=True, slots=True)
class UserFunction(Request[UserReply]):
    """Function `code` (1 to 127) with `data` as it is sent; the reply's `raw` is its data, which is not checked.

    `broadcastable` says whether it is a write that may be sent to unit 0.
    """

    code: int
    data: bytes
    shape: FixedShape | CountedShape
    broadcastable: bool = False

    def __post_init__(self) -> None:
        check_range("function code", self.code, 1, 127)
        check_range("data bytes of a request", len(self.data), 0, MAX_PDU - 1)

    @property
    def function(self) -> int:
        return self.code

    def encode(self) -> bytes:
        return bytes([self.code]) + self.data

    def nominal_length(self) -> int:
        return 1 + self.shape.length if isinstance(self.shape, FixedShape) else NEED_MORE

    def reply_length(self, head: bytes) -> int:
        return self.shape.reply_length(head)

    def decode(self, pdu: bytes, t_ns: int) -> UserReply:
        return UserReply(bytes(pdu[1:]), t_ns)

    def unanswered(self, t_ns: int) -> UserReply:
        if not self.broadcastable:
            # Explicit: super() is not bound in a class that dataclass has recreated for its slots.
            return Request.unanswered(self, t_ns)
        return UserReply(b"", t_ns, acknowledged=False)
