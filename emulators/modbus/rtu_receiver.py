"""Where RTU frames begin and end in what a line delivers, as a server on a shared line hears it.

Frames are told by their length and check sum, never by silence alone: behind USB adapters, ptys and sockets the
pauses of the line are gone (SL 2.5.1.1 is what a UART sees). A long pause only decides that an unfinished frame stays
unfinished. Pure: bytes and ``now`` in, whole frames out; who is asked and what is answered is known elsewhere.

Others' traffic is on the line too, requests and responses, and is told apart only by trying both lengths. The first
byte of the buffer is trusted to begin a frame and may hold back what follows until that frame is whole; once it proves
to be noise, every byte behind it is tried and only a correct check sum counts.
"""

from __future__ import annotations

from dataclasses import dataclass

from gateway.core.clock import NS_PER_MS

MIN_FRAME = 4
MAX_FRAME = 256
"""Bytes of a frame with unit and check sum: function only, and the limit of SL 2.5.1."""
FRAME_GAP_NS = 50 * NS_PER_MS
"""A pause after which nobody goes on with a frame: well over t3.5 and over the 16 ms of a USB adapter's timer, well
under any master's response timeout."""


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        for _ in range(8):
            byte = byte >> 1 ^ (0xA001 if byte & 1 else 0)
        table.append(byte)
    return tuple(table)


_TABLE = _crc_table()


