"""CAN FD through the python-can interface, together with classic nodes; both versions of the hello on one bus."""

from __future__ import annotations

import asyncio

import can
import pytest
from support import run

from fieldtwin.emulators.endpoints.can.bus_hello import BusHello, unpack_hello
from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.emulators.endpoints.can.software_end import open_can_end
from fieldtwin.gateway.connections.can.soft_bus import SoftBusConnection
from fieldtwin.gateway.connections.soft_bus import SoftBus
from fieldtwin.gateway.core.canframe import RECORD_SIZE, CanFrame
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError

WITH_SWITCH = can.Message(arbitration_id=0x98765, data=bytes(range(48)), is_fd=True, bitrate_switch=True)
WITHOUT = can.Message(
    arbitration_id=0x123, is_extended_id=False, data=bytes(64), is_fd=True, error_state_indicator=True
)
CLASSIC = can.Message(arbitration_id=0x321, is_extended_id=False, data=b"\1\2")


async def opened(data_bitrate: int = 0) -> tuple[SoftBusServer, str]:
    server = await SoftBusServer.open(
        Endpoint.parse("can:fieldtwin/127.0.0.1:0"), 500_000, paced=False, data_bitrate=data_bitrate
    )
    host, port = server.bound.address
    return server, f"{host}:{port}"


def test_fd_nodes_hear_everything_and_classic_nodes_hear_classic_frames() -> None:
    async def main() -> None:
        server, channel = await opened()
        sender, fd_node = [await asyncio.to_thread(SoftBus, channel, fd=True) for _ in range(2)]
        classic = await asyncio.to_thread(SoftBus, channel)
        attached = server.attach("ours")
        ends = [await SoftBusConnection.open(server.bound, 500_000), await open_can_end(server.bound, 500_000)]
        for message in (WITH_SWITCH, WITHOUT, CLASSIC):
            await asyncio.to_thread(sender.send, message)
        for message in (WITH_SWITCH, WITHOUT, CLASSIC):
            got = await asyncio.to_thread(fd_node.recv, 30.0)
            assert got is not None
            assert got.equals(message, timestamp_delta=None, check_channel=False)
            assert got.error_state_indicator == message.error_state_indicator
        first = await asyncio.to_thread(classic.recv, 30.0)
        assert first is not None
        assert first.arbitration_id == 0x321
        for end in (attached, *ends):
            assert (await end.recv()).key() == CanFrame(0x321, b"\1\2").key()
            with pytest.raises(UsageError, match="classic CAN frames only"):
                await ends[0].send(CanFrame(0x1, bytes(12), fd=True))
        await asyncio.to_thread(classic.send, CLASSIC)
        heard = await asyncio.to_thread(fd_node.recv, 30.0)
        assert heard is not None
        assert not heard.is_fd
        for bus in (sender, fd_node, classic):
            await asyncio.to_thread(bus.shutdown)
        for end in (attached, *ends):
            await end.aclose()
        await server.aclose()

    run(main(), timeout_s=60)


def test_a_frame_of_a_length_that_can_fd_does_not_have_is_refused() -> None:
    async def main() -> None:
        server, channel = await opened()
        bus = await asyncio.to_thread(SoftBus, channel, fd=True)
        with pytest.raises(can.CanOperationError, match="not a CAN FD frame"):
            bus.send(can.Message(is_fd=True, data=bytes(13)))
        await asyncio.to_thread(bus.shutdown)
        await server.aclose()

    run(main())


def test_the_data_bit_rate_is_checked() -> None:
    async def main() -> None:
        server, channel = await opened(data_bitrate=2_000_000)
        good = await asyncio.to_thread(SoftBus, channel, fd=True, bitrate=500_000, data_bitrate=2_000_000)
        await asyncio.to_thread(good.shutdown)
        with pytest.raises(can.CanInitializationError, match="expected 4000000 bit/s; got 2000000 bit/s"):
            await asyncio.to_thread(SoftBus, channel, fd=True, data_bitrate=4_000_000)
        await server.aclose()

    run(main())


def test_an_older_bus_refuses_can_fd_with_a_clear_error() -> None:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        assert unpack_hello(await reader.readexactly(RECORD_SIZE)) is not None
        writer.write(
            BusHello(500_000, status=2, window=1).pack()
        )  # as version 1 answers a version that it does not know
        writer.close()

    async def main() -> None:
        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        channel = f"127.0.0.1:{server.sockets[0].getsockname()[1]}"
        with pytest.raises(
            can.CanInitializationError, match="a different protocol version; expected version 2; got version 1"
        ):
            await asyncio.to_thread(SoftBus, channel, fd=True)
        server.close()
        await server.wait_closed()

    run(main())
