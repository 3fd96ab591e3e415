"""Read packets from pcap and pcapng files, in order: time, link type, and the bytes from the link layer on.

The module reads one packet at a time, so that a file of any size needs no more memory than its longest packet. If the last
packet of a file is truncated, the packets before it are read and `cut_off_at` is set; any other error is `FileInvalid` with
the offset. This module must not depend on the content of the packets.

The library python-pcapng (2.1.1, Apache-2.0) is not used: for 20,000 packets it takes 5.5 s, and this module 0.4 s.

Sources: draft-ietf-opsawg-pcap (pcap), draft-ietf-opsawg-pcapng (pcapng).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

from fieldtwin.capture.formats.packed import unpacked
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.input_file import open_input

MAX_PACKET = 262_144
"""The largest number of bytes of a packet: the largest snapshot length that libpcap allows."""
MAX_BLOCK = MAX_PACKET + 65_536
"""The largest number of bytes of a block that is read into memory."""
MAX_SKIPPED = 16 << 20
"""The largest number of bytes of a block that is skipped, for example TLS secrets: the largest block that Wireshark reads."""
MAX_INTERFACES = 1024
MAX_TIME_NS = 1 << 63

_CLASSIC = {
    b"\xa1\xb2\xc3\xd4": (">", 1000), b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\x3c\x4d": (">", 1), b"\x4d\x3c\xb2\xa1": ("<", 1),
}  # fmt: skip
_SECTION = b"\x0a\x0d\x0d\x0a"
_INTERFACE, _OBSOLETE, _SIMPLE, _ENHANCED = 1, 2, 3, 6
_READ = (_INTERFACE, _OBSOLETE, _SIMPLE, _ENHANCED)
_NAME, _TSRESOL, _TSOFFSET = 2, 9, 14
_PIECE = 65_536

Packet = tuple[int, int, bytes]
"""A packet of a file: (time in ns since 1970, 0 if the file has none; link type; bytes)."""


def is_packet_file(head: bytes) -> bool:
    """Return whether `PacketFile` can read a file that begins with these four bytes."""
    return head[:4] in _CLASSIC or head[:4] == _SECTION


@dataclass(frozen=True, slots=True)
class _Interface:
    """An interface of a pcapng file. `snapshot` is the largest number of bytes that it kept of a packet, 0 without a limit."""

    link: int
    snapshot: int
    name: str = ""
    ticks_per_s: int = 1_000_000
    offset_s: int = 0


class PacketFile:
    """A pcap or pcapng file (or either, gzipped). Use it as a context manager, and iterate once.

    `interface` is the name of the interface of the latest packet: its name in a pcapng file, ``if1`` for the second interface
    if it has no name, and "" for the first and in a pcap file. `cut_off_at` is the offset at which the truncated last packet or
    block begins, None if the file is complete.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.packets = 0
        self.cut_off_at: int | None = None
        self.position = 0
        self.interface = ""
        self._interfaces: list[_Interface] = []
        try:
            raw = open_input(path)
            self._raw = raw
            self._file: BinaryIO = unpacked(raw, path) or raw
        except OSError as e:
            raise FileInvalid(f"cannot read the capture: {e.strerror or e}", path=str(path)) from e

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._file.close()
        self._raw.close()

    @property
    def read_bytes(self) -> int:
        """Return the number of bytes read from the file, for a progress bar: packed bytes if it is packed."""
        return self._raw.tell()

    def __iter__(self) -> Iterator[Packet]:
        try:
            magic = self._file.read(4)
            self.position = 4
            if magic in _CLASSIC:
                return self._guarded(self._classic(*_CLASSIC[magic]))
            if magic == _SECTION:
                return self._guarded(self._pcapng())
        except (OSError, EOFError, zlib.error) as e:
            raise self._invalid(f"cannot be read: {e}") from e
        raise self._invalid("neither pcap nor pcapng", expected="a1b2c3d4, d4c3b2a1 or 0a0d0d0a", got=magic.hex(), at=0)

    def _guarded(self, packets: Iterator[Packet]) -> Iterator[Packet]:
        try:
            yield from packets
        except (OSError, EOFError, zlib.error) as e:  # gzip's errors for a truncated or damaged file
            raise self._invalid(f"cannot be read on: {e}") from e

    def _read(self, size: int) -> bytes:
        """Read `size` bytes; fewer at the end of the file."""
        data = self._file.read(size)
        self.position += len(data)
        return data

    def _invalid(self, message: str, *, expected: str = "", got: str = "", at: int = -1) -> FileInvalid:
        offset = self.position if at < 0 else at
        return FileInvalid(f"offset {offset}: {message}", path=str(self.path), expected=expected, got=got)

    # -- pcap ---------------------------------------------------------------------------------------------------------

    def _classic(self, order: str, tick_ns: int) -> Iterator[Packet]:
        head = self._read(20)
        if len(head) < 20:
            raise self._invalid("the file header is cut off", expected="24 bytes")
        major, _, _, _, _, link = struct.unpack(f"{order}HHiIII", head)
        if major != 2:
            raise self._invalid("a different version of the format", expected="2", got=str(major), at=4)
        link &= 0xFFFF  # the bits above show whether frames end with a check sum
        read, unpack = self._read, struct.Struct(f"{order}IIII").unpack
        while head := read(16):
            start = self.position - len(head)
            if len(head) < 16:
                self.cut_off_at = start
                return
            seconds, ticks, size, _ = unpack(head)
            if size > MAX_PACKET:
                raise self._invalid(
                    "a packet that is too long",
                    expected=f"at most {MAX_PACKET} bytes",
                    got=str(size),
                    at=self.position - 8,
                )
            data = read(size)
            if len(data) < size:
                self.cut_off_at = start
                return
            self.packets += 1
            yield seconds * NS_PER_S + ticks * tick_ns, link, data

    # -- pcapng -------------------------------------------------------------------------------------------------------

    def _pcapng(self) -> Iterator[Packet]:
        order, kind_bytes = "<", _SECTION
        while kind_bytes:
            start = self.position - len(kind_bytes)
            section = kind_bytes == _SECTION
            head = self._read(8 if section else 4)
            if len(kind_bytes) < 4 or len(head) < (8 if section else 4):
                return self._cut_off(start)
            if section:
                order = self._order(head[4:])
                self._interfaces.clear()
            (kind,), (size,) = struct.unpack(f"{order}I", kind_bytes), struct.unpack_from(f"{order}I", head)
            most = MAX_BLOCK if section or kind in _READ else MAX_SKIPPED
            if not (28 if section else 12) <= size <= most or size % 4:
                raise self._invalid(
                    "a block of impossible length", expected=f"12 to {most}, in fours", got=str(size), at=start
                )
            wanted = size - 8 - len(head)
            body = self._read(wanted) if section or kind in _READ else self._skip(wanted)
            end = self._read(4)
            if len(end) < 4:
                return self._cut_off(start)
            if struct.unpack(f"{order}I", end) != (size,):
                raise self._invalid(
                    "a block whose two lengths differ", expected=str(size), got=end.hex(), at=self.position - 4
                )
            if section:
                self._check_version(order, body, start)
            elif (packet := self._block(kind, order, body, start)) is not None:
                self.packets += 1
                yield packet
            kind_bytes = self._read(4)
        return None

    def _cut_off(self, start: int) -> None:
        """Note the truncated block that begins at `start`. Raises `FileInvalid` if it is the first block of the file."""
        if start == 0:
            raise self._invalid("the section header is cut off", expected="at least 28 bytes")
        self.cut_off_at = start

    def _skip(self, size: int) -> bytes:
        """Read `size` bytes in pieces, so that they need no memory, and return nothing."""
        while size > 0 and (piece := self._read(min(size, _PIECE))):
            size -= len(piece)
        return b""

    def _check_version(self, order: str, body: bytes, start: int) -> None:
        (major,) = struct.unpack_from(f"{order}H", body)
        if major != 1:
            raise self._invalid("a different version of the format", expected="1", got=str(major), at=start + 12)

    def _order(self, magic: bytes) -> str:
        if magic == b"\x1a\x2b\x3c\x4d":
            return ">"
        if magic == b"\x4d\x3c\x2b\x1a":
            return "<"
        raise self._invalid("no byte-order magic", expected="1a2b3c4d", got=magic.hex(), at=self.position - 4)

    def _block(self, kind: int, order: str, body: bytes, start: int) -> Packet | None:
        if kind == _INTERFACE:
            self._interface(order, body, start)
            return None
        if kind == _ENHANCED and len(body) >= 20:
            number, high, low, size, _ = struct.unpack_from(f"{order}IIIII", body)
            at = 20
        elif kind == _OBSOLETE and len(body) >= 20:
            number, _, high, low, size, _ = struct.unpack_from(f"{order}HHIIII", body)
            at = 20
        elif kind == _SIMPLE and len(body) >= 4:
            (size,) = struct.unpack_from(f"{order}I", body)
            number, high, low, at = 0, 0, 0, 4
        elif kind in (_ENHANCED, _OBSOLETE, _SIMPLE):
            raise self._invalid("a packet block that is too short", at=start)
        else:
            return None
        if number >= len(self._interfaces):
            raise self._invalid("a packet of an interface that was not described", got=str(number), at=start)
        interface = self._interfaces[number]
        if kind == _SIMPLE:
            size = min(size, interface.snapshot or size, len(body) - at)
        if size > len(body) - at:
            raise self._invalid("a packet longer than its block", got=f"{size} bytes", at=start)
        t_ns = 0  # a simple packet block has no time
        if kind != _SIMPLE:
            t_ns = (high << 32 | low) * NS_PER_S // interface.ticks_per_s + interface.offset_s * NS_PER_S
        if not 0 <= t_ns < MAX_TIME_NS:
            raise self._invalid("a packet with an impossible time", expected="1970 to 2262", got=f"{t_ns} ns", at=start)
        self.interface = interface.name or (f"if{number}" if number else "")
        return t_ns, interface.link, body[at : at + size]

    def _interface(self, order: str, body: bytes, start: int) -> None:
        if len(body) < 8 or len(self._interfaces) >= MAX_INTERFACES:
            raise self._invalid("an interface block that is too short, or one too many", at=start)
        link, _, snapshot = struct.unpack_from(f"{order}HHI", body)
        found, at = _Interface(link, snapshot), 8
        while at + 4 <= len(body):
            code, size = struct.unpack_from(f"{order}HH", body, at)
            value = body[at + 4 : at + 4 + size]
            if code == _NAME:
                found = replace(found, name=value.decode("utf-8", "replace").strip("\0 "))
            elif code == _TSRESOL and len(value) == 1:
                power = value[0] & 0x7F
                found = replace(found, ticks_per_s=1 << power if value[0] & 0x80 else 10**power)
            elif code == _TSOFFSET and len(value) == 8:
                found = replace(found, offset_s=struct.unpack(f"{order}q", value)[0])
            if code == 0:
                break
            at += 4 + size + -size % 4
        self._interfaces.append(found)
