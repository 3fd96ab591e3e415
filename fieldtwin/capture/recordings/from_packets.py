"""Convert a capture of third-party traffic into recordings: one for each Modbus server, a log of CAN, and draft profiles.

Memory is bounded by the number of open conversations. Malformed frames and stray replies are counted and written to a file
next to the recording (``.bad.jsonl``, which can be read as a capture).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from fieldtwin.capture.formats.packet_file import PacketFile
from fieldtwin.capture.formats.tcp_segments import Conversation, Conversations, PacketCounters, Side
from fieldtwin.capture.recordings.draft import Drafts
from fieldtwin.capture.recordings.importing import BadFile, write_drafts
from fieldtwin.capture.recordings.modbus_conversation import ModbusConversation
from fieldtwin.capture.recordings.pairing import Bad, HalfDuplexPairer, PairCounters, Pairer, SerialPairer
from fieldtwin.capture.recordings.rotating_file import RotatingFile
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid
from fieldtwin.gateway.core.files.candump import line_of
from fieldtwin.gateway.core.files.recording import RecordedExchange, RecordingHeader, encode_exchange, encode_header

LINK_CAN, LINK_USER0, LINK_RTAC = 227, 147, 250
MAX_SERVERS = 256
EVERY = 4096
"""Number of packets between two reports of progress."""
_UNFIT = re.compile(r"[^A-Za-z0-9_.+-]+")
"""Characters of an interface's name that do not appear in the name of a file or in the column of a CAN log."""
_EXTENDED, _REMOTE, _ERROR = 0x80000000, 0x40000000, 0x20000000

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Made:
    """A recording that the import has written, and the draft profiles for it."""

    path: Path
    endpoint: str
    exchanges: int
    units: tuple[int, ...] = ()
    profiles: tuple[Path, ...] = ()


@dataclass(slots=True)
class PacketSummary:
    """The result of the conversion of a capture."""

    packets: PacketCounters = field(default_factory=PacketCounters)
    pairs: PairCounters = field(default_factory=PairCounters)
    made: list[Made] = field(default_factory=list)
    can_frames: int = 0
    can_left_out: int = 0
    other_conversations: int = 0
    servers_left_out: int = 0
    cut_off_at: int | None = None
    """The offset of the truncated last packet, None if the capture is complete."""
    bad_file: Path | None = None
    seconds: float = 0.0


class _Server:
    """The recording of one server while the capture is imported."""

    def __init__(self, path: Path, endpoint: str, header: RecordingHeader) -> None:
        self.endpoint = endpoint
        self.file = RotatingFile(path, encode_header(header))
        self.drafts = Drafts()

    def add(self, exchanges: list[RecordedExchange]) -> None:
        for exchange in exchanges:
            self.file.line(exchange.t_s, encode_exchange(exchange))
            self.drafts.note(exchange)


