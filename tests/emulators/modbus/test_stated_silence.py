"""The silence before a request on an RTU line can be configured: above 19200 baud, the recommended 1.75 ms limits a bridge to
571 requests/s, while a device that counts 3.5 characters needs 0.3 ms at 115200 baud. Before, it could not be shortened."""

from __future__ import annotations

import asyncio

import pytest
from modbus_virtual import VirtualLoop, run_virtually
from virtual_bus import VirtualLine

from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.protocols.modbus.client import ModbusClient


@pytest.mark.parametrize(
    ("query", "silence_us"),
    [
        ("baudrate=115200&frame=8N1", 1750),
        ("baudrate=115200&frame=8N1&silence_us=1000", 1000),
        ("baudrate=115200&frame=8N1&silence_us=304", 304),
        ("baudrate=19200&frame=8E1", 2005),
        ("baudrate=19200&frame=8E1&silence_us=5000", 5000),
    ],
)
def test_the_next_request_goes_after_the_stated_silence(query: str, silence_us: int) -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        endpoint = Endpoint.parse(f"rtu:/dev/ttyVIRT?{query}")
        line = VirtualLine(loop, {1: ModbusUnit(MapBank([CellSpan("holding", 0, 10)]))})
        client = ModbusClient.at(endpoint, await line.open_bytes(endpoint), loop)
        first = await client.read_registers(1, "holding", 0, 1)
        await client.read_registers(1, "holding", 0, 1)
        assert (line.heard[1].t_s - first.t_ns / 1e9) * 1e6 == pytest.approx(silence_us, abs=1)
        await client.aclose()

    run_virtually(main())


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("rtu:/dev/ttyS0?baudrate=115200&frame=8N1&silence_us=303", "304 (3.5 characters) to 100000 microseconds"),
        ("rtu:/dev/ttyS0?baudrate=9600&frame=8N1&silence_us=1750", "3646 (3.5 characters)"),
        ("rtu:/dev/ttyS0?silence_us=100001", "to 100000 microseconds"),
        ("rtu:/dev/ttyS0?silence_us=1.75ms", "microseconds"),
        ("ascii:/dev/ttyS0?silence_us=5000", "an rtu: endpoint"),
    ],
)
def test_a_silence_that_cannot_end_a_frame_is_refused(url: str, says: str) -> None:
    with pytest.raises(UsageError) as caught:
        Endpoint.parse(url)
    assert says in str(caught.value)
