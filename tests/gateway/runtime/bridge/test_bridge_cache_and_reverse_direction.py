"""A bridge's cache, replies without fixed length, missing ports, and the reverse direction: a client on a line."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from bridge_rig import ANY_PORT, CLOCK, LINE, WRITERS, a_unit, refused, rig, take
from support import eventually, run

from fieldtwin.emulators.endpoints.modbus_server import serve_mbap
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.emulators.endpoints.socket_end import SocketListener
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.errors import ReplyTimeout
from fieldtwin.gateway.devices.config import BusConfig
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.bridge.bridge import Bridge, BridgeConfig, Route
from fieldtwin.gateway.runtime.buses.modbus.modbus_bus import ModbusBus
from fieldtwin.gateway.runtime.tags import TagTable


def test_the_cache_answers_within_its_age_and_forgets_on_a_write(tmp_path: Path) -> None:
    async def main() -> None:
        config = BridgeConfig("b", ANY_PORT, to="line", policy=WRITERS, cache_ms=300)
        async with rig(tmp_path, config) as r, r.client() as a, r.client() as b:
            assert (await a.read_registers(1, "holding", 0, 1)).registers == (100,)
            assert (await b.read_registers(1, "holding", 0, 1)).registers == (100,)
            assert (len(r.heard), r.bridge.cache.hits) == (1, 1)
            await a.write_register(1, 0, 5)
            assert (await b.read_registers(1, "holding", 0, 1)).registers == (5,)
            r.units[1].bank.write("holding", 0, [6], 0)

            async def renewed() -> bool:
                return (await b.read_registers(1, "holding", 0, 1)).registers == (6,)

            await eventually(renewed, within_s=1.0)
            assert (await a.read_registers(2, "holding", 0, 1)).registers == (200,)

    run(main())


def test_functions_with_replies_of_no_fixed_length(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r, r.raw() as raw:
            await raw.write(bytes.fromhex("0001 0000 0002 01 11"))
            reply = await take(raw, 8 + 1 + 9)
            assert b"unit 100" in reply

    run(main())


def test_a_missing_serial_port_is_not_a_path(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r, r.client() as client:
            assert (await client.read_registers(1, "holding", 0, 1)).registers == (100,)
            (tmp_path / "line").unlink()
            assert r.bus._client is not None
            await r.bus._client.aclose()
            # nothing was sent, so it waited until the attempt to open the port failed
            assert await refused(client, 1) == 0x0A
            assert await refused(client, 1) == 0x0A  # and now the failure is known
            assert r.bus.down is not None

    run(main())


@asynccontextmanager
async def reverse(
    tmp_path: Path, latency_s: float
) -> AsyncIterator[tuple[ModbusClient, Bridge, dict[int, ModbusUnit]]]:
    """A client on a serial line; units on Modbus TCP."""
    units = {3: a_unit(300)}
    near, far = tmp_path / "near", LINE.with_path(str(tmp_path / "near"))
    end = await PtyEnd.open(near, far, None)
    listener = await SocketListener.open(ANY_PORT, lambda c: serve_mbap(c, MbapServer(units), CLOCK, latency_s))
    audit = AuditLog(tmp_path / "audit.jsonl", CLOCK)
    bus = ModbusBus(BusConfig("lan", listener.bound, 0.5, 0), [], OsConnector(), CLOCK, TagTable(CLOCK), lambda d: None)
    bridge = Bridge(BridgeConfig("b", far, routes={7: Route("lan", 3)}), {"lan": bus}, OsConnector(), CLOCK, audit)
    client = ModbusClient(end, CLOCK, framing="rtu", serial=far.serial, timeout_s=0.4)
    try:
        async with Nursery() as nursery:
            nursery.start(bus.run(), "bus")
            nursery.start(bridge.run(), "bridge")
            await eventually(lambda: bridge.front.bound is not None and bus.connected)
            yield client, bridge, units
    finally:
        await client.aclose()
        await listener.aclose()
        audit.close()


def test_a_client_on_a_line_reaches_units_on_tcp(tmp_path: Path) -> None:
    async def main() -> None:
        async with reverse(tmp_path, 0.0) as (client, bridge, _):
            assert (await client.read_registers(7, "holding", 1, 2)).registers == (301, 302)
            with pytest.raises(ReplyTimeout):  # MB-029: a foreign unit
                await client.read_registers(3, "holding", 1, 1, timeout_s=0.1)
            assert (await client.read_registers(7, "holding", 2, 1)).registers == (302,)
            assert bridge.status().counters["requests"] == 2

    run(main())


def test_mb_012_an_answer_that_comes_after_the_client_went_on_is_never_sent(tmp_path: Path) -> None:
    async def main() -> None:
        async with reverse(tmp_path, 0.2) as (client, bridge, _):
            with pytest.raises(ReplyTimeout):
                await client.read_registers(7, "holding", 1, 1, timeout_s=0.02)
            # the client's own quarantine has long ended; a simpler client would ask at once
            assert (await client.read_registers(7, "holding", 2, 1)).registers == (302,)
            assert client.counters.desyncs == 0
            front = bridge.front
            assert front.status().counters["too_late"] + client.counters.late_bytes > 0

    run(main())
