"""Replayed old commands, and acknowledgements of events that never arrived: each command is obeyed once, no event is lost.

Recorded frames are sent again to a plant over TCP, in one session and after its restart. An event confirmed by a forged
acknowledgement is sent to the next follower that does not have it.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest
from local_mosquitto import broker
from support import eventually, run
from test_thread_carriers import modems, until_equal, virtually
from test_thread_mqtt import edge, host
from thread_rig import SCHEMA, Twin, WatchedCarrier, equal, value

from fieldtwin.emulators.endpoints.memory_ports import MemoryNet
from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.connections.sockets.listeners import TcpListener
from fieldtwin.gateway.connections.sockets.tcp import TcpConnection
from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Unreachable
from fieldtwin.gateway.store.event import Event, Kind
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.twin.model.mape.execute import CommandLimits
from fieldtwin.twin.plant.command_gate import OLD_MS, CommandGate
from fieldtwin.twin.thread import tcp as thread_tcp
from fieldtwin.twin.thread.frames import Ack, Data, Frame, Hello, tag_of
from fieldtwin.twin.thread.link import Carrier, Link
from fieldtwin.twin.thread.tcp import TcpDialler, TcpListening

CLOCK = WallClock()
Settled = Callable[[Twin, Twin], Awaitable[None]]


def command(n: int) -> Event:
    return Event(0, 1_790_000_000_000 + n, Kind.COMMAND, "shore", bytes([0, n]))


class Place:
    """The plant's endpoint: a port that is the same after its restart."""

    def __init__(self) -> None:
        self.listening: TcpListening | None = None
        self.address = Endpoint.parse("tcp://127.0.0.1:0")

    async def open(self) -> TcpListening:
        self.listening = await TcpListening.start(self.address, TcpListener.open, [SCHEMA])
        self.address = self.listening.bound
        return self.listening

    def dialler(self) -> TcpDialler:
        return TcpDialler(self.address, OsConnector(), [SCHEMA])


async def started(place: Place, folder: Path) -> Twin:
    listening = await place.open()
    plant = Twin("plant", folder, CLOCK, lambda: listening)
    await plant.start()
    return plant


async def heard_for(link: Link, condition: Callable[[Frame], bool]) -> Frame:
    async with asyncio.timeout(10):
        while True:
            frame = await link.receive()
            if condition(frame):
                return frame


def really(main: Callable[[], Coroutine[Any, Any, None]]) -> None:
    run(main(), 40)


def test_commands_that_are_sent_again_are_obeyed_once_also_after_a_restart(tmp_path: Path) -> None:
    async def main() -> None:
        place, sent = Place(), list[Frame]()
        plant = await started(place, tmp_path)
        shore = Twin("shore", tmp_path, CLOCK, lambda: WatchedCarrier(place.dialler(), sent))
        await shore.start()
        for n in range(1, 6):
            await shore.log(command(n))
        await eventually(lambda: equal(plant, shore))
        wanted = [bytes([0, n]) for n in range(1, 6)]
        assert [event.value for event in plant.arrived] == wanted
        await shore.kill()
        recorded = [frame for frame in sent if isinstance(frame, Hello | Data)]
        assert any(isinstance(frame, Data) for frame in recorded)

        async def again() -> None:
            link = await place.dialler().open()
            for _ in range(20):
                for frame in recorded:
                    await link.send(frame)
            await heard_for(link, lambda frame: isinstance(frame, Ack) and frame.through == 5)
            await link.aclose()

        await again()
        assert [event.value for event in plant.arrived] == wanted
        assert plant.end.into.duplicates > 0
        assert [event.value for event in await plant.all_of(shore.origin)] == wanted
        await plant.kill()
        plant = await started(place, tmp_path)  # it knows only the content of its store
        await again()
        assert plant.arrived == []
        await plant.kill()

    really(main)


class Repeating(WatchedCarrier):
    """A carrier that sends everything it ever sent three times again whenever a link is opened."""

    def __init__(self, carrier: Carrier, sent: list[Frame]) -> None:
        super().__init__(carrier, sent)
        self._old = list(sent)

    async def open(self) -> Link:
        link = await super().open()
        for frame in 3 * self._old:
            await link.send(frame)
        return link


