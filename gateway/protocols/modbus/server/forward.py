"""Forward the request PDU of a client of the gateway as a `Request`, and return the reply byte for byte.

The request determines the form of the reply, so a late or foreign reply is refused as it is for the gateway's own requests. This
module does not depend on the sender of the request or on a transaction ID.
"""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.gateway.core.errors import VerifyFailed
from fieldtwin.gateway.protocols.modbus.frames.crc import crc16
from fieldtwin.gateway.protocols.modbus.requests.replies import Reply
from fieldtwin.gateway.protocols.modbus.requests.request import IMPOSSIBLE, MAX_PDU, NEED_MORE, Request
from fieldtwin.gateway.protocols.modbus.server.analysis import BROADCAST_FUNCTIONS, ServerRequest

_COUNTED = frozenset({0x0C, 0x11, 0x14})
"""Functions whose reply has its length in the second byte."""

_ECHOED = {0x05: 5, 0x06: 5, 0x0F: 5, 0x10: 5, 0x16: 7}
"""By function code of a write: the number of bytes of the request that the reply repeats. 15h repeats all of them."""

_FIXED_BYTE_COUNT = frozenset({0x01, 0x02, 0x03, 0x04, 0x17})


@dataclass(frozen=True, slots=True)
class ForwardedReply(Reply):
    """The reply PDU as the unit sent it, in `raw`; empty after a broadcast."""

    raw: bytes
    t_ns: int


class Forwarded(Request[ForwardedReply]):
    """The request `pdu` for `unit`, used for one exchange. `asked` is the analysis of `pdu`.

    `on_line` says that the link is RTU. The reply to an unknown function then ends where the line becomes silent and the check
    sum is right; on other links the framing determines the end. The check sum alone would cut off one reply in 256: a reply whose
    last byte is 00 looks like a shorter reply with a 00 after it.
    """

    __slots__ = ("_asked", "_length", "_line_silent", "_on_line", "_pdu", "_unit")

    def __init__(self, unit: int, pdu: bytes, asked: ServerRequest, *, on_line: bool) -> None:
        self._unit = unit
        self._pdu = pdu
        self._asked = asked
        self._on_line = on_line
        self._line_silent = False
        self._length = asked.reply_bytes

    @property
    def function(self) -> int:
        return self._asked.function

    def encode(self) -> bytes:
        return self._pdu

    def nominal_length(self) -> int:
        return self._asked.reply_bytes

    def reply_length(self, head: bytes) -> int:
        function = self.function
        if function in _FIXED_BYTE_COUNT and len(head) > 1 and head[1] != (self._length - 2) & 0xFF:
            return IMPOSSIBLE  # the byte count has to be the one requested: MB-017
        if self._length:
            return self._length
        if function in _COUNTED:
            return NEED_MORE if len(head) < 2 else 2 + head[1] if 2 + head[1] <= MAX_PDU else IMPOSSIBLE
        if function == 0x18:
            return _fifo_length(head)
        if function == 0x2B and self._pdu[1] == 0x0E:
            return _identification_length(head)
        return self._open_length(head)

    def decode(self, pdu: bytes, t_ns: int) -> ForwardedReply:
        repeated = len(self._pdu) if self.function == 0x15 else _ECHOED.get(self.function, 0)
        if pdu[:repeated] != self._pdu[:repeated]:
            raise VerifyFailed(
                f"the acknowledgement of function {self.function:02X}h differs from the request",
                expected=self._pdu[:repeated].hex(" "),
                got=pdu[:repeated].hex(" "),
            )
        return ForwardedReply(bytes(pdu), t_ns)

    def unanswered(self, t_ns: int) -> ForwardedReply:
        if self.function not in BROADCAST_FUNCTIONS:
            return super().unanswered(t_ns)
        return ForwardedReply(b"", t_ns)

    def line_silent(self) -> None:
        self._line_silent = True

    def _open_length(self, head: bytes) -> int:
        """Return the reply length of a user-defined function: on RTU, all bytes before a silence, if their check sum is right."""
        if not self._on_line:
            return len(head)
        if not self._line_silent or len(head) < 3 or crc16(bytes([self._unit]) + head) != 0:
            return NEED_MORE
        self._length = len(head) - 2
        return self._length


def _fifo_length(head: bytes) -> int:
    """Return the length of a FIFO reply, whose byte count has two bytes (AP 6.18)."""
    if len(head) < 3:
        return NEED_MORE
    length = 3 + int.from_bytes(head[1:3], "big")
    return length if 5 <= length <= MAX_PDU else IMPOSSIBLE


def _identification_length(head: bytes) -> int:
    """Return the length of an identification reply (AP 6.21): seven bytes, then as many objects as the seventh byte
    says.

    Each object has an ID and its own length.
    """
    if len(head) > 1 and head[1] != 0x0E:
        return IMPOSSIBLE
    if len(head) < 7:
        return NEED_MORE
    end = 7
    for _ in range(head[6]):
        if len(head) < end + 2:
            return NEED_MORE if end + 2 <= MAX_PDU else IMPOSSIBLE
        end += 2 + head[end + 1]
    return end if end <= MAX_PDU else IMPOSSIBLE
