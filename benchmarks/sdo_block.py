#!/usr/bin/env python3
"""SDO block transfer over a modelled CAN bus, in virtual time: which share of the bus's theoretical rate is reached?

    benchmarks/sdo_block.py [--bytes 1048576] [--bitrate 1000000]

The gateway's client against the emulated node's server, in both directions, compared with plain segmented transfer. The peer
is the bus itself: the amount it would carry if all of its time were used by segments of 7 bytes, each at its exact stuffed
length. The exit status is 1 if a block transfer stays under 95 % of that. Virtual time: the figures are the same on any
machine.
"""

from __future__ import annotations

import argparse
import asyncio
import math
import random
import selectors
import sys
import time
from pathlib import Path

from peers import Goals

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.node import CanopenNode
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.endpoints.can.bus_runner import BusRunner
from fieldtwin.emulators.wires.can_timing import bits_on_wire
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster
from fieldtwin.gateway.protocols.canopen.sdo.block import UPLOAD_BLOCK

NODE, SEGMENT, GOAL = 5, 7, 0.95
HERE = Endpoint.parse("can:fieldtwin/127.0.0.1:1")
EDS = """
[DeviceInfo]
VendorName=benchmark
[1000]
ParameterName=Device type
ObjectType=0x7
DataType=0x0007
AccessType=ro
DefaultValue=0
[2000]
ParameterName=Program
ObjectType=0x7
DataType=0x000F
AccessType=rw
DefaultValue=
"""


class _Jump(selectors.SelectSelector):
    """Instead of waiting, advance the time."""

    now_ns = 0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if timeout is None:
            raise AssertionError("deadlock")
        self.now_ns += math.ceil(timeout * 1e9)
        return []


class VirtualLoop(asyncio.SelectorEventLoop):
    """The loop starts at 0, never waits, and is its own `Clock`."""

    def __init__(self) -> None:
        self._jump = _Jump()
        super().__init__(self._jump)

    def time(self) -> float:
        return self._jump.now_ns / 1e9

    def monotonic_ns(self) -> int:
        return self._jump.now_ns

    def utc_ns(self) -> int:
        return self._jump.now_ns

    async def sleep_until_ns(self, deadline_ns: int) -> None:
        while self._jump.now_ns < deadline_ns:
            await asyncio.sleep((deadline_ns - self._jump.now_ns) / 1e9)


def ideal_s(data: bytes, can_id: int, block: int, bitrate: int) -> float:
    """Return the time of the segments of `data` on the wire, one after the other."""
    bits, total = 0, -(-len(data) // SEGMENT)
    for number in range(total):
        first = number % block + 1 | (0x80 if number + 1 == total else 0)
        part = data[number * SEGMENT : (number + 1) * SEGMENT].ljust(SEGMENT, b"\0")
        bits += bits_on_wire(CanFrame(can_id, bytes([first]) + part))
    return bits / bitrate


async def measure(data: bytes, bitrate: int, *, block: bool) -> tuple[float, float]:
    """Return the virtual seconds of a download of `data` and of the upload that reads it back."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    runner = BusRunner(bitrate)
    node = CanopenNode(parse_eds(EDS, "benchmark"), NODE)
    ends = runner.attach(HERE, "node"), runner.attach(HERE, "master")
    master = CanopenMaster(ends[1], loop, sdo_timeout_s=1.0)
    tasks = [asyncio.ensure_future(serve_node(ends[0], node, loop)), asyncio.ensure_future(master.run())]
    await asyncio.sleep(0.01)
    started = loop.time()
    await master.sdo_download(NODE, 0x2000, 0, data, block=block)
    written = loop.time()
    back = await master.sdo_upload(NODE, 0x2000, 0, block=block)
    assert back == data, "another object came back"
    read = loop.time()
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    return written - started, read - written


def virtually(data: bytes, bitrate: int, *, block: bool) -> tuple[float, float]:
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(measure(data, bitrate, block=block))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--bytes", type=int, default=1 << 20)
    parser.add_argument("--bitrate", type=int, default=1_000_000)
    options = parser.parse_args()
    data = random.Random(1).randbytes(options.bytes)
    began = time.monotonic()
    goals = Goals()
    print(f"{options.bytes} bytes at {options.bitrate} bit/s; seconds of bus time, and share of the theoretical rate")
    plain = virtually(data[:7000], options.bitrate, block=False)
    blocks = virtually(data, options.bitrate, block=True)
    for what, can_id, size, blocked, plainly in (
        ("download", 0x600 + NODE, 127, blocks[0], plain[0]),
        ("upload", 0x580 + NODE, UPLOAD_BLOCK, blocks[1], plain[1]),
    ):
        best = ideal_s(data, can_id, size, options.bitrate)
        share, segmented = best / blocked, ideal_s(data[:7000], can_id, size, options.bitrate) / plainly
        print(
            f"  block {what:<9} {blocked:9.4f} s   theoretical {best:9.4f} s   {share:7.2%}   (segmented: {segmented:.1%})"
        )
        goals.least(f"block {what}", share, GOAL)
    print(f"({time.monotonic() - began:.0f} s of this computer)")
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
