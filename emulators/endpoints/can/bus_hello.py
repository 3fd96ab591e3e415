"""The hello of the software CAN bus, for the bus and the emulators: one record in each direction before the first frame.

This module packs and unpacks bytes and uses no sockets. A hello is as long as a frame's record (24 bytes) and its first byte has
bit 7 set, which no frame's record has, so a reader of fixed-size records needs no second framing. Network byte order:

    0  u8   80h
    1  u8   protocol version: 1, or 2 for records that carry CAN FD (80 bytes each); the answer has that of the request
    2  u8   status (answer): 0 welcome, 1 wrong bit rate, 2 unknown version, 3 bus full
    3  u8   options (request): bit 0, confirm each frame of the client once it was sent on the bus; bit 1, error frames when the
            state of the client's controller changes or frames for the client were lost; bit 2, an error frame for each error
            on the bus in which the client took part
    4  u32  bit rate: requested (0: that of the bus), in the answer that of the bus
    8  u64  monotonic clock of the bus in ns (answer)
    16 4s   "ftcb"
    20 u16  transmit window (answer): unconfirmed frames that the bus takes without holding back the sender
    22 u16  data bit rate in kbit/s, in version 2: requested (0: that of the bus), in the answer that of the bus; else 0

The client sends its hello first. After an answer with a status other than 0, the bus closes the connection.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

from fieldtwin.gateway.core.canframe import RECORD_SIZE

VERSION, FD_VERSION = 1, 2
WANTS_CONFIRMATIONS = 0x01
WANTS_ERRORS = 0x02
WANTS_VIOLATIONS = 0x04

_HELLO = struct.Struct("!BBBBIQ4sHH")
_MARK = 0x80
_MAGIC = b"ftcb"
assert _HELLO.size == RECORD_SIZE


class Status(IntEnum):
    """The bus's answer to a hello."""

    WELCOME = 0
    WRONG_BITRATE = 1
    UNKNOWN_VERSION = 2
    FULL = 3


@dataclass(frozen=True, slots=True)
class BusHello:
    """A request to join the bus, or the bus's answer to it. Fields that do not apply are 0."""

    bitrate: int
    version: int = VERSION
    status: int = Status.WELCOME
    options: int = 0
    t_ns: int = 0
    window: int = 0
    data_kbitrate: int = 0

    def pack(self) -> bytes:
        """Return the 24 bytes."""
        return _HELLO.pack(
            _MARK,
            self.version,
            self.status,
            self.options,
            self.bitrate,
            self.t_ns,
            _MAGIC,
            self.window,
            self.data_kbitrate,
        )


def unpack_hello(record: bytes) -> BusHello | None:
    """Return the hello in a record of 24 bytes, or None if the record is not a hello."""
    mark, version, status, options, bitrate, t_ns, magic, window, data_kbitrate = _HELLO.unpack(record)
    if mark != _MARK or magic != _MAGIC:
        return None
    return BusHello(bitrate, version, status, options, t_ns, window, data_kbitrate)
