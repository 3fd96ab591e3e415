"""RTU frames recognised only by the pauses of the line, as a directly connected UART receives them (SL 2.5.1.1).

A pause of t3.5 ends a frame, and a frame with a pause of more than t1.5 inside it is discarded; lengths are not used. This
suits media that deliver every byte in time. Ptys, sockets and USB adapters do not preserve the pauses: use `RtuReceiver`
there. This module performs no I/O.
"""

from __future__ import annotations

from fieldtwin.emulators.modbus.rtu.receiver import MAX_FRAME, MIN_FRAME, crc16
from fieldtwin.emulators.wires.serial_line import SerialPacer
from fieldtwin.gateway.core.endpoint import SerialSettings


class StrictReceiver:
    """A receiver that ends frames at pauses. `gap_ns` is t3.5; the counters are those of `RtuReceiver`.

    A chunk counts as characters without gaps, the last of which was complete at its `now_ns`. A frame is returned when the pause
    after it is known: with the next byte, or with ``b""``.
    """

    def __init__(self, settings: SerialSettings) -> None:
        self._pacer = SerialPacer(settings)
        self.gap_ns = self._pacer.t3_5_ns
        self.frames = 0
        self.crc_errors = 0
        self.noise_bytes = 0
        self._frame = bytearray()
        self._spoilt = False
        self._length = 0
        self._last_ns = 0

    @property
    def pending(self) -> int:
        """Return the number of bytes of a frame that no pause has ended yet.

        Bytes beyond the longest frame are counted and not kept.
        """
        return self._length

    def feed(self, data: bytes, now_ns: int) -> list[bytes]:
        """Return the frame that a pause ended, if any. Never raises, whatever `data` contains."""
        frames: list[bytes] = []
        if self._length:
            pause_ns = now_ns - self._pacer.duration_ns(len(data)) - self._last_ns
            if pause_ns >= self.gap_ns:
                frames = self._end_frame()
            elif data and pause_ns > self._pacer.t1_5_ns:
                self._spoilt = True
        if data:
            self._last_ns = now_ns
            self._length += len(data)
            self._frame += data[: max(0, MAX_FRAME - len(self._frame))]
        return frames

    def _end_frame(self) -> list[bytes]:
        frame, length = bytes(self._frame), self._length
        good = not self._spoilt and MIN_FRAME <= length <= MAX_FRAME and crc16(frame) == 0
        self._frame.clear()
        self._length, self._spoilt = 0, False
        if good:
            self.frames += 1
            return [frame]
        self.noise_bytes += length
        self.crc_errors += length >= MIN_FRAME
        return []
