"""The decoded traffic of a field simulator: requests with their answers, and messages; numbered and bounded.

The emulators pass bytes to the log, and a passive listener on each CAN bus passes frames. This module does not depend on tests.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import Any

from fieldtwin.capture.decoding.decoder import Decoder
from fieldtwin.capture.decoding.exchange import DecodedExchange
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import Clock
from fieldtwin.results.trace import TraceEvent, TraceKind
from fieldtwin.twin.site.system import System

MOST = 20_000
AT_ONCE = 5_000
MAX_CONNECTIONS = 256


@dataclass
class _Line:
    decoder: Decoder
    end: object
    last_ns: int = 0

    @property
    def closed(self) -> bool:
        """Return whether the connection is closed, so that no reply can follow."""
        return getattr(self.end, "lost", None) is not None


class WireLog:
    """The latest `MOST` exchanges of a system's buses."""

    def __init__(self, system: System, clock: Clock) -> None:
        self._system = system
        self._clock = clock
        self._start_ns = clock.monotonic_ns()
        self._lines: dict[tuple[str, int], _Line] = {}
        self._kept: deque[tuple[int, DecodedExchange]] = deque(maxlen=MOST)
        self.number = 0
        """The number of the latest exchange, counted from 1."""

    def on_bytes(self, bus: str, end: object, reply: bool, data: bytes) -> None:
        """Add bytes from a serial line or socket; `end` identifies the connection."""
        way = "received" if reply else "sent"
        self._feed(bus, end, {"dir": way, "bytes": data.hex()})

    def on_frame(self, bus: str, frame: CanFrame) -> None:
        """Add a frame of any sender on a CAN bus."""
        data: dict[str, Any] = {"dir": "received", "id": frame.can_id, "bytes": frame.data.hex()}
        data |= {key: True for key, on in (("ext", frame.extended), ("rtr", frame.remote), ("err", frame.error)) if on}
        self._feed(bus, None, data)

    def _feed(self, bus: str, end: object, data: dict[str, Any]) -> None:
        key = bus, hash(end) if isinstance(end, tuple) else id(end)
        line = self._lines.get(key)
        if line is None:
            if len(self._lines) >= MAX_CONNECTIONS:
                oldest = min(self._lines, key=lambda k: self._lines[k].last_ns)
                self._take(self._lines.pop(oldest).decoder.finish())
            line = self._lines[key] = _Line(Decoder(self._system), end)  # `end` is kept, so that its id stays unique
        line.last_ns = self._clock.monotonic_ns()
        self._take(line.decoder.feed(TraceEvent(line.last_ns - self._start_ns, TraceKind.FRAME, bus, data)))

    def _take(self, exchanges: list[DecodedExchange]) -> None:
        for exchange in exchanges:
            self.number += 1
            self._kept.append((self.number, exchange))

    def since(self, number: int) -> list[dict[str, Any]]:
        """Return the exchanges after `number`, in the order in which they ended, at most `AT_ONCE`.

        They are plain data with their number, times (s since the log began) and descriptions, without the values of secrets. A
        call has no side effects.
        """
        found = [(n, e) for n, e in self._kept if n > number][:AT_ONCE]
        return [_plain(n, e) for n, e in found]

    def pending(self) -> list[dict[str, Any]]:
        """Return the requests whose reply may still come, with the number 0.

        On a closed connection no reply can come: there the problem is ``no reply``. A call has no side effects.
        """
        found = []
        for line in self._lines.values():
            waiting = line.decoder.pending()
            if line.closed:
                waiting = [replace(e, problem="no reply", reply_text="no reply") for e in waiting]
            found += waiting
        return [_plain(0, e) for e in sorted(found, key=lambda e: e.t_ns)]

    @property
    def now_s(self) -> float:
        """Return the seconds since the log began."""
        return (self._clock.monotonic_ns() - self._start_ns) / 1e9


def _plain(number: int, exchange: DecodedExchange) -> dict[str, Any]:
    return {
        "number": number,
        "t_s": exchange.t_ns / 1e9,
        "bus": exchange.bus,
        **exchange.describe(),
        "transaction": exchange.transaction,
        "access": exchange.access,
        "address": exchange.address,
        "count": exchange.count,
        "text": exchange.text,
        "reply_text": exchange.reply_text,
        "request": "" if exchange.secrets else exchange.request.hex(),
        "reply": "" if exchange.secrets else exchange.reply.hex(),
    }
