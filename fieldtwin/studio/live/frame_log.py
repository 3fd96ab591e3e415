"""The frames of a run's buses, decoded: an index of the capture file with random access to each frame.

The run writes the capture (`fieldtwin.gateway.connections.tap.TapFile`); this module follows the file. Decoded frames go to a
temporary file, and memory holds some 30 bytes for each: a million frames take about 40 MB.

A frame here is a piece of traffic as the medium delivered it. On a serial line a long reply can arrive in several pieces;
the last one carries the decoded values and the latency.
"""

from __future__ import annotations

import json
import tempfile
from array import array
from bisect import bisect_left, bisect_right, insort
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from fieldtwin.capture.decoding.decoder import Decoder, frame_event
from fieldtwin.capture.decoding.exchange import SECRET, DecodedExchange
from fieldtwin.capture.decoding.fields import FieldSpan
from fieldtwin.capture.formats.pcap import MAX_LINE_BYTES, captured_of
from fieldtwin.gateway.connections.tap import Captured
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid
from fieldtwin.gateway.core.files.input_file import open_input
from fieldtwin.results.trace import TraceEvent
from fieldtwin.twin.site.system import System

MOST_FRAMES = 4_000_000
"""Largest number of frames that are indexed; the capture itself is limited to 1 GiB."""
MOST_FILTERS = 8
MOST_ENDPOINTS = 1_024
"""Largest number of endpoints of a capture whose bus is kept in memory."""
MOST_OPEN = 4_096
"""Largest number of requests whose reply is still awaited: more than the buses can have open at the same time."""
AT_ONCE_BYTES = 8_192
"""Bytes of the capture that one call of `follow` reads: about 60 frames, which take some 5 ms. HTTP requests wait meanwhile."""
PENDING, GOOD = 0, 1


