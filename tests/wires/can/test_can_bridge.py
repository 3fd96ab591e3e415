"""Two joined CAN buses: the software bus with a second one, and with the kernel's vcan0 if it exists."""

from __future__ import annotations

import asyncio
import contextlib
import re
import shutil
import signal
import socket
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import can
import pytest
from support import eventually, run

from fieldtwin.emulators.endpoints.can.bus_bridge import CanBridge
from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.emulators.endpoints.can.software_end import open_can_end
from fieldtwin.emulators.wires.can_faults import Disturbance, spoil
from fieldtwin.gateway.connections.can.socketcan import SocketCanConnection
from fieldtwin.gateway.connections.soft_bus import SoftBus
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import CanConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost

ANY_PORT = Endpoint.parse("can:fieldtwin/127.0.0.1:0")
VCAN0 = Endpoint.parse("can:socketcan/vcan0")
KINDS = [
    CanFrame(0x000),
    CanFrame(0x7FF, bytes(range(8))),
    CanFrame(0x605, remote=True, dlc=8),
    CanFrame(0x1FFFFFFF, b"\xff", extended=True),
]


@contextlib.asynccontextmanager
async def two_buses(**options: bool) -> AsyncIterator[tuple[SoftBusServer, SoftBusServer, CanBridge]]:
    one, other = [await SoftBusServer.open(ANY_PORT, 1_000_000, **options) for _ in range(2)]
    bridge = CanBridge(one.attach("bridge"), await open_can_end(other.bound, 0))
    bridge.start()
    try:
        yield one, other, bridge
    finally:
        await bridge.aclose()
        await bridge.aclose()
        await one.aclose()
        await other.aclose()


async def cross(sender: CanConnection, receiver: CanConnection, count: int, ahead: int = 100) -> None:
    """Send frames in order from one to the other, at most `ahead` of them in transit, because vcan does not throttle a sender."""
    got: list[int] = []
    room = asyncio.Semaphore(ahead)

    async def take() -> None:
        while len(got) < count:
            got.append(int.from_bytes((await receiver.recv()).data))
            room.release()

    taking = asyncio.create_task(take())
    for i in range(count):
        await room.acquire()
        await sender.send(CanFrame(0x181 + (i & 1), i.to_bytes(4)))
    await taking
    assert got == list(range(count))


def test_every_kind_of_frame_crosses_once_and_nothing_comes_back() -> None:
    async def main() -> None:
        async with two_buses() as (one, other, bridge):
            here, there, third = one.attach("here"), other.attach("there"), one.attach("third")
            for sender, receiver in ((here, there), (there, here)):
                for frame in KINDS:
                    await sender.send(frame)
                assert [(await receiver.recv()).key() for _ in KINDS] == [f.key() for f in KINDS]
            for _ in range(2):
                assert [(await third.recv()).key() for _ in KINDS] == [f.key() for f in KINDS]
            await eventually(lambda: list(bridge.forwarded.values()) == [len(KINDS)] * 2)
            assert (one.bus_stats()["frames"], other.bus_stats()["frames"]) == (2 * len(KINDS), 2 * len(KINDS))
            assert not any(end.inbound.data_stream for end in (here, there, third))
            for end in (here, there, third):
                await end.aclose()

    run(main())


def test_in_both_directions_at_once_complete_and_in_order() -> None:
    async def main() -> None:
        async with two_buses(paced=False) as (one, other, bridge):
            ends = [one.attach("a"), one.attach("b"), other.attach("c"), other.attach("d")]
            a, b, c, d = ends
            # b and c receive their neighbours' frames too, and count only those that crossed the bridge.
            b.accept = lambda frame: frame.can_id >= 0x700
            c.accept = lambda frame: frame.can_id < 0x700
            crossing = asyncio.create_task(cross(a, c, 3000))
            for i in range(3000):
                await d.send(CanFrame(0x701, i.to_bytes(4)))
            got = [int.from_bytes((await b.recv()).data) for _ in range(3000)]
            assert got == list(range(3000))
            await crossing
            assert bridge.lost == 0
            for end in ends:
                await end.aclose()

    run(main())


