"""Schemas DeviceDriver, SensorDriver, TransmitterDriver: the drivers of a run, on real wires to its emulators."""

from __future__ import annotations

import inspect
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from spec_rig import CLOCK, observatory, rig
from support import run

from fieldtwin.emulators.models.modbus.distorted_registers import DistortedRegisters
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.concurrency.events import Consumer, Producer
from fieldtwin.gateway.core.connection import PROTOCOL, ByteConnection, RS232Connection, TCPConnection
from fieldtwin.gateway.core.errors import Bug, FileInvalid, UnknownCommand
from fieldtwin.gateway.core.files.profile import Box
from fieldtwin.gateway.core.values import COMMAND, DATA, MEASUREMENT, RESPONSE
from fieldtwin.gateway.devices.driver import DeviceDriver
from fieldtwin.gateway.devices.register_device import SensorDriver
from fieldtwin.gateway.devices.transmitter import TransmitterDriver
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.twin.plant.physical import make_drivers

SYSTEM, _ = observatory()


def unattached() -> dict[str, DeviceDriver]:
    return dict(make_drivers(SYSTEM, TagTable(CLOCK), CLOCK))


class Nowhere(ByteConnection):
    """An open connection of a kind; only the kind matters here."""

    async def write(self, data: bytes) -> None:
        raise AssertionError("nothing may be written")

    async def aclose(self) -> None:
        return


def end(kind: type[RS232Connection] | type[TCPConnection]) -> Nowhere:
    return Nowhere(kind(), SYSTEM.buses["line1"].endpoint)


def test_DeviceDriver_is_abstract() -> None:
    assert inspect.isabstract(DeviceDriver)


@pytest.mark.parametrize("name", list(SYSTEM.devices))
def test_DeviceDriver_owns_an_emitter_and_a_consumer_and_Init_leaves_the_consumer_empty(name: str) -> None:
    driver = unattached()[name]
    assert isinstance(driver.emitter, Producer)
    assert isinstance(driver.consumer, Consumer)
    assert not driver.consumer.queue
    with pytest.raises(Bug, match="without a connection"):
        _ = driver.connection