class FrameRow(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """A decoded frame. `t_ns` counts on the monotonic clock; bytes are in hex; `latency_ns` is None if it answers no request."""

    t_ns: int
    bus: str
    sent: bool
    device: str
    unit: int | None
    """Unit ID or node ID."""
    service: str
    text: str
    bytes: str
    can_id: int | None
    latency_ns: int | None
    request: int | None
    """The number of the frame that this one answers."""
    tags: dict[str, Any]
    """The values that the frame carried, in engineering units."""
    whole: str = ""
    """The whole reply in hex if this frame is its last piece, else ""."""


@dataclass(frozen=True)
class FrameFilter:
    """Which frames to show. Empty fields accept everything; `problems` accepts only frames of failed exchanges."""

    bus: str = ""
    device: str = ""
    service: str = ""
    problems: bool = False

    @property
    def is_empty(self) -> bool:
        """Return whether every frame is accepted."""
        return self == _EVERYTHING


_EVERYTHING = FrameFilter()


class _Names:
    """A table that assigns a small number to each name, for the columns of the index."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self._numbers: dict[str, int] = {}

    def number(self, name: str) -> int:
        """Return the number of a name; a new name gets the next number. After 65,535 names all others share one."""
        found = self._numbers.get(name)
        if found is None:
            if len(self.names) == 0xFFFF:
                return 0xFFFF
            found = self._numbers[name] = len(self.names)
            self.names.append(name)
        return found

    def known(self, name: str) -> int | None:
        """Return the number of a name, None if it has not occurred."""
        return self._numbers.get(name)


class FrameLog:
    """The index of one capture. Raises `FileInvalid` if the file cannot be read."""

    def __init__(self, capture: Path, system: System) -> None:
        self.path = capture
        self.is_full = False
        """Whether `MOST_FRAMES` are indexed and further frames are ignored."""
        self.invalid_lines = 0
        self._system = system
        self._decoder = Decoder(system)
        try:
            self._capture = open_input(capture)
        except OSError as e:
            raise FileInvalid(f"cannot read the capture: {e.strerror or e}", path=str(capture)) from e
        self._rows = tempfile.TemporaryFile(prefix="fieldtwin-frames-")  # noqa: SIM115
        self._rest = b""
        self._read_to = 0
        self._written = 0
        self._raw_at, self._row_at, self._times = array("Q"), array("Q"), array("q")
        self._verdicts, self._replies = array("H"), array("L")
        self._buses, self._devices, self._services = array("H"), array("H"), array("H")
        self._bus_names: dict[str, str] = {}
        self._names, self._problems = _Names(), _Names()
        for reserved in ("", "good"):
            self._problems.number(reserved)
        self._open: OrderedDict[tuple[str, int], int] = OrderedDict()
        self._filtered: OrderedDict[FrameFilter, tuple[array[int], int]] = OrderedDict()

    def close(self) -> None:
        """Close both files; the temporary file is deleted."""
        self._capture.close()
        self._rows.close()

    def __len__(self) -> int:
        return len(self._times)

    @property
    def behind_bytes(self) -> int:
        """Return how many bytes of the capture are not indexed yet."""
        try:
            return max(0, self.path.stat().st_size - self._read_to)
        except OSError:
            return 0

    def follow(self) -> int:
        """Index the next piece of the capture, at most `AT_ONCE_BYTES`. Return the number of new frames."""
        if self.is_full:
            return 0
        chunk = self._capture.read(AT_ONCE_BYTES)
        if not chunk:
            return 0
        before, at = len(self), self._read_to - len(self._rest)
        self._read_to += len(chunk)
        *lines, self._rest = (self._rest + chunk).split(b"\n")
        if len(self._rest) > MAX_LINE_BYTES:
            self.is_full = True
            self.invalid_lines += 1
        for line in lines:
            self._add_line(line, at)
            at += len(line) + 1
            if len(self) >= MOST_FRAMES:
                self.is_full = True
                break
        self._rows.flush()
        return len(self) - before

    # -- reading ----------------------------------------------------------------------------------------------------------

    def count(self, wanted: FrameFilter = _EVERYTHING) -> int:
        """Return the number of frames that a filter accepts."""
        return len(self) if wanted.is_empty else len(self._matching(wanted))

    def page(self, start: int, count: int, wanted: FrameFilter = _EVERYTHING) -> list[tuple[int, FrameRow]]:
        """Return up to `count` accepted frames from position `start` on, each with its number among all frames."""
        if wanted.is_empty:
            numbers: list[int] = list(range(max(0, start), min(len(self), start + count)))
        else:
            numbers = list(self._matching(wanted)[max(0, start) : max(0, start) + count])
        return [(number, self.row(number)) for number in numbers]

    def row(self, number: int) -> FrameRow:
        """Return a frame by its number. Raises `IndexError`."""
        if not 0 <= number < len(self):
            raise IndexError(number)
        at = self._row_at[number]
        until = self._row_at[number + 1] if number + 1 < len(self) else self._written
        self._rows.seek(at)
        return msgspec.json.decode(self._rows.read(until - at), type=FrameRow)

    def verdict(self, number: int) -> str:
        """Return ``good``, the problem of the exchange, or "" for a request whose reply may still come, or a piece of a reply."""
        return self._problems.names[self._verdicts[number]]

    def reply_to(self, number: int) -> int | None:
        """Return the number of the frame that answered a request, None if no frame did."""
        return self._replies[number] - 1 if self._replies[number] else None

    def position_at(self, t_ns: int, wanted: FrameFilter = _EVERYTHING) -> int:
        """Return the position of the first accepted frame at or after an instant."""
        if wanted.is_empty:
            return bisect_left(self._times, t_ns)
        return bisect_left(self._matching(wanted), t_ns, key=lambda number: self._times[number])

    def numbers(self, first: int, last: int, wanted: FrameFilter = _EVERYTHING) -> Sequence[int]:
        """Return the numbers of the accepted frames from number `first` to number `last`."""
        first, last = max(0, first), min(last, len(self) - 1)
        if wanted.is_empty:
            return range(first, last + 1)
        matching = self._matching(wanted)
        return matching[bisect_left(matching, first) : bisect_right(matching, last)]

    def captured(self, numbers: Iterable[int]) -> list[Captured]:
        """Return the traffic of these frames, as the tap received it."""
        found = []
        for number in numbers:
            self._capture.seek(self._raw_at[number])
            found.append(self._captured_of(self._capture.readline()))
        self._capture.seek(self._read_to)
        return found

    def fields(self, number: int) -> list[FieldSpan]:
        """Explain a frame field by field; the last piece of a reply is explained with the pieces before it."""
        row = self.row(number)
        [seen] = self.captured([number])
        event = frame_event(seen, row.bus)
        if row.whole:
            event = TraceEvent(event.t_ns, event.kind, event.where, event.data | {"bytes": row.whole})
        request = bytes.fromhex(self.row(row.request).bytes) if row.request is not None else b""
        return self._decoder.fields(event, request)

    def services(self) -> list[str]:
        """Return the functions and services that have occurred, as choices for a filter."""
        return sorted({self._names.names[n] for n in set(self._services)} - {""})

    def _matching(self, wanted: FrameFilter) -> array[int]:
        """Return the numbers of the accepted frames. The result of the latest filters is kept and extended."""
        found, upto = self._filtered.pop(wanted, (array("L"), 0))
        conditions: list[tuple[array[int], int]] = []
        for column, name in (
            (self._buses, wanted.bus),
            (self._devices, wanted.device),
            (self._services, wanted.service),
        ):
            if name:
                number = self._names.known(name)
                conditions.append((column, -1 if number is None else number))
        for number in range(upto, len(self)):
            if all(column[number] == value for column, value in conditions) and (
                not wanted.problems or self._verdicts[number] > GOOD
            ):
                found.append(number)
        self._filtered[wanted] = found, len(self)
        while len(self._filtered) > MOST_FILTERS:
            self._filtered.popitem(last=False)
        return found

    # -- indexing ---------------------------------------------------------------------------------------------------------

    def _add_line(self, line: bytes, at: int) -> None:
        try:
            event = self._event_of(line)
        except (ValueError, KeyError, TypeError, RecursionError, FieldtwinError):
            self.invalid_lines += 1
            return
        if event is not None:
            self._add(event, at)

    def _event_of(self, line: bytes) -> TraceEvent | None:
        """Return the frame of a line of the file; None for any other line, or if its bus is not in the system."""
        if not line.startswith(b'{"t_ns"'):
            return None  # the head of the file
        read = json.loads(line)
        if "refused" in read:
            return None
        seen, bus = captured_of(read), self._bus_of(read["endpoint"])
        return frame_event(seen, bus) if bus else None

    def _captured_of(self, line: bytes) -> Captured:
        """Return the traffic of a line of the file that holds a frame."""
        return captured_of(json.loads(line))

    def _bus_of(self, endpoint: str) -> str:
        """Return the bus at an endpoint, "" if none is there. Cached, because formatting an endpoint is slower than decoding."""
        bus = self._bus_names.get(endpoint)
        if bus is None:
            text = str(Endpoint.parse(endpoint))
            bus = next((name for name, b in self._system.buses.items() if str(b.endpoint) == text), "")
            if len(self._bus_names) < MOST_ENDPOINTS:
                self._bus_names[endpoint] = bus
        return bus

    def _add(self, event: TraceEvent, at: int) -> None:
        number, decoded = len(self), self._decoder.decode(event)
        sent = event.data.get("dir") == "sent"
        answered: DecodedExchange | None = None
        request: int | None = None
        for exchange in decoded.exchanges:
            row = self._open.pop((exchange.bus, exchange.t_ns), None)
            if row is None and exchange.t_ns != event.t_ns:
                continue
            if row is None or exchange.latency_ns is not None or exchange.end_ns == event.t_ns:
                answered, request = exchange, row
            if row is not None:
                self._conclude(row, exchange, number if exchange.reply else None)
        waiting = None
        if answered is None and sent:
            waiting = next((p for p in self._decoder.pending() if p.bus == event.where and p.t_ns == event.t_ns), None)
        of = answered or waiting
        if waiting is not None:
            self._open[event.where, event.t_ns] = number
            if len(self._open) > MOST_OPEN:
                self._open.popitem(last=False)
        self._append(event, at, decoded.text, sent, of, answered, request)

    def _append(
        self, event: TraceEvent, at: int, text: str, sent: bool, of: DecodedExchange | None, answered: DecodedExchange | None,
        request: int | None,
    ) -> None:  # fmt: skip
        device = of.device if of else text.partition(":")[0] if text.partition(":")[0] in self._system.devices else ""
        tags: dict[str, Any] = {}
        if answered is not None:
            tags = {n: SECRET if n in answered.secrets else _plain(v) for n, v in answered.tags.items()}
        row = FrameRow(
            t_ns=event.t_ns,
            bus=event.where,
            sent=sent,
            device=device,
            unit=of.unit if of else None,
            service=of.service if of else "",
            text=text.removeprefix(f"{device}: ") if device else text,
            bytes=event.data["bytes"],
            can_id=event.data.get("id"),
            latency_ns=answered.latency_ns if answered else None,
            request=request,
            tags=tags,
            whole=_whole(event, answered),
        )
        encoded = msgspec.json.encode(row)
        self._rows.seek(self._written)
        self._rows.write(encoded)
        self._raw_at.append(at)
        self._row_at.append(self._written)
        self._written += len(encoded)
        self._times.append(event.t_ns)
        self._buses.append(self._names.number(event.where))
        self._devices.append(self._names.number(device))
        self._services.append(self._names.number(row.service))
        self._verdicts.append(PENDING if answered is None else self._problem(answered))
        self._replies.append(0)

    def _problem(self, exchange: DecodedExchange) -> int:
        return self._problems.number(exchange.problem) if exchange.problem else GOOD

    def _conclude(self, row: int, exchange: DecodedExchange, reply: int | None) -> None:
        """Record the verdict on a request that was indexed earlier."""
        self._verdicts[row] = verdict = self._problem(exchange)
        if reply is not None:
            self._replies[row] = reply + 1
        if verdict <= GOOD:
            return
        for wanted, (found, upto) in self._filtered.items():
            if wanted.problems and row < upto and self._accepts(wanted, row):
                insort(found, row)

    def _accepts(self, wanted: FrameFilter, row: int) -> bool:
        names = self._names.names
        return (
            wanted.bus in ("", names[self._buses[row]])
            and wanted.device in ("", names[self._devices[row]])
            and wanted.service in ("", names[self._services[row]])
        )


def _whole(event: TraceEvent, answered: DecodedExchange | None) -> str:
    """Return the whole reply that ended with this piece, or "" if the frame itself contains all of it."""
    if answered is None or "id" in event.data or event.data.get("dir") == "sent":
        return ""
    reply = answered.reply.hex()
    return reply if len(reply) > len(event.data["bytes"]) else ""


def _plain(value: object) -> object:
    return value.hex() if isinstance(value, bytes) else value
