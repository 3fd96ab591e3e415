"""Two clients that follow one thread over TCP: the first keeps it as long as it answers, and the second gets a message."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable, Coroutine
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from thread_rig import SCHEMA, Twin, equal, value

from fieldtwin.emulators.endpoints.memory_ports import MemoryNet
from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.emulators.virtual.seal import sealed
from fieldtwin.gateway.core.connection import ByteConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Unreachable
from fieldtwin.twin.thread.link import Unwelcome
from fieldtwin.twin.thread.tcp import ANSWERS_WITHIN_S, LET_IN_WITHIN_S, TcpDialler, TcpListening

PORTS = itertools.count(7000)


class Place:
    """A plant that is followed at `at`, in virtual time."""

    def __init__(self, folder: Path, clock: VirtualClock, net: MemoryNet) -> None:
        self.at = Endpoint.parse(f"tcp://127.0.0.1:{next(PORTS)}")
        self.listening: TcpListening
        self.net = net
        self._folder, self._clock = folder, clock

    async def start(self) -> None:
        self.listening = await TcpListening.start(self.at, self.net.listen_for_clients, [SCHEMA])
        self.plant = Twin("plant", self._folder, self._clock, lambda: self.listening)
        await self.plant.start()
        await self.plant.log(*(value(n) for n in range(20)))

    def follower(self, name: str) -> Twin:
        return Twin(name, self._folder, self._clock, lambda: TcpDialler(self.at, self.net, [SCHEMA]))

    async def all_there(self, follower: Twin) -> None:
        async with asyncio.timeout(60):
            while not await equal(self.plant, follower):
                await asyncio.sleep(0.1)


def played(tmp_path: Path, main: Callable[[Place], Coroutine[Any, Any, None]]) -> None:
    async def whole() -> None:
        place = Place(tmp_path, VirtualClock(loop), MemoryNet(loop))
        await place.start()
        await main(place)
        await place.plant.kill()

    loop = VirtualLoop()
    try:
        with sealed():
            loop.run_until_complete(whole())
    finally:
        loop.close()


def test_the_second_is_refused_while_the_first_answers_and_accepted_when_it_left(tmp_path: Path) -> None:
    async def main(place: Place) -> None:
        first, second = place.follower("first"), place.follower("second")
        await first.start()
        await place.all_there(first)
        await second.start()
        await asyncio.sleep(30)
        assert second.end.links == 0
        assert "another shadow or twin already follows this thread: " in second.end.trouble
        assert place.listening.refused >= 2, "it comes again: perhaps the first one went"
        assert (first.end.links, first.end.trouble) == (1, ""), "nobody took its place"
        await place.plant.log(value(20))
        await place.all_there(first)
        await first.kill()
        await place.all_there(second)
        assert second.end.trouble == ""
        await second.kill()

    played(tmp_path, main)


def test_a_follower_whose_link_was_lost_regains_its_place_immediately(tmp_path: Path) -> None:
    """Its old connection still exists, half open: it does not answer, and no request is sent on it."""

    async def main(place: Place) -> None:
        dialler = TcpDialler(place.at, place.net, [SCHEMA])
        old = await dialler.open()
        await asyncio.sleep(1)
        began = asyncio.get_running_loop().time()
        new = await dialler.open()
        assert asyncio.get_running_loop().time() - began < 0.1
        assert place.listening.refused == 0
        for link in (old, new):
            await link.aclose()

    played(tmp_path, main)


def test_one_that_does_not_answer_any_more_gives_its_place_up(tmp_path: Path) -> None:
    async def main(place: Place) -> None:
        dead = await TcpDialler(place.at, place.net, [SCHEMA]).open()  # no client reads the received data
        await asyncio.sleep(1)
        began = asyncio.get_running_loop().time()
        second = place.follower("second")
        await second.start()
        await place.all_there(second)
        assert ANSWERS_WITHIN_S <= asyncio.get_running_loop().time() - began < ANSWERS_WITHIN_S + 3
        assert place.listening.refused == 0
        await dead.aclose()
        await second.kill()

    played(tmp_path, main)


def test_a_silent_unknown_client_takes_no_place(tmp_path: Path) -> None:
    async def main(place: Place) -> None:
        first = place.follower("first")
        await first.start()
        await place.all_there(first)
        stranger: ByteConnection = await place.net.open_bytes(place.at)
        await asyncio.sleep(10)
        assert first.end.links == 1
        assert stranger.lost is not None
        await stranger.aclose()
        await first.kill()

    played(tmp_path, main)


def test_a_follower_that_need_not_wait_ends_with_the_reason(tmp_path: Path) -> None:
    async def main(place: Place) -> None:
        first = place.follower("first")
        await first.start()
        await place.all_there(first)
        with pytest.raises(Unwelcome, match=r"already follows this thread: .*stop it first, or use a broker"):
            await TcpDialler(place.at, place.net, [SCHEMA]).open()
        await first.kill()

    played(tmp_path, main)


def test_a_silent_listener_counts_as_one_nevertheless(tmp_path: Path) -> None:
    """Messages may be lost on a bad link, like frames."""

    async def main(place: Place) -> None:
        async def silent(client: Any) -> None:
            with suppress(Unreachable):
                while True:
                    await client.read()

        at = Endpoint.parse(f"tcp://127.0.0.1:{next(PORTS)}")
        listener = await place.net.listen_for_clients(at, silent, 1, lambda address: True, 0.0)
        began = asyncio.get_running_loop().time()
        link = await TcpDialler(at, place.net, [SCHEMA]).open()
        assert asyncio.get_running_loop().time() - began == pytest.approx(LET_IN_WITHIN_S)
        await link.aclose()
        await listener.aclose()

    played(tmp_path, main)
