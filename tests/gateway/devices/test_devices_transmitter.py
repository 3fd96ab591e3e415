"""The transmitter's driver against emulated modems and the link between them: no loss, no duplicates (paper.md, ruling 17)."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from itertools import pairwise
from pathlib import Path
from random import Random

import pytest
from gateway_rig import LAN, LINE, PROFILES, FieldBus, running_bus, wire
from hypothesis import given
from hypothesis import strategies as st
from support import eventually, run

from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.emulators.models.modbus.mailbox_modem import ModemPair
from fieldtwin.emulators.models.modbus.packet_link import LinkImpairments, PacketLink
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.concurrency.events import Consumer
from fieldtwin.gateway.core.errors import ConnectionLost, FieldtwinError, FileInvalid, NotAllowed
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.values import COMMAND, DATA, RESPONSE
from fieldtwin.gateway.devices.config import BusConfig, DeviceConfig
from fieldtwin.gateway.devices.transmitter import TransmitterDriver, next_sequence
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.buses.modbus.jobs import BusJob
from fieldtwin.gateway.runtime.buses.modbus.modbus_bus import ModbusBus
from fieldtwin.gateway.runtime.mailboxes.pump import MailboxPump
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.gateway.wallclock import WallClock

PROFILE = load_profile(PROFILES / "modem-mailbox.yaml")


def pair(loss: float = 0.0) -> ModemPair:
    return ModemPair(PROFILE, bytes_per_s=1e6, latency_s=0.0, loss=loss, seed=1)


class Station:
    """One end: a driver whose messages are taken and acknowledged, over a connection that can be interrupted."""

    def __init__(self, bus: ModbusBus, driver: TransmitterDriver, field: FieldBus) -> None:
        self.bus, self.driver, self.field = bus, driver, field
        self.inbox: Consumer[DATA] = Consumer(driver.emitter.event, capacity=1000)
        driver.emitter.subscribe(self.inbox)
        self.errors: list[FieldtwinError | None] = []

    async def do(self, what: str) -> FieldtwinError | None:
        """Run one of the driver's exchanges on the bus and wait for its end."""
        count = len(self.errors)
        driver = self.driver
        actions = {"send": driver.send, "acknowledge": driver.acknowledge, "ask": self._ask, "read": self._read}
        self.bus.submit(BusJob(driver, actions[what], self.errors.append))
        await eventually(lambda: len(self.errors) > count)
        return self.errors[-1]

    async def _ask(self) -> None:
        await self.driver.check_outbox()

    async def _read(self) -> None:
        await self.driver.receive("inbox")

    async def reconnect(self) -> None:
        self.field.unplug()
        assert isinstance(await self.do("ask"), ConnectionLost)
        await eventually(lambda: not self.bus.connected)
        self.field.plugged = True
        await eventually(lambda: self.bus.online(self.driver))


@asynccontextmanager
async def station(modems: ModemPair, side: str = "near") -> AsyncIterator[Station]:
    bank = modems.near if side == "near" else modems.far
    incoming = COMMAND if side == "near" else RESPONSE
    config = DeviceConfig("modem", PROFILE, "bus", 1)
    drivers: list[TransmitterDriver] = []

    def make(tags: TagTable) -> list[TransmitterDriver]:
        drivers.append(TransmitterDriver(config, tags, incoming=incoming))
        return drivers

    async with running_bus(make, FieldBus({1: ModbusUnit(bank)}), LAN) as r:  # type: ignore[arg-type]
        await eventually(lambda: r.bus.online(drivers[0]))
        yield Station(r.bus, drivers[0], r.field)


def test_the_same_command_sent_twice_is_two_commands_and_read_twice_is_one() -> None:
    async def main() -> None:
        modems = pair()
        async with station(modems, "far") as far, station(modems) as near:
            for number in (1, 2):
                far.driver.consumer.observe(COMMAND(b"\0\1"))
                assert await far.do("send") is None
                assert await near.do("read") is None
                assert await near.do("read") is None  # a duplicate: discarded
                assert list(near.inbox.queue) == [COMMAND(b"\0\1")] * number
                await near.do("acknowledge")
                await near.do("read")
                assert len(near.inbox.queue) == number
            assert near.driver.received == 2

    run(main())


def test_messages_wait_for_a_free_mailbox_and_arrive_in_order() -> None:
    async def main() -> None:
        modems = pair()
        async with station(modems, "far") as far, station(modems) as near:
            sent = [COMMAND(bytes([0, n])) for n in range(1, 6)]
            for command in sent:
                far.driver.consumer.observe(command)
            while far.driver.consumer.queue:
                await far.do("ask")
                if far.driver.outbox_free:
                    await far.do("send")
                await near.do("read")
                if near.driver.to_acknowledge:
                    await near.do("acknowledge")
            for _ in range(6):
                await near.do("read")
                await near.do("acknowledge")
            assert list(near.inbox.queue) == sent
            assert far.driver.sent == 5

    run(main())


