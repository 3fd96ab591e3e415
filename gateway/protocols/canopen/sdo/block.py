"""SDO block upload and download (CiA 301, 7.2.4.3.9 to 7.2.4.3.16): up to 127 segments for one acknowledgement.

As in `transfers`, the classes do no I/O. Segments carry a sequence number, so that lost segments can be sent again: the receiver
acknowledges the last good segment, and the sender resends the rest, renumbered from 1 (CO-016). Two rules ensure that the result
is never a wrong object:

- When no more segments arrive, the client acknowledges the part of the sub-block that it received. If it received nothing, the
  node may take this acknowledgement for that of the previous sub-block and send the previous sub-block again. So the client
  acknowledges an empty sub-block only once, and only if the announced size shows in the end whether data was repeated.
- The client requests at most 63 segments per block. Their first bytes (01h to 3Fh and 81h to BFh) then differ from those of a
  reply to an upload (40h to 7Fh) and of an abort (80h). So segments that arrive late, after the transfer was given up, cannot be
  taken for a reply to a later request.

At the end of the transfer, size and CRC are checked.
"""

from __future__ import annotations

from binascii import crc_hqx

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.protocols.canopen.sdo import abort_codes
from fieldtwin.gateway.protocols.canopen.sdo.transfers import (
    MAX_BYTES,
    Done,
    SdoDownload,
    SdoUpload,
    SendFrame,
    Step,
    WaitForFrame,
)

UPLOAD_BLOCK = 63
BLOCK_MAX = 127
MAX_REPEATS = 8
"""The number of consecutive sub-blocks without a new segment after which the transfer is given up."""

_LAST = 0x80
_UPLOAD_REPLY, _DOWNLOAD_REPLY = 6, 5
_INITIATE, _END, _ACKNOWLEDGE = 0, 1, 2
_WITH_CRC = 0x04
_SEGMENT = 7


def crc16(data: bytes) -> int:
    """Return the CRC of a block transfer (7.2.4.3.16): x^16 + x^12 + x^5 + 1, from 0. 31C3h for ``123456789``."""
    return crc_hqx(data, 0)


