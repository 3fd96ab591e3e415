"""Values cached by the Modbus path between exchanges are dropped when their source changes."""

from __future__ import annotations

import pytest

from fieldtwin.emulators.modbus.bank import CellHooks, CellSpan, MapBank, NoSuchAddress
from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.emulators.virtual.memory_stream import MemoryWire
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ReplyTimeout
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.protocols.modbus.unit_timing import UnitPace


def test_a_changed_timeout_counts_from_the_next_request_on() -> None:
    endpoint = Endpoint.parse("tcp://plant:502")
    loop = VirtualLoop()

    async def main() -> list[float]:
        wire = MemoryWire(loop, endpoint, endpoint, None, serial=False)
        client = ModbusClient.at(endpoint, wire.near, VirtualClock(loop), timeout_s=1.0)

        async def waited() -> float:
            began_ns = loop.now_ns
            with pytest.raises(ReplyTimeout):
                await client.read_registers(1, "holding", 0, 1)
            return (loop.now_ns - began_ns) / 1e9

        seen = [await waited()]
        client.restate(timeout_s=2.0, turnaround_s=0.1, spacing_s=0.0)
        seen.append(await waited())
        client.units.set_pace(1, UnitPace(timeout_s=0.5))
        seen.append(await waited())
        client.units.set_pace(1, UnitPace())
        seen.append(await waited())
        await client.aclose()
        return seen

    try:
        assert loop.run_until_complete(main()) == [1.0, 2.0, 0.5, 2.0]
    finally:
        loop.close()


def test_a_cell_that_is_hooked_after_a_read_is_read_through_its_hook() -> None:
    bank = MapBank([CellSpan("holding", 10, 4)])
    bank.poke("holding", 10, 1, 2, 3, 4)
    assert list(bank.read("holding", 10, 4, 0)) == [1, 2, 3, 4]
    bank.hook("holding", 12, CellHooks(reading=lambda value, now_ns: value + now_ns))
    assert list(bank.read("holding", 10, 4, 30)) == [1, 2, 33, 4]
    bank.poke("holding", 12, 5)
    assert list(bank.read("holding", 12, 1, 40)) == [45]
    bank.hook("holding", 12, CellHooks())
    assert list(bank.read("holding", 10, 4, 50)) == [1, 2, 5, 4]
    with pytest.raises(NoSuchAddress):
        bank.read("holding", 11, 4, 0)
