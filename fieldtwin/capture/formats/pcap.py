"""Write captures as pcap files, so that other tools (tshark, Wireshark) can read them; `pcapng` writes the same packets.

A capture contains chunks and frames, not packets. This module creates the missing layers around them, so that a dissector
finds what it expects: Ethernet, IP and TCP with correct check sums and sequence numbers around Modbus/TCP, nothing at all
around Modbus RTU (DLT_USER0, to be decoded as ``mbrtu``), a SocketCAN header around CAN frames. No byte of the protocols
themselves is made, changed or interpreted here: this module must never depend on Modbus or CANopen.

Sources: the pcap file format and its link types (https://www.tcpdump.org/linktypes.html), RFC 791, RFC 9293.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from fieldtwin.gateway.connections.tap import Captured
from fieldtwin.gateway.core.canframe import CanFrame, parse_frame
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid
from fieldtwin.gateway.core.files.input_file import open_input

LINKTYPE_ETHERNET = 1
LINKTYPE_USER0 = 147
LINKTYPE_CAN_SOCKETCAN = 227

MAGIC_NS = 0xA1B23C4D
"""The magic number of a pcap file with times in nanoseconds and numbers in big-endian byte order."""
SNAPLEN = 65_535

MODBUS_PORT = 502
CLIENT_PORT = 50_200
MAX_SEGMENT = 1460
MAX_SERVERS = 64
"""Maximum number of conversations in one file. Each server has an address of TEST-NET-1 (192.0.2.0/24, RFC 5737)."""
_NETWORK = bytes((192, 0, 2))  # TEST-NET-1: reserved for examples
_CLIENT = 1
_SYN, _ACK, _PSH = 0x02, 0x10, 0x08


KEPT_ENDPOINTS = 1_024
MAX_LINE_BYTES = 1 << 20
"""Maximum length in bytes of a line of a capture; longer lines are refused. The longest real chunk is a fraction of it."""


def read_capture(path: Path, refusals: list[dict[str, Any]] | None = None) -> Iterator[Captured]:
    """Yield the content of a capture written by `TapFile`, in order, a line at a time. A truncated last line is omitted.

    Writes that did not reach their device are not traffic: they are appended to `refusals`. Raises `FileInvalid` when the file
    cannot be read, and with the line number for any other invalid line.
    """
    try:
        with open_input(path) as file:
            number = 0
            while line := file.readline(MAX_LINE_BYTES):
                number += 1
                try:
                    read = json.loads(line)
                    if "started" in read:
                        continue  # the header of a session in a `FrameLog`
                    if "refused" in read:
                        if refusals is not None:
                            refusals.append(dict(read["refused"]))
                        continue
                    captured = captured_of(read)
                except (ValueError, KeyError, TypeError, FieldtwinError) as e:
                    if not line.endswith(b"\n") and not file.read(1):
                        return
                    raise FileInvalid(
                        f"not a line of a capture: {e}",
                        path=str(path),
                        line=number,
                        expected="t_ns, endpoint, direction, hex",
                    ) from e
                yield captured
    except OSError as e:
        raise FileInvalid(f"cannot read the capture: {e.strerror or e}", path=str(path)) from e


def captured_of(line: dict[str, object]) -> Captured:
    item: bytes | CanFrame = bytes.fromhex(str(line["hex"]))
    if "frame" in line:
        item = parse_frame(str(line["frame"]), error=bool(line.get("error")))
    t_ns = line["t_ns"]
    if not isinstance(t_ns, int):
        raise ValueError(f"t_ns is {t_ns!r}")
    return Captured(t_ns, _endpoint(str(line["endpoint"])), Direction(line["direction"]), item)


def utc_offset_ns(path: Path) -> int:
    """Return the nanoseconds from the monotonic times of a capture to UTC, 0 if its first line does not state them.

    Such a line has the time of its writing twice: ``started`` (ISO 8601) and ``t_ns`` (monotonic).
    """
    try:
        with open_input(path) as file:
            head = json.loads(file.readline(MAX_LINE_BYTES))
        return utc_ns(str(head["started"])) - int(head["t_ns"])
    except OSError as e:
        raise FileInvalid(f"cannot read the capture: {e.strerror or e}", path=str(path)) from e
    except (ValueError, KeyError, TypeError, OverflowError):
        return 0


def utc_ns(text: str) -> int:
    """Return an ISO 8601 time as nanoseconds since 1970. Raises `ValueError` or `OverflowError`."""
    return round(datetime.fromisoformat(text).timestamp() * NS_PER_S)


@lru_cache(maxsize=KEPT_ENDPOINTS)
def _endpoint(text: str) -> Endpoint:
    """Parse an endpoint. Results are cached, because the lines of a capture repeat a few endpoints."""
    return Endpoint.parse(text)


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet of a file: its time in nanoseconds, and its bytes from the link layer on.

    `direction` is that of the gateway, None if it is not known. `comment` explains the packet in words; only pcapng stores both.
    """

    t_ns: int
    data: bytes
    direction: Direction | None = None
    comment: str = ""


