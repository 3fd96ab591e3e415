"""Detect the kind of a third-party file and import it. `fieldtwin import` uses this module for all files except CTD casts.

The kind is detected by the content if the format has a mark (pcap, pcapng, a fieldtwin trace, mbpoll's banner), else by the
file's name. This module opens files; the formats themselves are in `fieldtwin.capture.formats`.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from fieldtwin.capture.formats.can_files import SUFFIXES as CAN_SUFFIXES
from fieldtwin.capture.formats.can_files import read_can_file
from fieldtwin.capture.formats.packet_file import is_packet_file
from fieldtwin.capture.formats.pcap import read_capture
from fieldtwin.capture.formats.poll_text import IS_POLL_TEXT, read_polls
from fieldtwin.capture.recordings.draft import Drafts
from fieldtwin.capture.recordings.framing_guess import guess_framing
from fieldtwin.capture.recordings.pairing import Bad, PairCounters, Pairer, pairer
from fieldtwin.capture.recordings.rotating_file import RotatingFile, parts_of
from fieldtwin.gateway.connections.tap import Captured
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.candump import LeftOut, line_of, read_log
from fieldtwin.gateway.core.files.input_file import open_input
from fieldtwin.gateway.core.files.recording import RecordingHeader, encode_exchange, encode_header
from fieldtwin.gateway.protocols.modbus.frames.selection import framing_of

CNV = (".cnv", ".cnv.gz", ".cnv.bz2")
KINDS = ".pcap, .pcapng, .log (candump), .asc, .blf, .trc, .csv, .cnv, .txt (mbpoll, modpoll), a capture of fieldtwin's"
_PACKETS = (".pcap", ".pcapng", ".cap", ".pcap.gz", ".pcapng.gz")
_SUFFIXES = (*_PACKETS, ".log", *CAN_SUFFIXES, ".csv", ".tsv", ".jsonl")
MAX_LINE = 65_536


@dataclass(slots=True)
class TextSummary:
    """The result of importing a CAN log, a capture or a poll session."""

    out: Path | None = None
    records: int = 0
    seconds: float = 0.0
    left_out: LeftOut = field(default_factory=LeftOut)
    pairs: PairCounters = field(default_factory=PairCounters)
    bad_file: Path | None = None
    profiles: list[Path] = field(default_factory=list)


def kind_of(path: Path) -> str:
    """Return the kind of a file: ``packets``, ``can``, ``csv``, ``cnv``, ``polls`` or ``capture``.

    Raises `UsageError`, or `FileInvalid` where the file cannot be read.
    """
    name = path.name.lower()
    if name.endswith(CNV):
        return "cnv"
    try:
        with open_input(path) as file:
            head = file.read(512)
    except OSError as e:
        if not name.endswith(_SUFFIXES):
            raise UsageError(f"cannot import {path.name!r}", expected=KINDS) from e
        raise FileInvalid(f"cannot be read: {e.strerror or e}", path=str(path)) from e
    if is_packet_file(head) or name.endswith(_PACKETS):
        return "packets"
    if path.suffix.lower() in (".log", *CAN_SUFFIXES):
        return "can"
    if path.suffix.lower() in (".csv", ".tsv"):
        return "csv"
    if IS_POLL_TEXT.search(head.decode("latin-1")):
        return "polls"
    if head[:1] == b"{" and b'"t_ns"' in head:
        return "capture"
    raise UsageError(f"cannot import {path.name!r}", expected=KINDS)


def import_can(path: Path, out: Path) -> TextSummary:
    """Convert a CAN log of any supported program to candump's format. Raises `FileInvalid`."""
    summary = TextSummary()
    frames: Iterator[tuple[int, str, CanFrame]] = (
        read_log(path, summary.left_out) if path.suffix.lower() == ".log" else read_can_file(path, summary.left_out)
    )
    return _write_log(frames, out, summary)


