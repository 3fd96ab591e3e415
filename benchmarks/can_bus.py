#!/usr/bin/env python3
"""The software CAN bus unpaced: frames/s from one process to another, complete and in order, and round trips between them.

    benchmarks/can_bus.py [--runs 5] [--frames 100000] [--trips 3000]

Three processes: the bus, and two programs on it. The peer is a plain TCP hub (24 bytes in, the same to all others, no model of
a bus), with the same programs on it, in the same run; runs are interleaved; the results are medians and ratios. python-can's
`udp_multicast` is shown where it works, with its losses in a burst. Goals: 10,000 frames/s, and half of the round trips within
300 us. The exit status is 1 if a goal is missed, or a frame is lost or out of order.
"""

from __future__ import annotations

import argparse
import asyncio
import subprocess
import sys
from functools import partial
from pathlib import Path
from statistics import median
from typing import ClassVar

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from peers import Goals, Missing, python, row, start, stop

ID_STREAM, ID_ASK, ID_ANSWER, ID_READY = 0x181, 0x601, 0x581, 0x701
BUS, HUB = "fieldtwin", "plain TCP hub"
PEER_FRAMES = 10_000


# -- what runs in the other processes -------------------------------------------------------------------------------


async def serve_bus() -> None:
    from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
    from fieldtwin.gateway.core.endpoint import Endpoint

    server = await SoftBusServer.open(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), 1_000_000, paced=False)
    print("ready", flush=True)
    print(server.bound.address[1], flush=True)
    await asyncio.Event().wait()


class _HubClient(asyncio.Protocol):
    """A minimal hub: answer a hello like a bus, confirm every record, and pass it to all others."""

    everybody: ClassVar[set[_HubClient]] = set()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport: asyncio.Transport = transport  # type: ignore[assignment]
        self.welcome = False
        self.inbound = b""

    def data_received(self, data: bytes) -> None:
        from fieldtwin.emulators.endpoints.can.bus_hello import BusHello

        data = self.inbound + data
        if not self.welcome and len(data) >= 24:
            self.welcome, data = True, data[24:]
            self.everybody.add(self)
            self.transport.write(
                BusHello(1_000_000, t_ns=int(asyncio.get_running_loop().time() * 1e9), window=64).pack()
            )
        whole = len(data) - len(data) % 24
        data, self.inbound = data[:whole], data[whole:]
        if data:
            for other in self.everybody - {self}:
                other.transport.write(data)
            confirmed = bytearray(data)
            for at in range(0, whole, 24):
                confirmed[at] |= 0x08
            self.transport.write(bytes(confirmed))

    def connection_lost(self, exc: Exception | None) -> None:
        self.everybody.discard(self)


async def serve_hub() -> None:
    server = await asyncio.get_running_loop().create_server(_HubClient, "127.0.0.1", 0)
    print("ready", flush=True)
    print(server.sockets[0].getsockname()[1], flush=True)
    await asyncio.Event().wait()


async def device(port: int) -> None:
    """The second program: count the stream, report when it was complete, and echo requests."""
    from fieldtwin.emulators.endpoints.can.software_end import open_can_end
    from fieldtwin.gateway.core.canframe import CanFrame
    from fieldtwin.gateway.core.endpoint import Endpoint

    end = await open_can_end(Endpoint.parse(f"can:fieldtwin/127.0.0.1:{port}"), 0)
    print("ready", flush=True)
    expected, good = 0, True
    while True:
        frame = await end.recv()
        if frame.can_id == ID_STREAM:
            good = good and int.from_bytes(frame.data) == expected
            expected += 1
        elif frame.can_id == ID_ASK:
            await end.send(CanFrame(ID_ANSWER, frame.data))
        elif frame.can_id == ID_READY:
            await end.send(CanFrame(ID_READY, (expected if good else 0).to_bytes(4)))
            expected, good = 0, True


# -- what is measured -----------------------------------------------------------------------------------------------


