"""Guess the framing of a line from its bytes: RTU, ASCII or Modbus TCP, whichever finds the most bytes in complete frames."""

from __future__ import annotations

from collections.abc import Iterable

from fieldtwin.capture.decoding.modbus_frames import splitter

LOOKED_AT = 65_536
"""Number of bytes after which the guess is final."""


def guess_framing(chunks: Iterable[tuple[bool, bytes]]) -> str:
    """Return rtu, ascii or mbap, or "" if no bytes form a frame. `chunks` are (sent, bytes), in order."""
    splitters = {framing: {side: splitter(framing) for side in (True, False)} for framing in ("rtu", "ascii", "mbap")}
    good = dict.fromkeys(splitters, 0)
    seen = 0
    for sent, data in chunks:
        seen += len(data)
        for framing, sides in splitters.items():
            frames = sides[sent].feed(data, 0)
            if framing == "rtu":
                frames += sides[not sent].flush()
            good[framing] += sum(len(f.raw) for f in frames if not f.bad)
        if seen > LOOKED_AT:
            break
    for framing, sides in splitters.items():
        good[framing] += sum(len(f.raw) for side in sides.values() for f in side.flush() if not f.bad)
    best = max(good, key=lambda framing: good[framing])
    return best if good[best] else ""