def _write_log(frames: Iterable[tuple[int, str, CanFrame]], out: Path, summary: TextSummary) -> TextSummary:
    first_ns, last_ns = -1, 0
    with _New(out) as file:
        for t_ns, channel, frame in frames:
            first_ns = t_ns if first_ns < 0 else first_ns
            last_ns = max(last_ns, t_ns)
            file.line(t_ns / 1e9, line_of(t_ns, frame, channel))
        summary.records = file.lines
    summary.out, summary.seconds = out, max(last_ns - first_ns, 0) / 1e9
    return summary


def import_polls(path: Path, out: Path) -> TextSummary:
    """Convert a session of modpoll or mbpoll into a recording of exchanges, with a draft profile.

    Raises `FileInvalid` with the line.
    """
    summary, drafts = TextSummary(out), Drafts()
    with open_input(path) as source, _New(out, encode_header(_header(path, out, ""))) as file:
        for exchange in read_polls(_lines(source, path), str(path)):
            file.line(exchange.t_s, encode_exchange(exchange))
            drafts.note(exchange)
            summary.seconds = exchange.t_s
            summary.pairs.exchanges += 1
            summary.pairs.unanswered += exchange.reply is None
        summary.records = file.lines
    summary.profiles = write_drafts(drafts, out, path.name)
    return summary


def import_capture(
    path: Path, out: Path, framing: str = "", url: str = "", header: RecordingHeader | None = None
) -> TextSummary:
    """Import a fieldtwin capture as a recording.

    Such a file comes from `fieldtwin run --capture` or `record --tap`, or is a command's log of sent frames. If it has several
    endpoints, `url` selects one; `framing` (rtu, ascii, mbap) overrides the endpoint's. Raises `FileInvalid`, `UsageError`.
    """
    seen = [Endpoint.parse(url)] if url else endpoints_of(path)
    if len(seen) != 1:
        there = ", ".join(map(str, seen)) or "nothing"
        raise UsageError(f"{path.name} holds {there}", expected="one of them", hint="--endpoint URL")
    endpoint = seen[0]
    items = (c for c in _captured(path) if c.endpoint == endpoint)
    if endpoint.is_can:
        frames = ((c.t_ns, "can0", c.item) for c in items if isinstance(c.item, CanFrame))
        return _write_log(frames, out, TextSummary())
    head = header or _header(path, out, str(endpoint))
    return _pair_capture(items, path, out, head, framing or _framing(path, endpoint))


def _captured(path: Path) -> Iterator[Captured]:
    """Yield the content of all parts of a capture."""
    for part in parts_of(path):
        yield from read_capture(part)


def _framing(path: Path, endpoint: Endpoint) -> str:
    """Return the framing that the bytes of the endpoint show; if they show none, the framing that the endpoint's URL states."""
    if endpoint.scheme in ("udp", "tls"):
        return framing_of(endpoint)
    chunks = (
        (c.direction is Direction.SENT, c.item)
        for c in _captured(path)
        if c.endpoint == endpoint and isinstance(c.item, bytes)
    )
    with contextlib.closing(chunks):
        return guess_framing(chunks) or framing_of(endpoint)


def endpoints_of(path: Path) -> list[Endpoint]:
    """Return the first 64 endpoints of a capture, in the order of their first appearance."""
    found: dict[Endpoint, None] = {}
    for captured in _captured(path):
        if len(found) < 64:
            found.setdefault(captured.endpoint)
    return list(found)


def _pair_capture(
    items: Iterable[Captured], path: Path, out: Path, header: RecordingHeader, framing: str
) -> TextSummary:
    summary, drafts = TextSummary(out), Drafts()
    wire: Pairer | None = None
    with _New(out, encode_header(header)) as file, BadFile(out, header.endpoint) as bad:
        for captured in items:
            if wire is None:
                wire = pairer(framing, captured.t_ns, bad.keep)
                first_ns = captured.t_ns
            summary.seconds = (captured.t_ns - first_ns) / 1e9
            if isinstance(captured.item, bytes):
                for e in wire.feed(captured.direction is Direction.SENT, captured.item, captured.t_ns):
                    file.line(e.t_s, encode_exchange(e))
                    drafts.note(e)
        for e in wire.finish() if wire is not None else ():
            file.line(e.t_s, encode_exchange(e))
            drafts.note(e)
        summary.records = file.lines
    if wire is not None:
        summary.pairs = wire.counters
    summary.bad_file = bad.path if bad.lines else None
    summary.profiles = write_drafts(drafts, out, path.name)
    return summary