def test_errors_stay_on_their_side() -> None:
    async def main() -> None:
        async with two_buses() as (one, other, bridge):
            here, there = one.attach("here"), other.attach("there")
            one.disturb(spoil(Disturbance(at_bit=3), times=32))
            await there.send(CanFrame(0x123))  # the bridge's own node is bus-off before it can send it
            assert str(await here.recv()) == "123#"
            await here.send(CanFrame(0x124))
            assert str(await there.recv()) == "124#"
            assert not bridge.ended.done()
            assert (one.bus_stats()["error_frames"], other.bus_stats()["error_frames"]) == (32, 0)
            for end in (here, there):
                await end.aclose()

    run(main())


def test_a_bus_that_vanishes_ends_the_bridge_with_a_message() -> None:
    async def main() -> None:
        async with two_buses() as (one, other, bridge):
            await other.aclose()
            assert isinstance(await bridge.ended, ConnectionLost)
            assert one.bus_stats()["nodes"]

    run(main())


# -- the command ----------------------------------------------------------------------------------------------------


@contextlib.asynccontextmanager
async def command(*options: str) -> AsyncIterator[tuple[asyncio.subprocess.Process, dict[str, str]]]:
    """Start `fieldtwin can-bus` and return the addresses that it prints."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "fieldtwin", "can-bus", "--listen", "127.0.0.1:0", *options),
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        assert process.stderr is not None
        told = {}
        while "CAN bus" not in told or ("--slcan" in options and "slcan" not in told):
            line = (await asyncio.wait_for(process.stderr.readline(), 60)).decode()
            assert line, "it ended"
            if match := re.match(r"(CAN bus|slcan) on (?:can:fieldtwin/)?(\S+?),?(?: |$)", line.strip() + " "):
                told[match[1]] = match[2]
        yield process, told
    finally:
        if process.returncode is None:
            process.kill()
        await process.communicate()


def test_the_command_serves_python_can_by_both_of_its_interfaces() -> None:
    def program(told: dict[str, str]) -> list[str]:
        with (
            SoftBus(told["CAN bus"], bitrate=500_000) as one,
            can.Bus(
                interface="slcan",
                channel=f"socket://{told['slcan']}",
                bitrate=500_000,
                sleep_after_open=0,
                ignore_config=True,
            ) as other,
        ):
            assert other.get_version(5.0) == (10, 13)  # type: ignore[attr-defined] # its channel is open from here on
            heard = []
            for sender, receiver in ((one, other), (other, one)):
                sender.send(can.Message(arbitration_id=0x123, data=b"\x01", is_extended_id=False), 5.0)
                message = receiver.recv(5.0)
                heard.append(str(message and message.data.hex()))
            return heard

    async def main() -> None:
        async with command("--bitrate", "500000", "--slcan", "127.0.0.1:0", "--strict-ack") as (process, told):
            assert await asyncio.to_thread(program, told) == ["01", "01"]
            process.send_signal(signal.SIGINT)
            _, rest = await process.communicate()
            assert process.returncode == 0
            assert b"2 frames" in rest

    run(main(), 40)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--slcan", "nowhere"], "nowhere"),
        (["--bridge", "no-such-0"], "no-such-0"),
        (["--bitrate", "5"], "--bitrate"),
    ],
)
def test_the_command_refuses_in_one_line(options: list[str], said: str) -> None:
    async def main() -> None:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "fieldtwin", "can-bus", "--listen", "127.0.0.1:0", *options),
            stderr=asyncio.subprocess.PIPE,
        )
        _, told = await asyncio.wait_for(process.communicate(), 15)
        assert process.returncode not in (0, None)
        assert said in told.decode()
        assert "Traceback" not in told.decode()

    run(main(), 30)


# -- a real kernel --------------------------------------------------------------------------------------------------


def has_socketcan() -> bool:
    try:
        socket.socket(socket.PF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (OSError, AttributeError):
        return False
    return True


@pytest.fixture
def kernel_can() -> None:
    if not has_socketcan():
        pytest.skip("this kernel has no SocketCAN: scripts/test-vcan")


@pytest.mark.socketcan
@pytest.mark.usefixtures("kernel_can")
class TestVcan:
    def test_the_command_joins_vcan0_in_both_directions_without_loops(self) -> None:
        async def main() -> None:
            async with command("--bitrate", "1000000", "--bridge", "vcan0") as (process, told):
                soft = await open_can_end(Endpoint.parse(f"can:fieldtwin/{told['CAN bus']}"), 0)
                kernel = await SocketCanConnection.open(VCAN0, 0)
                for sender, receiver in ((soft, kernel), (kernel, soft)):
                    for frame in KINDS:
                        await sender.send(frame)
                    assert [(await receiver.recv()).key() for _ in KINDS] == [f.key() for f in KINDS]
                    await cross(sender, receiver, 1000)
                assert not soft.inbound.data_stream
                assert not kernel.inbound.data_stream
                for end in (soft, kernel):
                    await end.aclose()
                process.send_signal(signal.SIGTERM)
                _, rest = await process.communicate()
                assert process.returncode == 0
                assert b"0 lost" in rest
                assert rest.count(b"1004 from") == 2

        run(main(), 120)

    @pytest.mark.skipif(shutil.which("candump") is None, reason="needs can-utils")
    def test_candump_and_cangen_on_the_other_side(self, tmp_path: Path) -> None:
        async def main() -> None:
            async with command("--bitrate", "1000000", "--bridge", "vcan0") as (_, told):
                soft = await open_can_end(Endpoint.parse(f"can:fieldtwin/{told['CAN bus']}"), 0)
                dump = await asyncio.create_subprocess_exec(
                    *("candump", "-L", "-n", "200", "vcan0"), stdout=asyncio.subprocess.PIPE
                )
                await asyncio.sleep(1)  # candump does not indicate when it is ready
                for i in range(200):
                    await soft.send(CanFrame(0x181, i.to_bytes(2)))
                out, _ = await asyncio.wait_for(dump.communicate(), 60)
                assert [line.split()[2] for line in out.decode().splitlines()] == [f"181#{i:04X}" for i in range(200)]
                gen = await asyncio.create_subprocess_exec(
                    *("cangen", "vcan0", "-g", "2", "-n", "200", "-I", "201", "-L", "4", "-D", "i"),
                )
                got = [await soft.recv() for _ in range(200)]
                assert await asyncio.wait_for(gen.wait(), 60) == 0
                assert {f.can_id for f in got} == {0x201}
                assert [f.data[0] for f in got] == list(range(200))
                await soft.aclose()

        run(main(), 200)

    @pytest.mark.skipif(not (shutil.which("slcand") and shutil.which("socat")), reason="needs can-utils and socat")
    def test_slcand_makes_an_interface_of_the_slcan_port(self, tmp_path: Path) -> None:
        async def main() -> None:
            async with command("--bitrate", "1000000", "--slcan", "127.0.0.1:0") as (_, told):
                soft = await open_can_end(Endpoint.parse(f"can:fieldtwin/{told['CAN bus']}"), 0)
                link = tmp_path / "tty"
                socat = await asyncio.create_subprocess_exec(
                    "socat", f"pty,raw,echo=0,link={link}", f"tcp:{told['slcan']},nodelay"
                )
                await eventually(link.exists, 20)
                slcand = await asyncio.create_subprocess_exec(
                    "slcand", "-F", "-o", "-c", "-s8", link.readlink(), "slcan9"
                )
                await eventually(lambda: Path("/sys/class/net/slcan9").exists(), 20)
                up = await asyncio.create_subprocess_exec("ip", "link", "set", "slcan9", "up")
                assert await up.wait() == 0
                kernel = await SocketCanConnection.open(Endpoint.parse("can:socketcan/slcan9"), 0)
                for sender, receiver in ((soft, kernel), (kernel, soft)):
                    for frame in KINDS:
                        await sender.send(frame)
                    assert [(await receiver.recv()).key() for _ in KINDS] == [f.key() for f in KINDS]
                    await cross(sender, receiver, 200, ahead=5)
                for end in (soft, kernel):
                    await end.aclose()
                slcand.terminate()
                await slcand.wait()
                socat.terminate()
                await socat.wait()

        run(main(), 120)
