"""Recordings of a device's replies, or of its signals, as JSON Lines files that survive a crash.

The first line is a header; every further line is one record and is written with one ``write``, so that a killed process
loses at most the line that it was writing. There are two kinds:

``exchanges``  ``{"t": 1.25, "unit": 1, "req": "0400000002", "rep": "04044148f5c3", "lat": 0.021}``
               `req` and `rep` are hex of the protocol data unit (Modbus: function code and data; neither unit ID nor
               CRC nor MBAP header), `t` is the time at which the request was sent, in seconds since the start, and `lat`
               the seconds from the request's last byte to the reply's. If no valid reply came, there is
               ``"err": "timeout"`` instead of `rep`. An empty `rep` is a broadcast, which has no reply.
``signals``    ``[1.25, 10.31, 18.402, 4.5871]``: seconds since the start, then one number for each signal in the
               header's order, ``null`` if it has no value. An array is a third of the size of an object, and as easy
               to compare.

A recording is read as a stream; the memory is limited to a block of lines. A last line that was cut off is reported and
not used (`truncated`); any other line that is not a record raises `FileInvalid` with path and line. This module has no
clock: the caller supplies every time.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Literal, TypeVar

import msgspec

from fieldtwin.gateway.core.errors import Bug, FileInvalid
from fieldtwin.gateway.core.files.input_file import open_input

MAX_LINE_BYTES = 65_536
"""Longer lines are refused: the longest Modbus exchange takes about 1,100 bytes."""

_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
"""The flags for a new file. Of the last two flags, each operating system has only one."""

_OTHER_FILES = (
    (b'{"fieldtwin_dump"', " but a dump: fieldtwin infer, diff and report read it"),
    (b"[", " but a trace: fieldtwin trace shows and converts it"),
    (b'{"started"', " but raw traffic: fieldtwin import makes a recording of it"),
)
"""Files that users give by mistake, recognised by their first bytes."""

BLOCK_BYTES = 4 * MAX_LINE_BYTES
"""The number of bytes of a recording of exchanges that are read in one block."""

Kind = Literal["exchanges", "signals"]
Source = Literal["measured", "synthetic", "imported"]
ExchangeError = Literal["timeout", "crc", "desync", "lost"]
"""The reason why an exchange has no reply: timeout, wrong check sum, a frame that did not answer the request, or a lost
connection.
"""


def looks_like_another_file(path: Path) -> bool:
    """Return whether a file begins like one that is often mistaken for a recording: a dump, or raw traffic. Raises `OSError`."""
    with open_input(path) as file:
        begins = file.read(max(len(other) for other, _ in _OTHER_FILES))
    return any(begins.startswith(other) for other, _ in _OTHER_FILES)


class SignalInfo(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A signal: its unit as displayed, and the column of the file from which it was imported."""

    unit: str = ""
    column: str = ""


class RecordingHeader(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True, kw_only=True):
    """The first line: the recorded device, the kind of recording, and its origin.

    `prototype` is true if the recorded device was an emulator (paper.md, ruling 15). `start_utc` is ISO 8601, empty if the
    date of the start is not known. `profile_hash` is that of the device profile in use, empty if there was none.
    """

    version: Literal[1] = msgspec.field(name="fieldtwin_recording")
    device: str
    kind: Kind
    source: Source
    endpoint: str = ""
    made_by: str = ""
    profile_hash: str = ""
    start_utc: str = ""
    prototype: bool = False
    signals: dict[str, SignalInfo] = {}


class RecordedExchange(msgspec.Struct, frozen=True, gc=False):
    """One request and its result. `reply` is None exactly when `error` gives the reason.

    This is a struct, not a dataclass: a recording of a day has millions, and a struct is made in a third of the time.
    """

    t_s: float
    unit: int
    request: bytes
    reply: bytes | None
    latency_s: float = 0.0
    error: ExchangeError | None = None


class SignalRow(msgspec.Struct, frozen=True, gc=False):
    """The values of all signals at one time, in the header's order; NaN for a signal without a value."""

    t_s: float
    values: tuple[float, ...]


class _ExchangeLine(msgspec.Struct, forbid_unknown_fields=True, gc=False):
    t: float
    unit: int
    req: str
    rep: str | None = None
    err: ExchangeError | None = None
    lat: float = 0.0


_encoder = msgspec.json.Encoder()
_header_decoder = msgspec.json.Decoder(RecordingHeader)
_exchange_decoder = msgspec.json.Decoder(_ExchangeLine)
_row_decoder = msgspec.json.Decoder(list[float | None])

