"""Write captures as pcap files, so that other tools (tshark, Wireshark) can read them.

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
from functools import lru_cache
from pathlib import Path
from typing import Any

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
_CLIENT, _SERVER = bytes((192, 0, 2, 1)), bytes((192, 0, 2, 2))  # TEST-NET-1 (RFC 5737): reserved for examples
_MACS = {_CLIENT: bytes((2, 0, 0, 0, 0, 1)), _SERVER: bytes((2, 0, 0, 0, 0, 2))}
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


@lru_cache(maxsize=KEPT_ENDPOINTS)
def _endpoint(text: str) -> Endpoint:
    """Parse an endpoint. Results are cached, because the lines of a capture repeat a few endpoints."""
    return Endpoint.parse(text)


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet of a pcap file: its time in nanoseconds, and its bytes from the link layer on."""

    t_ns: int
    data: bytes


def link_type(endpoint: Endpoint) -> int:
    """Return the link type of the file for a capture of `endpoint`."""
    if endpoint.is_can:
        return LINKTYPE_CAN_SOCKETCAN
    return LINKTYPE_ETHERNET if endpoint.scheme == "tcp" else LINKTYPE_USER0


def packets(captured: Iterable[Captured], endpoint: Endpoint) -> Iterator[Packet]:
    """Yield the packets of one endpoint's conversation, in order.

    ``tcp``: one connection to port 502, handshake included. If the capture spans several connections, their packets are written
    as one connection. ``rtu``, ``rtu+tcp``: a packet for each request, and one for all bytes until the next request. ``can``: a
    packet for each frame.
    """
    seen = (c for c in captured if c.endpoint == endpoint)
    if endpoint.is_can:
        return (Packet(c.t_ns, socketcan(c.item)) for c in seen if isinstance(c.item, CanFrame))
    chunks = ((c.t_ns, c.direction, c.item) for c in seen if isinstance(c.item, bytes))
    return _tcp_packets(chunks) if endpoint.scheme == "tcp" else _turns(chunks)


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

Chunk = tuple[int, Direction, bytes]


def _turns(chunks: Iterable[Chunk]) -> Iterator[Packet]:
    """Yield one packet for each sent chunk of a serial line, and one for all bytes received before the next sent chunk."""
    reply, reply_ns = b"", 0
    for t_ns, direction, data in chunks:
        if direction is Direction.RECEIVED:
            reply_ns = reply_ns if reply else t_ns
            reply += data
            continue
        if reply:
            yield Packet(reply_ns, reply)
            reply = b""
        yield Packet(t_ns, data)
    if reply:
        yield Packet(reply_ns, reply)


# -- TCP ----------------------------------------------------------------------------------------------------------------


def _tcp_packets(chunks: Iterable[Chunk]) -> Iterator[Packet]:
    """Yield the chunks as segments of one connection that the gateway opened just before the first of them."""
    sequence = {_CLIENT: 1000, _SERVER: 2000}

    def segment(t_ns: int, source: bytes, flags: int, data: bytes = b"") -> Packet:
        target = _SERVER if source == _CLIENT else _CLIENT
        acknowledged = sequence[target] if flags & _ACK else 0
        packet = Packet(
            t_ns, _ethernet(source, target, _tcp(source, target, sequence[source], acknowledged, flags, data))
        )
        sequence[source] += len(data) + bool(flags & _SYN)
        return packet

    opened = False
    for t_ns, direction, data in chunks:
        if not opened:
            yield segment(t_ns - 3, _CLIENT, _SYN)
            yield segment(t_ns - 2, _SERVER, _SYN | _ACK)
            yield segment(t_ns - 1, _CLIENT, _ACK)
            opened = True
        source = _CLIENT if direction is Direction.SENT else _SERVER
        for at in range(0, len(data), MAX_SEGMENT):
            yield segment(t_ns, source, _PSH | _ACK, data[at : at + MAX_SEGMENT])


def _tcp(source: bytes, target: bytes, sequence: int, acknowledged: int, flags: int, data: bytes) -> bytes:
    ports = (CLIENT_PORT, MODBUS_PORT) if source == _CLIENT else (MODBUS_PORT, CLIENT_PORT)
    words = (*ports, sequence & 0xFFFFFFFF, acknowledged & 0xFFFFFFFF, 5 << 4, flags, 0xFFFF)
    bare = struct.pack(">HHIIBBHHH", *words, 0, 0) + data
    pseudo = source + target + struct.pack(">BBH", 0, 6, len(bare))
    return struct.pack(">HHIIBBHHH", *words, internet_checksum(pseudo + bare), 0) + data


def _ethernet(source: bytes, target: bytes, tcp: bytes) -> bytes:
    head = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(tcp), 0, 0x4000, 64, 6, 0, source, target)
    head = head[:10] + internet_checksum(head).to_bytes(2) + head[12:]
    return _MACS[target] + _MACS[source] + b"\x08\x00" + head + tcp


def internet_checksum(data: bytes) -> int:
    """Return the one's complement of the one's complement sum of 16-bit words (RFC 1071)."""
    padded = data + b"\0" * (len(data) % 2)
    total: int = sum(struct.unpack(f">{len(padded) // 2}H", padded))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF
