"""Helpers for the tests of the commissioning commands: hidden register maps on a wire in memory, in virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Iterable, Sequence
from contextlib import asynccontextmanager

from modbus_virtual import VirtualLoop, VirtualWire, run_virtually

from fieldtwin.emulators.canopen.node import CanopenNode
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.endpoints.can.bus_runner import BusRunner
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.unit import ModbusUnit, UnitLimits
from fieldtwin.gateway.core.connection import ByteConnection, CanConnection
from fieldtwin.gateway.core.endpoint import Endpoint

__all__ = ["CAN_URL", "URL", "Mute", "Wired", "bank", "can_bus", "loop", "run_virtually", "unit"]

URL = "tcp://192.0.2.1:502"
CAN_URL = "can:fieldtwin/127.0.0.1:1"


def loop() -> VirtualLoop:
    """The running loop, which is a `Clock` too."""
    running = asyncio.get_running_loop()
    assert isinstance(running, VirtualLoop)
    return running


def bank(spans: Iterable[CellSpan], words: dict[str, dict[int, Sequence[int]]] | None = None) -> MapBank:
    """A bank with these values: table -> address -> words from there on."""
    made = MapBank(spans)
    for table, blocks in (words or {}).items():
        for address, values in blocks.items():
            for i, word in enumerate(values):
                made.poke(table, address + i, word)  # type: ignore[arg-type]
    return made


def unit(made: MapBank, **limits: object) -> ModbusUnit:
    return ModbusUnit(made, UnitLimits(**limits))  # type: ignore[arg-type]


Mute = Callable[[bytes, int], bool]
"""Map ``(request ADU, number of earlier ones)`` to whether it gets no answer."""


class Wired:
    """A connector to one unit: each connection is a Modbus TCP wire in memory. `requests` has the received PDUs."""

    def __init__(self, device: ModbusUnit, number: int = 1, latency_s: float = 0.01, mute: Mute | None = None) -> None:
        self._slave = MbapServer({number: device})
        self._latency_s = latency_s
        self._mute = mute
        self.requests: list[bytes] = []

    async def open_bytes(self, endpoint: Endpoint) -> ByteConnection:
        clock = loop()

        def answer(data: bytes) -> None:
            self.requests.append(data[7:])
            if self._mute is not None and self._mute(data, len(self.requests) - 1):
                return
            reply = b"".join(self._slave.feed(data, clock.monotonic_ns()))
            clock.call_later(self._latency_s, wire.feed, reply)

        wire = VirtualWire(endpoint, answer)
        return wire

    async def open_can(self, endpoint: Endpoint, bitrate: int) -> CanConnection:
        raise AssertionError("no CAN here")


class _CanConnector:
    def __init__(self, runner: BusRunner) -> None:
        self._runner = runner

    async def open_bytes(self, endpoint: Endpoint) -> ByteConnection:
        raise AssertionError("no bytes here")

    async def open_can(self, endpoint: Endpoint, bitrate: int) -> CanConnection:
        return self._runner.attach(endpoint, "us")


@asynccontextmanager
async def can_bus(*nodes: CanopenNode) -> AsyncIterator[_CanConnector]:
    """A connector to a modelled bus that carries `nodes`."""
    clock = loop()
    runner = BusRunner(1_000_000)
    ends = [runner.attach(Endpoint.parse(CAN_URL), f"node {i}") for i, _ in enumerate(nodes)]
    tasks = [asyncio.ensure_future(serve_node(end, node, clock)) for end, node in zip(ends, nodes, strict=True)]
    await asyncio.sleep(0.1)
    try:
        yield _CanConnector(runner)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