def crc16(data: bytes | bytearray | memoryview) -> int:
    """CRC of SL 2.5.1.2 (polynomial A001h reflected, start FFFFh). Over a whole frame with its CRC it is zero."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _TABLE[(crc ^ byte) & 0xFF]
    return crc


def with_crc(frame: bytes) -> bytes:
    """`frame` (unit and PDU) with its check sum, low byte first."""
    return frame + crc16(frame).to_bytes(2, "little")


@dataclass(frozen=True, slots=True)
class Shape:
    """How long a frame is by its head. `plausible`: the head makes sense, so that waiting for the rest does too.

    While the head itself is short, `length` is the least it can be, which is more than what is there.
    """

    length: int
    plausible: bool = True


_FIXED_REQUESTS = {
    **dict.fromkeys((0x01, 0x02, 0x03, 0x04, 0x05, 0x06), 8),
    **dict.fromkeys((0x07, 0x0B, 0x0C, 0x11), 4),
    0x16: 10,
    0x18: 6,
}
_COUNTED_RESPONSES = frozenset({0x01, 0x02, 0x03, 0x04, 0x0C, 0x11, 0x14, 0x15, 0x17})
_WORD_RESPONSES = frozenset({0x03, 0x04, 0x17})
_FIXED_RESPONSES = {0x05: 8, 0x06: 8, 0x07: 5, 0x0B: 8, 0x0F: 8, 0x10: 8, 0x16: 10}


def request_shape(head: bytes | bytearray) -> Shape | None:
    """Shape of a request that begins with `head` (at least unit and function); None: only its CRC can tell."""
    function = head[1]
    if function in _FIXED_REQUESTS:
        return Shape(_FIXED_REQUESTS[function])
    if function in (0x0F, 0x10):
        if len(head) < 7:
            return Shape(9)
        count, size = head[4] << 8 | head[5], head[6]
        return Shape(9 + size, size == ((count + 7) // 8 if function == 0x0F else 2 * count) and size > 0)
    if function == 0x17:
        if len(head) < 11:
            return Shape(13)
        return Shape(13 + head[10], head[10] == 2 * (head[8] << 8 | head[9]) and head[10] > 0)
    if function in (0x14, 0x15):
        return Shape(5 + head[2], head[2] >= 7) if len(head) > 2 else Shape(12)
    return None


def response_shape(head: bytes | bytearray) -> Shape | None:
    """Shape of a response that begins with `head`; None: only its CRC can tell."""
    function = head[1]
    if function >= 0x80:
        return Shape(5)
    if function in _FIXED_RESPONSES:
        return Shape(_FIXED_RESPONSES[function])
    if function in _COUNTED_RESPONSES:
        if len(head) < 3:
            return Shape(6)
        return Shape(5 + head[2], head[2] > 0 and not (function in _WORD_RESPONSES and head[2] % 2))
    if function == 0x18:
        return Shape(6 + (head[2] << 8 | head[3])) if len(head) > 3 else Shape(8)
    return None


class RtuReceiver:
    """Cuts frames out of a line. `own`: the unit ids served here, which never *send* anything that is heard here.

    `crc_errors` counts runs of at least `MIN_FRAME` bytes that belong to no frame, `noise_bytes` every such byte. They
    are known once the next frame is found or the line has paused for `gap_ns`; feed ``b""`` to tell of a pause.
    """

    def __init__(self, own: frozenset[int], gap_ns: int = FRAME_GAP_NS) -> None:
        self.gap_ns = gap_ns
        self.frames = 0
        self.crc_errors = 0
        self.noise_bytes = 0
        self._own = own
        self._buffer = bytearray()
        self._run = 0
        self._last_ns = 0

    @property
    def pending(self) -> int:
        """Bytes that wait for more, at most `MAX_FRAME`."""
        return len(self._buffer)

    def feed(self, data: bytes, now_ns: int) -> list[bytes]:
        """Frames that are whole now, oldest first, each with unit and CRC. Never raises, whatever comes."""
        frames: list[bytes] = []
        if self._buffer and now_ns - self._last_ns >= self.gap_ns:
            while frame := self._next_frame(wait=False):
                frames.append(frame)
            self._drop(len(self._buffer))
            self._end_run()
        if data:
            self._last_ns = now_ns
            self._buffer += data
            while frame := self._next_frame(wait=True):
                frames.append(frame)
        self.frames += len(frames)
        return frames

    def _next_frame(self, wait: bool) -> bytes | None:
        size = len(self._buffer)
        for start in range(size - MIN_FRAME + 1):
            length = self._complete(start)
            if length:
                self._drop(start)
                self._end_run()
                frame = bytes(self._buffer[:length])
                del self._buffer[:length]
                return frame
            if start == 0 and wait and self._run == 0 and self._unfinished():
                return None
        if size > MAX_FRAME - 1:  # what began earlier than this has had all the bytes that a frame can have
            self._drop(size - MAX_FRAME + 1)
        return None

    def _complete(self, start: int) -> int:
        """Length of the whole, correct frame at `start`, or 0."""
        head = self._buffer[start : start + MAX_FRAME]
        shapes = self._shapes(head)
        # Shortest first: a 00 behind a whole frame leaves its check sum right, and is the next frame's broadcast address.
        lengths = sorted(s.length for s in shapes if s is not None and MIN_FRAME <= s.length <= len(head))
        for length in lengths:
            if crc16(head[:length]) == 0:
                return length
        # Searching by CRC alone is for frames to us, and for the place where a frame is known to begin: elsewhere it would
        # find frames in noise, one in 65536 tries.
        if None in shapes and (head[0] in self._own or (start == 0 and self._run == 0)):
            return _crc_search(head)
        return 0

    def _unfinished(self) -> bool:
        """Whether a sensible frame begins with the buffer's first byte and is not whole yet."""
        head = self._buffer[:MAX_FRAME]
        return any(s is not None and s.plausible and len(head) < s.length <= MAX_FRAME for s in self._shapes(head))

    def _shapes(self, head: bytes | bytearray) -> tuple[Shape | None, ...]:
        if head[0] > 247:
            return ()  # reserved unit ids (SL 2.2): noise, or nothing to do with us
        if head[0] == 0 or head[0] in self._own:
            return (request_shape(head),)
        return (request_shape(head), response_shape(head))

    def _drop(self, count: int) -> None:
        del self._buffer[:count]
        self._run += count
        self.noise_bytes += count

    def _end_run(self) -> None:
        if self._run >= MIN_FRAME:
            self.crc_errors += 1
        self._run = 0


def _crc_search(head: bytes | bytearray) -> int:
    """Length of the shortest prefix with a correct check sum, or 0."""
    crc = 0xFFFF
    for length, byte in enumerate(head, 1):
        crc = crc >> 8 ^ _TABLE[(crc ^ byte) & 0xFF]
        if crc == 0 and length >= MIN_FRAME:
            return length
    return 0