R = TypeVar("R")


def encode_header(header: RecordingHeader) -> bytes:
    """Return the header's line, newline included."""
    return _encoder.encode(header) + b"\n"


def encode_exchange(exchange: RecordedExchange) -> bytes:
    """Return an exchange's line, newline included."""
    line: dict[str, object] = {"t": exchange.t_s, "unit": exchange.unit, "req": exchange.request.hex()}
    if exchange.reply is not None:
        line["rep"] = exchange.reply.hex()
    else:
        line["err"] = exchange.error
    line["lat"] = exchange.latency_s
    return _encoder.encode(line) + b"\n"


def encode_row(t_s: float, values: Sequence[float]) -> bytes:
    """Return a signal row's line, newline included. NaN and infinities become null."""
    return _encoder.encode([t_s, *values]) + b"\n"


def shown(path: Path) -> str:
    """Return a recording's name and origin for display: ``cast.jsonl (synthetic)``. Raises `FileInvalid`."""
    with RecordingReader(path) as reader:
        header = reader.header
    return f"{path.name} ({header.source}{', of an emulator' if header.prototype else ''})"


class RecordingReader:
    """The reader of a recording. `header` is available immediately; then call `exchanges()` or `rows()` once.

    At the end, `truncated` says whether the last line was cut off, and `lines` holds the number of complete lines. Use the reader
    as a context manager. Raises `FileInvalid` for a file that does not exist, is not a recording, or is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.lines = 0
        self.truncated = False
        try:
            self._file: BinaryIO = open_input(path)
        except OSError as error:
            raise FileInvalid(f"cannot read the recording: {error.strerror}", path=str(path)) from error
        try:
            self.header = self._read_header()
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> RecordingReader:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; closing twice does nothing."""
        self._file.close()

    def exchanges(self) -> Iterator[RecordedExchange]:
        """Yield the exchanges that follow. The recording must be of kind `exchanges`."""
        self._expect("exchanges")
        return self._exchanges()

    def _exchanges(self) -> Iterator[RecordedExchange]:
        """Decode whole blocks of lines while they are valid. From the first invalid block on, decode line by line to report the
        line number.
        """
        while self._file.seekable():
            start = self._file.tell()
            block = self._file.read(BLOCK_BYTES)
            block = block[: block.rfind(b"\n") + 1]
            try:
                found = [_exchange_of(raw) for raw in _exchange_decoder.decode_lines(block)]
            except (msgspec.MsgspecError, ValueError):
                found = []
            if not found:
                self._file.seek(start)
                break
            self._file.seek(start + len(block))
            self.lines += block.count(b"\n")
            yield from found
        yield from self._records(_read_exchange)

    def rows(self) -> Iterator[SignalRow]:
        """Yield the rows that follow; their times never decrease. The recording must be of kind `signals`."""
        self._expect("signals")
        width, last_t = len(self.header.signals), -math.inf

        def read(line: bytes) -> SignalRow:
            nonlocal last_t
            row = _read_row(line, width)
            if row.t_s < last_t:
                raise ValueError(f"the time decreased from {last_t} s to {row.t_s} s")
            last_t = row.t_s
            return row

        return self._records(read)

    def _expect(self, kind: Kind) -> None:
        if self.header.kind != kind:
            raise FileInvalid(
                "the recording is of another kind", path=str(self.path), line=1, expected=kind, got=self.header.kind
            )

    def _read_header(self) -> RecordingHeader:
        line = self._next_line()
        if not line.strip():
            raise FileInvalid("the recording is empty", path=str(self.path), line=1, expected="a header")
        try:
            header = _header_decoder.decode(line)
        except (msgspec.MsgspecError, UnicodeDecodeError) as error:
            other = next((advice for begins, advice in _OTHER_FILES if line.startswith(begins)), "")
            raise FileInvalid(
                f"not a recording{other}" if other else f"not a recording's header: {error}",
                path=str(self.path),
                line=1,
                expected='{"fieldtwin_recording": 1, "device": ..., "kind": ..., "source": ...}',
            ) from error
        if header.kind == "signals" and not header.signals:
            raise FileInvalid("a recording of signals has no signals", path=str(self.path), line=1)
        return header

    def _next_line(self) -> bytes:
        """Return the next line with its newline, b"" at the end of the file."""
        try:
            line = self._file.readline(MAX_LINE_BYTES + 1)
        except OSError as error:
            raise FileInvalid(
                f"cannot continue reading: {error.strerror}", path=str(self.path), line=self.lines + 1
            ) from error
        if len(line) > MAX_LINE_BYTES:
            raise FileInvalid(
                "the line is too long", path=str(self.path), line=self.lines + 1, expected=f"{MAX_LINE_BYTES} bytes"
            )
        if line:
            self.lines += 1
        return line

    def _records(self, read: Callable[[bytes], R]) -> Iterator[R]:
        while line := self._next_line():
            if line.isspace():
                continue
            try:
                record = read(line)
            except (msgspec.MsgspecError, ValueError) as error:
                if not line.endswith(b"\n"):
                    self.lines -= 1
                    self.truncated = True
                    return
                raise FileInvalid(f"not a record: {error}", path=str(self.path), line=self.lines) from error
            yield record


