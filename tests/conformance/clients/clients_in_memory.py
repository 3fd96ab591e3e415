"""Clients in memory and in virtual time, tested by the cases: ours, and intentionally wrong ones."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from pathlib import Path

from fieldtwin.conformance.clients.canopen.cases import CASES as CANOPEN_CASES
from fieldtwin.conformance.clients.canopen.cases import SILENT as CANOPEN_SILENT
from fieldtwin.conformance.clients.canopen.hostile_node import HostileNode
from fieldtwin.conformance.clients.modbus.cases import CASES, SILENT
from fieldtwin.conformance.clients.modbus.hostile_server import HostileServer, traits, wire_for
from fieldtwin.conformance.clients.probe import Classifier
from fieldtwin.conformance.clients.run import ClientPlan, ClientRun
from fieldtwin.conformance.core.observation import Word
from fieldtwin.conformance.core.results import CaseResult
from fieldtwin.emulators.endpoints.memory_ports import MemoryNet
from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FieldtwinError, ReplyTimeout
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster
from fieldtwin.gateway.protocols.canopen.nmt.states import NmtCommand, NodeEvent
from fieldtwin.gateway.protocols.modbus.client import ModbusClient

WORDS = (1111, 2222, 3333)
PERIOD_S = 0.3
TIMEOUT_S = 0.2
LAZY_S = 0.3
"""Pause of the clients between two polls."""
Publish = Callable[[str], None]
Client = Callable[[MemoryNet, Endpoint, VirtualClock, Publish], Coroutine[object, object, None]]


class Told:
    """A probe that the client calls."""

    def __init__(self) -> None:
        self._classifier = Classifier(WORDS[2])
        self.on_shown: Callable[[Word, str], None] = lambda word, text: None

    def learn(self, word: Word) -> bool:
        return self._classifier.learn(word)

    def latest_text(self) -> str:
        return self._classifier.latest

    def publish(self, text: str) -> None:
        self.on_shown(self._classifier.word(text), text)


async def ours(net: MemoryNet, endpoint: Endpoint, clock: VirtualClock, publish: Publish) -> None:
    """Our client as used by a driver: an invalid answer gives no value, and a lost or silent connection is opened
    again."""
    while True:
        client = ModbusClient.at(endpoint, await net.open_bytes(endpoint), clock, timeout_s=TIMEOUT_S)
        unheard = 0
        try:
            while not client.closed and (endpoint.is_serial or unheard < 4):
                try:
                    reply = await client.read_registers(17, "holding", 107, 2)
                    publish(str(reply.registers[0]))
                    unheard = 0
                except ReplyTimeout:
                    unheard += 1
                except FieldtwinError:
                    pass
                await asyncio.sleep(PERIOD_S)
        finally:
            await client.aclose()


def judge(
    client: Client, url: str, *only: str, timeout_s: float = TIMEOUT_S, probed: bool = True
) -> dict[str, CaseResult]:
    """Return the result by case id for a client that connects to `url` in memory."""
    loop = VirtualLoop()

    async def main() -> list[CaseResult]:
        net, plant, told = MemoryNet(loop), Endpoint.parse(url), Told()
        clock = VirtualClock(loop)
        stage = HostileServer(wire_for(plant.scheme), WORDS, {})
        plan = ClientPlan(frozenset(only), timeout_s=timeout_s, patience_s=5.0)
        run = ClientRun(stage, CASES, SILENT, plan, traits(plant.scheme), told if probed else None)
        async with Nursery() as nursery:
            if plant.is_serial:
                end, _ = await net.serial(Path(plant.path), plant, plant.serial)
                nursery.start(stage.serve(end), "stage")
            else:
                listener = await net.listen(plant, stage.serve, 8)
                plant = listener.bound
            nursery.start(client(net, plant, clock, told.publish), "client")
            results = await run.run()
        if not plant.is_serial:
            await listener.aclose()
        return results

    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        return {r.case.id: r for r in runner.run(main())}


async def our_canopen(
    net: MemoryNet,
    endpoint: Endpoint,
    clock: VirtualClock,
    publish: Publish,
    block: bool = False,
    download: bool = False,
) -> None:
    """Our NMT master. It reads an object, and starts the node at first, after each boot-up and when the heartbeat
    returns. With `download` it also writes a long object by block transfer."""
    async with Nursery() as nursery:
        connection = await net.open_can(endpoint, 125_000)
        boots: asyncio.Queue[bool] = asyncio.Queue()
        boots.put_nowait(True)

        def heard(event: NodeEvent) -> None:
            if (event.kind == "boot-up" and event.unexpected) or event.kind == "heartbeat-back":
                boots.put_nowait(True)

        canopen = CanopenMaster(connection, clock, sdo_timeout_s=TIMEOUT_S, on_event=heard)
        canopen.add_node(5, heartbeat_consumer_ms=2500)
        nursery.start(canopen.run(), "client")
        while True:
            if not boots.empty():
                boots.get_nowait()
                await canopen.nmt(NmtCommand.START, 5)
            try:
                raw = await canopen.sdo_upload(5, 0x2000, 0, length=None if block else 4, block=block)
                if len(raw) >= 4:  # an empty text is not a number
                    publish(str(int.from_bytes(raw[:4], "little")))
                if download:
                    await canopen.sdo_download(5, 0x2100, 0, bytes(range(50)), block=True)
            except FieldtwinError:
                pass
            await asyncio.sleep(PERIOD_S)


def judge_canopen(client: Client, *only: str, timeout_s: float = TIMEOUT_S) -> dict[str, CaseResult]:
    """Return the result by case id for an NMT master on a bus in memory."""
    loop = VirtualLoop()

    async def main() -> list[CaseResult]:
        net, told, clock = MemoryNet(loop), Told(), VirtualClock(loop)
        bus = await net.can_bus(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), 125_000, paced=True)
        stage = HostileNode(WORDS, nodes=(5,))
        plan = ClientPlan(frozenset(only), timeout_s=timeout_s, patience_s=5.0)
        run = ClientRun(stage, CANOPEN_CASES, CANOPEN_SILENT, plan, frozenset({"can", "heartbeat"}), told)
        async with Nursery() as nursery:
            nursery.start(stage.serve(await bus.join("nodes")), "nodes")
            nursery.start(client(net, bus.bound, clock, told.publish), "client")
            results = await run.run()
        await bus.aclose()
        return results

    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        return {r.case.id: r for r in runner.run(main())}
