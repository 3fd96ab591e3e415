"""What a Modbus server answered, decoded: plain frozen values.

Knows nothing of framing, requests or scaling: a register here is the unsigned 16-bit word of the wire.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import msgspec


class Reply:
    """What every reply has: `raw`, the payload as on the wire, and `t_ns`, the monotonic time when it was complete."""

    __slots__ = ()
    raw: bytes
    t_ns: int


@dataclass(frozen=True, slots=True)
class WriteReply(Reply):
    """A write that was acknowledged and verified against the request; `raw` is the echoed data field.

    A broadcast is acknowledged by nobody: then `acknowledged` is False, `raw` empty and `t_ns` the end of transmission.
    """

    raw: bytes
    t_ns: int
    acknowledged: bool = True


class RegistersReply(Reply, msgspec.Struct, frozen=True, gc=False):
    """Registers; `raw` is their 2 x n bytes, high byte first (AP 4.2). A struct: one is made with nearly every exchange."""

    raw: bytes
    t_ns: int

    @property
    def registers(self) -> tuple[int, ...]:
        """0 to 65535 each, in the order of their addresses."""
        return struct.unpack(f">{len(self.raw) // 2}H", self.raw)


@dataclass(frozen=True, slots=True)
class BitsReply(Reply):
    """Exactly as many bits as asked for, in the order of their addresses; `raw` with its padding bits (AP 6.1)."""

    bits: tuple[bool, ...]
    raw: bytes
    t_ns: int


@dataclass(frozen=True, slots=True)
class ExceptionStatusReply(Reply):
    """The eight exception status outputs as one byte (AP 6.7); what they mean is the device's own."""

    status: int
    raw: bytes
    t_ns: int


@dataclass(frozen=True, slots=True)
class DiagnosticsReply(Reply):
    """The data field of a diagnostics reply (AP 6.8) as one word: the echo, or the counter asked for."""

    value: int
    raw: bytes
    t_ns: int


@dataclass(frozen=True, slots=True)
class ServerIdReply(Reply):
    """What function 11h reports (AP 6.13): everything after the byte count.

    How it divides into id, run indicator and additional data is the device's own, so it stays whole.
    """

    raw: bytes
    t_ns: int


@dataclass(frozen=True, slots=True)
class DeviceIdentificationReply(Reply):
    """One answer of function 2Bh/0Eh (AP 6.21): (id, value) pairs, and the id to go on with when `more_follows`."""

    objects: tuple[tuple[int, bytes], ...]
    conformity: int
    more_follows: bool
    next_object_id: int
    raw: bytes
    t_ns: int


@dataclass(frozen=True, slots=True)
class CommEventCounterReply(Reply):
    """Function 0Bh (AP 6.9): whether a program command is being executed, and the requests completed so far."""

    busy: bool
    event_count: int
    raw: bytes
    t_ns: int


@dataclass(frozen=True, slots=True)
class CommEventLogReply(Reply):
    """Function 0Ch (AP 6.10): as 0Bh, the messages on the line, and the events as bytes, the latest first."""

    busy: bool
    event_count: int
    message_count: int
    events: bytes
    raw: bytes
    t_ns: int


@dataclass(frozen=True, slots=True)
class FileRecordsReply(Reply):
    """Function 14h (AP 6.14): the words of each span, in the order in which the spans were asked for."""

    records: tuple[tuple[int, ...], ...]
    raw: bytes
    t_ns: int


@dataclass(frozen=True, slots=True)
class UserReply(Reply):
    """The reply to a user-defined function: `raw` is its data. Unacknowledged and empty after a broadcast."""

    raw: bytes
    t_ns: int
    acknowledged: bool = True