def test_an_emitted_and_unacknowledged_message_is_not_emitted_again_after_a_reconnection() -> None:
    async def main() -> None:
        modems = pair()
        async with station(modems, "far") as far, station(modems) as near:
            far.driver.consumer.observe(COMMAND(b"\0\5"))
            await far.do("send")
            await near.do("read")
            assert near.driver.to_acknowledge == 1
            await near.reconnect()
            await near.do("read")
            assert list(near.inbox.queue) == [COMMAND(b"\0\5")]  # the control logic has it: once is sufficient
            assert near.driver.to_acknowledge == 1
            await near.do("acknowledge")
            far.driver.consumer.observe(COMMAND(b"\0\5"))
            await far.do("ask")
            await far.do("send")
            await near.do("read")
            assert len(near.inbox.queue) == 2  # the same bytes with a new sequence are a new command

    run(main())


def test_a_new_driver_reads_unacknowledged_messages_again() -> None:
    """A gateway that died between reading and acknowledging: the command survives."""

    async def main() -> None:
        modems = pair()
        async with station(modems, "far") as far:
            far.driver.consumer.observe(COMMAND(b"\0\5"))
            await far.do("send")
        for expected in ([COMMAND(b"\0\5")], [COMMAND(b"\0\5")]):
            async with station(modems) as near:
                await near.do("read")
                assert list(near.inbox.queue) == expected
                last = near
                if expected and last.driver.to_acknowledge == 0:
                    raise AssertionError
        async with station(modems) as near:
            await near.do("read")
            await near.do("acknowledge")
        async with station(modems) as near:
            await near.do("read")
            assert not near.inbox.queue

    run(main())


def test_a_write_whose_reply_was_lost_with_the_connection_is_not_sent_a_second_time() -> None:
    async def main() -> None:
        modems = pair()
        clock = WallClock()
        async with station(modems) as near, station(modems, "far") as far:
            driver = near.driver
            driver.consumer.observe(RESPONSE(b"once"))
            here, there = wire(LAN)
            client = ModbusClient(here, clock, framing="mbap", timeout_s=0.05)
            kept = driver.client, driver.connection
            driver.attach_client(here, client)
            with pytest.raises(FieldtwinError):
                await driver.send()  # no device answers; the written message is in `there`
            request = there.read_pending()
            await client.aclose()
            with pytest.raises(ConnectionLost):
                await there.read()
            modems.near.write("holding", 100, [int.from_bytes(request[13 + i : 15 + i]) for i in range(0, 8, 2)], 1)
            driver.attach_client(kept[1], kept[0])  # type: ignore[arg-type]
            await near.reconnect()
            assert not driver.consumer.queue  # the modem has it already
            assert driver.sent == 1
            await far.do("read")
            assert list(far.inbox.queue) == [RESPONSE(b"once")]
            await far.do("acknowledge")
            driver.consumer.observe(RESPONSE(b"once"))  # the next one, with the same bytes
            await near.do("ask")
            assert await near.do("send") is None
            await far.do("read")
            assert list(far.inbox.queue) == [RESPONSE(b"once"), RESPONSE(b"once")]

    run(main())


def test_sequences_wrap_to_one() -> None:
    async def main() -> None:
        modems = pair()
        async with station(modems, "far") as far, station(modems) as near:
            for bank, driver in ((modems.near, near.driver), (modems.far, far.driver)):
                bank._sequence = bank._accepted = 0xFFFE
                for at, value in ((PROFILE.inbox, 0xFFFE), (PROFILE.outbox, 0xFFFE)):
                    assert at is not None
                    bank._poke(at.at, value)
                    bank._poke(at.ack, value)
                await driver.synchronise()
            for n in range(4):
                far.driver.consumer.observe(COMMAND(bytes([0, n])))
                await far.do("ask")
                assert await far.do("send") is None
                await near.do("read")
                await near.do("acknowledge")
            assert [c.data[1] for c in near.inbox.queue] == [0, 1, 2, 3]

    run(main())


@pytest.mark.parametrize("payload", [b"", b"x" * 65], ids=["empty", "too long"])
def test_a_message_that_does_not_fit_the_outbox_is_refused_and_dropped(payload: bytes) -> None:
    async def main() -> None:
        async with station(pair()) as near:
            near.driver.consumer.observe(RESPONSE(payload))
            assert isinstance(await near.do("send"), NotAllowed)
            assert not near.driver.consumer.queue

    run(main())


def test_next_sequence_never_is_zero() -> None:
    assert [next_sequence(n) for n in (0, 1, 0xFFFE, 0xFFFF)] == [1, 2, 0xFFFF, 1]


def test_a_transmitter_needs_a_mailbox_and_a_socket() -> None:
    tags = TagTable(WallClock())
    ctd = load_profile(PROFILES / "ctd-reference.yaml")
    with pytest.raises(FileInvalid, match="mailbox"):
        TransmitterDriver(DeviceConfig("x", ctd, "b", 1), tags)
    driver = TransmitterDriver(DeviceConfig("x", PROFILE, "b", 1), tags)
    near, _ = wire(LINE)
    with pytest.raises(FileInvalid, match="does not fit this bus"):
        driver.attach(near)
    assert BusConfig("b", LAN).retries == 1