class RecordingWriter:
    """The writer of a new recording, which appends each record with one write. Use it as a context manager.

    The file must not exist: a recording is never overwritten. A full disk raises `FileInvalid`, and the file is cut
    back to its last complete record.
    """

    def __init__(self, path: Path, header: RecordingHeader) -> None:
        self.path = path
        self.header = header
        self.records = 0
        self._size = 0
        try:
            self._fd = os.open(path, _NEW, 0o644)
        except FileExistsError:
            raise FileInvalid("the recording exists already", path=str(path), hint="choose another name") from None
        except OSError as error:
            raise FileInvalid(f"cannot write the recording: {error.strerror}", path=str(path)) from error
        try:
            self._append(encode_header(header))
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def exchange(self, exchange: RecordedExchange) -> None:
        """Append one exchange."""
        if self.header.kind != "exchanges" or (exchange.reply is None) == (exchange.error is None):
            raise Bug("no exchange for this recording", expected="reply or error, in a recording of exchanges")
        self._append(encode_exchange(exchange))
        self.records += 1

    def row(self, t_s: float, values: Sequence[float]) -> None:
        """Append all signals at time `t_s`, in the header's order; NaN for a signal without a value."""
        if self.header.kind != "signals" or len(values) != len(self.header.signals):
            raise Bug("no row for this recording", expected=f"{len(self.header.signals)} values", got=str(len(values)))
        self._append(encode_row(t_s, values))
        self.records += 1

    def sync(self) -> None:
        """Write everything to the disk, so that it also survives a power failure."""
        try:
            os.fsync(self._fd)
        except OSError as error:
            raise FileInvalid(f"cannot continue writing: {error.strerror}", path=str(self.path)) from error

    def close(self) -> None:
        """Close the file; closing twice does nothing."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _append(self, line: bytes) -> None:
        if self._fd < 0:
            raise Bug("a closed recording was written to", where=str(self.path))
        if len(line) > MAX_LINE_BYTES:
            raise Bug("a record is too long", expected=f"{MAX_LINE_BYTES} bytes", got=str(len(line)))
        try:
            done = os.write(self._fd, line)
            while done < len(line):  # signal, or disk nearly full: write the rest, or get the reason
                done += os.write(self._fd, line[done:])
        except OSError as error:
            os.ftruncate(self._fd, self._size)
            raise FileInvalid(f"cannot continue writing: {error.strerror}", path=str(self.path)) from error
        self._size += len(line)


def _read_exchange(line: bytes) -> RecordedExchange:
    """Return the exchange of one line. Raises ValueError."""
    return _exchange_of(_exchange_decoder.decode(line))


def _exchange_of(raw: _ExchangeLine) -> RecordedExchange:
    if (raw.rep is None) == (raw.err is None):
        raise ValueError("exactly one of rep and err is needed")
    if not 0 <= raw.unit <= 255:
        raise ValueError(f"unit {raw.unit} is not from 0 to 255")
    if raw.lat < 0:
        raise ValueError(f"latency {raw.lat} is negative")
    request = bytes.fromhex(raw.req)
    if not request:
        raise ValueError("the request is empty")
    reply = None if raw.rep is None else bytes.fromhex(raw.rep)
    return RecordedExchange(raw.t, raw.unit, request, reply, raw.lat, raw.err)


def _read_row(line: bytes, width: int) -> SignalRow:
    """Return the row of one line of a signals recording. Raises ValueError."""
    raw = _row_decoder.decode(line)
    if len(raw) != width + 1:
        raise ValueError(f"expected a time and {width} values, got {len(raw)} numbers")
    t = raw[0]
    if t is None:
        raise ValueError("the row has no time")
    return SignalRow(t, tuple(math.nan if v is None else v for v in raw[1:]))
