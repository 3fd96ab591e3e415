"""Reassemble chunks of bytes into Modbus frames: RTU, ASCII and MBAP, one direction of a connection each.

Frames are found by length and check sum, as a bus analyser does; other bytes are noise and returned as such. The module is
independent of the gateway's framers on purpose, because it checks them. It stores at most one incomplete frame and reads no
clock: the caller gives the time of the bytes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass

from fieldtwin.gateway.protocols.modbus.frames.crc import crc16
from fieldtwin.gateway.protocols.modbus.frames.shapes import MAX_FRAME, MIN_FRAME, frame_lengths

MAX_ADU = 260
MAX_ASCII = 513
_LAST_UNIT = 247


@dataclass(frozen=True, slots=True)
class ModbusFrame:
    """A frame of unit ID `unit` (-1: not readable), whose last byte arrived at `t_ns`.

    `bad` is its fault, "" for a good frame. `transaction` is the transaction ID of MBAP, -1 for other framings.
    """

    t_ns: int
    unit: int
    pdu: bytes
    raw: bytes
    bad: str = ""
    transaction: int = -1


@dataclass(frozen=True, slots=True)
class Expected:
    """The reply that a serial line waits for: from `unit`, to `function`, with `pdu_bytes` (0: the reply itself states its
    length).
    """

    unit: int
    function: int
    pdu_bytes: int


_READS = (1, 2, 3, 4, 23)
"""Functions whose reply begins with its byte count."""


class Splitter(ABC):
    """Divides the bytes of one direction into frames. `feed` returns complete frames, `flush` the incomplete rest."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._arrivals: deque[tuple[int, int]] = deque()  # number of bytes received so far, and the time
        self._came = self._gone = 0

    @property
    def pending(self) -> int:
        """Return the number of bytes of a frame that is not complete."""
        return len(self._buffer)

    def feed(self, data: bytes, t_ns: int, expected: Expected | None = None) -> list[ModbusFrame]:
        """Add received bytes and return the frames that are complete."""
        self._buffer += data
        if data:
            self._came += len(data)
            self._arrivals.append((self._came, t_ns))
        return self._split(expected, False)

    def flush(self, expected: Expected | None = None) -> list[ModbusFrame]:
        """End the present frame: no further bytes belong to it. Return the bytes so far as a complete frame or as noise."""
        return self._split(expected, True) if self._buffer else []

    @abstractmethod
    def _split(self, expected: Expected | None, settled: bool) -> list[ModbusFrame]:
        """Remove the complete frames at the beginning of the buffer, and return them."""

    def _cut(self, size: int) -> tuple[int, bytes]:
        """Remove the first `size` bytes; return them and the time of the last one."""
        raw = bytes(self._buffer[:size])
        del self._buffer[:size]
        self._gone += size
        while self._arrivals[0][0] < self._gone:
            self._arrivals.popleft()
        upto, t_ns = self._arrivals[0]
        if upto == self._gone:
            self._arrivals.popleft()
        return t_ns, raw

    def _noise(self, size: int, why: str) -> ModbusFrame:
        t_ns, raw = self._cut(size)
        return ModbusFrame(t_ns, -1, b"", raw, why)


