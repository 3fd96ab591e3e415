"""The server side of SDO: expedited, segmented and block transfers (CiA 301 v4.2, 7.2.4.3).

`SdoServer` does no I/O: it takes one request's 8 bytes and the time, and returns the replies' bytes (a list, because one request
can be answered with the many frames of a sub-block). It must not depend on objects, NMT states or the bus: an `ObjectAccess`
decides which objects a client may read and write.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from fieldtwin.emulators.canopen.aborts import Abort, abort, abort_frame
from fieldtwin.emulators.canopen.sdo.block import MAX_BLOCK, BlockDownload, BlockUpload
from fieldtwin.gateway.core.errors import SdoAborted

MAX_TRANSFER_BYTES = 1 << 20
"""The longest value that a client may write; a longer one is refused with 05040005."""

_MUX = struct.Struct("<HB")
_ABORT = 0x80


class ObjectAccess(Protocol):
    """The object dictionary as an SDO client sees it. Every method raises `SdoAborted` to refuse."""

    def read(self, index: int, subindex: int, now_ns: int) -> bytes:
        """Return the value."""
        ...

    def begin_write(self, index: int, subindex: int, size: int | None) -> int | None:
        """Check existence, access and `size` (None if unknown) before the data arrive.

        Returns the size of the entry, None if every size is valid.
        """
        ...

    def write(self, index: int, subindex: int, raw: bytes, now_ns: int) -> None:
        """Check and store the value."""
        ...


@dataclass(slots=True)
class _Download:
    index: int
    subindex: int
    announced: int | None
    limit: int
    overflow: Abort
    toggle: int = 0
    data: bytearray = field(default_factory=bytearray)


@dataclass(slots=True)
class _Upload:
    index: int
    subindex: int
    data: bytes
    offset: int = 0
    toggle: int = 0


_Transfer = _Download | _Upload | BlockDownload | BlockUpload


class SdoServer:
    """One SDO channel with one transfer at a time; a new initiate request replaces a running transfer.

    While a sub-block of a block download is being received, every frame except an abort is taken as one of its segments, because
    the standard offers no way to distinguish other frames. `block` is the number of segments that a client may send in one
    sub-block.
    """

    def __init__(self, access: ObjectAccess, timeout_ns: int, block: int = MAX_BLOCK) -> None:
        self._access = access
        self._block = block
        self._timeout_ns = timeout_ns
        self._transfer: _Transfer | None = None
        self._deadline_ns: int | None = None
        self._prompt_ns: int | None = None
        self._handlers: dict[int, Callable[[bytes, int], list[bytes]]] = {
            0: self._download_segment,
            1: self._initiate_download,
            2: self._initiate_upload,
            3: self._upload_segment,
            5: self._block_upload,
            6: self._block_download,
        }

    @property
    def busy(self) -> bool:
        """Return whether a segmented or block transfer is under way."""
        return self._transfer is not None

    @property
    def in_sub_block(self) -> bool:
        """Return whether frames are taken as segments of a block download."""
        return isinstance(self._transfer, BlockDownload) and self._transfer.receiving

    @property
    def deadline_ns(self) -> int | None:
        """Return when `tick` must be called for the running transfer, None if there is none."""
        return self._deadline_ns if self._prompt_ns is None else self._prompt_ns

    def reset(self) -> None:
        """Drop a running transfer silently (NMT reset, STOPPED)."""
        self._transfer = None
        self._deadline_ns = None
        self._prompt_ns = None

    def request(self, data: bytes, now_ns: int) -> list[bytes]:
        """Answer one request of exactly 8 bytes. A client's abort and frames inside a sub-block get no reply."""
        try:
            replies = self._dispatch(data, now_ns)
        except SdoAborted as e:
            self.reset()
            return [abort_frame(e)]
        self._deadline_ns = now_ns + self._timeout_ns if self._transfer else None
        self._prompt_ns = now_ns + self._timeout_ns // 2 if self.in_sub_block else None
        return replies

    def tick(self, now_ns: int) -> list[bytes]:
        """Process the passage of time. A transfer whose client is silent for too long is aborted with 05040000.

        Inside a sub-block, half of that time without a segment means that its end was lost: the segments received in
        sequence are acknowledged, and the client sends the rest again.
        """
        transfer = self._transfer
        if transfer is None or self._deadline_ns is None:
            return []
        if now_ns >= self._deadline_ns:
            self.reset()
            return [abort_frame(abort(transfer.index, transfer.subindex, Abort.TIMEOUT))]
        if self._prompt_ns is None or now_ns < self._prompt_ns or not isinstance(transfer, BlockDownload):
            return []
        self._prompt_ns = None
        return [transfer.acknowledge()]

    def _dispatch(self, data: bytes, now_ns: int) -> list[bytes]:
        transfer = self._transfer
        if isinstance(transfer, BlockDownload) and transfer.receiving and data[0] != _ABORT:
            reply = transfer.segment(data)
            return [] if reply is None else [reply]
        command = data[0] >> 5
        if command == _ABORT >> 5:
            self.reset()
            return []
        handler = self._handlers.get(command)
        if handler is None:
            raise self._out_of_turn()
        return handler(data, now_ns)

    def _initiate_download(self, data: bytes, now_ns: int) -> list[bytes]:
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
            announced, limit, overflow = self._room(index, subindex, data[4:8] if sized else b"")
            self._transfer = _Download(index, subindex, announced, limit, overflow)
        return [b"\x60" + data[1:4] + bytes(4)]

    def _room(self, index: int, subindex: int, size: bytes) -> tuple[int | None, int, Abort]:
        """Return the announced size, the size limit, and the abort code for data beyond the limit.

        Raises `SdoAborted` if the announced size already exceeds the limit."""
        announced = int.from_bytes(size, "little") if size else None
        own = self._access.begin_write(index, subindex, announced)
        if announced is not None and announced > MAX_TRANSFER_BYTES:
            raise abort(index, subindex, Abort.OUT_OF_MEMORY)
        limit = announced if announced is not None else own
        if limit is None:
            return None, MAX_TRANSFER_BYTES, Abort.OUT_OF_MEMORY
        return announced, limit, Abort.TOO_LONG

    def _download_segment(self, data: bytes, now_ns: int) -> list[bytes]:
        transfer = self._transfer
        if not isinstance(transfer, _Download):
            raise self._out_of_turn()
        self._check_toggle(transfer, data)
        transfer.data += data[1 : 8 - (data[0] >> 1 & 0x07)]
        if len(transfer.data) > transfer.limit:
            raise abort(transfer.index, transfer.subindex, transfer.overflow)
        reply = bytes([0x20 | transfer.toggle << 4]) + bytes(7)
        transfer.toggle ^= 1
        if data[0] & 0x01:
            if transfer.announced is not None and len(transfer.data) < transfer.announced:
                raise abort(transfer.index, transfer.subindex, Abort.TOO_SHORT)
            self._access.write(transfer.index, transfer.subindex, bytes(transfer.data), now_ns)
            self.reset()
        return [reply]

    def _initiate_upload(self, data: bytes, now_ns: int) -> list[bytes]:
        self.reset()
        index, subindex = _MUX.unpack_from(data, 1)
        return self._begin_upload(data, self._access.read(index, subindex, now_ns))

    def _begin_upload(self, data: bytes, raw: bytes) -> list[bytes]:
        if 1 <= len(raw) <= 4:
            return [bytes([0x43 | (4 - len(raw)) << 2]) + data[1:4] + raw.ljust(4, b"\0")]
        # An empty value cannot be expedited: n counts at most three unused bytes.
        index, subindex = _MUX.unpack_from(data, 1)
        self._transfer = _Upload(index, subindex, raw)
        return [b"\x41" + data[1:4] + len(raw).to_bytes(4, "little")]

    def _upload_segment(self, data: bytes, now_ns: int) -> list[bytes]:
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
        return [reply]

    def _block_download(self, data: bytes, now_ns: int) -> list[bytes]:
        transfer = self._transfer
        if not data[0] & 0x01:
            self.reset()
            index, subindex = _MUX.unpack_from(data, 1)
            announced, limit, overflow = self._room(index, subindex, data[4:8] if data[0] & 0x02 else b"")
            self._transfer = BlockDownload(
                index, subindex, announced, limit, bool(data[0] & 0x04), overflow, self._block
            )
            return [b"\xa4" + data[1:4] + bytes([self._block, 0, 0, 0])]
        if not isinstance(transfer, BlockDownload):
            raise self._out_of_turn()
        self._access.write(transfer.index, transfer.subindex, transfer.end(data), now_ns)
        self.reset()
        return [b"\xa1" + bytes(7)]

    def _block_upload(self, data: bytes, now_ns: int) -> list[bytes]:
        step, transfer = data[0] & 0x03, self._transfer
        if step == 0:
            return self._initiate_block_upload(data, now_ns)
        if not isinstance(transfer, BlockUpload):
            raise self._out_of_turn()
        if step == 3:
            return transfer.start()
        if step == 2:
            return transfer.acknowledged(data)
        if not transfer.ending:
            raise self._out_of_turn()
        self.reset()
        return []

    def _initiate_block_upload(self, data: bytes, now_ns: int) -> list[bytes]:
        """Start a block upload. A value that is not longer than the client's threshold (pst) is sent by an ordinary upload."""
        self.reset()
        index, subindex = _MUX.unpack_from(data, 1)
        raw = self._access.read(index, subindex, now_ns)
        block, threshold = data[4], data[5]
        if not 1 <= block <= MAX_BLOCK:
            raise abort(index, subindex, Abort.BLOCK_SIZE)
        if threshold and len(raw) <= threshold:
            return self._begin_upload(data, raw)
        self._transfer = BlockUpload(index, subindex, raw, block, crc=bool(data[0] & 0x04))
        return [b"\xc6" + data[1:4] + len(raw).to_bytes(4, "little")]

    def _check_toggle(self, transfer: _Download | _Upload, data: bytes) -> None:
        if data[0] >> 4 & 1 != transfer.toggle:
            raise abort(transfer.index, transfer.subindex, Abort.TOGGLE)

    def _out_of_turn(self) -> SdoAborted:
        """Return the abort for an unknown or unexpected command, with the object of the running transfer."""
        transfer = self._transfer
        index, subindex = (transfer.index, transfer.subindex) if transfer else (0, 0)
        return abort(index, subindex, Abort.COMMAND)
