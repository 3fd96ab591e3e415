"""Observe a serial line passively: frames, requests and replies. The module does no I/O: the caller gives the bytes and their
times.

Both directions share one pair of wires, so requests and replies are distinguished by their shape and order. A frame counts if
its check sum is correct. This module does not know the baud rate at which it listens: `listening` compares the results at
several.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from fieldtwin.capture.decoding.modbus_frames import ModbusFrame, splitter
from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.protocols.modbus.frames.selection import Framing

SETTLE_NS = 40 * NS_PER_MS
"""A silence in ns after which new bytes do not belong to earlier ones, even with a USB adapter."""

SURE_FRAMES = 3
"""Number of good frames that cannot be due to chance: one of 65,536 random four-byte sequences has a correct check sum."""


@dataclass(slots=True)
class ObservedUnit:
    """The traffic of a unit ID that was observed on the line. The unit is live if it answered."""

    requests: int = 0
    replies: int = 0
    exceptions: int = 0
    functions: set[int] = field(default_factory=set)

    @property
    def live(self) -> bool:
        return self.replies + self.exceptions > 0


@dataclass(slots=True)
class Heard:
    """The totals of the observed traffic. `good_bytes` are the bytes of good frames; `longest_gap_ns` is the longest silence
    between chunks.
    """

    framing: Framing
    bytes: int = 0
    good_bytes: int = 0
    frames: int = 0
    bad_frames: int = 0
    units: dict[int, ObservedUnit] = field(default_factory=dict)
    repeated: int = 0
    """Number of requests that were immediately repeated, as with an adapter that returns sent bytes."""
    glitches: int = 0
    """Number of pieces of one or two bytes next to frames, caused by a transceiver that switches too early or late."""
    longest_gap_ns: int = 0
    values: dict[int, int] = field(default_factory=dict)
    """How often each byte value was received."""

    @property
    def share(self) -> float:
        """Return the share of bytes that belong to good frames, 0 to 1."""
        return self.good_bytes / self.bytes if self.bytes else 0.0

    @property
    def live(self) -> list[int]:
        """Return the units that answered."""
        return sorted(u for u, h in self.units.items() if h.live)

    @property
    def silent(self) -> list[int]:
        """Return the units that received requests and did not answer."""
        return sorted(u for u, h in self.units.items() if h.requests and not h.live and u)

    @property
    def sure(self) -> bool:
        """Return whether the frames prove Modbus at these settings, because chance cannot explain them."""
        return self.frames >= SURE_FRAMES and self.share > 0.5


class LineListener:
    """A listener for `framing` (rtu or ascii). Call `feed` with received bytes, and `settle` from time to time or during
    silence."""

    def __init__(self, framing: Framing) -> None:
        self.heard = Heard(framing)
        self._splitter = splitter(framing)
        self._last_ns: int | None = None
        self._open: ModbusFrame | None = None

    def feed(self, data: bytes, t_ns: int) -> None:
        """Add bytes received at `t_ns`."""
        if not data:
            return
        self.settle(t_ns)
        heard = self.heard
        if self._last_ns is not None:
            heard.longest_gap_ns = max(heard.longest_gap_ns, t_ns - self._last_ns)
        self._last_ns = t_ns
        heard.bytes += len(data)
        for byte in data:
            heard.values[byte] = heard.values.get(byte, 0) + 1
        for frame in self._splitter.feed(data, t_ns):
            self._take(frame)

    def settle(self, now_ns: int) -> None:
        """End an incomplete frame, which counts as damaged, if the line has been silent for `SETTLE_NS` at `now_ns`."""
        if self._last_ns is not None and now_ns - self._last_ns > SETTLE_NS:
            for frame in self._splitter.flush():
                self._take(frame)

    def _take(self, frame: ModbusFrame) -> None:
        heard = self.heard
        if frame.bad:
            heard.bad_frames += 1
            heard.glitches += len(frame.raw) <= 2
            return
        heard.frames += 1
        heard.good_bytes += len(frame.raw)
        unit = heard.units.setdefault(frame.unit, ObservedUnit())
        function = frame.pdu[0]
        unit.functions.add(function & 0x7F)
        asked, self._open = self._open, None
        if asked is not None and asked.raw == frame.raw and _request_shape(frame.pdu) == "request":
            heard.repeated += 1  # the reply to a write repeats the request
            self._open = asked
        elif function & 0x80:
            unit.exceptions += 1
        elif is_reply(frame, asked):
            unit.replies += 1
        else:
            unit.requests += 1
            self._open = frame


def is_reply(frame: ModbusFrame, asked: ModbusFrame | None) -> bool:
    """Return whether a good frame is a reply, by its shape, or else by the request `asked` before it."""
    if frame.pdu[0] & 0x80:
        return True
    shape = _request_shape(frame.pdu)
    if shape == "either":
        return asked is not None and (asked.unit, asked.pdu[0]) == (frame.unit, frame.pdu[0])
    return shape == "reply"


def _request_shape(pdu: bytes) -> str:
    """Return ``request`` or ``reply`` if a PDU can only be that, else ``either``."""
    function, size = pdu[0], len(pdu)
    if function in (0x01, 0x02):
        return "either" if size == 5 and pdu[1] == 3 else "request" if size == 5 else "reply"
    if function in (0x03, 0x04):
        return "request" if size == 5 else "reply"
    if function in (0x0F, 0x10):
        return "reply" if size == 5 else "request"
    if function == 0x17:
        return "request" if size >= 12 and size == 10 + pdu[9] else "reply"
    if function in (0x07, 0x0B, 0x0C, 0x11):
        return "request" if size == 1 else "reply"
    return "either"
