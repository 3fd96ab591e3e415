"""Decoded replies of a Modbus server: plain frozen values.

They are independent of framing, requests and scaling: a register is the unsigned 16-bit word as sent.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import msgspec


class Reply:
    """The common part of all replies: `raw`, the payload as received, and `t_ns`, the monotonic time when it was complete."""

    __slots__ = ()
    raw: bytes
    t_ns: int


@dataclass(frozen=True, slots=True)
class WriteReply(Reply):
    """A write that was acknowledged and verified against the request; `raw` is the echoed data field.

    A broadcast is not acknowledged: then `acknowledged` is False, `raw` empty and `t_ns` the end of transmission.
    """

    raw: bytes
    t_ns: int
    acknowledged: bool = True


class RegistersReply(Reply, msgspec.Struct, frozen=True, gc=False):
    """Registers.

    `raw` is their 2 x n bytes, high byte first (AP 4.2). It is a msgspec struct, which is created faster than a dataclass,
    because nearly every exchange creates one.
    """

    raw: bytes
    t_ns: int

    @property
    def registers(self) -> tuple[int, ...]:
        """Return the registers, 0 to 65535 each, in the order of their addresses."""
        return struct.unpack(f">{len(self.raw) // 2}H", self.raw)


@dataclass(frozen=True, slots=True)
class BitsReply(Reply):
    """The bits that a server returned: exactly as many as requested, in the order of their addresses. `raw` includes the
    padding bits (AP 6.1).
    """

    bits: tuple[bool, ...]
    raw: bytes
    t_ns: int


@dataclass(frozen=True, slots=True)
class ExceptionStatusReply(Reply):
    """The eight exception status outputs as one byte (AP 6.7). The device defines their meaning."""

    status: int
    raw: bytes
    t_ns: int


@dataclass(frozen=True, slots=True)
class DiagnosticsReply(Reply):
    """The data field of a diagnostics reply (AP 6.8) as one word: the echo, or the requested counter."""

    value: int
    raw: bytes
    t_ns: int


@dataclass(frozen=True, slots=True)
class ServerIdReply(Reply):
    """The content of a reply to function 11h (AP 6.13): everything after the byte count.

    The device defines how the content divides into ID, run indicator and additional data, so it is not divided here.
    """

    raw: bytes
    t_ns: int


@dataclass(frozen=True, slots=True)
class DeviceIdentificationReply(Reply):
    """One reply of function 2Bh/0Eh (AP 6.21): (ID, value) pairs, and the ID at which to continue if `more_follows`."""

    objects: tuple[tuple[int, bytes], ...]
    conformity: int
    more_follows: bool
    next_object_id: int
    raw: bytes
    t_ns: int


@dataclass(frozen=True, slots=True)
class CommEventCounterReply(Reply):
    """The reply to function 0Bh (AP 6.9): whether a program command is being executed, and the number of requests completed so
    far.
    """

    busy: bool
    event_count: int
    raw: bytes
    t_ns: int


@dataclass(frozen=True, slots=True)
class CommEventLogReply(Reply):
    """The reply to function 0Ch (AP 6.10): the fields of 0Bh, the number of messages on the line, and the events as bytes, the
    latest first.
    """

    busy: bool
    event_count: int
    message_count: int
    events: bytes
    raw: bytes
    t_ns: int


@dataclass(frozen=True, slots=True)
class FileRecordsReply(Reply):
    """The reply to function 14h (AP 6.14): the words of each span, in the order of the requested spans."""

    records: tuple[tuple[int, ...], ...]
    raw: bytes
    t_ns: int


@dataclass(frozen=True, slots=True)
class UserReply(Reply):
    """The reply to a user-defined function: `raw` is its data. After a broadcast it is empty, and `acknowledged` is False."""

    raw: bytes
    t_ns: int
    acknowledged: bool = True