def write_drafts(drafts: Drafts, recording: Path, origin: str) -> list[Path]:
    """Write the draft profiles next to a recording, as ``NAME.unit1.yaml`` and so on; return their paths."""
    found = []
    for unit, text in drafts.texts(recording.stem, origin).items():
        path = recording.with_suffix(f".unit{unit}.yaml")
        path.write_text(text, encoding="utf-8")
        found.append(path)
    return found


def _header(path: Path, out: Path, endpoint: str) -> RecordingHeader:
    return RecordingHeader(
        version=1, device=f"imported/{out.stem}", kind="exchanges", source="imported", endpoint=endpoint,
        made_by=f"fieldtwin import {path.name}", prototype=_of_prototype(path),
    )  # fmt: skip


def _of_prototype(capture: Path) -> bool:
    """Return whether the header of a capture marks it as the run of a digital twin prototype (paper.md, ruling 15)."""
    try:
        with open_input(capture) as file:
            head = json.loads(file.readline(MAX_LINE))
    except (OSError, ValueError):
        return False
    return isinstance(head, dict) and "started" in head and head.get("prototype") is True


def _lines(source: IO[bytes], path: Path) -> Iterator[str]:
    number = 0
    while line := source.readline(MAX_LINE + 1):
        number += 1
        if len(line) > MAX_LINE:
            raise FileInvalid("the line is too long", path=str(path), line=number, expected=f"{MAX_LINE} bytes")
        yield line.decode("utf-8", "replace")


class _New:
    """A file that gets its name only when it is complete; until then it is ``NAME.part``."""

    def __init__(self, out: Path, head: bytes = b"") -> None:
        if out.exists():
            raise FileInvalid("the recording exists already", path=str(out), hint="choose another name with --out")
        self._out = out
        self._part = out.with_name(out.name + ".part")
        self._part.unlink(missing_ok=True)
        self._file = RotatingFile(self._part, head, max_bytes=1 << 50)

    def __enter__(self) -> RotatingFile:
        return self._file

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._file.close()
        if kind is None:
            self._part.rename(self._out)
        else:
            self._part.unlink(missing_ok=True)


class BadFile:
    """The first `most` frames that are not part of an exchange, kept next to a recording as a capture (``NAME.bad.jsonl``)."""

    def __init__(self, recording: Path, endpoint: str, most: int = 100_000) -> None:
        self.path = recording.with_suffix(".bad.jsonl")
        self._endpoint, self._most = endpoint, most
        self._file: RotatingFile | None = None
        self.lines = 0

    def __enter__(self) -> BadFile:
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            self._file.close()

    def discard(self) -> None:
        """Close and remove the file of a recording that turned out to be empty."""
        self.__exit__()
        if self._file is not None:
            self.path.unlink(missing_ok=True)

    def keep(self, bad: Bad, endpoint: str = "") -> None:
        """Count one more frame, and write it unless `most` frames were written already."""
        if self._file is None:
            self.path.unlink(missing_ok=True)
            self._file = RotatingFile(self.path)
        self.lines += 1
        if self.lines <= self._most:
            direction = Direction.SENT if bad.sent else Direction.RECEIVED
            line = {
                "t_ns": bad.t_ns, "endpoint": endpoint or self._endpoint, "direction": direction.value,
                "hex": bad.data.hex(), "why": bad.why,
            }  # fmt: skip
            self._file.line(0.0, json.dumps(line, separators=(",", ":")).encode() + b"\n")