def test_DeviceDriver_Init_takes_a_connection_that_is_initialised(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            for name in ("ctd", "modem"):
                inbound = r.drivers[name].connection.inbound
                assert type(inbound) in (RS232Connection, TCPConnection)
                assert not inbound.data_stream

    run(main())


def test_DeviceDriver_opens_nothing_itself() -> None:
    """The connector given to the runtime opens wires; a driver has no access to it."""
    for driver in unattached().values():
        assert not any(isinstance(held, OsConnector) for held in vars(driver).values())


def test_DeviceDriver_Send_is_consume_then_write(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            driver, unit = r.register_driver("ctd"), r.unit("ctd")
            with pytest.raises(Bug, match="empty"):
                await driver.send()
            for period_s in (7, -1, 0):
                driver.consumer.observe(driver.command("sample_period_s", period_s))
            for left, period_s in ((2, 7), (1, -1), (0, 0)):  # in order, one each
                await driver.send()
                assert len(driver.consumer.queue) == left
                assert list(unit.bank.read("holding", 1, 1, CLOCK.monotonic_ns())) == [period_s & 0xFFFF]
            assert unit.emulator.executed["set_period"] == 3

    run(main())


def test_DeviceDriver_Send_refuses_what_is_not_in_the_command_list(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            driver, unit = r.register_driver("ctd"), r.unit("ctd")
            driver.consumer.observe(COMMAND(b"\0\1", "self_destruct"))
            with pytest.raises(UnknownCommand, match="self_destruct"):
                await driver.send()
            assert unit.counters.requests == 0

    run(main())


def test_DeviceDriver_Receive_is_read_then_emit(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            driver, unit = r.register_driver("ctd"), r.unit("ctd")
            subscribers: list[Consumer[DATA]] = [Consumer(driver.emitter.event) for _ in range(2)]
            for subscriber in subscribers:
                driver.emitter.subscribe(subscriber)
            await driver.receive("values")  # the reference: the age of that sample is unknown
            driver.consumer.observe(driver.command("sample_period_s", 3600))
            await driver.send()  # the first sample is taken at once
            await driver.receive("values")
            words = unit.bank.read("input", 0, 10, CLOCK.monotonic_ns())
            sample = MEASUREMENT(b"".join(word.to_bytes(2) for word in words))
            assert [list(subscriber.queue) for subscriber in subscribers] == [[sample], [sample]]

    run(main())


def test_SensorDriver_is_the_driver_on_RS232_and_accepts_no_other_connection() -> None:
    driver = unattached()["ctd"]
    assert type(driver) is SensorDriver
    assert SensorDriver.wire_types == {PROTOCOL.RS232}
    driver.attach(end(RS232Connection))
    with pytest.raises(FileInvalid, match="does not fit this bus"):
        driver.attach(end(TCPConnection))


def test_SensorDriver_result_of_a_command_is_a_RESPONSE(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            driver = r.register_driver("ctd")
            subscriber: Consumer[DATA] = Consumer(driver.emitter.event)
            driver.emitter.subscribe(subscriber)
            await driver.receive("values")
            driver.consumer.observe(driver.command("sample_period_s", 3600))
            await driver.send()
            await driver.receive("values")
            assert isinstance(subscriber.consume(), RESPONSE)

    run(main())


def test_TransmitterDriver_is_the_driver_on_TCP_and_accepts_no_other_connection() -> None:
    driver = unattached()["modem"]
    assert type(driver) is TransmitterDriver
    assert TransmitterDriver.wire_types == {PROTOCOL.TCP}
    driver.attach(end(TCPConnection))
    with pytest.raises(FileInvalid, match="does not fit this bus"):
        driver.attach(end(RS232Connection))


@settings(max_examples=10, deadline=None)
@given(payloads=st.lists(st.binary(min_size=1, max_size=64), min_size=1, max_size=4))
def test_TransmitterDriver_is_a_pure_relay(tmp_path_factory: pytest.TempPathFactory, payloads: list[bytes]) -> None:
    """In both directions, with unaltered payloads; the same payload twice counts as two (ruling 17). The link loses nothing
    here."""

    async def main() -> None:
        async with rig(tmp_path_factory.mktemp("relay")) as r:
            driver = r.register_driver("modem")
            assert isinstance(driver, TransmitterDriver)
            near = r.unit("modem").bank
            assert isinstance(near, DistortedRegisters)
            subscriber: Consumer[DATA] = Consumer(driver.emitter.event)
            driver.emitter.subscribe(subscriber)
            await driver.synchronise()
            outbox, inbox = driver.profile.outbox, driver.profile.inbox
            assert outbox is not None
            assert inbox is not None
            for sequence, payload in enumerate(payloads, 1):
                driver.consumer.observe(RESPONSE(payload))
                await driver.send()
                words = list(near.read("holding", outbox.at.address, outbox.at.count, CLOCK.monotonic_ns()))
                assert (words[0], message(words, outbox)) == (sequence, payload)
                while not await driver.check_outbox():
                    pass
                put_into_inbox(near, inbox, sequence, payload)
                await driver.receive("inbox")
                await driver.receive("inbox")  # the same sequence again is the same message
                await driver.acknowledge()
            assert list(subscriber.queue) == [COMMAND(payload) for payload in payloads]
            assert r.unit("modem").unlisted == 0  # all requests of the driver are in the command list
            executed = r.unit("modem").emulator.executed
            assert set(executed) == {"send", "receive", "acknowledge"}
            assert executed["acknowledge"] == len(payloads)

    run(main())


def message(words: list[int], box: Box) -> bytes:
    return b"".join(word.to_bytes(2) for word in words[2:])[: words[1]][: box.bytes]


def put_into_inbox(near: DistortedRegisters, box: Box, sequence: int, payload: bytes) -> None:
    """Data received over the acoustic link, without waiting: the cells that the modem itself sets."""
    cells = near.bank._cells  # type: ignore[attr-defined]
    padded = payload + b"\0" * (len(payload) % 2)
    body = [int.from_bytes(padded[i : i + 2]) for i in range(0, len(padded), 2)]
    cells.poke("holding", box.at.address, sequence, len(payload), *body)