async def repeated_commands_are_obeyed_once(
    folder: Path, clock: Clock, near: Callable[[], Carrier], far: Callable[[], Carrier], settled: Settled
) -> None:
    sent: list[Frame] = []
    plant = Twin("plant", folder, clock, near)
    shore = Twin("shore", folder, clock, lambda: Repeating(far(), sent))
    await shore.start()
    await plant.start()
    for n in range(1, 4):
        await shore.log(command(n))
        await settled(plant, shore)
        await shore.kill()
        await shore.start()
        if n == 2:
            await plant.kill()
            await plant.start()
    await plant.log(value(1))
    await settled(plant, shore)
    assert len(sent) > 10
    assert [event.value for event in plant.arrived] == [bytes([0, n]) for n in range(1, 4)]
    await plant.kill()
    await shore.kill()


def test_commands_that_are_sent_again_over_modems_are_obeyed_once(tmp_path: Path) -> None:
    async def main(loop: VirtualLoop, clock: VirtualClock, net: MemoryNet) -> None:
        async def settled(one: Twin, other: Twin) -> None:
            await until_equal(one, other, 600, loop)

        async with modems(net, clock, 3) as (near, far):
            await repeated_commands_are_obeyed_once(tmp_path, clock, near, far, settled)

    virtually(main)


@pytest.mark.interop
def test_commands_that_are_sent_again_over_a_broker_are_obeyed_once(tmp_path: Path) -> None:
    async def settled(one: Twin, other: Twin) -> None:
        await eventually(lambda: equal(one, other), 20)

    async def main() -> None:
        with broker(tmp_path) as here:
            await repeated_commands_are_obeyed_once(tmp_path, CLOCK, lambda: edge(here), lambda: host(here), settled)

    really(main)


@pytest.mark.parametrize("through", [40, 41, 1 << 40], ids=["all of it", "one too many", "far too many"])
def test_a_forged_acknowledgement_loses_nothing_for_the_next_follower(tmp_path: Path, through: int) -> None:
    async def main() -> None:
        place = Place()
        plant = await started(place, tmp_path)
        await plant.log(*(value(n) for n in range(40)))
        link = await place.dialler().open()
        hello = await heard_for(link, lambda frame: isinstance(frame, Hello))
        assert isinstance(hello, Hello)
        await link.send(Ack(tag_of(hello.origin, hello.schema), through, ()))
        await link.send(Ack(tag_of(hello.origin, hello.schema), 0, ((through - 1, 1),)))
        await eventually(lambda: plant.end.waiting == 0 if through == 40 else "backup" in plant.end.trouble)
        await link.aclose()
        assert await plant.store.span(plant.origin) == (1, 40)
        shore = Twin("shore", tmp_path, CLOCK, place.dialler)
        await shore.start()
        await plant.log(value(40))
        await eventually(lambda: equal(plant, shore), 20)
        assert [event.sequence for event in shore.arrived] == list(range(1, 42))
        await shore.kill()
        await plant.kill()

    really(main)


def test_a_follower_that_drips_gives_its_place_up_to_an_honest_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One byte of a frame at a time, and never a complete frame."""
    monkeypatch.setattr(thread_tcp, "SAYS_WITHIN_S", 0.2)
    monkeypatch.setattr(thread_tcp, "ANSWERS_WITHIN_S", 0.3)

    async def main() -> None:
        place = Place()
        plant = await started(place, tmp_path)
        hostile = await TcpConnection.open(place.address)

        async def drip() -> None:
            with contextlib.suppress(Unreachable):
                await hostile.write((8000).to_bytes(2))
                while True:
                    await hostile.write(b"\1")
                    await asyncio.sleep(0.05)

        dripping = asyncio.ensure_future(drip())
        await eventually(lambda: plant.end.connected)  # a silent unknown client is treated as a follower
        shore = Twin("shore", tmp_path, CLOCK, place.dialler)
        await shore.start()
        await plant.log(*(value(n) for n in range(10)))
        await eventually(lambda: equal(plant, shore), 15)
        await shore.kill()
        await plant.kill()
        dripping.cancel()
        await asyncio.gather(dripping, return_exceptions=True)
        await hostile.aclose()

    really(main)


def test_a_command_with_a_time_in_the_far_future_is_refused() -> None:
    """The plant's age limit protects a plant whose store was lost; a forged time would defeat it."""
    now_ms = CLOCK.utc_ns() // 1_000_000
    gate = CommandGate(remote=True, bounds=CommandLimits(), clock=CLOCK)
    ahead = Event(1, now_ms + OLD_MS + 60_000, Kind.COMMAND, "shore", bytes(2))
    assert gate.admit("twin:x", ahead) is None
    assert gate.admit("twin:x", Event(2, now_ms + 60_000, Kind.COMMAND, "shore", bytes(2))) is not None
    assert (gate.taken, gate.refused) == (1, 1)
