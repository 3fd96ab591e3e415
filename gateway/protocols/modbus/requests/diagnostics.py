"""Diagnostics of a serial line: 08h, 0Bh and 0Ch (AP 6.8 to 6.10).

This module encodes the requests itself, because pymodbus has a class for each sub-function although all have the same form, and
it cannot read the replies to 0Ch. The caller interprets the counters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from fieldtwin.gateway.core.errors import Desync, UsageError
from fieldtwin.gateway.protocols.modbus.requests.data import check_range
from fieldtwin.gateway.protocols.modbus.requests.replies import (
    CommEventCounterReply,
    CommEventLogReply,
    DiagnosticsReply,
    WriteReply,
)
from fieldtwin.gateway.protocols.modbus.requests.request import IMPOSSIBLE, MAX_PDU, NEED_MORE, Request, short_hex

_FUNCTION = 0x08
_LOOPBACK = 0x00
_FORCE_LISTEN_ONLY = 0x04

_ECHOED = frozenset({_LOOPBACK, 0x01, 0x03, 0x0A, 0x14})
"""Sub-functions whose reply repeats the request (AP 6.8.1): loopback, restart, change delimiter, clear counters, clear
overrun.
"""

_LOG_HEAD = 6  # status, event count and message count precede the events of a log
_MOST_EVENTS = 64


@dataclass(frozen=True, slots=True)
class Diagnostics(Request[DiagnosticsReply]):
    """Function 08h with one data word: loopback (sub-function 0), restart (1) and the counters (0Bh to 12h).

    A unit in listen-only mode restarts without a reply, so 08h/1 may raise `ReplyTimeout` although the unit restarts.
    """

    sub_function: int
    value: int = 0

    def __post_init__(self) -> None:
        check_range("diagnostics sub-function", self.sub_function, 0, 0xFFFF)
        if self.sub_function == _FORCE_LISTEN_ONLY:
            raise UsageError("diagnostics sub-function 4 has no reply", expected="the request ForceListenOnly")
        check_range("diagnostics data", self.value, 0, 0xFFFF)

    @property
    def function(self) -> int:
        return _FUNCTION

    def encode(self) -> bytes:
        return bytes([_FUNCTION]) + self.sub_function.to_bytes(2, "big") + self.value.to_bytes(2, "big")

    def nominal_length(self) -> int:
        return 5

    def reply_length(self, head: bytes) -> int:
        return 5

    def decode(self, pdu: bytes, t_ns: int) -> DiagnosticsReply:
        _check_echo(self.sub_function, self.encode(), pdu)
        return DiagnosticsReply(int.from_bytes(pdu[3:5], "big"), bytes(pdu[1:]), t_ns)


@dataclass(frozen=True, slots=True)
class Loopback(Request[DiagnosticsReply]):
    """Function 08h/00h with 2 to 250 bytes of data, in words (AP 6.8.1); the reply must return it unchanged.

    The reply's `value` is the first word.
    """

    data: bytes

    def __post_init__(self) -> None:
        check_range("bytes of loopback data", len(self.data), 2, MAX_PDU - 3)
        if len(self.data) % 2:
            raise UsageError(
                "loopback data consists of words", expected="an even number of bytes", got=str(len(self.data))
            )

    @property
    def function(self) -> int:
        return _FUNCTION

    def encode(self) -> bytes:
        return bytes([_FUNCTION, 0, _LOOPBACK]) + self.data

    def nominal_length(self) -> int:
        return 3 + len(self.data)

    def reply_length(self, head: bytes) -> int:
        return 3 + len(self.data)

    def decode(self, pdu: bytes, t_ns: int) -> DiagnosticsReply:
        _check_echo(_LOOPBACK, self.encode(), pdu)
        return DiagnosticsReply(int.from_bytes(pdu[3:5], "big"), bytes(pdu[1:]), t_ns)


@dataclass(frozen=True, slots=True)
class ForceListenOnly(Request[WriteReply]):
    """Function 08h/04h: the unit stops answering until 08h/1 or a power cycle. This request is not answered either."""

    expects_reply: ClassVar[bool] = False

    @property
    def function(self) -> int:
        return _FUNCTION

    def encode(self) -> bytes:
        return bytes([_FUNCTION, 0, _FORCE_LISTEN_ONLY, 0, 0])

    def reply_length(self, head: bytes) -> int:
        return IMPOSSIBLE

    def decode(self, pdu: bytes, t_ns: int) -> WriteReply:
        raise Desync("a reply to force listen only, which has none", got=short_hex(pdu))

    def unanswered(self, t_ns: int) -> WriteReply:
        return WriteReply(b"", t_ns, acknowledged=False)


@dataclass(frozen=True, slots=True)
class GetCommEventCounter(Request[CommEventCounterReply]):
    """Function 0Bh, serial line only: the number of requests that the unit has completed."""

    @property
    def function(self) -> int:
        return 0x0B

    def encode(self) -> bytes:
        return b"\x0b"

    def nominal_length(self) -> int:
        return 5

    def reply_length(self, head: bytes) -> int:
        return 5

    def decode(self, pdu: bytes, t_ns: int) -> CommEventCounterReply:
        return CommEventCounterReply(_busy(pdu[1:3]), int.from_bytes(pdu[3:5], "big"), bytes(pdu[1:]), t_ns)


@dataclass(frozen=True, slots=True)
class GetCommEventLog(Request[CommEventLogReply]):
    """Function 0Ch, serial line only: the counters and up to 64 events, the latest first."""

    @property
    def function(self) -> int:
        return 0x0C

    def encode(self) -> bytes:
        return b"\x0c"

    def reply_length(self, head: bytes) -> int:
        if len(head) < 2:
            return NEED_MORE
        return 2 + head[1] if _LOG_HEAD <= head[1] <= _LOG_HEAD + _MOST_EVENTS else IMPOSSIBLE

    def decode(self, pdu: bytes, t_ns: int) -> CommEventLogReply:
        return CommEventLogReply(
            busy=_busy(pdu[2:4]),
            event_count=int.from_bytes(pdu[4:6], "big"),
            message_count=int.from_bytes(pdu[6:8], "big"),
            events=bytes(pdu[8:]),
            raw=bytes(pdu[2:]),
            t_ns=t_ns,
        )


def _check_echo(sub_function: int, sent: bytes, pdu: bytes) -> None:
    if pdu[1:3] != sent[1:3]:
        raise Desync("a reply to another diagnostics sub-function", expected=sent[1:3].hex(), got=short_hex(pdu))
    if sub_function in _ECHOED and pdu != sent:
        raise Desync("the loopback data was changed in the reply", expected=short_hex(sent), got=short_hex(pdu))


def _busy(status: bytes) -> bool:
    """Return whether the status word says that a program command is being executed: FFFFh, otherwise 0000h (AP 6.9)."""
    if status not in (b"\x00\x00", b"\xff\xff"):
        raise Desync("the status word of an event counter", expected="0000h or FFFFh", got=status.hex() + "h")
    return status == b"\xff\xff"
