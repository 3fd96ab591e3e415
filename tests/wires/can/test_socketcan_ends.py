"""Kernel CAN: the plant's end and the emulators' end on vcan0, and on an slcan interface made of a pty.

The slcan interface has two properties that a virtual one lacks: a bit rate, and a transmit queue that fills up.
"""

from __future__ import annotations

import asyncio
import fcntl
import os
import pty
import select
import shutil
import socket
import struct
import subprocess
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager

import can
import pytest
from support import eventually, run

from fieldtwin.emulators.endpoints.can.software_end import open_can_end
from fieldtwin.gateway.connections.can.socketcan import SocketCanConnection
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, Unreachable, UsageError, WireError

VCAN0, VCAN1 = Endpoint.parse("can:socketcan/vcan0"), Endpoint.parse("can:socketcan/vcan1")
N_SLCAN = 17


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


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, timeout=20)


@pytest.mark.skipif(has_socketcan(), reason="this kernel has SocketCAN")
def test_a_kernel_without_socketcan_is_unreachable_with_a_remedy() -> None:
    async def main() -> None:
        with pytest.raises(Unreachable, match=r"can:socketcan/vcan0: .*no SocketCAN.*can:fieldtwin/HOST:PORT"):
            await SocketCanConnection.open(VCAN0, 125_000)
        with pytest.raises(Unreachable, match="can:socketcan/vcan0"):
            await open_can_end(VCAN0, 125_000)

    run(main())


def test_another_kind_of_endpoint_is_refused() -> None:
    async def main() -> None:
        with pytest.raises(UsageError):
            await SocketCanConnection.open(Endpoint.parse("can:fieldtwin/127.0.0.1:1"), 125_000)

    run(main())


@pytest.mark.socketcan
@pytest.mark.usefixtures("kernel_can")
class TestVcan:
    def test_every_kind_of_frame_in_both_directions(self) -> None:
        frames = [
            CanFrame(0x000),
            CanFrame(0x7FF, bytes(range(8))),
            CanFrame(0x605, remote=True, dlc=8),
            CanFrame(0x1FFFFFFF, b"\xff", extended=True),
        ]

        async def main() -> None:
            loop = asyncio.get_running_loop()
            ours, theirs = await SocketCanConnection.open(VCAN0, 125_000), await open_can_end(VCAN0, 125_000)
            for sender, receiver in ((ours, theirs), (theirs, ours)):
                before_ns = loop.time() * 1e9
                for frame in frames:
                    await sender.send(frame)
                got = [await receiver.recv() for _ in frames]
                assert [f.key() for f in got] == [f.key() for f in frames]
                for frame in got:
                    assert before_ns - 50e6 <= frame.t_ns <= loop.time() * 1e9 + 50e6
                assert not sender.inbound.data_stream, "a node does not receive its own frames"
            for end in (ours, theirs):
                await end.aclose()
                await end.aclose()
                with pytest.raises(ConnectionLost):
                    await end.recv()
                with pytest.raises(ConnectionLost):
                    await end.send(CanFrame(1))

        run(main())

    def test_a_burst_arrives_whole_and_in_order(self) -> None:
        async def main() -> None:
            ours, theirs = await SocketCanConnection.open(VCAN0, 0), await open_can_end(VCAN0, 0)
            for i in range(2000):
                await theirs.send(CanFrame(0x181, i.to_bytes(2)))
                await asyncio.sleep(0)
            assert [int.from_bytes((await ours.recv()).data) for _ in range(2000)] == list(range(2000))
            assert (ours.overruns, ours.malformed) == (0, 0)
            await ours.aclose()
            await theirs.aclose()

        run(main(), timeout_s=50)

    def test_error_frames_are_received_as_such(self) -> None:
        async def main() -> None:
            ours = await SocketCanConnection.open(VCAN0, 125_000)
            with can.Bus(interface="socketcan", channel="vcan0", ignore_config=True) as bus:
                bus.send(can.Message(arbitration_id=0x40, is_error_frame=True, is_extended_id=False, data=bytes(8)))
                frame = await ours.recv()
            assert (frame.error, frame.can_id, frame.dlc) == (True, 0x40, 8)  # 40h: bus-off (linux/can/error.h)
            with pytest.raises(UsageError):
                await ours.send(frame)
            await ours.aclose()

        run(main())

    @pytest.mark.skipif(not shutil.which("candump"), reason="can-utils are not installed")
    def test_cansend_and_candump_agree(self) -> None:
        async def main() -> None:
            ours = await SocketCanConnection.open(VCAN0, 125_000)
            sent = await asyncio.create_subprocess_exec("cansend", "vcan0", "585#4300100091010F00")
            assert await sent.wait() == 0
            assert str(await ours.recv()) == "585#4300100091010F00"
            dump = await asyncio.create_subprocess_exec("candump", "-L", "-n", "1", "vcan0,605:7FF", stdout=-1)
            assert dump.stdout is not None
            line = asyncio.create_task(dump.stdout.readline())
            while not line.done():  # it listens at some time after its start
                await ours.send(CanFrame(0x605, b"\x40\x00\x10\x00\0\0\0\0"))
                await asyncio.wait([line], timeout=0.2)
            assert line.result().split()[-1] == b"605#4000100000000000"
            await dump.wait()
            await ours.aclose()

        run(main(), timeout_s=50)

    def test_interface_missing_down_or_no_can(self) -> None:
        async def main() -> None:
            for opener in (SocketCanConnection.open, open_can_end):
                with pytest.raises(Unreachable, match=r"can:socketcan/nosuch0.*no interface"):
                    await opener(Endpoint.parse("can:socketcan/nosuch0"), 125_000)
                with pytest.raises(Unreachable, match="not a CAN interface"):
                    await opener(Endpoint.parse("can:socketcan/lo"), 125_000)
                ip("link", "set", "vcan1", "down")
                try:
                    with pytest.raises(Unreachable, match=r"vcan1 is down.*ip link set vcan1 up"):
                        await opener(VCAN1, 125_000)
                finally:
                    ip("link", "set", "vcan1", "up")

        run(main())

    @pytest.mark.parametrize("opener", [SocketCanConnection.open, open_can_end])
    def test_the_interface_going_down_is_a_lost_connection(self, opener) -> None:  # type: ignore[no-untyped-def]
        async def main() -> None:
            end = await opener(VCAN1, 125_000)
            reading = asyncio.create_task(end.recv())
            await asyncio.sleep(0)
            ip("link", "set", "vcan1", "down")
            try:
                with pytest.raises(ConnectionLost):
                    await reading
                with pytest.raises(ConnectionLost):
                    await end.send(CanFrame(1))
            finally:
                ip("link", "set", "vcan1", "up")
            await end.aclose()
            again = await opener(VCAN1, 125_000)
            await again.send(CanFrame(1))
            await again.aclose()

        run(main())


