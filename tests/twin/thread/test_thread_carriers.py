"""Threads over their carriers: the modems of the reference system and TCP, in virtual time with a bad link and sudden deaths."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Coroutine
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support import eventually
from support import run as run_really
from thread_rig import SCHEMA, ShakyCarrier, Twin, WatchedCarrier, equal, value

from fieldtwin.emulators.endpoints.memory_ports import MemoryNet
from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.emulators.virtual.seal import sealed
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.connections.sockets.listeners import TcpListener
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Unreachable
from fieldtwin.gateway.devices.config import BusConfig, DeviceConfig
from fieldtwin.gateway.store.event import Event, Kind
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.prototype.prototype import DigitalTwinPrototype
from fieldtwin.twin.site.system import load_system
from fieldtwin.twin.thread.frames import Ack, Ask, Frame, Refused, Schema
from fieldtwin.twin.thread.link import Carrier
from fieldtwin.twin.thread.modem import ModemCarrier
from fieldtwin.twin.thread.tcp import TcpDialler, TcpListening

ADDRESS = Endpoint.parse("tcp://127.0.0.1:7000")


def virtually(main: Callable[[VirtualLoop, VirtualClock, MemoryNet], Coroutine[Any, Any, None]]) -> None:
    loop = VirtualLoop()
    try:
        with sealed():
            loop.run_until_complete(main(loop, VirtualClock(loop), MemoryNet(loop)))
    finally:
        loop.close()


async def until_equal(one: Twin, other: Twin, within_s: float, loop: VirtualLoop) -> float:
    began = loop.time()
    while not await equal(one, other):
        assert loop.time() - began < within_s, (one.end.status(), other.end.status())
        await asyncio.sleep(0.25)
    return loop.time() - began


class LateListening(Carrier):
    """Call `TcpListening.start` when the first link is requested."""

    name = "listening"

    def __init__(self, net: MemoryNet) -> None:
        self._net = net
        self._real: TcpListening | None = None

    async def open(self) -> Any:
        if self._real is None:
            self._real = await TcpListening.start(ADDRESS, self._net.listen_for_clients, [SCHEMA])
        return await self._real.open()

    async def aclose(self) -> None:
        if self._real is not None:
            await self._real.aclose()


def over_tcp(net: MemoryNet, seed: int) -> tuple[Callable[[], Carrier], Callable[[], Carrier]]:
    return (
        lambda: ShakyCarrier(LateListening(net), seed),
        lambda: ShakyCarrier(TcpDialler(ADDRESS, net, [SCHEMA]), seed + 1),
    )


@pytest.mark.parametrize("seed", range(3))
def test_over_tcp_with_loss_repeats_reordering_and_deaths_both_logs_are_equal(tmp_path: Path, seed: int) -> None:
    async def main(loop: VirtualLoop, clock: VirtualClock, net: MemoryNet) -> None:
        chance = random.Random(seed)
        plant_carrier, shore_carrier = over_tcp(net, seed)
        plant = Twin("plant", tmp_path, clock, plant_carrier)
        shore = Twin("shore", tmp_path, clock, shore_carrier)
        await plant.start()
        await shore.start()
        for n in range(60):
            await plant.log(*(value(10 * n + i) for i in range(chance.randrange(25))))
            if n % 6 == 0:
                await shore.log(Event(0, n, Kind.COMMAND, "shore", bytes([0, n % 5])))
            await asyncio.sleep(chance.random())
            if chance.random() < 0.12:
                dying = chance.choice([plant, shore])
                await dying.kill()
                await asyncio.sleep(chance.random() * 5)
                await dying.start()
        await until_equal(plant, shore, 600, loop)
        commands = [e.value for e in plant.arrived]
        assert len({e.sequence for e in plant.arrived}) == len(commands), "nothing is told twice"
        assert [e.sequence for e in plant.arrived] == sorted(e.sequence for e in plant.arrived)
        await plant.kill()
        await shore.kill()

    virtually(main)


SYSTEM = Path(__file__).resolve().parents[3] / "profiles" / "systems" / "observatory.yaml"


@asynccontextmanager
async def modems(net: MemoryNet, clock: VirtualClock, seed: int, **worse: float) -> Any:
    """The observatory's modems and their link in memory; carriers for both ends. `worse`: changes to `far_link`."""
    system = load_system(str(SYSTEM))
    prototype = replace(load_prototype(system), seed=seed)
    modem = prototype.devices["modem"]
    form = modem.form.model_copy(update={"far_link": modem.form.far_link.model_copy(update=worse)})
    prototype = replace(prototype, devices={**prototype.devices, "modem": replace(modem, form=form)})
    field = DigitalTwinPrototype(system, prototype, clock).field(Path("virtual"), net)
    await field.open()
    async with Nursery() as nursery:
        nursery.start(field.run(), "field")

        def at(name: str, endpoint: Endpoint) -> ModemCarrier:
            config = system.devices["modem"]
            device = DeviceConfig(name, config.profile, name, config.address, {"inbox": 200})
            return ModemCarrier(device, BusConfig(name, endpoint, 2.0, 1), net, clock, [SCHEMA])

        yield (lambda: at("near", field.listening["lan"])), (lambda: at("far", field.far["modem"]))
    await field.aclose()


