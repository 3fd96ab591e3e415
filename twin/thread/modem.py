"""A thread over the reference system's modems: each datagram is one mailbox message of 64 bytes, a few per second.

The transmitter's driver is the plant's own (`TransmitterDriver`). A datagram is put into the modem's outbox when the
previous one was taken, and a received message is acknowledged after it was read. Both ends use this class.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

from fieldtwin.gateway.core.clock import NS_PER_MS, Clock
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import Connector
from fieldtwin.gateway.core.errors import ConnectionLost, FieldtwinError
from fieldtwin.gateway.core.values import DATA
from fieldtwin.gateway.devices.config import BusConfig, DeviceConfig
from fieldtwin.gateway.devices.transmitter import TransmitterDriver
from fieldtwin.gateway.runtime.buses.modbus.bus_turns import DeviceState
from fieldtwin.gateway.runtime.buses.modbus.modbus_bus import ModbusBus
from fieldtwin.gateway.runtime.mailboxes.mailboxes import Inbox, Mailboxes
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.twin.thread.frames import Schema
from fieldtwin.twin.thread.link import Carrier, DatagramLink

TICK_NS = 20 * NS_PER_MS
ACK_DELAY_NS = 1000 * NS_PER_MS
"""A frame takes a second or more to arrive, so one ACK confirms several."""
LINGER_NS = 500 * NS_PER_MS
HALT_S = 0.5
NOT_ASKED = DeviceState.error


class ModemLink(DatagramLink):
    """A link through a transmitter's mailboxes.

    The link stays open while the modem is offline, and sends its waiting datagrams when the modem is back.
    """

    ack_delay_ns = ACK_DELAY_NS
    linger_ns = LINGER_NS

    def __init__(self, driver: TransmitterDriver, bus: ModbusBus, clock: Clock, schemas: Sequence[Schema]) -> None:
        assert driver.profile.outbox is not None
        super().__init__(schemas, driver.profile.outbox.bytes)
        self._driver = driver
        self._bus = bus
        self._clock = clock
        self._news = asyncio.Event()
        self._room = asyncio.Event()
        self._inbox = Inbox(driver, self._news)
        self._boxes = Mailboxes(driver, bus, self._ended)
        self._nursery = Nursery()
        self._nursery.start(bus.run(), "transmitter")
        self._nursery.start(self._pump(), "mailboxes")

    async def send_datagram(self, data: bytes) -> None:
        while self._driver.consumer.queue:
            self._room.clear()
            self._look()
            await self._room.wait()
        self._driver.consumer.observe(DATA(data))

    async def receive_datagram(self) -> bytes:
        while not self._inbox.queue:
            self._look()
            self._news.clear()
            await self._news.wait()
        return self._inbox.consume().data

    @property
    def trouble(self) -> str:  # type: ignore[override]
        """Return why the modem does not answer, without the details that differ between tries; empty before the first request."""
        state = self._bus.devices[0]
        why = "" if state.online else self._bus.error or state.error.removeprefix(NOT_ASKED)
        return f"the modem: {why.partition('; expected')[0]}" if why else ""

    def _look(self) -> None:
        if (failure := self._nursery.failure()) is not None:
            raise ConnectionLost(f"the transmitter is no longer served: {failure}", where=self._driver.config.name)

    async def _pump(self) -> None:
        """Start the next exchange with the modem's mailboxes periodically, one at a time."""
        while True:
            now_ns = self._clock.monotonic_ns()
            self._boxes.next(now_ns, taken=not self._inbox.queue)
            await self._clock.sleep_until_ns(now_ns + TICK_NS)

    def _ended(self, error: FieldtwinError | None) -> None:
        if not self._driver.consumer.queue:
            self._room.set()

    async def aclose(self) -> None:
        await self._bus.halt(HALT_S)
        await self._nursery.__aexit__(None, None, None)


class ModemCarrier(Carrier):
    """The carrier that uses the mailboxes of the transmitter `device` on its bus, at either end of the modems' link."""

    def __init__(
        self, device: DeviceConfig, bus: BusConfig, connector: Connector, clock: Clock, schemas: Sequence[Schema]
    ) -> None:
        self.name = f"thread over {device.name}"
        self._device = device
        self._bus = bus
        self._connector = connector
        self._clock = clock
        self._schemas = schemas

    async def open(self) -> ModemLink:
        tags = TagTable(self._clock)
        driver = TransmitterDriver(self._device, tags, incoming=DATA)
        bus = ModbusBus(self._bus, [driver], self._connector, self._clock, tags, lambda state: None)
        return ModemLink(driver, bus, self._clock, self._schemas)