@contextmanager
def slcan(bitrate: int) -> Iterator[tuple[str, int]]:
    """An slcan interface on a pty: its name, and the pty's master side, which represents the adapter."""
    master, slave = pty.openpty()
    try:
        tty.setraw(slave)
        before = {name for _, name in socket.if_nameindex()}
        fcntl.ioctl(slave, termios.TIOCSETD, struct.pack("i", N_SLCAN))
        (name,) = {name for _, name in socket.if_nameindex()} - before
        ip("link", "set", name, "type", "can", "bitrate", str(bitrate))
        ip("link", "set", name, "txqueuelen", "10")
        os.set_blocking(master, False)
        # The driver sends the adapter the bit rate and waits until that is read: the pty wakes a writer only then.
        with subprocess.Popen(["ip", "link", "set", name, "up"]) as bringing_up:
            while bringing_up.poll() is None:
                if select.select([master], [], [], 0.05)[0]:
                    os.read(master, 4096)
        assert bringing_up.returncode == 0
        yield name, master
    finally:
        os.close(slave)  # takes the interface with it
        os.close(master)


@pytest.mark.socketcan
@pytest.mark.usefixtures("kernel_can")
class TestSlcan:
    def test_the_kernels_bit_rate_is_checked(self) -> None:
        async def main() -> None:
            with slcan(250_000) as (name, _):
                endpoint = Endpoint.parse(f"can:socketcan/{name}")
                with pytest.raises(UsageError, match="expected 125000 bit/s; got 250000 bit/s"):
                    await SocketCanConnection.open(endpoint, 125_000)
                end = await SocketCanConnection.open(endpoint, 250_000)
                await end.aclose()

        run(main())

    @pytest.mark.parametrize("opener", [SocketCanConnection.open, open_can_end])
    def test_a_full_transmit_queue_backs_off_and_loses_nothing(self, opener) -> None:  # type: ignore[no-untyped-def]
        async def main() -> None:
            loop = asyncio.get_running_loop()
            with slcan(125_000) as (name, master):
                end = await opener(Endpoint.parse(f"can:socketcan/{name}"), 125_000)
                count, sent = 300, 0

                async def send_all() -> None:
                    nonlocal sent
                    for i in range(count):
                        await end.send(CanFrame(0x100, i.to_bytes(8)))
                        sent = i + 1

                sending = asyncio.create_task(send_all())
                stuck_at = -1
                while stuck_at != sent or sent == 0:  # the adapter's side is not read, so it must block
                    stuck_at = sent
                    await asyncio.sleep(0.3)
                assert 0 < sent < count
                got = bytearray()
                loop.add_reader(master, lambda: got.extend(os.read(master, 65536)))
                await sending
                await eventually(lambda: got.count(b"t100") == count, within_s=20)
                loop.remove_reader(master)
                lines = [line for line in bytes(got).split(b"\r") if line.startswith(b"t100")]
                assert lines == [b"t1008" + i.to_bytes(8).hex().upper().encode() for i in range(count)]
                await end.aclose()

        run(main(), timeout_s=55)

    def test_a_queue_that_stays_full_is_an_error_and_the_connection_lives_on(self) -> None:
        async def main() -> None:
            with slcan(125_000) as (name, master):
                end = await SocketCanConnection.open(Endpoint.parse(f"can:socketcan/{name}"), 125_000)

                async def flood() -> None:
                    for i in range(100_000):
                        await end.send(CanFrame(0x100, i.to_bytes(8)))

                with pytest.raises(WireError, match="stayed full"):
                    await flood()
                assert end.tx_retries > 10
                asyncio.get_running_loop().add_reader(master, lambda: os.read(master, 65536))
                await end.send(CanFrame(0x100))
                asyncio.get_running_loop().remove_reader(master)
                await end.aclose()

        run(main(), timeout_s=50)
