"""A device that answers busy (exception 06) to everything for a while, in virtual time: it gets one growing pause for all
requests, and returns soon after it is ready."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from itertools import pairwise

import pytest
from gateway_rig import LAN, profile
from modbus_virtual import VirtualLoop, VirtualWire, run_virtually

from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import ByteConnection, CanConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Unreachable
from fieldtwin.gateway.devices.config import BusConfig, DeviceConfig
from fieldtwin.gateway.devices.register_device import SensorDriver
from fieldtwin.gateway.runtime.buses.modbus.modbus_bus import ModbusBus
from fieldtwin.gateway.runtime.tags import TagTable

GROUPS = ("a", "b", "c", "d")
MAP = "tags:\n" + "".join(f'  {g}: {{at: "holding:{10 * n}", poll: {g}}}\n' for n, g in enumerate(GROUPS))
BUSY_FROM_S, READY_S = 2.0, 5.0


class Device:
    """The connector to one unit. `busy` decides by register and time whether it answers busy."""

    def __init__(self, busy: Callable[[float, int], bool]) -> None:
        self._busy = busy
        self.asked: list[tuple[float, int, bool]] = []
        """Time, register, and whether it was busy."""
        self.wire = VirtualWire(LAN, self._on_request)

    def _on_request(self, adu: bytes) -> None:
        loop = asyncio.get_running_loop()
        now_s, register = loop.time(), int.from_bytes(adu[8:10])
        busy = self._busy(now_s, register)
        self.asked.append((now_s, register, busy))
        pdu = b"\x83\x06" if busy else b"\x03\x02\x00\x07"
        reply = adu[:4] + (len(pdu) + 1).to_bytes(2) + adu[6:7] + pdu
        loop.call_later(0.005, self.wire.feed, reply)

    async def open_bytes(self, endpoint: Endpoint) -> ByteConnection:
        return self.wire

    async def open_can(self, endpoint: Endpoint, bitrate: int) -> CanConnection:
        raise Unreachable("no CAN here", where=str(endpoint))


def play(device: Device, seconds: float) -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        tags = TagTable(loop)
        config = DeviceConfig("d", profile(MAP), "bus", 1, poll=dict.fromkeys(GROUPS, 500), stale_after_ms=1500)
        bus = ModbusBus(BusConfig("bus", LAN, 0.1, 1), [SensorDriver(config, tags)], device, loop, tags, lambda d: None)
        nursery = Nursery()
        nursery.start(bus.run(), "bus")
        await loop.sleep_until_ns(int(seconds * 1e9))
        await nursery.__aexit__(None, None, None)

    run_virtually(main())


def test_the_pause_of_a_busy_device_doubles_once_for_all_its_groups() -> None:
    device = Device(lambda now_s, register: BUSY_FROM_S <= now_s < READY_S)
    play(device, 15)
    pauses = [0.25 * 2**n for n in range(4)]  # from 2 s on: until 2.25, 2.75, 3.75 and 5.75 s
    busy = [(at_s, register) for at_s, register, said in device.asked if said]
    for register in (0, 10, 20, 30):
        assert sum(r == register for _, r in busy) <= len(pauses)
    assert busy[-1][0] < BUSY_FROM_S + sum(pauses[:3]) + 0.5
    back = {register: at_s for at_s, register, said in reversed(device.asked) if not said and at_s > READY_S}
    assert set(back) == {0, 10, 20, 30}
    assert max(back.values()) < BUSY_FROM_S + sum(pauses) + 0.1


@pytest.mark.parametrize("register", [0, 30])
def test_one_register_that_is_always_busy_does_not_delay_the_others(register: int) -> None:
    device = Device(lambda now_s, asked: now_s >= BUSY_FROM_S and asked == register)
    play(device, 12)
    for other in {0, 10, 20, 30} - {register}:
        times = [at_s for at_s, r, _ in device.asked if r == other and at_s > BUSY_FROM_S]
        assert max(b - a for a, b in pairwise(times)) < 0.6
