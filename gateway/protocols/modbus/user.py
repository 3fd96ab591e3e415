"""User-defined functions (AP 5: 41h to 48h and 64h to 6Eh; devices use others too, such as 78h), with a stated reply.

Nothing on a serial line but the length tells where a reply ends, so whoever sends such a request says how long its reply
is: a fixed number of bytes, or where the byte count stands.
"""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.gateway.protocols.modbus.replies import UserReply
from fieldtwin.gateway.protocols.modbus.request import IMPOSSIBLE, MAX_PDU, NEED_MORE, Request
from fieldtwin.gateway.protocols.modbus.requests import check_range


@dataclass(frozen=True, slots=True)
class FixedShape:
    """A reply of `length` data bytes behind its function code."""

    length: int

    def __post_init__(self) -> None:
        check_range("data bytes of a reply", self.length, 0, MAX_PDU - 1)

    def reply_length(self, head: bytes) -> int:
        return 1 + self.length


@dataclass(frozen=True, slots=True)
class CountedShape:
    """A reply with a byte count: `at` data bytes before it, `size` bytes of count (high byte first), and `after` bytes
    that it does not count behind those that it does."""

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
    """Function `code` (1 to 127) with `data` as it goes on the wire; the reply's `raw` is its data, not judged.

    `broadcastable`: whether it is a write that unit 0 may be sent.
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
            # Explicit: super() is not bound in a class that dataclass has made anew for its slots.
            return Request.unanswered(self, t_ns)
        return UserReply(b"", t_ns, acknowledged=False)