def link_type(endpoint: Endpoint) -> int:
    """Return the link type of the file for a capture of `endpoint`."""
    if endpoint.is_can:
        return LINKTYPE_CAN_SOCKETCAN
    return LINKTYPE_ETHERNET if endpoint.scheme == "tcp" else LINKTYPE_USER0


def packets(captured: Iterable[Captured], endpoint: Endpoint, *, server: int = 0) -> Iterator[Packet]:
    """Yield the packets of one endpoint's conversation, in order.

    ``tcp``: one connection to port 502, handshake included. If the capture spans several connections, their packets are written
    as one connection. `server` (0 to `MAX_SERVERS` - 1) distinguishes the servers of one file by their addresses. ``rtu``,
    ``rtu+tcp``: a packet for each request, and one for all bytes until the next request. ``can``: a packet for each frame.
    """
    return commented_packets(((c, "") for c in captured), endpoint, server=server)


def commented_packets(
    captured: Iterable[tuple[Captured, str]], endpoint: Endpoint, *, server: int = 0
) -> Iterator[Packet]:
    """Yield the packets of one endpoint's conversation, as `packets`, from chunks and frames with their comments."""
    seen = ((c, comment) for c, comment in captured if c.endpoint == endpoint)
    if endpoint.is_can:
        return (
            Packet(c.t_ns, socketcan(c.item), c.direction, comment)
            for c, comment in seen
            if isinstance(c.item, CanFrame)
        )
    chunks = (Chunk(c.t_ns, c.direction, c.item, comment) for c, comment in seen if isinstance(c.item, bytes))
    return _tcp_packets(chunks, server) if endpoint.scheme == "tcp" else _turns(chunks)


def write_pcap(path: Path, captured: Iterable[Captured], endpoint: Endpoint, utc_offset_ns: int = 0) -> int:
    """Write one endpoint's conversation as a pcap file; return the number of packets.

    `utc_offset_ns` is added to the monotonic times of the capture to convert them to UTC. Raises `FileInvalid` if the file cannot
    be written.
    """
    count = 0
    try:
        with path.open("wb") as file:
            file.write(struct.pack(">IHHiIII", MAGIC_NS, 2, 4, 0, 0, SNAPLEN, link_type(endpoint)))
            for packet in packets(captured, endpoint):
                seconds, ns = divmod(packet.t_ns + utc_offset_ns, NS_PER_S)
                size = len(packet.data)
                file.write(struct.pack(">IIII", seconds & 0xFFFFFFFF, ns, size, size) + packet.data)
                count += 1
    except OSError as e:
        raise FileInvalid(f"cannot write the pcap file: {e.strerror or e}", path=str(path)) from e
    return count


# -- CAN ----------------------------------------------------------------------------------------------------------------


def socketcan(frame: CanFrame) -> bytes:
    """Return a frame as LINKTYPE_CAN_SOCKETCAN: identifier and flags, length, three spare bytes, data."""
    flags = frame.extended << 31 | frame.remote << 30 | frame.error << 29
    return struct.pack(">IBxxx", frame.can_id | flags, frame.dlc) + frame.data


# -- serial line --------------------------------------------------------------------------------------------------------