@pytest.mark.parametrize("worse", [{}, {"lost": 0.2, "repeated": 0.1, "overtakes": 0.1}])
def test_over_the_modems_of_the_reference_system_both_logs_are_equal(tmp_path: Path, worse: dict[str, float]) -> None:
    """64 bytes per message, 400 bytes a second, a delay of 200 ms; and modems that do not repeat lost messages."""

    async def main(loop: VirtualLoop, clock: VirtualClock, net: MemoryNet) -> None:
        async with modems(net, clock, 3, **worse) as (near, far):
            plant = Twin("plant", tmp_path, clock, near)
            shore = Twin("shore", tmp_path, clock, far)
            await plant.start()
            await shore.start()
            for n in range(24):
                await plant.log(value(n))
                await asyncio.sleep(0.5)
                if n == 8:
                    await shore.log(Event(0, 1, Kind.COMMAND, "shore", b"\0\1"))
                    await plant.kill()
                    await plant.start()
                if n == 16:
                    await shore.kill()
                    await asyncio.sleep(30)
                    await shore.start()
            await until_equal(plant, shore, 600, loop)
            assert len(await shore.all_of("plant:5f3a91c2")) == 24
            await plant.kill()
            await shore.kill()

    virtually(main)


@pytest.mark.parametrize("over", ["tcp", "modems"])
def test_a_new_twin_with_an_empty_store_gets_the_events_of_the_first_one(tmp_path: Path, over: str) -> None:
    """Over TCP there is a new link; the plant's modem does not know that a different program listens at the other end."""

    async def main(loop: VirtualLoop, clock: VirtualClock, net: MemoryNet) -> None:
        async def served(near: Callable[[], Carrier], far: Callable[[], Carrier]) -> None:
            plant = Twin("plant", tmp_path, clock, near)
            await plant.start()
            await plant.log(*(value(n) for n in range(40)))
            for name in ("first", "second"):
                twin = Twin(name, tmp_path, clock, far)
                await twin.start()
                await plant.log(value(40))
                await until_equal(plant, twin, 300, loop)
                await twin.kill()
            assert len(await plant.all_of(plant.origin)) == 42
            await plant.kill()

        if over == "tcp":
            await served(lambda: LateListening(net), lambda: TcpDialler(ADDRESS, net, [SCHEMA]))
        else:
            async with modems(net, clock, 3) as (near, far):
                await served(near, far)

    virtually(main)


@pytest.mark.parametrize("over", ["tcp", "modems"])
def test_towards_the_plant_a_shadow_sends_only_acknowledgements_and_requests(tmp_path: Path, over: str) -> None:
    """paper.md, ruling 16: a capture holds no COMMAND and nothing of DTtoPT, despite losses and deaths."""

    async def main(loop: VirtualLoop, clock: VirtualClock, net: MemoryNet) -> None:
        sent: list[Frame] = []

        async def both(near: Callable[[], Carrier], far: Callable[[], Carrier]) -> None:
            plant = Twin("plant", tmp_path, clock, lambda: ShakyCarrier(near(), 1))
            shadow = Twin("shadow", tmp_path, clock, lambda: WatchedCarrier(far(), sent), sends=False)
            await plant.start()
            await shadow.start()
            for n in range(30):
                await plant.log(value(n), Event(0, n, Kind.COMMAND, "modem.inbox", b"\0\1"))
                await asyncio.sleep(0.5)
                if n == 15:
                    await shadow.kill()
                    await shadow.start()
            while plant.end.waiting:
                await asyncio.sleep(1)
            assert await shadow.all_of(plant.origin) == await plant.all_of(plant.origin)
            await plant.kill()
            await shadow.kill()

        if over == "tcp":
            await both(lambda: LateListening(net), lambda: TcpDialler(ADDRESS, net, [SCHEMA]))
        else:
            async with modems(net, clock, 3) as (near, far):
                await both(near, far)
        assert {type(frame) for frame in sent} <= {Ack, Ask, Refused}
        assert any(isinstance(frame, Ack) for frame in sent)

    virtually(main)