@pytest.mark.parametrize("log", ["audit.jsonl", "/dev/full"])
def test_a_plant_switched_to_local_takes_no_command_and_reports_it(tmp_path: Path, log: str) -> None:
    """With a writable log, and with one that is not: the command is refused in both cases.

    Acknowledging it is a write, which waits for a writable log.
    """

    async def main() -> None:
        modems = pair()
        audit = AuditLog(tmp_path / log, WallClock())
        async with station(modems, "far") as far, station(modems) as near:
            pump = MailboxPump(near.driver, near.bus, audit, allow_writes=True, remote=False)
            far.driver.consumer.observe(COMMAND(b"\0\5"))
            await far.do("send")
            await near.do("read")
            pump.refuse_when_local()
            assert not pump.inbox.queue
            assert pump.commands_refused == 1
            pump.tick(1, all_consumed=True)
            if log == "audit.jsonl":  # it is acknowledged: the next one can come
                await eventually(lambda: not near.driver.to_acknowledge)
            assert bool(near.driver.to_acknowledge) == (log == "/dev/full")
        audit.close()
        if log == "audit.jsonl":
            refused, *acknowledged = map(json.loads, (tmp_path / log).read_text(encoding="utf-8").splitlines())
            assert refused["payload"] == "0005"
            assert [(e["tag"], e["result"]) for e in acknowledged] == [
                ("modem.inbox_ack", "asked"),
                ("modem.inbox_ack", "done"),
            ]

    run(main())


def test_a_mailbox_assigned_to_a_thread_is_neither_read_nor_written(tmp_path: Path) -> None:
    """Messages over it are not commands; output of the control logic is not put there; commands of the thread are taken."""

    async def main() -> None:
        modems = pair()
        audit = AuditLog(tmp_path / "audit.jsonl", WallClock())
        async with station(modems, "far") as far, station(modems) as near:
            pump = MailboxPump(near.driver, near.bus, audit, allow_writes=True, remote=True, delegated=True)
            far.driver.consumer.observe(COMMAND(b"\0\5"))
            await far.do("send")
            await near.do("read")
            pump.offer([b"a response"])
            pump.tick(1, all_consumed=True)
            assert (len(pump.inbox.queue), pump.undelivered) == (0, 0)
            assert near.driver.to_acknowledge
            assert pump.command(b"\0\7", "twin:1")
            assert [item.data for item in pump.inbox.queue] == [b"\0\7"]
        audit.close()

    run(main())


# -- the link between the modems ------------------------------------------------------------------------------------------

payloads = st.lists(st.binary(min_size=1, max_size=64), max_size=30)


@given(payloads=payloads, loss=st.floats(0, 0.9), latency_s=st.floats(0, 3), rate=st.floats(1, 1e5), seed=st.integers())
def test_the_link_delivers_everything_once_in_order_and_no_faster_than_it_can(
    payloads: list[bytes], loss: float, latency_s: float, rate: float, seed: int
) -> None:
    link = PacketLink(rate, latency_s, loss, Random(seed), capacity=4)
    now_ns, waiting, got, arrived_ns = 0, list(payloads), [], []
    for _ in range(100_000):
        while waiting and link.submit(waiting[0], now_ns):
            waiting.pop(0)
        packet = link.arrived(now_ns)
        if packet is None:
            if not waiting and not link.waiting:
                break
            now_ns += max(1, link._under_way[0][0] - now_ns)
            continue
        got.append(packet)
        arrived_ns.append(now_ns)
    assert got == payloads
    assert arrived_ns == sorted(arrived_ns)
    assert (link.sent, link.delivered) == (len(payloads), len(payloads))
    if payloads:
        airtime_s = sum(len(p) + 8 for p in payloads) / rate
        assert arrived_ns[-1] >= (airtime_s + latency_s) * NS_PER_S * (1 - 1e-9) - len(payloads)
        if loss == 0:
            assert link.resent == 0
            assert arrived_ns[-1] <= (airtime_s + latency_s * (1 + len(payloads))) * NS_PER_S + 2 * len(payloads)


def test_modems_that_do_not_send_again_lose_repeat_and_turn_round_messages() -> None:
    """Random losses with a seed; arriving messages are complete, and at most one position out of order."""
    link = PacketLink(1e6, 1.0, 0.0, Random(1), capacity=10_000, untamed=LinkImpairments(0.2, 0.1, 0.1))
    sent = [n.to_bytes(2) for n in range(2000)]
    assert all(link.submit(payload, 0) for payload in sent)
    got = []
    while (payload := link.arrived(10 * NS_PER_S)) is not None:
        got.append(int.from_bytes(payload))
    assert link.sent == 2000
    assert 300 < link.lost == 2000 - len(set(got)) < 500
    assert 100 < len(got) - len(set(got)) < 250
    assert 80 < sum(a > b for a, b in pairwise(got)) < 250


def test_a_full_link_takes_nothing_more() -> None:
    link = PacketLink(10, 1.0, 0.0, Random(1), capacity=2)
    assert link.submit(b"a", 0)
    assert link.submit(b"b", 0)
    assert not link.submit(b"c", 0)
    assert link.full
    assert link.sent == 2
