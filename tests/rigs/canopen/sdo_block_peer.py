"""An SDO server for tests of the client: segmented and block transfers in both directions, pure, with optional omissions.

It is written from the standard for these tests alone. With `early`, it acknowledges at once when it detects a gap.
"""

from __future__ import annotations

from binascii import crc_hqx
from collections.abc import Iterator

Frames = list[bytes]


class BlockServer:
    """`feed` takes a request and returns the replies. `written` holds what downloads have stored."""

    def __init__(
        self, objects: dict[bytes, bytes], *, block: int = 5, crc: bool = True, sized: bool = True, early: bool = False
    ) -> None:
        self.objects = objects
        self.written: dict[bytes, bytes] = {}
        self.block, self.crc, self.sized, self.early = block, crc, sized, early
        self.state = "idle"
        self.mux = b""
        self.data = b""
        self.at = self.sent = self.asked = self.expected = self.size = 0
        self.buffer = bytearray()
        self.pieces: Iterator[bytes] = iter(())

    def feed(self, request: bytes) -> Frames:
        if self.state == "down" and request[0] != 0x80:
            return self.segment(request)
        if request[0] == 0x80:
            self.state = "idle"
            return []
        if request[0] == 0x40:
            return self.plain(request[1:4])
        if request[0] & 0xE3 == 0xA0:
            return self.begin_upload(request)
        if request[0] & 0xE1 == 0xC0:
            return self.begin_download(request)
        handler = {"start": self.start, "up": self.acknowledged, "end-up": self.ended, "end-down": self.finish}
        return handler[self.state](request) if self.state in handler else self.abort(0x0504_0001)

    def abort(self, code: int) -> Frames:
        self.state = "idle"
        return [b"\x80" + self.mux.ljust(3, b"\0") + code.to_bytes(4, "little")]

    def plain(self, mux: bytes) -> Frames:
        """Expedited only: the objects read by probes."""
        self.state, self.mux = "idle", mux
        value = self.objects.get(mux)
        if value is None or not 1 <= len(value) <= 4:
            return self.abort(0x0602_0000)
        return [bytes([0x43 | (4 - len(value)) << 2]) + mux + value.ljust(4, b"\0")]

    # -- upload -------------------------------------------------------------------------------------------------------

    def begin_upload(self, request: bytes) -> Frames:
        self.mux = request[1:4]
        if self.mux not in self.objects:
            return self.abort(0x0602_0000)
        self.data, self.at, self.asked, self.state = self.objects[self.mux], 0, request[4], "start"
        size = len(self.data).to_bytes(4, "little") if self.sized else bytes(4)
        return [bytes([0xC0 | self.crc << 2 | self.sized << 1]) + self.mux + size]

    def start(self, request: bytes) -> Frames:
        return self.send_block() if request[0] == 0xA3 else self.abort(0x0504_0001)

    def send_block(self) -> Frames:
        self.state, frames = "up", []
        total = max(1, -(-len(self.data) // 7))
        for number in range(1, self.asked + 1):
            at = self.at + number - 1
            last = at + 1 == total
            frames.append(bytes([number | last << 7]) + self.data[at * 7 : at * 7 + 7].ljust(7, b"\0"))
            if last:
                break
        self.sent = len(frames)
        return frames

    def acknowledged(self, request: bytes) -> Frames:
        if request[0] != 0xA2:
            return self.abort(0x0504_0001)
        if request[1] > self.sent:
            return self.abort(0x0504_0003)
        self.at += request[1]
        self.asked = request[2]
        total = max(1, -(-len(self.data) // 7))
        if self.at < total:
            return self.send_block()
        self.state = "end-up"
        crc = crc_hqx(self.data, 0) if self.crc else 0
        return [bytes([0xC1 | (total * 7 - len(self.data)) << 2]) + crc.to_bytes(2, "little") + bytes(5)]

    def ended(self, request: bytes) -> Frames:
        self.state = "idle"
        return [] if request[0] == 0xA1 else self.abort(0x0504_0001)

    # -- download -----------------------------------------------------------------------------------------------------

    def begin_download(self, request: bytes) -> Frames:
        self.mux, self.size, self.state = request[1:4], int.from_bytes(request[4:8], "little"), "down"
        self.buffer, self.expected = bytearray(), 1
        return [bytes([0xA0 | self.crc << 2]) + self.mux + bytes([self.block]) + bytes(3)]

    def segment(self, request: bytes) -> Frames:
        number, last = request[0] & 0x7F, request[0] & 0x80
        if number == self.expected:
            self.buffer += request[1:]
            self.expected += 1
            if last:
                self.state = "end-down"
                return [self.acknowledge()]
        elif number > self.expected and self.early:
            return [self.acknowledge()]
        return [self.acknowledge()] if number == self.block or last else []

    def acknowledge(self) -> bytes:
        good, self.expected = self.expected - 1, 1
        return bytes([0xA2, good, self.block]) + bytes(5)

    def finish(self, request: bytes) -> Frames:
        if request[0] & 0xE3 != 0xC1:
            return self.abort(0x0504_0001)
        value = bytes(self.buffer[: len(self.buffer) - (request[0] >> 2 & 7)])
        if len(value) != self.size:
            return self.abort(0x0607_0010)
        if self.crc and crc_hqx(value, 0) != int.from_bytes(request[1:3], "little"):
            return self.abort(0x0504_0004)
        self.state = "idle"
        self.written[self.mux] = value
        return [b"\xa1" + bytes(7)]