class Chunk(NamedTuple):
    """Bytes of a stream as the medium delivered them, with their comment."""

    t_ns: int
    direction: Direction
    data: bytes
    comment: str


def _turns(chunks: Iterable[Chunk]) -> Iterator[Packet]:
    """Yield one packet for each sent chunk of a serial line, and one for all bytes received before the next sent chunk."""
    reply = list[Chunk]()

    def received() -> Packet:
        comment = "; ".join(c.comment for c in reply if c.comment)
        return Packet(reply[0].t_ns, b"".join(c.data for c in reply), Direction.RECEIVED, comment)

    for chunk in chunks:
        if chunk.direction is Direction.RECEIVED:
            reply.append(chunk)
            continue
        if reply:
            yield received()
            reply.clear()
        yield Packet(chunk.t_ns, chunk.data, Direction.SENT, chunk.comment)
    if reply:
        yield received()


# -- TCP ----------------------------------------------------------------------------------------------------------------


def _tcp_packets(chunks: Iterable[Chunk], server: int) -> Iterator[Packet]:
    """Yield the chunks as segments of one connection that the gateway opened just before the first of them."""
    hosts = {Direction.SENT: _CLIENT, Direction.RECEIVED: _CLIENT + 1 + server}
    ports = {Direction.SENT: CLIENT_PORT + server, Direction.RECEIVED: MODBUS_PORT}
    sequence = {Direction.SENT: 1000, Direction.RECEIVED: 2000}

    def segment(t_ns: int, direction: Direction, flags: int, data: bytes = b"", comment: str = "") -> Packet:
        other = Direction.RECEIVED if direction is Direction.SENT else Direction.SENT
        acknowledged = sequence[other] if flags & _ACK else 0
        words = (ports[direction], ports[other], sequence[direction], acknowledged)
        packet = _ethernet(hosts[direction], hosts[other], words, flags, data)
        sequence[direction] = (sequence[direction] + len(data) + bool(flags & _SYN)) & 0xFFFFFFFF
        return Packet(t_ns, packet, direction, comment)

    opened = False
    for chunk in chunks:
        if not opened:
            yield segment(chunk.t_ns - 3, Direction.SENT, _SYN)
            yield segment(chunk.t_ns - 2, Direction.RECEIVED, _SYN | _ACK)
            yield segment(chunk.t_ns - 1, Direction.SENT, _ACK)
            opened = True
        for at in range(0, len(chunk.data), MAX_SEGMENT):
            piece = chunk.data[at : at + MAX_SEGMENT]
            yield segment(chunk.t_ns, chunk.direction, _PSH | _ACK, piece, "" if at else chunk.comment)


def _ethernet(source: int, target: int, words: tuple[int, int, int, int], flags: int, data: bytes) -> bytes:
    """Return an Ethernet frame with a TCP segment. `source` and `target` are the last bytes of the addresses, `words` the ports,
    the sequence number and the acknowledged number.
    """
    here, there = _NETWORK + bytes((source,)), _NETWORK + bytes((target,))
    tcp = _tcp(here, there, words, flags, data)
    head = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(tcp), 0, 0x4000, 64, 6, 0, here, there)
    head = head[:10] + internet_checksum(head).to_bytes(2) + head[12:]
    return bytes((2, 0, 0, 0, 0, target, 2, 0, 0, 0, 0, source)) + b"\x08\x00" + head + tcp


def _tcp(here: bytes, there: bytes, words: tuple[int, int, int, int], flags: int, data: bytes) -> bytes:
    fields = (*words, 5 << 4, flags, 0xFFFF)
    bare = struct.pack(">HHIIBBHHH", *fields, 0, 0) + data
    pseudo = here + there + struct.pack(">BBH", 0, 6, len(bare))
    return struct.pack(">HHIIBBHHH", *fields, internet_checksum(pseudo + bare), 0) + data


def internet_checksum(data: bytes) -> int:
    """Return the one's complement of the one's complement sum of 16-bit words (RFC 1071)."""
    padded = data + b"\0" * (len(data) % 2)
    total: int = sum(struct.unpack(f">{len(padded) // 2}H", padded))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF
