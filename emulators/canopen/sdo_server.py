"""The server side of SDO: expedited and segmented transfers (CiA 301 v4.2, 7.2.4.3).

A pure object: one request's 8 bytes and `now` in, the replies' bytes out (a list, since a sub-block of a block transfer
answers one request with many frames). It must never know objects, NMT states or the bus: what may be read and written is
asked of an `ObjectAccess`. Block transfers are answered as by a server without them, 05040001.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from emulators.canopen.aborts import Abort, abort
from gateway.core.errors import SdoAborted

MAX_TRANSFER_BYTES = 1 << 20
"""The longest value a client may write; more is refused with 05040005."""

_MUX = struct.Struct("<HB")


class ObjectAccess(Protocol):
    """The object dictionary as an SDO client sees it. Every method raises `SdoAborted` to refuse."""

    def read(self, index: int, subindex: int, now_ns: int) -> bytes:
        """The value."""
        ...

    def begin_write(self, index: int, subindex: int, size: int | None) -> int | None:
        """Check existence, access and `size` (None if unknown) before data come; the entry's own size, None if any."""
        ...

    def write(self, index: int, subindex: int, raw: bytes, now_ns: int) -> None:
        """Check and take the value."""
        ...


@dataclass(slots=True)
class _Download:
    index: int
    subindex: int
    announced: int | None
    limit: int
    toggle: int = 0
    data: bytearray = field(default_factory=bytearray)


@dataclass(slots=True)
class _Upload:
    index: int
    subindex: int
    data: bytes
    offset: int = 0
    toggle: int = 0


