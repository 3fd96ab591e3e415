"""The slcan port over real TCP: python-can's own `slcan` interface, and a client that knows only the bytes."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import can
import pytest
from support import eventually, run

from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.emulators.endpoints.can.slcan_port import SlcanPort
from fieldtwin.emulators.wires.can_faults import Disturbance, spoil
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import EndpointBusy, Unreachable

ANY_BUS, ANY_TCP = Endpoint.parse("can:fieldtwin/127.0.0.1:0"), Endpoint.parse("tcp://127.0.0.1:0")


@asynccontextmanager
async def bench(bitrate: int = 125_000, **options: bool) -> AsyncIterator[tuple[SoftBusServer, SlcanPort]]:
    server = await SoftBusServer.open(ANY_BUS, bitrate, **options)
    port = await SlcanPort.open(server.runner, ANY_TCP)
    try:
        yield server, port
    finally:
        await port.aclose()
        await port.aclose()
        await server.aclose()


class Client:
    """Raw bytes."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    @classmethod
    async def join(cls, port: SlcanPort) -> Client:
        return cls(*await asyncio.open_connection(*port.bound))

    async def say(self, text: bytes, answer: bytes) -> None:
        self.writer.write(text)
        assert await self.reader.readexactly(len(answer)) == answer

    async def leave(self) -> None:
        self.writer.close()
        await self.writer.wait_closed()


def test_python_cans_slcan_in_both_directions() -> None:
    sent = [
        can.Message(arbitration_id=0x605, data=bytes(8), is_extended_id=False),
        can.Message(arbitration_id=0x1FFFFFFF, data=b"\x01", is_extended_id=True),
        can.Message(arbitration_id=0x701, is_remote_frame=True, dlc=1, is_extended_id=False),
    ]

    def program(channel: str) -> list[str]:
        # by default, python-can waits two seconds for an Arduino to boot
        with can.Bus(
            interface="slcan", channel=channel, bitrate=125_000, sleep_after_open=0, ignore_config=True, timeout=1
        ) as bus:
            assert bus.get_version(5.0) == (10, 13)  # type: ignore[attr-defined]
            for message in sent:
                bus.send(message, 5.0)
            heard: list[str] = []
            while len(heard) < 2:
                told = bus.recv(5.0)
                assert told is not None
                heard.append(f"{told.arbitration_id:X}#{told.data.hex()}")
            return heard

    async def main() -> None:
        async with bench() as (server, port):
            other = server.attach("other")
            running = asyncio.create_task(asyncio.to_thread(program, "socket://{}:{}".format(*port.bound)))
            got = [await other.recv() for _ in sent]
            assert [str(f) for f in got] == ["605#0000000000000000", "1FFFFFFF#01", "701#R1"]
            await other.send(CanFrame(0x585, b"\x60"))
            await other.send(CanFrame(0x12345, b"", extended=True))
            assert await running == ["585#60", "12345#"]
            await eventually(lambda: len(server.bus_stats()["nodes"]) == 1)

    run(main())


def test_a_node_from_open_to_close() -> None:
    async def main() -> None:
        async with bench() as (server, port):
            other, client = server.attach("other"), await Client.join(port)
            await client.say(b"\r\rS6\rS4\rV\r", b"\r\r\a\rV1013\r")
            assert len(server.bus_stats()["nodes"]) == 1  # not before it opened
            await client.say(b"Z1\rO\r", b"\r\r")
            assert [n["name"].split()[0] for n in server.bus_stats()["nodes"]] == ["other", "slcan"]
            await client.say(b"t185401020304\r", b"z\r")
            assert str(await other.recv()) == "185#01020304"
            await other.send(CanFrame(0x80))
            line = await client.reader.readuntil(b"\r")
            assert line[:5] == b"t0800"
            assert int(line[5:9], 16) < 60_000
            await client.say(b"C\r", b"\r")
            assert len(server.bus_stats()["nodes"]) == 1
            await client.say(b"L\rt1230\r", b"\r\a")
            await client.leave()
            await eventually(lambda: len(server.bus_stats()["nodes"]) == 1)
            await other.aclose()

    run(main())


