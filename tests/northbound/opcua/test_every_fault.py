"""Under every fault that exists, on sockets, serial lines, CAN and values, each sample of a client equals the process image."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from itertools import zip_longest
from pathlib import Path

import pytest
import yaml
from image_record import ImageRecord
from procs import Asking, every_device_online, fieldtwin, no_tracebacks, wait_for
from received_samples import Received
from served_hall import START_WITHIN_S, client, write_site
from support import eventually

from fieldtwin.emulators.faults.fault import ValueFault, WireFault
from fieldtwin.emulators.faults.registry import FAULTS
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.twin.site.system import load_system

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]
LASTS_S = 0.8
"""How long each fault lasts: several polls, and longer than the time-out of the devices."""
LOST = ("half-open", "disconnect", "reset", "silence", "bus-off", "heartbeat-loss", "boot-storm", "odd-heartbeat")
"""Faults that last longer, because the gateway notices them later."""
TAGS = (
    "sensor.temperature",
    "sensor.ticks",
    "meter.temperature",
    "meter.flow",
    "tilt.slope_long",
    "tilt.slope_lateral",
)
SYSTEM = """\
buses:
  line: {url: "rtu:/dev/ttyS0?baudrate=19200&frame=8E1", timeout_ms: 200, retries: 0}
  can0: {url: "can:socketcan/can0", bitrate: 125000}
devices:
  meter:
    profile: ./sensor.yaml
    bus: line
    unit: 1
    poll: {values: {every_ms: 200}}
    backoff_first_ms: 100
    backoff_limit_ms: 200
  tilt:
    profile: inclinometer-cia410
    bus: can0
    node: 5
    heartbeat: {producer_ms: 200, consumer_ms: 600}
    tpdo1: {map: [slope_long, slope_lateral], event_ms: 100}
    stale_after_ms: 400
    start: true
"""
PROTOTYPE = """\
buses:
  line: {listen: "pty:line", pace: true}
  can0: {listen: "can:fieldtwin/127.0.0.1:0"}
devices:
  meter: {simulation: room, values: {flow: 3.5, state: 1, serial: "SN-0043"}}
  tilt: {recording: incl.jsonl, at_end: loop, identity: {serial: "1005"}}
"""


def write_all_kinds_of_buses(folder: Path) -> Path:
    """Write the site of `served_hall` with a serial line and a CAN bus as well, and return the system file."""
    path = write_site(folder)
    for file, more in ((path, SYSTEM), (path.with_name("hall.prototype.yaml"), PROTOTYPE)):
        whole, added = yaml.safe_load(file.read_text(encoding="utf-8")), yaml.safe_load(more)
        for section, entries in added.items():
            whole[section] |= entries
        file.write_text(yaml.safe_dump(whole, sort_keys=False), encoding="utf-8")
    return path


def rounds() -> list[list[tuple[str, str]]]:
    """Return pairs of fault and device that act at the same time: one fault on socket and line, one on CAN, one of values."""
    of_wires = [name for name, kind in FAULTS.items() if issubclass(kind, WireFault)]
    of_values = [name for name, kind in FAULTS.items() if issubclass(kind, ValueFault)]
    of_can = [name for name in FAULTS if name not in of_wires and name not in of_values]
    found = []
    for wire, can, value in zip_longest(of_wires, of_can, of_values):
        found.append([(name, device) for name, devices in (
            (wire, ("sensor", "meter")), (can, ("tilt",)), (value, ("sensor",)),
        ) if name for device in devices])  # fmt: skip
    return found


def inject(field: Asking, faults: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """Inject faults, and return those that are active. The simulated devices refuse a fault that has no effect there."""
    active = []
    for name, device in faults:
        with suppress(AssertionError):
            field("fault", fault={"id": f"{name} {device}", "name": name, "device": device})
            active.append((name, device))
    return active


def test_every_sample_equals_the_image_under_every_fault(tmp_path: Path) -> None:
    path, received, injected = write_all_kinds_of_buses(tmp_path), Received(), []

    def is_well() -> bool:
        return all(received.latest(tag) == "Good" for tag in TAGS)

    async def follow(url: str, field: Asking) -> None:
        async with client(url) as connected:
            subscription = await connected.create_subscription(50, received)
            nodes = [connected.get_node(f"ns=2;s={tag}") for tag in TAGS]
            await subscription.subscribe_data_change(nodes, queuesize=100)
            await eventually(is_well, 60.0, "all tags good at the start")
            for faults in rounds():
                active = await asyncio.to_thread(inject, field, faults)
                injected.extend(active)
                await asyncio.sleep(LASTS_S * (3 if any(name in LOST for name, _ in faults) else 1))
                for name, device in active:
                    await asyncio.to_thread(field, "clear", id=f"{name} {device}")
                await eventually(is_well, 60.0, f"all tags good after {faults}")

    with fieldtwin(tmp_path, "run", str(path), "--prototype") as run:
        wait_for((tmp_path / "hall" / "gateway.sock").is_socket, START_WITHIN_S, "the gateway")
        gateway, field = run.control("hall", "gateway"), run.control("hall", "field")
        every_device_online(gateway)
        url = wait_for(lambda: gateway("get", brief=True)["serve"]["scada"]["listening"], START_WITHIN_S, "the server")
        with ImageRecord(load_system(str(path)), tmp_path / "hall/image") as record:
            asyncio.run(follow(url, field))
    no_tracebacks(tmp_path)
    clock = WallClock()
    offset_ns = clock.utc_ns() - clock.monotonic_ns()
    compared = [(s, record.objection(*s, offset_ns)) for s in received.samples[len(TAGS) :]]
    wrong = [text for sample, text in compared if text and not record.was_unseen(sample[2])]
    assert not wrong, f"{len(wrong)} of {len(compared)}: {wrong[:5]}"
    unseen = sum(1 for sample, text in compared if text)
    assert unseen <= len(compared) // 20, (
        f"{unseen} of {len(compared)} arrived while the host was too busy for the record"
    )
    assert {name for name, _ in injected} == set(FAULTS)
    statuses = {data.StatusCode.name for _, data, _ in received.samples}
    assert statuses >= {"Good", "BadNoCommunication", "BadCommunicationError", "BadDeviceFailure", "BadSensorFailure"}
