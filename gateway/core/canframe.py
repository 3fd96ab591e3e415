"""One CAN frame, and the fixed-size record that carries it over the software CAN bus.

The record is a transport format, not a protocol under test, so the gateway and the emulators may share it. A record has
24 bytes, in network byte order: flags u8, dlc u8, two spare bytes, identifier u32, time stamp u64 (ns), and 8 data
bytes padded with zeros. On a connection that carries CAN FD, records have 80 bytes; they differ only in their 64 data
bytes, and their dlc is the number of bytes. The size is fixed so that a reader can take exactly one record from a
socket and leave the rest readable.
"""

from __future__ import annotations

import struct

import msgspec

from fieldtwin.gateway.core.errors import Desync, UsageError

_RECORD = struct.Struct("!BBxxIQ8s")
_FD_RECORD = struct.Struct("!BBxxIQ64s")
RECORD_SIZE = _RECORD.size
FD_RECORD_SIZE = _FD_RECORD.size
FD_LENGTHS = frozenset({*range(9), 12, 16, 20, 24, 32, 48, 64})
"""The data lengths in bytes that a CAN FD frame can carry (ISO 11898-1:2015, 10.4.2.4)."""

FLAG_EXTENDED = 0x01
FLAG_REMOTE = 0x02
FLAG_ERROR = 0x04
FLAG_TX_CONFIRMED = 0x08
"""The bus confirms to the sender that this frame was sent on the bus. Only in records; never set on a received frame.
"""
FLAG_FD = 0x10
FLAG_BIT_RATE_SWITCH = 0x20
FLAG_ERROR_STATE = 0x40
_FD_FLAGS = FLAG_FD | FLAG_BIT_RATE_SWITCH | FLAG_ERROR_STATE


_set = msgspec.structs.force_setattr


class CanFrame(msgspec.Struct, frozen=True, gc=False):
    """A classic CAN frame or a CAN FD frame.

    `can_id` has 11 bits, or 29 with `extended`; `data` has 0 to 8 bytes. With `fd`, `data` has up to 64 bytes
    (`FD_LENGTHS`) and `dlc` is their number; with `brs`, the data phase is sent at the data bit rate; `esi` means that
    the sender was error-passive.

    A remote frame (`remote`) has no data and requests `dlc` bytes. `t_ns` is the time of reception (monotonic, 0 if
    unknown). To compare the contents of two frames without their times, compare `key()`.
    """

    can_id: int
    data: bytes = b""
    extended: bool = False
    remote: bool = False
    error: bool = False
    dlc: int = -1
    t_ns: int = 0
    fd: bool = False
    brs: bool = False
    esi: bool = False

    def __post_init__(self) -> None:
        length = len(self.data)
        if self.dlc < 0:
            _set(self, "dlc", length)
        if self.fd or self.brs or self.esi:
            self._check_fd()
            return
        if 0 <= self.can_id <= 0x7FF and length <= 8 and self.dlc <= 8:
            return  # a short standard identifier is valid for data, remote and error frames alike
        limit = 0x1FFFFFFF if self.extended or self.error else 0x7FF
        if not 0 <= self.can_id <= limit or len(self.data) > 8 or self.dlc > 8:
            raise Desync(
                "not a classic CAN frame",
                expected=f"an identifier up to {limit:X}h and at most 8 bytes",
                got=f"{self.can_id:X}h with {len(self.data)} bytes",
            )

    def _check_fd(self) -> None:
        limit, length = 0x1FFFFFFF if self.extended else 0x7FF, len(self.data)
        good = self.fd and not self.remote and not self.error and length in FD_LENGTHS and self.dlc == length
        if not good or not 0 <= self.can_id <= limit:
            raise Desync(
                "not a CAN FD frame",
                expected=f"a data frame, an identifier up to {limit:X}h, and 0 to 8, 12, 16, 20, 24, 32, 48 or 64 bytes",
                got=f"{self.can_id:X}h with {length} bytes",
            )

    def at(self, t_ns: int) -> CanFrame:
        """Return the same frame with the time of reception `t_ns`."""
        frame: CanFrame = self.__copy__()  # type: ignore[attr-defined]  # of every Struct; a valid frame is not checked again
        _set(frame, "t_ns", t_ns)
        return frame

    def key(self) -> tuple[int, bytes, bool, bool, bool, int, bool, bool, bool]:
        """Return everything that is sent on the bus. Two frames that look the same to a bus analyser have equal keys."""
        return self.can_id, self.data, self.extended, self.remote, self.error, self.dlc, self.fd, self.brs, self.esi

    def __str__(self) -> str:
        """Return the frame in candump's notation: ``705#7F``, ``605#R8``, or ``123##1CAFE`` for CAN FD with bit-rate
        switch.
        """
        width = 8 if self.extended else 3
        if self.fd:
            return f"{self.can_id:0{width}X}##{self.brs + 2 * self.esi:X}{self.data.hex().upper()}"
        body = f"R{self.dlc or ''}" if self.remote else self.data.hex().upper()
        return f"{self.can_id:0{width}X}#{body}"