class PacketImport:
    """Imports the capture `source` as the recording `out` (``.jsonl``; if there are several servers, ``NAME.HOST-PORT.jsonl``
    each). If `ports` are given, only conversations with these ports are treated as Modbus.
    """

    def __init__(self, source: Path, out: Path, ports: Collection[int] = ()) -> None:
        self._source, self._out, self._ports = source, out, ports
        self.summary = PacketSummary()
        self._zero_ns = -1
        self._last_ns = 0
        self._servers: dict[str, _Server] = {}
        self._lines: dict[str, Pairer] = {}
        self._can: RotatingFile | None = None
        self._bad = BadFile(out, "rtu:line")
        self._talks = Conversations(self._said, self._ended)

    def run(self, progress: Progress | None = None) -> PacketSummary:
        """Read the whole capture. Raises `FileInvalid` for a file that is not a capture, or if a recording exists already."""
        for path in (self._out, self._log_path):
            if path.exists():
                raise FileInvalid("the recording exists already", path=str(path), hint="choose another name with --out")
        size = self._source.stat().st_size if self._source.is_file() else 0
        try:
            with PacketFile(self._source) as source:
                for t_ns, link, data in source:
                    self._packet(t_ns, link, data, source.interface)
                    if progress is not None and source.packets % EVERY == 0:
                        progress(source.read_bytes, size)
                self.summary.cut_off_at = source.cut_off_at
            self._talks.finish()
            self._finish_lines()
        except FieldtwinError:
            for file in self._files:
                for path in file.parts:
                    path.unlink(missing_ok=True)
            self._bad.discard()
            raise
        finally:
            for file in self._files:
                file.close()
            self._bad.__exit__()
        return self._finish()

    @property
    def _files(self) -> list[RotatingFile]:
        """Return the files written so far."""
        return [s.file for s in self._servers.values()] + ([self._can] if self._can else [])

    @property
    def _log_path(self) -> Path:
        return self._out.with_suffix(".log")

    def _packet(self, t_ns: int, link: int, data: bytes, interface: str) -> None:
        if self._zero_ns < 0:
            self._zero_ns = t_ns
        self._last_ns = max(t_ns, self._last_ns)
        if link == LINK_CAN:
            self._can_frame(t_ns, data, interface)
        elif link in (LINK_USER0, LINK_RTAC):
            self._serial(t_ns, link, data, interface)
        else:
            self._talks.packet(t_ns, link, data)

    # -- Modbus in TCP and UDP ----------------------------------------------------------------------------------------

    def _said(self, conversation: Conversation, side: Side, data: bytes, t_ns: int, lost: int) -> None:
        talk = conversation.state
        if not isinstance(talk, ModbusConversation):
            talk = conversation.state = self._talk(conversation)
        self._add(talk, talk.feed(side, data, t_ns, lost))

    def _talk(self, conversation: Conversation) -> ModbusConversation:
        def keep(bad: Bad) -> None:
            self._bad.keep(bad, talk.endpoint)

        talk = ModbusConversation(conversation, self._zero_ns, self._ports, keep)
        return talk

    def _ended(self, conversation: Conversation) -> None:
        talk = conversation.state
        if not isinstance(talk, ModbusConversation):
            return
        self._add(talk, talk.finish())
        if talk.pairer is None:
            self.summary.other_conversations += 1
        else:
            self.summary.pairs.add(talk.pairer.counters)

    def _add(self, talk: ModbusConversation, exchanges: list[RecordedExchange]) -> None:
        if exchanges and talk.server is not None:
            self._of(talk.endpoint, exchanges)

    def _of(self, endpoint: str, exchanges: list[RecordedExchange], interface: str = "") -> None:
        """Add exchanges of a server, or of the serial line at `interface`, whose endpoint the capture does not state."""
        key = endpoint or interface
        server = self._servers.get(key)
        if server is None:
            if len(self._servers) >= MAX_SERVERS:
                self.summary.servers_left_out += 1
                return
            plain = endpoint.partition("://")[2].replace(":", "-").strip("[]").replace("]", "")
            plain = plain or _UNFIT.sub("-", interface) or "line"
            path = self._out.with_name(f"{self._out.stem}.{plain}{self._out.suffix}")
            while any(s.file.path == path for s in self._servers.values()):
                path = path.with_name(f"{path.stem}-2{path.suffix}")
            server = self._servers[key] = _Server(path, endpoint, self._header(endpoint))
        server.add(exchanges)

    def _header(self, endpoint: str) -> RecordingHeader:
        started = ""
        if self._zero_ns > NS_PER_S:
            with suppress(ValueError, OverflowError, OSError):  # a time that no calendar has
                started = datetime.fromtimestamp(self._zero_ns / NS_PER_S, UTC).isoformat(timespec="milliseconds")
        return RecordingHeader(
            version=1, device=f"imported/{self._out.stem}", kind="exchanges", source="imported", endpoint=endpoint,
            made_by=f"fieldtwin import {self._source.name}", start_utc=started,
        )  # fmt: skip

    # -- Modbus on a line ---------------------------------------------------------------------------------------------

    def _serial(self, t_ns: int, link: int, data: bytes, interface: str) -> None:
        """Handle serial bytes as line analysers write them: bare, or after the RTAC link header, which states the direction.

        Each interface is a separate line.
        """
        self.summary.packets.packets += 1
        sent = True
        if link == LINK_RTAC:
            if len(data) < 12:
                self.summary.packets.cut_short += 1
                return
            sent, data = data[8] in (1, 3), data[12:]
        if not data:
            return
        self.summary.packets.carried += 1
        line = self._lines.get(interface)
        if line is None:
            kind = SerialPairer if link == LINK_RTAC else HalfDuplexPairer
            line = kind("ascii" if data[:1] == b":" else "rtu", self._zero_ns, self._bad.keep)
            self._lines[interface] = line
        found = line.feed(sent, data, t_ns)
        if found:
            self._of("", found, interface)

    def _finish_lines(self) -> None:
        for interface, line in self._lines.items():
            if found := line.finish():
                self._of("", found, interface)
            self.summary.pairs.add(line.counters)

    # -- CAN ----------------------------------------------------------------------------------------------------------

    def _can_frame(self, t_ns: int, data: bytes, interface: str) -> None:
        self.summary.packets.packets += 1
        frame = socketcan_frame(data)
        if frame is None:
            self.summary.can_left_out += 1
            return
        if self._can is None:
            self._can = RotatingFile(self._log_path)
        self._can.line(t_ns / NS_PER_S, line_of(t_ns, frame, _UNFIT.sub("_", interface)[:64] or "can0"))
        self.summary.can_frames += 1

    # -- the end ------------------------------------------------------------------------------------------------------

    def _finish(self) -> PacketSummary:
        counters, there = self._talks.counters, self.summary.packets
        for name in PacketCounters.__dataclass_fields__:
            setattr(there, name, getattr(there, name) + getattr(counters, name))
        self.summary.bad_file = self._bad.path if self._bad.lines else None
        self.summary.seconds = max(self._last_ns - self._zero_ns, 0) / NS_PER_S
        for server in self._servers.values():
            if len(self._servers) == 1:
                server.file.parts = _renamed(server.file.parts, server.file.path, self._out)
            path = server.file.parts[0]
            profiles = write_drafts(server.drafts, path, self._source.name)
            units = tuple(sorted(server.drafts.units))
            self.summary.made.append(Made(path, server.endpoint, server.file.lines, units, tuple(profiles)))
        if self._can is not None:
            self.summary.made.append(Made(self._can.path, "can", self._can.lines))
        return self.summary


def socketcan_frame(data: bytes) -> CanFrame | None:
    """Return the classic CAN frame in a packet of link type 227; None for CAN FD and XL, and for truncated data."""
    if len(data) < 8 or data[4] > 8 or data[5] & 0x04 or len(data) < 8 + min(data[4], 8):
        remote = len(data) >= 8 and data[0] & 0x40 and data[4] <= 8
        if not remote:
            return None
    (word,) = struct.unpack(">I", data[:4])
    extended, remote, error = bool(word & _EXTENDED), bool(word & _REMOTE), bool(word & _ERROR)
    can_id = word & (0x1FFFFFFF if extended or error else 0x7FF)
    payload = b"" if remote else data[8 : 8 + data[4]]
    return CanFrame(can_id, payload, extended=extended and not error, remote=remote, error=error, dlc=data[4])


def _renamed(parts: list[Path], old: Path, new: Path) -> list[Path]:
    """Rename the parts of the only recording to the requested name, and return their new paths."""
    found = []
    for path in parts:
        target = path.with_name(new.stem + path.name.removeprefix(old.stem))
        found.append(path.rename(target))
    return found
