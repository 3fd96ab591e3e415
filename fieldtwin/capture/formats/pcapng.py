"""Write captures as pcapng files: the packets of several interfaces in one file, with names, descriptions and comments.

The packets are those of `fieldtwin.capture.formats.pcap`. The file has one section in little-endian byte order, and times in
nanoseconds. `fieldtwin.capture.formats.packet_file` reads such files.

Source: draft-ietf-opsawg-pcapng, sections 3.5 (options), 4.1 (section header), 4.2 (interface description), 4.3 (enhanced
packet).
"""

from __future__ import annotations

import heapq
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from fieldtwin.__about__ import __version__
from fieldtwin.capture.formats.pcap import MAX_SERVERS, SNAPLEN, Packet
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FileInvalid, UsageError

MAX_TEXT = 4_096
"""Maximum number of bytes of a name, a description or a comment; longer texts are cut at a character."""

_SECTION, _INTERFACE, _ENHANCED = 0x0A0D0D0A, 1, 6
_COMMENT, _APPLICATION, _NAME, _DESCRIPTION, _FLAGS, _TSRESOL = 1, 4, 2, 3, 2, 9
_NANOSECONDS = b"\x09"
_DIRECTIONS = {Direction.RECEIVED: 1, Direction.SENT: 2, None: 0}


@dataclass(frozen=True, slots=True)
class Wire:
    """An interface of a file: its link type, its name and description, and its packets in order."""

    link: int
    name: str
    description: str
    packets: Iterable[Packet]


def write_pcapng(path: Path, wires: Sequence[Wire], *, comment: str = "", utc_offset_ns: int = 0) -> int:
    """Write the packets of all wires, ordered by time; return their number.

    `comment` describes the whole file. `utc_offset_ns` is added to the times of the packets to convert them to UTC; a time before
    1970 becomes 0. Raises `FileInvalid` if the file cannot be written, and `UsageError` for more than `MAX_SERVERS` wires, each
    of which usually reads its source separately.
    """
    if len(wires) > MAX_SERVERS:
        raise UsageError("too many interfaces for one pcapng file", expected=str(MAX_SERVERS), got=str(len(wires)))
    count = 0
    try:
        with path.open("wb") as file:
            file.write(_section(comment))
            for wire in wires:
                file.write(_interface(wire))
            for number, packet in heapq.merge(*map(_numbered, range(len(wires)), wires), key=_time):
                file.write(_packet(number, packet, max(0, packet.t_ns + utc_offset_ns)))
                count += 1
    except OSError as e:
        raise FileInvalid(f"cannot write the pcapng file: {e.strerror or e}", path=str(path)) from e
    return count


def interface_names(endpoints: Sequence[Endpoint]) -> list[str]:
    """Return a short, unique name for each endpoint: the name of a serial port or CAN interface, or HOST-PORT."""
    names: list[str] = []
    for endpoint in endpoints:
        plain = endpoint.path.rpartition("/")[2].replace(":", "_") or f"{endpoint.host}-{endpoint.port}"
        name, number = plain, 2
        while name in names:
            name, number = f"{plain}-{number}", number + 1
        names.append(name)
    return names


def _numbered(number: int, wire: Wire) -> Iterator[tuple[int, Packet]]:
    for packet in wire.packets:
        yield number, packet


def _time(numbered: tuple[int, Packet]) -> int:
    return numbered[1].t_ns


def _section(comment: str) -> bytes:
    options = _text(_COMMENT, comment) + _text(_APPLICATION, f"fieldtwin {__version__}")
    return _block(_SECTION, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1), options)


def _interface(wire: Wire) -> bytes:
    options = _text(_NAME, wire.name) + _text(_DESCRIPTION, wire.description) + _option(_TSRESOL, _NANOSECONDS)
    return _block(_INTERFACE, struct.pack("<HHI", wire.link, 0, SNAPLEN), options)


def _packet(number: int, packet: Packet, t_ns: int) -> bytes:
    size = len(packet.data)
    body = struct.pack("<IIIII", number, t_ns >> 32 & 0xFFFFFFFF, t_ns & 0xFFFFFFFF, size, size)
    options = _text(_COMMENT, packet.comment)
    if flags := _DIRECTIONS[packet.direction]:
        options += _option(_FLAGS, struct.pack("<I", flags))
    return _block(_ENHANCED, body + packet.data + bytes(-size % 4), options)


def _block(kind: int, body: bytes, options: bytes) -> bytes:
    if options:
        options += bytes(4)  # opt_endofopt
    size = 12 + len(body) + len(options)
    return struct.pack("<II", kind, size) + body + options + struct.pack("<I", size)


def _text(code: int, text: str) -> bytes:
    """Return the option with that text, nothing for an empty text."""
    value = text.encode("utf-8", "replace")
    if len(value) > MAX_TEXT:
        value = value[:MAX_TEXT].decode("utf-8", "ignore").encode()
    return _option(code, value) if value else b""


def _option(code: int, value: bytes) -> bytes:
    return struct.pack("<HH", code, len(value)) + value + bytes(-len(value) % 4)