class SdoBlockUpload(SdoUpload):
    """An upload in blocks. If the node answers with a segmented or expedited upload instead, the transfer continues as such
    (CO-021).

    `block` is the number of segments per block (1 to 127; with more than 63, late segments may be mistaken for replies,
    see the module). `switch_bytes` is the protocol switch threshold, 0 if the node must not switch.
    """

    def __init__(
        self,
        node: int,
        index: int,
        subindex: int,
        timeout_ns: int,
        *,
        length: int | None = None,
        max_bytes: int = MAX_BYTES,
        block: int = UPLOAD_BLOCK,
        switch_bytes: int = 0,
    ) -> None:
        super().__init__(node, index, subindex, timeout_ns, length=length, max_bytes=max_bytes)
        if not 1 <= block <= BLOCK_MAX or not 0 <= switch_bytes <= 0xFF:
            raise UsageError(f"{self.name}: block size or switch threshold", expected="1 to 127, 0 to 255")
        self._block = block
        self._switch_bytes = switch_bytes
        self._in_blocks = False
        self._crc = False
        self._good = 0  # the last segment of the present sub-block that arrived in sequence
        self._surplus = 0  # consecutive segments that were not the one expected
        self._repeats = 0
        self._nudged = False
        self._last_seen = False

    @property
    def to_abort(self) -> bool:
        return self.started and not self.over

    @property
    def unmarked(self) -> bool:
        return self._in_blocks and not self.over

    def _request(self) -> bytes:
        return bytes([0xA0 | _WITH_CRC]) + self._multiplexor + bytes([self._block, self._switch_bytes])

    def _is_reply(self, data: bytes) -> bool:
        return (data[0] >> 5 == _UPLOAD_REPLY and data[0] & 1 == _INITIATE) or super()._is_reply(data)

    def _on_reply(self, data: bytes) -> Step:
        if data[0] >> 5 != _UPLOAD_REPLY:
            return super()._on_reply(data)
        self._in_blocks, self._crc = True, bool(data[0] & _WITH_CRC)
        self._indicated = int.from_bytes(data[4:8], "little") if data[0] & 0x02 else None
        if self._indicated is not None and self._indicated > self._max_bytes:
            return self._break(abort_codes.OUT_OF_MEMORY, f"{self._indicated} bytes announced", data)
        return SendFrame(self._frame(b"\xa3"))

    def _on_next(self, data: bytes) -> Step:
        if not self._in_blocks:
            return super()._on_next(data)
        return self._on_end(data) if self._last_seen else self._on_segment(data)

    def _on_segment(self, data: bytes) -> Step:
        number, last = data[0] & 0x7F, bool(data[0] & _LAST)
        if not 1 <= number <= self._block:
            return self._break(abort_codes.INVALID_SEQUENCE, f"segment {number} of {self._block}", data)
        if number != self._good + 1:  # one was lost, or an old one is repeated: only the expected segment is taken
            self._surplus += 1
            if self._surplus > 2 * BLOCK_MAX:
                return self._break(abort_codes.INVALID_SEQUENCE, "segments, but never the expected one", data)
            return self._again(data) if last or number == self._block else WaitForFrame()
        self._good, self._surplus, self._repeats, self._nudged = number, 0, 0, False
        self._received += data[1:]
        if len(self._received) > self._max_bytes + _SEGMENT:
            return self._break(abort_codes.OUT_OF_MEMORY, f"more than {self._max_bytes} bytes", data)
        self._last_seen = last
        return self._acknowledge() if last or number == self._block else WaitForFrame()

    def _again(self, data: bytes) -> Step:
        """Acknowledge the received part of an incomplete sub-block, so that the node sends the rest again.

        Abort after more than `MAX_REPEATS` sub-blocks without a new segment.
        """
        self._repeats += not self._good
        if self._repeats > MAX_REPEATS:
            return self._break(abort_codes.INVALID_SEQUENCE, "blocks without new segments", data)
        return self._acknowledge()

    def _acknowledge(self) -> SendFrame:
        acknowledged, self._good = self._good, 0
        return SendFrame(self._frame(bytes([0xA0 | _ACKNOWLEDGE, acknowledged, self._block])))

    def _on_end(self, data: bytes) -> Step:
        if data[0] >> 5 != _UPLOAD_REPLY or data[0] & 3 != _END:
            return self._stray("not the end of a block upload")
        unused = (data[0] >> 2) & 7
        value, indicated = bytes(self._received[: len(self._received) - unused]), self._indicated
        if indicated is not None and len(value) != indicated:
            code = abort_codes.LENGTH_TOO_HIGH if len(value) > indicated else abort_codes.LENGTH_TOO_LOW
            return self._break(code, f"{indicated} bytes announced, {len(value)} sent", data)
        if len(value) > self._max_bytes:
            return self._break(abort_codes.OUT_OF_MEMORY, f"more than {self._max_bytes} bytes", data)
        if self._crc and crc16(value) != int.from_bytes(data[1:3], "little"):
            return self._break(abort_codes.CRC_ERROR, f"the CRC is {crc16(value):04X}h", data)
        return Done(value, self._frame(bytes([0xA0 | _END])))

    def _patience_ns(self) -> int:
        """Return the time limit for the next frame in ns: half the timeout among segments, to request lost ones before the node
        gives up.
        """
        return self.timeout_ns // 2 if self._may_recover() else self.timeout_ns

    def _may_recover(self) -> bool:
        safe = self._good > 0 or (self._indicated is not None and not self._nudged)
        return self._in_blocks and not self._last_seen and safe

    def _recover(self, now_ns: int) -> SendFrame | None:
        """Acknowledge the segments that have arrived, because the last segments of the sub-block were lost (CO-017)."""
        if not self._may_recover():
            return None
        self._nudged = not self._good
        step = self._acknowledge()
        self._go_on(step, now_ns)
        return step


