"""One CAN 2.0 frame, and the fixed-size record that carries it over the software CAN bus.

The record is a carrier, not a protocol under test: both sides may share it. Its layout (network byte order, 24 bytes):
flags u8, dlc u8, two spare bytes, identifier u32, time stamp u64 (ns), data 8 bytes padded with zeros.
Fixed size, so that a reader can take exactly one from a socket and leave the rest readable (DESIGN.md decision 4).
"""

from __future__ import annotations

import struct

import msgspec

from gateway.core.errors import Desync

_RECORD = struct.Struct("!BBxxIQ8s")
RECORD_SIZE = _RECORD.size

FLAG_EXTENDED = 0x01
FLAG_REMOTE = 0x02
FLAG_ERROR = 0x04
FLAG_TX_CONFIRMED = 0x08
"""The bus tells the sender that this very frame was on the wire (record only; never on a received frame)."""


_set = msgspec.structs.force_setattr


class CanFrame(msgspec.Struct, frozen=True, gc=False):
    """A classic CAN frame. `can_id` is 11 bits, 29 with `extended`; `data` is 0 to 8 bytes.

    A remote frame (`remote`) has no data and asks for `dlc` bytes. `t_ns` is when it was received (monotonic, 0 if
    unknown) and does not count for equality of content: compare `key()`.
    """

    can_id: int
    data: bytes = b""
    extended: bool = False
    remote: bool = False
    error: bool = False
    dlc: int = -1
    t_ns: int = 0

    def __post_init__(self) -> None:
        length = len(self.data)
        if self.dlc < 0:
            _set(self, "dlc", length)
        if 0 <= self.can_id <= 0x7FF and length <= 8 and self.dlc <= 8:
            return  # whatever its flags
        limit = 0x1FFFFFFF if self.extended or self.error else 0x7FF
        if not 0 <= self.can_id <= limit or len(self.data) > 8 or self.dlc > 8:
            raise Desync(
                "not a classic CAN frame",
                expected=f"an identifier up to {limit:X}h and at most 8 bytes",
                got=f"{self.can_id:X}h with {len(self.data)} bytes",
            )

    def at(self, t_ns: int) -> CanFrame:
        """The same frame, received at `t_ns`."""
        frame: CanFrame = self.__copy__()  # type: ignore[attr-defined]  # each Struct's: what is a frame is not checked again
        _set(frame, "t_ns", t_ns)
        return frame

    def key(self) -> tuple[int, bytes, bool, bool, bool, int]:
        """All that is on the wire: equal for frames that look the same to a bus analyser."""
        return self.can_id, self.data, self.extended, self.remote, self.error, self.dlc

    def __str__(self) -> str:
        """As candump writes it: ``705#7F`` or ``605#R8``."""
        width = 8 if self.extended else 3
        body = f"R{self.dlc}" if self.remote else self.data.hex().upper()
        return f"{self.can_id:0{width}X}#{body}"


def pack_record(frame: CanFrame, *, confirmed: bool = False) -> bytes:
    """The 24-byte record of a frame."""
    flags = (
        (FLAG_EXTENDED if frame.extended else 0)
        | (FLAG_REMOTE if frame.remote else 0)
        | (FLAG_ERROR if frame.error else 0)
        | (FLAG_TX_CONFIRMED if confirmed else 0)
    )
    return _RECORD.pack(flags, frame.dlc, frame.can_id, frame.t_ns, frame.data.ljust(8, b"\0"))


def unpack_record(record: bytes) -> tuple[CanFrame, bool]:
    """A frame and whether the record is a TX confirmation. Raises `Desync` on a record that is none."""
    if len(record) != RECORD_SIZE:
        raise Desync("a record of the software CAN bus", expected=f"{RECORD_SIZE} bytes", got=f"{len(record)} bytes")
    flags, dlc, can_id, t_ns, data = _RECORD.unpack(record)
    if dlc > 15 or flags & 0xF0:
        raise Desync("a record of the software CAN bus", expected="dlc 0 to 15, known flags", got=record.hex())
    dlc = min(dlc, 8)  # a classic frame's length codes 9 to 15 mean 8 bytes (ISO 11898-1, 8.4.2.4)
    remote = bool(flags & FLAG_REMOTE)
    frame = CanFrame(
        can_id,
        b"" if remote else data[:dlc],
        extended=bool(flags & FLAG_EXTENDED),
        remote=remote,
        error=bool(flags & FLAG_ERROR),
        dlc=dlc,
        t_ns=t_ns,
    )
    return frame, bool(flags & FLAG_TX_CONFIRMED)
