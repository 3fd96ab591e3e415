"""The requests to a transmitter's mailboxes, one at a time: acknowledge a received message, and send one when the outbox is free.

The outbox is not checked more often than the modem's own speed justifies. Both ends of a link use this module: the plant's
gateway and the topside controller.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.concurrency.events import Consumer
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.core.values import DATA
from fieldtwin.gateway.devices.transmitter import TransmitterDriver
from fieldtwin.gateway.runtime.buses.modbus.jobs import BusJob
from fieldtwin.gateway.runtime.buses.modbus.modbus_bus import ModbusBus

ASK_EVERY_NS = 50 * NS_PER_MS
"""The time between two checks of a full outbox."""
MOST_PATIENCE_NS = 2000 * NS_PER_MS
"""The longest time for which a full outbox is not checked because the previous message took that long to leave it."""
INBOX_KEPT = 256


class Patience:
    """The decision when to check a full outbox, from the time that the previous message took to leave it.

    The next check is after three quarters of that time, so that a modem that became faster is noticed. Times are monotonic
    nanoseconds.
    """

    def __init__(self) -> None:
        self._sent_ns: int | None = None
        self._next_ns = 0
        self._wait_ns = 0
        self._was_full = False

    def asks(self, now_ns: int) -> bool:
        """Return whether to check the outbox now. If the result is True, it counts as a check."""
        if now_ns < self._next_ns or (self._sent_ns is not None and now_ns < self._sent_ns + self._wait_ns):
            return False
        self._next_ns = now_ns + ASK_EVERY_NS
        return True

    def full(self) -> None:
        """Note that the outbox was checked and the message is still there."""
        self._was_full = True

    def sent(self, now_ns: int) -> None:
        """Note that the outbox was free, and that a message is written into it at `now_ns`."""
        if self._sent_ns is not None:
            took_ns = (now_ns - self._sent_ns) * 3 // 4
            # If the outbox was not checked while it was full, it became free at an unknown earlier time.
            self._wait_ns = min(took_ns, MOST_PATIENCE_NS if self._was_full else self._wait_ns)
        self._sent_ns, self._was_full = now_ns, False


class Inbox(Consumer[DATA]):
    """The queue of messages that a transmitter received. It sets an event for each message."""

    def __init__(self, driver: TransmitterDriver, news: asyncio.Event) -> None:
        super().__init__(driver.emitter.event, INBOX_KEPT)
        self._news = news
        driver.emitter.subscribe(self)

    def observe(self, item: DATA) -> None:
        super().observe(item)
        self._news.set()


class Mailboxes:
    """The mailbox requests of `driver` on `bus`. When one ends, `busy` becomes False, and `ended` is called with its error or
    None.
    """

    def __init__(
        self,
        driver: TransmitterDriver,
        bus: ModbusBus,
        ended: Callable[[FieldtwinError | None], None] = lambda error: None,
    ) -> None:
        self.driver = driver
        self.busy = False
        self._bus = bus
        self._ended = ended
        self._patience = Patience()

    @property
    def ready(self) -> bool:
        """Return whether the next request may begin: none is under way, and the device is online."""
        return not self.busy and self._bus.online(self.driver)

    def acknowledge(self) -> None:
        """Acknowledge the received message, so that the transmitter can put the next one into the inbox."""
        self._submit(self.driver.acknowledge)

    def send(self, now_ns: int) -> None:
        """Write the first queued message into the outbox, which must be free."""
        self._patience.sent(now_ns)
        self._submit(self.driver.send)

    def look(self, now_ns: int) -> None:
        """Check whether the outbox is free, if a check is due."""
        if self._patience.asks(now_ns):
            self._submit(self._check)

    def next(self, now_ns: int, *, taken: bool) -> None:
        """Start the request that is due, if any. `taken` says that the received message may be acknowledged."""
        if not self.ready:
            return
        if self.driver.to_acknowledge and taken:
            self.acknowledge()
        elif self.driver.consumer.queue:
            if self.driver.outbox_free:
                self.send(now_ns)
            else:
                self.look(now_ns)

    async def _check(self) -> None:
        if not await self.driver.check_outbox():
            self._patience.full()

    def _submit(self, run: Callable[[], Awaitable[None]]) -> None:
        self.busy = True
        self._bus.submit(BusJob(self.driver, run, self._done))

    def _done(self, error: FieldtwinError | None) -> None:
        self.busy = False
        self._ended(error)