class SdoBlockDownload(SdoDownload):
    """A download in blocks of the size that the node requests. An early acknowledgement is accepted (CO-018)."""

    def __init__(self, node: int, index: int, subindex: int, timeout_ns: int, data: bytes) -> None:
        super().__init__(node, index, subindex, timeout_ns, data)
        self._segments = max(1, -(-len(self._data) // _SEGMENT))
        self._block = 0
        self._done = 0  # segments of earlier sub-blocks
        self._in_block = 0  # segments of this sub-block that were sent
        self._crc = False
        self._repeats = 0
        self._resent = False

    @property
    def to_abort(self) -> bool:
        return self.started and not self.over

    @property
    def _moved(self) -> int:
        return min(self._done * _SEGMENT, len(self._data))

    @property
    def _expedited(self) -> bool:
        return False

    def _request(self) -> bytes:
        return bytes([0xC0 | _WITH_CRC | 0x02]) + self._multiplexor + len(self._data).to_bytes(4, "little")

    def _is_reply(self, data: bytes) -> bool:
        return data[0] >> 5 == _DOWNLOAD_REPLY and data[0] & 3 == _INITIATE

    def _on_reply(self, data: bytes) -> Step:
        self._crc = bool(data[0] & _WITH_CRC)
        return self._next_block(data[4], data)

    def _on_next(self, data: bytes) -> Step:
        ended = self._done == self._segments
        kind = data[0] & 3 if data[0] >> 5 == _DOWNLOAD_REPLY else None
        if ended and kind == _END:
            return Done(b"")
        if ended or kind != _ACKNOWLEDGE:
            return self._stray("no acknowledgement")
        acknowledged = data[1]
        if acknowledged > self._in_block:
            return self._break(
                abort_codes.INVALID_SEQUENCE, f"segment {acknowledged} acknowledged, {self._in_block} sent", data
            )
        self._repeats = 0 if acknowledged else self._repeats + 1
        if self._repeats > MAX_REPEATS:
            return self._break(abort_codes.INVALID_SEQUENCE, "blocks of which no segment arrives", data)
        self._done += acknowledged
        return self._end() if self._done == self._segments else self._next_block(data[2], data)

    def _next_block(self, size: int, data: bytes) -> Step:
        if not 1 <= size <= BLOCK_MAX:
            return self._break(abort_codes.INVALID_BLOCK_SIZE, f"{size} segments a block", data)
        self._block, self._in_block, self._resent = size, 0, False
        return self._segment()

    def _segment(self) -> SendFrame:
        position = self._done + self._in_block
        part = self._data[position * _SEGMENT : (position + 1) * _SEGMENT]
        self._in_block += 1
        last = position + 1 == self._segments
        command = self._in_block | (_LAST if last else 0)
        return SendFrame(self._frame(bytes([command]) + part), more=not last and self._in_block < self._block)

    def more(self, now_ns: int) -> SendFrame | None:
        if self.over or self._in_block >= self._block or self._done + self._in_block >= self._segments:
            return None
        step = self._segment()
        self._go_on(step, now_ns)
        return step

    def _end(self) -> SendFrame:
        unused = self._segments * _SEGMENT - len(self._data)
        crc = crc16(self._data) if self._crc else 0
        return SendFrame(self._frame(bytes([0xC0 | unused << 2 | _END]) + crc.to_bytes(2, "little")))

    def _recover(self, now_ns: int) -> SendFrame | None:
        """Send the last segment of the sub-block again, but only once: it may be lost, and the node waits for it (CO-017)."""
        if not self.answered or self._done == self._segments or self._resent:
            return None
        self._resent = True
        self._in_block -= 1
        step = self._segment()
        self._go_on(step, now_ns)
        return step