class RtuSplitter(Splitter):
    """Divides the bytes of Modbus RTU into frames (SL 2.5.1)."""

    def _split(self, expected: Expected | None, settled: bool) -> list[ModbusFrame]:
        found: list[ModbusFrame] = []
        skipped = 0
        while skipped < len(self._buffer):
            size, bad = self._frame_at(skipped, expected, settled)
            if size < 0:
                break
            if size == 0:
                skipped += 1
                continue
            if skipped:
                found.append(self._noise(skipped, "noise"))
                skipped = 0
            t_ns, raw = self._cut(size)
            found.append(ModbusFrame(t_ns, raw[0], raw[1:-2], raw, bad))
        if settled and self._buffer:
            found.append(self._noise(len(self._buffer), "no frame"))
        elif skipped and len(self._buffer) > MAX_FRAME:
            found.append(self._noise(skipped, "noise"))
        return found

    def _frame_at(self, at: int, expected: Expected | None, settled: bool) -> tuple[int, str]:
        """Return the size of the frame at position `at` and its fault. The size is 0 if no frame begins there, and -1 if more
        bytes are needed.
        """
        head = self._buffer[at:]
        if head[0] > _LAST_UNIT:
            return 0, ""
        size = self._expected_size(head, expected)
        if own := _by_its_byte_count(head, size, expected):
            return own, ""
        if size > len(head):
            return (0, "") if settled else (-1, "")
        if size > 0:
            good = crc16(head[:size]) == 0
            return size, "" if good else "check sum"
        if len(head) < 2:
            return (0, "") if settled else (-1, "")
        lengths, more = frame_lengths(head)
        for size in lengths:
            if MIN_FRAME <= size <= min(len(head), MAX_FRAME) and crc16(head[:size]) == 0:
                return size, ""
        whole = MIN_FRAME <= len(head) <= MAX_FRAME and crc16(head) == 0
        if whole and (settled or not (lengths or more)):  # an unknown function has no known length
            return len(head), ""
        grows = len(head) < MAX_FRAME and (more or not lengths or any(n > len(head) for n in lengths))
        return (-1, "") if grows and not settled else (0, "")

    def _expected_size(self, head: bytearray, expected: Expected | None) -> int:
        """Return the length of the awaited reply if `head` is its beginning, else 0.

        While the length is not known yet, the result is larger than the length of `head`.
        """
        if expected is None or head[0] != expected.unit:
            return 0
        if len(head) < 2:
            return 2
        if head[1] == expected.function | 0x80:
            return 5
        return expected.pdu_bytes + 3 if head[1] == expected.function and expected.pdu_bytes else 0


def _by_its_byte_count(head: bytearray, size: int, expected: Expected | None) -> int:
    """Return the size of a reply to a read with an unexpected byte count and a correct check sum; else 0."""
    if (
        expected is None
        or expected.function not in _READS
        or size < MIN_FRAME
        or len(head) < 3
        or head[1] != expected.function
    ):
        return 0
    own = head[2] + 5
    return own if own != size and own <= min(len(head), MAX_FRAME) and crc16(head[:own]) == 0 else 0


class AsciiSplitter(Splitter):
    """Splits one direction of a Modbus ASCII line into frames. A frame begins with a colon and ends with LF (SL 2.5.2)."""

    def _split(self, expected: Expected | None, settled: bool) -> list[ModbusFrame]:
        found = []
        while self._buffer:
            end = self._buffer.find(b"\n")
            start = self._buffer.rfind(b":", 0, end if end >= 0 else len(self._buffer))
            if end < 0:
                if settled or len(self._buffer) > MAX_ASCII:
                    found.append(self._noise(len(self._buffer), "no frame"))
                return found
            if start != 0:
                found.append(self._noise(start if start > 0 else end + 1, "noise"))
                continue
            t_ns, raw = self._cut(end + 1)
            found.append(_ascii_frame(t_ns, raw))
        return found


def _ascii_frame(t_ns: int, raw: bytes) -> ModbusFrame:
    try:
        body = bytes.fromhex(raw[1:].strip(b"\r\n").decode("ascii"))
    except ValueError:
        body = b""
    if len(body) < 3:
        return ModbusFrame(t_ns, -1, b"", raw, "no frame")
    return ModbusFrame(t_ns, body[0], body[1:-1], raw, "" if sum(body) & 0xFF == 0 else "check sum")


class MbapSplitter(Splitter):
    """Divides the bytes of Modbus TCP into frames (TG 3.1.3). After an invalid header the rest of the received bytes is noise."""

    def _split(self, expected: Expected | None, settled: bool) -> list[ModbusFrame]:
        found = []
        while len(self._buffer) >= 6:
            size = 6 + int.from_bytes(self._buffer[4:6])
            if not 8 <= size <= MAX_ADU:
                found.append(self._noise(len(self._buffer), "an impossible header"))
                return found
            if len(self._buffer) < size:
                break
            foreign = self._buffer[2:4] != b"\0\0"
            t_ns, raw = self._cut(size)
            bad = "not Modbus: the protocol id is not 0" if foreign else ""
            found.append(ModbusFrame(t_ns, raw[6], raw[7:], raw, bad, int.from_bytes(raw[:2])))
        if settled and self._buffer:
            found.append(self._noise(len(self._buffer), "no frame"))
        return found


def splitter(framing: str) -> Splitter:
    """Return the splitter for one direction of a connection with that framing: rtu, ascii, mbap or udp."""
    return {"rtu": RtuSplitter, "ascii": AsciiSplitter}.get(framing, MbapSplitter)()