async def measure(port: int, frames: int, trips: int) -> tuple[float, float, float, int]:
    """Return frames/s to the other process, median and 99th percentile of a round trip in us, and frames lost or out of order."""
    from fieldtwin.gateway.connections.can.soft_bus import SoftBusConnection
    from fieldtwin.gateway.core.canframe import CanFrame
    from fieldtwin.gateway.core.endpoint import Endpoint

    loop = asyncio.get_running_loop()
    end = await SoftBusConnection.open(Endpoint.parse(f"can:fieldtwin/127.0.0.1:{port}"), 0)
    before = loop.time()
    for i in range(frames):
        await end.send(CanFrame(ID_STREAM, i.to_bytes(4)))
    await end.send(CanFrame(ID_READY))
    whole = int.from_bytes((await end.recv()).data)
    rate = frames / (loop.time() - before)
    took = []
    for i in range(trips):
        before = loop.time()
        await end.send(CanFrame(ID_ASK, i.to_bytes(4)))
        answer = await end.recv()
        took.append((loop.time() - before) * 1e6)
        assert answer.data == i.to_bytes(4)
    await end.aclose()
    took.sort()
    return rate, median(took), took[len(took) * 99 // 100], frames - whole


def once(kind: str, frames: int, trips: int) -> tuple[float, float, float, int]:
    server = start([python(), __file__, "--role", kind])
    try:
        assert server.stdout is not None
        port = int(server.stdout.readline())
        other = start([python(), __file__, "--role", "device", "--port", str(port)])
        try:
            return asyncio.run(measure(port, frames, trips))
        finally:
            stop(other)
    finally:
        stop(server)


def lost_by_multicast() -> str:
    """Return the losses of a burst of `PEER_FRAMES` on python-can's udp_multicast, within one computer."""
    program = f"""
import can, time
a = can.Bus(interface="udp_multicast", channel="239.74.163.2", ignore_config=True)
b = can.Bus(interface="udp_multicast", channel="239.74.163.2", ignore_config=True)
before = time.perf_counter()
for i in range({PEER_FRAMES}):
    a.send(can.Message(arbitration_id=0x181, data=i.to_bytes(4), is_extended_id=False))
took = time.perf_counter() - before
got = 0
while b.recv(0.5) is not None:
    got += 1
lost = 100 * (1 - got / {PEER_FRAMES})
print(f"{{lost:.1f}} % of a burst of {PEER_FRAMES} lost, sent at {{{PEER_FRAMES} / took:.0f}} frames/s")
"""
    done = subprocess.run([python(), "-c", program], capture_output=True, text=True, timeout=120, check=False)
    return done.stdout.strip() or (done.stderr.strip().splitlines() or ["nothing"])[-1]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--trips", type=int, default=3000)
    parser.add_argument("--role", choices=["bus", "hub", "device"], help=argparse.SUPPRESS)
    parser.add_argument("--port", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.role:
        asyncio.run({"bus": serve_bus, "hub": serve_hub}.get(options.role, partial(device, options.port))())
        return 0
    results: dict[str, list[tuple[float, float, float, int]]] = {BUS: [], HUB: []}
    for _ in range(options.runs):
        results[BUS].append(once("bus", options.frames, options.trips))
        results[HUB].append(once("hub", options.frames, options.trips))
    for at, what in enumerate(("frames/s", "round trip p50, us", "round trip p99, us")):
        print(f"{what:<24} {'median':>12}   ratio to the {HUB}")
        for name, runs in results.items():
            print(row(name, [run[at] for run in runs], [run[at] for run in results[HUB]]))
        print()
    lost = sum(run[3] for run in results[BUS])
    print(f"{lost} of {options.runs * options.frames} frames lost or out of order")
    print(f"python-can udp_multicast: {lost_by_multicast()}\n")
    goals = Goals()
    goals.least("frames/s between two processes", median(run[0] for run in results[BUS]), 10_000)
    goals.most("round trip, p50", median(run[1] for run in results[BUS]), 300, "us")
    goals.most("frames lost or out of order", lost, 0)
    return goals.verdict()


if __name__ == "__main__":
    try:
        sys.exit(main())
    except Missing as missing:
        print(f"can_bus: needs {missing}", file=sys.stderr)
        sys.exit(2)
