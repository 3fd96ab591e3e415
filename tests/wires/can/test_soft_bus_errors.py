"""Error frames for nodes on the software CAN bus about their controllers, at each kind of end."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import can
from support import eventually, run

from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.emulators.endpoints.can.software_end import open_can_end
from fieldtwin.emulators.wires.can_faults import Disturbance, spoil
from fieldtwin.gateway.connections.can.soft_bus import SoftBusConnection
from fieldtwin.gateway.connections.soft_bus import SoftBus
from fieldtwin.gateway.core.can_error import CanErrorState, reported_state, reports_overrun
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import CanConnection
from fieldtwin.gateway.core.endpoint import Endpoint

ANY_PORT = Endpoint.parse("can:fieldtwin/127.0.0.1:0")
WARNING, PASSIVE, BUS_OFF = CanErrorState.WARNING, CanErrorState.PASSIVE, CanErrorState.BUS_OFF
ACTIVE = CanErrorState.ACTIVE


@asynccontextmanager
async def bus(bitrate: int = 1_000_000, **options: object) -> AsyncIterator[SoftBusServer]:
    server = await SoftBusServer.open(ANY_PORT, bitrate, **options)  # type: ignore[arg-type]
    try:
        yield server
    finally:
        await server.aclose()


async def ends(server: SoftBusServer) -> list[CanConnection]:
    return [
        await SoftBusConnection.open(server.bound, 0),
        await open_can_end(server.bound, 0),
        server.attach("attached"),
    ]


def test_every_kind_of_end_gets_errors_of_its_own_controller_only() -> None:
    async def main() -> None:
        async with bus() as server:
            all_ends = await ends(server)
            for sender in all_ends:
                rule = spoil(Disturbance(at_bit=3), times=32)
                server.disturb(rule)
                await sender.send(CanFrame(0x123))
                told = [await sender.recv() for _ in range(4)]
                assert [reported_state(f) for f in told] == [WARNING, PASSIVE, BUS_OFF, ACTIVE]
                assert [f.can_id & 0x140 for f in told] == [0, 0, 0x40, 0x100]
                assert [f.data[6] for f in told] == [96, 128, 255, 0]  # TEC
                assert [f.t_ns for f in told] == sorted(f.t_ns for f in told)
                for other in all_ends:
                    if other is not sender:
                        assert str(await other.recv()) == "123#"
                server.undisturb(rule)
            assert not any(end.inbound.data_stream for end in all_ends)
            for end in all_ends:
                await end.aclose()

    run(main())


def test_python_can_gets_error_frames_like_those_of_a_kernel_and_each_error_on_request() -> None:
    def program(channel: str) -> list[tuple[int, int, int]]:
        with SoftBus(channel, [{"can_id": 0x7FF, "can_mask": 0x7FF}], bus_errors=True) as own:
            own.send(can.Message(arbitration_id=0x7FF, is_extended_id=False), 5.0)
            told: list[tuple[int, int, int]] = []
            while len(told) < 34:
                message = own.recv(5.0)
                assert message is not None
                assert message.is_error_frame
                told.append((message.arbitration_id, message.data[1], message.data[2]))
            return told

    async def main() -> None:
        async with bus() as server:
            server.disturb(spoil(Disturbance(at_bit=3), times=32))
            told = await asyncio.to_thread(program, str(server.bound).removeprefix("can:fieldtwin/"))
            violation = (0x288, 0, 0x01)  # protocol violation, bus error, counters; a bit error
            assert told.count(violation) == 32
            # After the 12th, the 16th and the 32nd of them.
            assert [(i, *t) for i, t in enumerate(told) if t != violation] == [
                (12, 0x204, 0x08, 0), (17, 0x204, 0x20, 0)
            ]  # fmt: skip

    run(main())


def test_a_slow_node_is_informed_once_it_reads() -> None:
    async def main() -> None:
        async with bus(paced=False) as server:
            sender = server.attach("sender")
            slow = server.attach("slow", max_pending=10)
            for i in range(15):
                await sender.send(CanFrame(i))
            await eventually(lambda: slow.overruns == 5)
            got = [await slow.recv() for _ in range(11)]
            assert [f.can_id for f in got[:10]] == list(range(10))
            assert reports_overrun(got[10])
            assert not slow.inbound.data_stream
            assert server.bus_stats()["overruns"] == 5
            for end in (sender, slow):
                await end.aclose()

    run(main())


def test_alone_on_a_bus_without_listeners() -> None:
    async def main() -> None:
        async with bus(monitored=False) as server:
            alone = await open_can_end(server.bound, 0)
            await alone.send(CanFrame(0x705, b"\0"))
            assert [reported_state(await alone.recv()) for _ in range(2)] == [WARNING, PASSIVE]
            await eventually(lambda: server.bus_stats()["nodes"][0]["state"] == "error-passive")
            late = await open_can_end(server.bound, 0)
            assert str(await late.recv()) == "705#00"  # sent until a node acknowledged it
            assert reported_state(await alone.recv()) is WARNING  # 127
            for end in (late, alone):
                await end.aclose()

    run(main())
