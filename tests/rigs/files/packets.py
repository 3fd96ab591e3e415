"""Packets for captures in tests, built byte by byte, independent of the code that reads them."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path

SYN, ACK, RST, PSH = 0x02, 0x10, 0x04, 0x08
CLIENT, SERVER = bytes((10, 0, 0, 1)), bytes((10, 0, 0, 2))


def tcp(
    source: bytes,
    target: bytes,
    ports: tuple[int, int],
    sequence: int,
    data: bytes = b"",
    flags: int = ACK,
    ack: int = 0,
) -> bytes:
    """An IPv4 packet with a TCP segment, after an Ethernet header, padded as short frames are."""
    ip = struct.pack(">BBHHHBBH", 0x45, 0, 40 + len(data), 0, 0x4000, 64, 6, 0) + source + target
    head = struct.pack(">HHIIBBHHH", *ports, sequence % 2**32, ack % 2**32, 0x50, flags, 0xFFFF, 0, 0)
    return (bytes(12) + b"\x08\x00" + ip + head + data).ljust(60, b"\0")


def udp6(hosts: tuple[int, int], ports: tuple[int, int], data: bytes) -> bytes:
    """An IPv6 packet with a datagram, after an Ethernet header with a VLAN tag."""
    body = struct.pack(">HHHH", *ports, 8 + len(data), 0) + data
    ip = struct.pack(">IHBB", 6 << 28, len(body), 17, 64) + bytes((*bytes(15), hosts[0], *bytes(15), hosts[1]))
    return bytes(12) + b"\x81\x00\x00\x05\x86\xdd" + ip + body


def pcap(packets: Iterable[bytes], link: int = 1, *, magic: bytes = b"\xd4\xc3\xb2\xa1") -> bytes:
    """A pcap file; packets are 1 ms apart."""
    order = "<" if magic[0] in (0xD4, 0x4D) else ">"
    tick = 1000 if magic in (b"\xd4\xc3\xb2\xa1", b"\xa1\xb2\xc3\xd4") else 1
    out = magic + struct.pack(f"{order}HHiIII", 2, 4, 0, 0, 65535, link)
    for i, data in enumerate(packets):
        out += struct.pack(f"{order}IIII", 1_700_000_000, i * 1_000_000 // tick, len(data), len(data)) + data
    return out


def pcapng(packets: Iterable[bytes], link: int = 1, order: str = "<") -> bytes:
    """A pcapng file with nanosecond time stamps, an unknown block and options in it."""

    def block(kind: int, body: bytes) -> bytes:
        size = 12 + len(body)
        return struct.pack(f"{order}II", kind, size) + body + struct.pack(f"{order}I", size)

    out = block(0x0A0D0D0A, struct.pack(f"{order}IHHq", 0x1A2B3C4D, 1, 0, -1))
    options = struct.pack(f"{order}HHB3xHH", 9, 1, 9, 0, 0)
    out += block(1, struct.pack(f"{order}HHI", link, 0, 0) + options) + block(0xBAD, b"skip")
    for i, data in enumerate(packets):
        t_ns = 1_700_000_000 * 10**9 + i * 1_000_000
        body = struct.pack(f"{order}IIIII", 0, t_ns >> 32, t_ns & 0xFFFFFFFF, len(data), len(data))
        out += block(6, body + data + bytes(-len(data) % 4))
    return out


def mbap(transaction: int, unit: int, pdu: bytes) -> bytes:
    """A Modbus TCP frame."""
    return struct.pack(">HHHB", transaction, 0, len(pdu) + 1, unit) + pdu


def read(address: int, count: int = 1, function: int = 3) -> bytes:
    """A request PDU."""
    return struct.pack(">BHH", function, address, count)


def values(*words: int, function: int = 3) -> bytes:
    """The reply PDU to a read."""
    return struct.pack(f">BB{len(words)}H", function, 2 * len(words), *words)


class Talk:
    """One TCP connection as packets, opened with a handshake."""

    def __init__(
        self, port: int = 502, client_port: int = 50_000, server: bytes = SERVER, *, opened: bool = True
    ) -> None:
        self._server, self._ports = server, (client_port, port)
        self._next = {True: 1000, False: 2**32 - 5}  # the server's number wraps around soon
        self.packets: list[bytes] = []
        if opened:
            self.packets += [self._segment(True, b"", SYN), self._segment(False, b"", SYN | ACK)]
        for side in (True, False):
            self._next[side] += 1

    def say(self, sent: bool, data: bytes) -> None:
        self.packets.append(self._segment(sent, data, ACK | PSH))
        self._next[sent] += len(data)

    def lose(self, sent: bool, size: int) -> None:
        """Omit bytes from the capture."""
        self._next[sent] += size

    def acknowledge(self, sent: bool) -> None:
        self.packets.append(self._segment(sent, b"", ACK))

    def _segment(self, sent: bool, data: bytes, flags: int) -> bytes:
        one, other = (CLIENT, self._server) if sent else (self._server, CLIENT)
        ports = self._ports if sent else (self._ports[1], self._ports[0])
        return tcp(one, other, ports, self._next[sent], data, flags, self._next[not sent])


def write(path: Path, data: bytes) -> Path:
    """Return a file with these bytes."""
    path.write_bytes(data)
    return path


def crc(data: bytes) -> bytes:
    """SL 6.2.2, bit by bit."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0xA001 if value & 1 else 0)
    return data + struct.pack("<H", value)
