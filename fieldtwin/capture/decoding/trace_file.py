"""Read recorded traffic: a run's trace (`fieldtwin simulate --trace`) or a capture of its buses (`--capture`)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from fieldtwin.capture.decoding.decoder import frame_events
from fieldtwin.capture.formats.pcap import MAX_LINE_BYTES, read_capture, utc_offset_ns
from fieldtwin.emulators.virtual.clock import EPOCH_UTC_NS
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.input_file import open_input, reading
from fieldtwin.results.trace import TraceEvent, TraceKind, decode_event, refusal_data
from fieldtwin.results.trace_about import read_about
from fieldtwin.twin.site.system import System

_EXPECTED = "[ns, kind, where, data], as `fieldtwin simulate --trace` writes it"


def read_events(path: Path, system: System) -> Iterator[TraceEvent]:
    """Yield the events of a trace, or the frames of a capture on the system's buses, in ns since the first.

    A truncated last line is omitted. Raises `FileInvalid` with the line number for any other invalid line.
    """
    if _is_capture(path):
        refusals: list[dict[str, Any]] = []
        captured = list(read_capture(path, refusals))
        start_ns = captured[0].t_ns if captured else 0
        refused = [TraceEvent(r["t_ns"] - start_ns, TraceKind.REFUSED, r["tag"], refusal_data(r)) for r in refusals]
        yield from sorted([*frame_events(captured, system, start_ns), *refused], key=lambda event: event.t_ns)
        return
    yield from _trace(path)


def start_utc_ns(path: Path) -> int:
    """Return the time of the start of `read_events` in nanoseconds since 1970, 0 if the file does not state it.

    A trace of a run in virtual time starts on 1 January 2026, as the clock of that run did. Raises `FileInvalid`.
    """
    if _is_capture(path):
        offset_ns = utc_offset_ns(path)
        begin = next(read_capture(path), None)
        return begin.t_ns + offset_ns if begin is not None and offset_ns else 0
    about = read_about(path)
    return EPOCH_UTC_NS if about is not None and about.target == "virtual" else 0


def _is_capture(path: Path) -> bool:
    """Return whether the file is a capture and not a trace. Raises `FileInvalid` if it cannot be read."""
    with reading(path), open_input(path) as file:
        return file.read(1) == b"{"


def _trace(path: Path) -> Iterator[TraceEvent]:
    with open_input(path) as file:
        number = 0
        while line := file.readline(MAX_LINE_BYTES):
            number += 1
            try:
                event = decode_event(line)
            except (msgspec.DecodeError, ValueError) as e:
                if not line.endswith(b"\n") and not file.read(1):
                    return
                raise FileInvalid(f"no event: {e}", path=str(path), line=number, expected=_EXPECTED) from e
            yield event
