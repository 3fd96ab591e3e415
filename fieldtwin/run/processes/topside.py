"""The topside controller: a transmitter at the topside end of the modem link, and a script of commands.

It uses the same `TransmitterDriver` and runtime as the plant's side, with inputs and outputs exchanged.
Commands are periods in seconds; the next is sent when it is due and the transmitter has accepted the last.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S, Clock
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import Connector
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FieldtwinError, UsageError
from fieldtwin.gateway.core.statemachine import encode_period
from fieldtwin.gateway.core.values import RESPONSE
from fieldtwin.gateway.devices.config import BusConfig, DeviceConfig
from fieldtwin.gateway.devices.transmitter import TransmitterDriver
from fieldtwin.gateway.runtime.buses.modbus.modbus_bus import ModbusBus
from fieldtwin.gateway.runtime.mailboxes.mailboxes import Inbox, Mailboxes
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.twin.site.system import System

TICK_NS = 20 * NS_PER_MS
"""Period in ns of the checks of an exchange in progress."""
IDLE_S = 60.0
KEPT_RESPONSES = 1000
DEFAULT_SCRIPT = (1, 2, 0, -1)
SCRIPT_TIMES = (0.1, 0.35, 0.65, 0.82)
"""The times of a script's commands, as fractions of the run. They leave time for each state to be seen and for the last
command to arrive.
"""


@dataclass(frozen=True)
class Scripted:
    """A command: seconds after the start, and the period to command."""

    at_s: float
    period_s: int


def script(periods: tuple[int, ...], duration_s: float) -> list[Scripted]:
    """Return the commands with times that spread them over a run of `duration_s` seconds."""
    if len(periods) == len(SCRIPT_TIMES):
        return [Scripted(part * duration_s, p) for part, p in zip(SCRIPT_TIMES, periods, strict=True)]
    return [Scripted((i + 0.5) * 0.85 * duration_s / len(periods), p) for i, p in enumerate(periods)]


def parse_periods(text: str) -> tuple[int, ...]:
    """Return the periods in a text such as ``1,2,0,-1``; ``none`` stands for no period. Raises `UsageError`."""
    if text.strip().lower() in ("", "none"):
        return ()
    try:
        periods = tuple(int(part) for part in text.split(","))
        for period in periods:
            encode_period(period)
    except (ValueError, FieldtwinError) as e:
        raise UsageError(
            "a script of commands", expected="periods in seconds such as 1,2,0,-1, or none", got=text
        ) from e
    return periods


class TopsideController:
    """The topside controller for one transmitter of `system`; its modem is reached at `endpoint`."""

    def __init__(
        self, system: System, device: str, endpoint: Endpoint, clock: Clock, connector: Connector | None = None
    ) -> None:
        config: DeviceConfig = system.devices[device]
        far = DeviceConfig(
            name=f"{device}_far",
            profile=config.profile,
            bus="far",
            address=config.address,
            poll={"inbox": config.poll.get("inbox", 200)},
        )
        self._clock = clock
        self._driver = TransmitterDriver(far, TagTable(clock), incoming=RESPONSE)
        self._news = asyncio.Event()
        self._inbox = Inbox(self._driver, self._news)
        bus = BusConfig("far", endpoint, system.buses[config.bus].timeout_s, 1)
        self._bus = ModbusBus(bus, [self._driver], connector or OsConnector(), clock, TagTable(clock), lambda d: None)
        self._boxes = Mailboxes(self._driver, self._bus)
        self._halted = False
        self.commands_sent: list[int] = []
        self.responses: deque[bytes] = deque(maxlen=KEPT_RESPONSES)
        self.responses_received = 0
        self.on_send: Callable[[int], None] | None = None
        """Called with each period when it is commanded."""

    async def run(self, commands: list[Scripted]) -> None:
        """Operate the topside end of the link until cancelled, and send each command at its time."""
        async with Nursery() as nursery:
            nursery.start(self._bus.run(), "far transmitter")
            nursery.start(self._cycle(deque(commands)), "topside")
            await nursery.wait()

    async def halt(self) -> None:
        """Stop sending and polling."""
        self._halted = True
        await self._bus.halt(0.5)

    async def _cycle(self, commands: deque[Scripted]) -> None:
        start_ns = self._clock.monotonic_ns()
        while not self._halted:
            now_ns = self._clock.monotonic_ns()
            while commands and now_ns - start_ns >= round(
                commands[0].at_s * NS_PER_S
            ):  # without rounding, less than 1 ns could remain
                self.send(commands.popleft().period_s)
            for response in self._inbox.drain():
                self.responses_received += 1
                self.responses.append(response.data)
            self._boxes.next(now_ns, taken=True)
            if self._boxes.busy or self._driver.to_acknowledge or self._driver.consumer.queue:
                await self._clock.sleep_until_ns(now_ns + TICK_NS)
            else:
                await self._wait_for_news(commands[0].at_s - (now_ns - start_ns) / NS_PER_S if commands else IDLE_S)

    async def _wait_for_news(self, at_most_s: float) -> None:
        self._news.clear()
        try:
            async with asyncio.timeout(min(max(at_most_s, 0.0), IDLE_S)):
                await self._news.wait()
        except TimeoutError:
            pass

    def send(self, period_s: int) -> None:
        """Send a command with this sample period (s) to the plant."""
        self._driver.consumer.observe(encode_period(period_s))
        self._news.set()
        self.commands_sent.append(period_s)
        if self.on_send is not None:
            self.on_send(period_s)

    def describe(self) -> dict[str, Any]:
        """Return the topside controller's commands, responses and connection state, for a summary."""
        return {
            "connected": self._bus.connected,
            "error": self._bus.error,
            "commands_sent": list(self.commands_sent),
            "commands_waiting": len(self._driver.consumer.queue),
            "responses": self.responses_received,
            "last_response": self.responses[-1].hex() if self.responses else "",
        }