class SdoServer:
    """One SDO channel. One transfer at a time; a new initiate replaces a running one."""

    def __init__(self, access: ObjectAccess, timeout_ns: int) -> None:
        self._access = access
        self._timeout_ns = timeout_ns
        self._transfer: _Download | _Upload | None = None
        self._deadline_ns: int | None = None
        self._handlers: dict[int, Callable[[bytes, int], bytes]] = {
            0: self._download_segment,
            1: self._initiate_download,
            2: self._initiate_upload,
            3: self._upload_segment,
        }

    @property
    def busy(self) -> bool:
        """Whether a segmented transfer is under way."""
        return self._transfer is not None

    @property
    def deadline_ns(self) -> int | None:
        """When a running transfer is given up, None when there is none."""
        return self._deadline_ns

    def reset(self) -> None:
        """Forget a running transfer silently (NMT reset, STOPPED)."""
        self._transfer = None
        self._deadline_ns = None

    def request(self, data: bytes, now_ns: int) -> list[bytes]:
        """Answer one request of exactly 8 bytes; no reply to a client's abort."""
        command = data[0] >> 5
        if command == 4:
            self.reset()
            return []
        handler = self._handlers.get(command)
        try:
            if handler is None:
                index, subindex = self._mux_of(data, command)
                raise abort(index, subindex, Abort.COMMAND)
            reply = handler(data, now_ns)
        except SdoAborted as e:
            self.reset()
            return [abort_frame(e)]
        self._deadline_ns = now_ns + self._timeout_ns if self._transfer else None
        return [reply]

    def tick(self, now_ns: int) -> list[bytes]:
        """Give up a transfer whose client fell silent: one abort, 05040000."""
        transfer = self._transfer
        if transfer is None or self._deadline_ns is None or now_ns < self._deadline_ns:
            return []
        self.reset()
        return [abort_frame(abort(transfer.index, transfer.subindex, Abort.TIMEOUT))]

    def _mux_of(self, data: bytes, command: int) -> tuple[int, int]:
        """What an unknown command is about: its own multiplexer if it has one, else the running transfer's, else 0."""
        if command in (5, 6):
            index, subindex = _MUX.unpack_from(data, 1)
            return index, subindex
        return (self._transfer.index, self._transfer.subindex) if self._transfer else (0, 0)

    def _initiate_download(self, data: bytes, now_ns: int) -> bytes:
        self.reset()
        index, subindex = _MUX.unpack_from(data, 1)
        expedited, sized = data[0] & 0x02, data[0] & 0x01
        if expedited:
            size = 4 - (data[0] >> 2 & 0x03) if sized else None
            own = self._access.begin_write(index, subindex, size)
            if size is None:
                size = min(own, 4) if own is not None else 4
            self._access.write(index, subindex, data[4 : 4 + size], now_ns)
        else:
            announced = int.from_bytes(data[4:8], "little") if sized else None
            own = self._access.begin_write(index, subindex, announced)
            if announced is not None and announced > MAX_TRANSFER_BYTES:
                raise abort(index, subindex, Abort.OUT_OF_MEMORY)
            limit = announced if announced is not None else own
            self._transfer = _Download(index, subindex, announced, MAX_TRANSFER_BYTES if limit is None else limit)
        return b"\x60" + data[1:4] + bytes(4)

    def _download_segment(self, data: bytes, now_ns: int) -> bytes:
        transfer = self._transfer
        if not isinstance(transfer, _Download):
            raise self._out_of_turn()
        self._check_toggle(transfer, data)
        transfer.data += data[1 : 8 - (data[0] >> 1 & 0x07)]
        if len(transfer.data) > transfer.limit:
            unbounded = transfer.announced is None and transfer.limit == MAX_TRANSFER_BYTES
            raise abort(transfer.index, transfer.subindex, Abort.OUT_OF_MEMORY if unbounded else Abort.TOO_LONG)
        reply = bytes([0x20 | transfer.toggle << 4]) + bytes(7)
        transfer.toggle ^= 1
        if data[0] & 0x01:
            if transfer.announced is not None and len(transfer.data) < transfer.announced:
                raise abort(transfer.index, transfer.subindex, Abort.TOO_SHORT)
            self._access.write(transfer.index, transfer.subindex, bytes(transfer.data), now_ns)
            self.reset()
        return reply

    def _initiate_upload(self, data: bytes, now_ns: int) -> bytes:
        self.reset()
        index, subindex = _MUX.unpack_from(data, 1)
        raw = self._access.read(index, subindex, now_ns)
        if 1 <= len(raw) <= 4:
            return bytes([0x43 | (4 - len(raw)) << 2]) + data[1:4] + raw.ljust(4, b"\0")
        # An empty value cannot be expedited: n counts at most three unused bytes.
        self._transfer = _Upload(index, subindex, raw)
        return b"\x41" + data[1:4] + len(raw).to_bytes(4, "little")

    def _upload_segment(self, data: bytes, now_ns: int) -> bytes:
        transfer = self._transfer
        if not isinstance(transfer, _Upload):
            raise self._out_of_turn()
        self._check_toggle(transfer, data)
        chunk = transfer.data[transfer.offset : transfer.offset + 7]
        transfer.offset += len(chunk)
        last = transfer.offset >= len(transfer.data)
        reply = bytes([transfer.toggle << 4 | (7 - len(chunk)) << 1 | last]) + chunk.ljust(7, b"\0")
        transfer.toggle ^= 1
        if last:
            self.reset()
        return reply

    def _check_toggle(self, transfer: _Download | _Upload, data: bytes) -> None:
        if data[0] >> 4 & 1 != transfer.toggle:
            raise abort(transfer.index, transfer.subindex, Abort.TOGGLE)

    def _out_of_turn(self) -> SdoAborted:
        """A segment of a transfer that is not under way."""
        index, subindex = self._mux_of(b"", -1)
        return abort(index, subindex, Abort.COMMAND)


def abort_frame(error: SdoAborted) -> bytes:
    """The 8 bytes that abort a transfer."""
    return b"\x80" + _MUX.pack(error.index, error.subindex) + error.code.to_bytes(4, "little")