def test_a_listen_only_adapter_does_not_acknowledge() -> None:
    async def main() -> None:
        async with bench(1_000_000, monitored=False) as (server, port):
            alone, client = server.attach("alone"), await Client.join(port)
            await client.say(b"S8\rL\r", b"\r\r")
            await alone.send(CanFrame(0x123))
            await eventually(lambda: server.bus_stats()["nodes"][0]["state"] == "error-passive")
            await client.say(b"C\rO\r", b"\r\r")
            assert await client.reader.readuntil(b"\r") == b"t1230\r"
            await alone.aclose()
            await client.leave()

    run(main())


def test_a_burst_keeps_its_order_and_waits_for_the_wire() -> None:
    count = 1000

    async def main() -> None:
        async with bench(1_000_000) as (server, port):
            other, client = server.attach("other"), await Client.join(port)
            await client.say(b"S8\rO\r", b"\r\r")
            client.writer.write(b"".join(b"t1812%04X\r" % i for i in range(count)))
            got = [int.from_bytes((await other.recv()).data) for _ in range(count)]
            assert got == list(range(count))
            assert await client.reader.readexactly(2 * count) == b"z\r" * count
            await other.aclose()
            await client.leave()

    run(main())


def test_status_reports_bus_off_and_queued_frames_go_out_after_it() -> None:
    async def main() -> None:
        async with bench(10_000) as (server, port):
            client, other = await Client.join(port), server.attach("other")
            server.disturb(spoil(Disturbance(at_bit=3), times=32))
            await client.say(b"S0\rO\rt0000\r", b"\r\rz\r")
            await eventually(lambda: server.bus_stats()["nodes"][-1]["state"] == "bus-off")
            await client.say(b"F\r", b"FA4\r")
            assert str(await other.recv()) == "000#"  # 128 * 11 bits of 100 us later
            await client.say(b"F\r", b"F00\r")
            await client.leave()
            await other.aclose()

    run(main())


@pytest.mark.long
def test_a_client_that_does_not_read_loses_frames_alone() -> None:
    async def main() -> None:
        async with bench(paced=False) as (server, port):
            sender, other, client = server.attach("sender"), server.attach("other"), await Client.join(port)
            await client.say(b"O\r", b"\r")
            frame = CanFrame(0x1FFFFFFF, bytes(8), extended=True)
            for sent in itertools.count(1):
                await sender.send(frame)
                await other.recv()
                if server.bus_stats()["overruns"] or sent > 100_000:
                    break
            assert [n["overruns"] for n in server.bus_stats()["nodes"]] == [0, 0, 1]
            client.writer.write(b"F\r")
            while (line := await client.reader.readuntil(b"\r")).startswith(b"T"):
                pass
            assert line == b"F09\r"
            await client.leave()
            for end in (sender, other):
                await end.aclose()

    run(main())


def test_an_endpoint_that_cannot_listen() -> None:
    async def main() -> None:
        async with bench() as (server, port):
            with pytest.raises(EndpointBusy):
                await SlcanPort.open(server.runner, Endpoint.parse(f"tcp://127.0.0.1:{port.bound[1]}"))
            with pytest.raises(Unreachable):
                await SlcanPort.open(server.runner, Endpoint.parse("tcp://192.0.2.1:1"))

    run(main())


def test_a_bus_that_closes_takes_its_clients_along() -> None:
    async def main() -> None:
        async with bench() as (server, port):
            client = await Client.join(port)
            await client.say(b"O\r", b"\r")
            await server.aclose()
            assert await client.reader.read() == b""
            late = await Client.join(port)
            late.writer.write(b"O\r")
            with pytest.raises((ConnectionError, asyncio.IncompleteReadError)):
                await late.reader.readexactly(2)
            for gone in (client, late):
                gone.writer.close()

    run(main())
