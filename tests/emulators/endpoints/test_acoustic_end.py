"""The acoustic channel between processes: served on a socket, with a modem's end in a different process, here in this one."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from support import eventually, run

from fieldtwin.emulators.endpoints.acoustic_end import ROOM, AcousticEnd, AcousticServer
from fieldtwin.emulators.wires.acoustic import AcousticMedium, AcousticProperties
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.errors import Unreachable
from fieldtwin.gateway.wallclock import WallClock

PLACES = {"a": (0.0, 0.0), "b": (15.0, 0.0)}
WATER = AcousticProperties(range_m=100.0, bytes_per_s=10_000.0)


def test_each_end_receives_the_messages_of_the_other(tmp_path: Path) -> None:
    async def main() -> None:
        clock = WallClock()
        medium = AcousticMedium(WATER, PLACES, 1)
        server = AcousticServer(medium, clock)
        await server.open(tmp_path / "w")
        async with Nursery() as nursery:
            nursery.start(server.run(), "water")
            a, b = await AcousticEnd.open(tmp_path / "w", "a"), await AcousticEnd.open(tmp_path / "w", "b")
            said = [bytes([n]) * 12 for n in range(20)]
            for payload in said:
                await eventually(lambda payload=payload: a.submit(payload, 0))
            heard: list[bytes] = []

            def all_heard() -> bool:
                while (payload := b.arrived(0)) is not None:
                    heard.append(payload)
                return len(heard) == len(said)

            await eventually(all_heard)
            assert heard == said
            assert (a.sent, b.delivered) == (20, 20)
            medium.transmit("b", b"ahoy", clock.monotonic_ns())  # an end in this process: the server wakes up for it
            await eventually(lambda: a.arrived(0) == b"ahoy")
            await server.aclose()
            await eventually(lambda: not a.submit(b"x", 0))  # no client takes it any more; nothing breaks
            assert a.arrived(0) is None
            await a.aclose()
            await b.aclose()

    run(main())


def test_a_modem_delivers_a_limited_number_of_bytes(tmp_path: Path) -> None:
    async def main() -> None:
        server = AcousticServer(AcousticMedium(WATER, PLACES, 1), WallClock())
        await server.open(tmp_path / "w")  # and no task runs it
        a = await AcousticEnd.open(tmp_path / "w", "a")
        assert [a.submit(b"x", 0) for _ in range(ROOM + 1)] == [True] * ROOM + [False]
        await a.aclose()
        await server.aclose()

    run(main())


@pytest.mark.parametrize("first", [b"M\x00\x01z", b"S\x00\x01x", b"M\xff\xff"])
def test_a_client_without_a_place_in_the_channel_is_disconnected(tmp_path: Path, first: bytes) -> None:
    async def main() -> None:
        server = AcousticServer(AcousticMedium(WATER, PLACES, 1), WallClock())
        await server.open(tmp_path / "w")
        reader, writer = await asyncio.open_unix_connection(tmp_path / "w")
        writer.write(first)
        assert await reader.read() == b""
        writer.close()
        with pytest.raises(Unreachable, match="z is not on the acoustic channel"):
            await AcousticEnd.open(tmp_path / "w", "z")
        await server.aclose()
        with pytest.raises(Unreachable):
            await AcousticEnd.open(tmp_path / "w", "a")

    run(main())