def test_an_hour_without_a_carrier_costs_nothing(tmp_path: Path) -> None:
    async def main(loop: VirtualLoop, clock: VirtualClock, net: MemoryNet) -> None:
        plant_carrier, shore_carrier = over_tcp(net, 9)
        plant, shore = Twin("plant", tmp_path, clock, plant_carrier), Twin("shore", tmp_path, clock, shore_carrier)
        await plant.start()
        for n in range(20):
            await plant.log(*(value(600 * n + i) for i in range(600)))
            await asyncio.sleep(180)
        assert plant.end.waiting == 12_000
        await shore.start()
        took_s = await until_equal(plant, shore, 120, loop)
        assert took_s < 120
        assert [e.sequence for e in shore.arrived] == list(range(1, 12_001)), "told in order, each once"
        await plant.kill()
        await shore.kill()

    virtually(main)


@pytest.mark.parametrize(
    "other", [Schema(("something.else",)), Schema(SCHEMA.names, "another plant, built alike")], ids=["tags", "system"]
)
def test_a_schema_that_the_other_side_lacks_is_reported_on_both(tmp_path: Path, other: Schema) -> None:
    async def main(loop: VirtualLoop, clock: VirtualClock, net: MemoryNet) -> None:
        plant = Twin("plant", tmp_path, clock, lambda: LateListening(net))
        shore = Twin("shore", tmp_path, clock, lambda: TcpDialler(ADDRESS, net, [other]), other)
        await plant.start()
        await shore.start()
        await plant.log(value(1))
        await asyncio.sleep(5)
        assert f"does not have our schema {SCHEMA.id.hex()}" in plant.end.trouble
        assert SCHEMA.id.hex() in shore.end.trouble
        assert plant.end.waiting == 1
        await plant.kill()
        await shore.kill()

    virtually(main)


def test_a_store_that_refuses_is_not_acknowledged_to_and_catches_up(tmp_path: Path) -> None:
    async def main(loop: VirtualLoop, clock: VirtualClock, net: MemoryNet) -> None:
        plant, shore = (
            Twin("plant", tmp_path, clock, lambda: LateListening(net)),
            Twin("shore", tmp_path, clock, lambda: TcpDialler(ADDRESS, net, [SCHEMA])),
        )
        await plant.start()
        await shore.start()
        keep = shore.store.keep

        async def refuse(*args: Any, **kwargs: Any) -> int:
            raise Unreachable("the disk is full")

        shore.store.keep = refuse  # type: ignore[method-assign]
        await plant.log(*(value(n) for n in range(50)))
        await asyncio.sleep(20)
        assert (plant.end.waiting, shore.end.status().trouble) == (50, "the disk is full")
        shore.store.keep = keep  # type: ignore[method-assign]
        await until_equal(plant, shore, 120, loop)
        assert shore.end.status().trouble == "", "and that it is over"
        await plant.kill()
        await shore.kill()

    virtually(main)


def test_a_full_store_of_the_sender_deletes_only_acknowledged_events(tmp_path: Path) -> None:
    async def main(loop: VirtualLoop, clock: VirtualClock, net: MemoryNet) -> None:
        plant = Twin("plant", tmp_path, clock, lambda: LateListening(net))
        shore = Twin("shore", tmp_path, clock, lambda: TcpDialler(ADDRESS, net, [SCHEMA]))
        await plant.start()
        await plant.log(*(value(n) for n in range(100)))
        assert await plant.end.make_room() == 0, "nothing is confirmed yet"
        await shore.start()
        await until_equal(plant, shore, 60, loop)
        await plant.log(value(100))
        assert await plant.end.make_room() == 50
        assert await plant.store.span(plant.origin) == (51, 101)
        await plant.kill()
        await plant.start()
        while plant.end.waiting:
            await asyncio.sleep(1)
        assert [e.sequence for e in await shore.all_of(plant.origin)] == list(range(1, 102))
        await plant.kill()
        await shore.kill()

    virtually(main)


def test_over_a_real_socket(tmp_path: Path) -> None:
    async def main() -> None:
        listening = await TcpListening.start(Endpoint.parse("tcp://127.0.0.1:0"), TcpListener.open, [SCHEMA])
        clock = WallClock()
        plant = Twin("plant", tmp_path, clock, lambda: listening)
        shore = Twin("shore", tmp_path, clock, lambda: TcpDialler(listening.bound, OsConnector(), [SCHEMA]))
        await plant.start()
        await shore.start()
        await plant.log(*(value(n) for n in range(5000)))
        await shore.log(Event(0, 1, Kind.COMMAND, "shore", b"\0\1"))
        await eventually(lambda: equal(plant, shore))
        assert plant.arrived[0].value == b"\0\1"
        await shore.kill()
        await eventually(lambda: plant.end.trouble.startswith(f"{listening.bound}: "))  # the port in use
        await plant.log(value(5000))
        await shore.start()
        await eventually(lambda: equal(plant, shore))
        await shore.kill()
        await plant.kill()

    run_really(main())
