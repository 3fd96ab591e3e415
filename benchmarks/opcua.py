#!/usr/bin/env python3
"""The OPC UA server's CPU time for monitored items, and its start with 10,000 variables.

    benchmarks/opcua.py [--quick] [--rounds 200] [--items 1000] [--variables 10000]

The server is the process that a run starts. This script writes the process image in place of a gateway, and its client, which is
asyncua's, subscribes to 1,000 items with a publishing interval of 100 ms. In the first part 10 % of the values change at each
publication, in the second part all of them; the times of all values change in both. Measured is the CPU time of the server for
each publication with the notifications of its changes, as a share of 100 ms of one core. Nothing is compared: it says what a
user pays. CPU times stand some load of the machine. Needs the extra `opcua`.
"""

from __future__ import annotations

import argparse
import asyncio
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import msgspec
from peers import Goals, cpu_s, free_port, peak_mb, stop

CHANGING_SHARE = 0.1
GOAL_SHARE = 0.15
GOAL_START_S = 30.0
EVERY_S = 0.1
TAGS_OF_A_DEVICE = 100


def write_site(folder: Path, tags: int, port: int) -> Path:
    """Write a system with this number of tags, in devices of `TAGS_OF_A_DEVICE`."""
    lines = [f"  t{n}: {{at: 'holding:{n}', type: uint16, unit: degC}}\n" for n in range(TAGS_OF_A_DEVICE)]
    head = 'device: bench/many\nsource: "a benchmark"\nprotocol: modbus\ntags:\n'
    (folder / "many.yaml").write_text(head + "".join(lines), encoding="utf-8")
    buses = "".join(
        f"  lan{b}: {{url: 'tcp://192.0.2.{b + 1}:502'}}\n" for b in range(-(-tags // TAGS_OF_A_DEVICE // 200))
    )
    devices = "".join(
        f"  d{n}: {{profile: ./many.yaml, bus: lan{n // 200}, unit: {n % 200 + 1}}}\n"
        for n in range(tags // TAGS_OF_A_DEVICE)
    )
    server = f"serve:\n  scada: {{kind: opcua, url: 'opc.tcp://127.0.0.1:{port}'}}\n"
    path = folder / "bench.yaml"
    path.write_text(f"fieldtwin: 1\nsystem: bench\nbuses:\n{buses}devices:\n{devices}{server}", encoding="utf-8")
    return path


class Plant:
    """A process image that is written as by a gateway, and the server's process that reads it."""

    def __init__(self, folder: Path, tags: int) -> None:
        from fieldtwin.gateway.core.image.image import INPUTS
        from fieldtwin.northbound.process_config import ServerProcessConfig
        from fieldtwin.twin.plant.physical import attached, image_layout, make_image
        from fieldtwin.twin.site.resolved import write_resolved
        from fieldtwin.twin.site.system import load_system

        port = free_port()
        system = load_system(str(write_site(folder, tags, port)))
        layout = image_layout(system)
        make_image(layout, folder / "image")
        self._attached = attached(layout, folder / "image")
        self._writer = self._attached.__enter__().writer(INPUTS)
        self.url = f"opc.tcp://127.0.0.1:{port}"
        self.count = 0
        self.names = [f"d{n // TAGS_OF_A_DEVICE}.t{n % TAGS_OF_A_DEVICE}" for n in range(tags)]
        config = ServerProcessConfig(write_resolved(folder / "system.pickle", system), str(folder), "scada", False)
        (folder / "config.json").write_bytes(msgspec.json.encode(config))
        self.publish(1.0)
        command = [sys.executable, "-m", "fieldtwin.northbound.opcua.process", str(folder / "config.json")]
        self.server = subprocess.Popen(command, stdout=subprocess.DEVNULL)

    def publish(self, share: float) -> None:
        """Publish all tags with the present time; this share of them with a new value."""
        from fieldtwin.gateway.core.values import Quality, TagValue

        self.count += 1
        now_ns = time.monotonic_ns()
        step = max(1, round(1 / share))
        self._values = [
            TagValue(self.count % 65_536 if n % step == 0 else 7, Quality.GOOD, t_ns=now_ns)
            for n in range(len(self.names))
        ]
        self._writer.publish(self._values, now_ns)

    def beat(self) -> None:
        """Publish the same values again, because the server takes a gateway that publishes nothing for dead."""
        self._writer.publish(self._values, time.monotonic_ns())

    def end(self) -> None:
        stop(self.server)
        self._attached.__exit__(None, None, None)


class Counter:
    """Counts the notifications of a subscription."""

    def __init__(self) -> None:
        self.count = 0

    def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
        self.count += 1


async def connected(url: str, within_s: float) -> Any:
    """Return a client as soon as the server accepts one."""
    from asyncua import Client

    until = time.monotonic() + within_s
    while True:
        client = Client(url, timeout=60, watchdog_intervall=60)
        try:
            await client.connect()
            return client
        except (OSError, TimeoutError):
            if time.monotonic() > until:
                raise
            await asyncio.sleep(0.2)


async def monitored(folder: Path, items: int, rounds: int) -> list[tuple[float, float, float]]:
    """Return for both parts: share of changing values, CPU time per round in seconds, CPU time per notification in seconds.

    A round is a publication, and the notifications of its changes. The next round begins when the client has all of them, so that
    a busy machine makes rounds longer and their CPU time only a little larger.
    """
    plant = Plant(folder, items)
    found = []
    try:
        client = await connected(plant.url, 300)
        try:
            counter = Counter()
            subscription = await client.create_subscription(EVERY_S * 1000, counter)
            await subscription.subscribe_data_change([client.get_node(f"ns=2;s={name}") for name in plant.names])
            for share in (CHANGING_SHARE, 1.0):
                await one_round(plant, counter, share)
                await settled(plant, counter)
                count, cpu = counter.count, cpu_s(plant.server.pid)
                for _ in range(rounds):
                    await one_round(plant, counter, share)
                used = cpu_s(plant.server.pid) - cpu
                found.append((share, used / rounds, used / (counter.count - count)))
        finally:
            await client.disconnect()
    finally:
        plant.end()
    return found


async def settled(plant: Plant, counter: Counter) -> None:
    """Wait until no notification has come for two seconds: those of the first values, and of the change between the two parts."""
    count = -1
    while count != counter.count:
        count = counter.count
        for _ in range(20):
            plant.beat()
            await asyncio.sleep(0.1)


async def one_round(plant: Plant, counter: Counter, share: float) -> None:
    """Publish, and wait until the client has all changes, at least `EVERY_S`."""
    loop = asyncio.get_running_loop()
    began_s, wanted = loop.time(), counter.count + round(len(plant.names) * share)
    plant.publish(share)
    async with asyncio.timeout(60):
        while counter.count < wanted:
            plant.beat()
            await asyncio.sleep(0.01)
    await asyncio.sleep(max(0.0, began_s + EVERY_S - loop.time()))


async def started(folder: Path, variables: int) -> tuple[float, float]:
    """Return the CPU time in seconds and the memory in MB of a server with many variables at its first client."""
    plant = Plant(folder, variables)
    try:
        client = await connected(plant.url, 900)
        try:
            plant.publish(1.0)
            await asyncio.sleep(1)
            value = await client.get_node(f"ns=2;s={plant.names[-1]}").read_value()
            assert isinstance(value, int)
            return cpu_s(plant.server.pid), peak_mb(plant.server.pid)
        finally:
            await client.disconnect()
    finally:
        plant.end()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--rounds", type=int, default=200)
    parser.add_argument("--items", type=int, default=1000)
    parser.add_argument("--variables", type=int, default=10_000)
    options = parser.parse_args()
    rounds = 20 if options.quick else options.rounds
    goals = Goals()
    with tempfile.TemporaryDirectory() as folder:
        for share, each_s, notification_s in asyncio.run(monitored(Path(folder), options.items, rounds)):
            core = each_s / EVERY_S
            print(
                f"{options.items} items at 100 ms, {share:.0%} of the values change each time: {core:.1%} of a core, "
                f"{notification_s * 1e6:.0f} us for each notification"
            )
            if share == CHANGING_SHARE:
                goals.most("share of a core", core, GOAL_SHARE)
    with tempfile.TemporaryDirectory() as folder:
        cpu, memory = asyncio.run(started(Path(folder), options.variables))
        print(f"{options.variables} variables: {cpu:.1f} s of CPU time until the first client reads, {memory:.0f} MB")
        goals.most("CPU time of the start, s", cpu, GOAL_START_S)
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