def parse_frame(text: str, *, error: bool = False) -> CanFrame:
    """Parse a classic frame in candump's notation: ``705#7F``, ``605#R8``, eight digits of identifier for the extended format.

    `error` says that it is an error frame. Raises `ValueError` if the text is malformed, and `Desync` if the identifier
    or the data is too long.
    """
    identifier, _, body = text.partition("#")
    can_id, extended = int(identifier, 16), len(identifier) == 8 and not error
    if body[:1] in ("R", "r"):
        return CanFrame(can_id, extended=extended, remote=True, error=error, dlc=int(body[1:] or "0"))
    return CanFrame(can_id, bytes.fromhex(body), extended=extended, error=error)


def pack_record(frame: CanFrame, *, confirmed: bool = False, fd: bool = False) -> bytes:
    """Return the record of a frame: 24 bytes, or 80 on a connection that carries CAN FD (`fd`).

    Raises `UsageError` for a CAN FD frame if the connection carries only classic frames.
    """
    flags = (
        (FLAG_EXTENDED if frame.extended else 0)
        | (FLAG_REMOTE if frame.remote else 0)
        | (FLAG_ERROR if frame.error else 0)
        | (FLAG_TX_CONFIRMED if confirmed else 0)
    )
    if fd:
        flags |= (
            (FLAG_FD if frame.fd else 0)
            | (FLAG_BIT_RATE_SWITCH if frame.brs else 0)
            | (FLAG_ERROR_STATE if frame.esi else 0)
        )
        return _FD_RECORD.pack(flags, frame.dlc, frame.can_id, frame.t_ns, frame.data)
    if frame.fd:
        raise UsageError("this connection carries classic CAN frames only", got=str(frame))
    return _RECORD.pack(flags, frame.dlc, frame.can_id, frame.t_ns, frame.data.ljust(8, b"\0"))


def unpack_record(record: bytes) -> tuple[CanFrame, bool]:
    """Return the frame of a record, and whether the record is a TX confirmation.

    The length says whether it is a classic or a CAN FD record. Raises `Desync` if the bytes are not a valid record.
    """
    if len(record) not in (RECORD_SIZE, FD_RECORD_SIZE):
        raise Desync("a record of the software CAN bus", expected=f"{RECORD_SIZE} bytes", got=f"{len(record)} bytes")
    of_fd = len(record) == FD_RECORD_SIZE
    flags, dlc, can_id, t_ns, data = (_FD_RECORD if of_fd else _RECORD).unpack(record)
    fd = bool(flags & FLAG_FD)
    if flags & 0x80 or (flags & _FD_FLAGS and not of_fd) or dlc > (64 if fd else 15):
        raise Desync("a record of the software CAN bus", expected="dlc 0 to 15, known flags", got=record.hex())
    if not fd:
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
        fd=fd,
        brs=bool(flags & FLAG_BIT_RATE_SWITCH),
        esi=bool(flags & FLAG_ERROR_STATE),
    )
    return frame, bool(flags & FLAG_TX_CONFIRMED)
