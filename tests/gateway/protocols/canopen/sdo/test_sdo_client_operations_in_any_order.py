"""The SDO client with operations in any order: block and plain, read and written, cancelled, lost, late, aborted.

Every answer of the server is filled with the number of the request that it answers, so that a value older than its request, or
combined from two answers, is detected.
"""

from __future__ import annotations

import asyncio
import random

from canopen_master_bus import LoopClock, MemoryEnd, bus, running
from hypothesis import given, settings
from hypothesis import strategies as st
from modbus_virtual import run_virtually
from sdo_block_peer import BlockServer

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster

LENGTHS = {0: 4, 1: 12, 2: 84}
"""Subindex: bytes of the object. 4 are read expedited, 12 segmented or in one block, 84 in two."""


class NumberedServer(BlockServer):
    """Answer each read with repetitions of its request number; remember complete writes."""

    def __init__(self) -> None:
        super().__init__({}, block=5, crc=True, early=True)
        self.number = 0
        self.toggle = 0
        self.segments: list[bytes] = []

    def value(self, mux: bytes) -> bytes:
        self.number += 1
        return self.number.to_bytes(4, "little") * (LENGTHS.get(mux[2], 4) // 4)

    def feed(self, request: bytes) -> list[bytes]:
        if self.state != "down" and request[0] & 0xE3 == 0xA0:
            self.objects[request[1:4]] = self.value(request[1:4])
        if self.state == "segments" and request[0] & 0xE0 == 0x60:
            return self.next_segment()
        return super().feed(request)

    def plain(self, mux: bytes) -> list[bytes]:
        self.mux, value = mux, self.value(mux)
        if len(value) <= 4:
            self.state = "idle"
            return [b"\x43" + mux + value]
        self.state, self.toggle = "segments", 0
        self.segments = [value[i : i + 7] for i in range(0, len(value), 7)]
        return [b"\x41" + mux + len(value).to_bytes(4, "little")]

    def next_segment(self) -> list[bytes]:
        part = self.segments.pop(0)
        command = self.toggle << 4 | (7 - len(part)) << 1 | (not self.segments)
        self.toggle ^= 1
        if not self.segments:
            self.state = "idle"
        return [bytes([command]) + part.ljust(7, b"\0")]


class Wire:
    """Serve over a wire that loses frames and delays replies, in order."""

    def __init__(self, end: MemoryEnd, server: NumberedServer, seed: int, loss: float, delay_s: float) -> None:
        self.end, self.server, self.random = end, server, random.Random(seed)
        self.loss, self.delay_s, self.last_s = loss, delay_s, 0.0

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            request = (await self.end.recv()).data
            if self.random.random() < self.loss:
                continue
            for reply in self.server.feed(request):
                if self.random.random() >= self.loss:
                    self.last_s = max(self.last_s + 1e-6, loop.time() + self.random.random() ** 3 * self.delay_s)
                    loop.call_at(self.last_s, self.end.peer.feed, CanFrame(0x585, reply))


def operations(chance: random.Random) -> list[tuple[str, bool, int, float | None]]:
    """An operation: read or write, in blocks or not, subindex, and the time until it is cancelled (s, None: never)."""
    return [
        (
            chance.choice(["read", "read", "write"]),
            chance.random() < 0.5,
            chance.randrange(3),
            chance.choice([None, None, 0.01, 0.12]),
        )
        for _ in range(20)
    ]


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**64))
def test_never_a_wrong_object_and_never_stuck(seed: int) -> None:
    """Everything follows from the seed, because hypothesis' own lists are too short and too uniform to meet a late reply."""
    chance = random.Random(seed)
    loss, delay_s = chance.choice([0.0, 0.03, 0.2]), chance.choice([0.01, 0.2, 1.0])

    async def main() -> None:
        ours, theirs = bus()
        server = NumberedServer()
        serving = asyncio.ensure_future(Wire(theirs, server, seed, loss, delay_s).run())
        master = CanopenMaster(ours, LoopClock(), sdo_timeout_s=0.3)
        async with running(master):
            for count, (what, block, sub, cancel_s) in enumerate(operations(chance)):
                before, wanted = server.number, count.to_bytes(4, "little") * 8
                call = (
                    master.sdo_upload(5, 0x2000, sub, block=block)
                    if what == "read"
                    else master.sdo_download(5, 0x2100 + count, 0, wanted, block=True)
                )
                try:
                    async with asyncio.timeout(cancel_s):
                        data = await call
                except (FieldtwinError, TimeoutError):
                    continue
                if what == "write":
                    assert server.written[(0x2100 + count).to_bytes(2, "little") + b"\0"] == wanted
                    continue
                assert data is not None
                assert len(data) == LENGTHS[sub]
                assert data == data[:4] * (len(data) // 4)
                assert int.from_bytes(data[:4], "little") > before
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)
        for mux, written in server.written.items():  # each stored value was written completely
            count = int.from_bytes(mux[:2], "little") - 0x2100
            assert written == count.to_bytes(4, "little") * 8

    run_virtually(asyncio.wait_for(main(), 1000))
