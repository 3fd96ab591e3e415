"""One Modbus bus: its connection, its queue, its devices' polls. One transaction at a time, writes first in line; then
polls that are due and the requests of bridge clients, turn by turn.

A device that does not answer costs the others its own timeouts once and is then left alone with growing pauses
(catalogue case 62). Nothing here opens anything but through the Connector, and a connection that ends is opened again for ever,
with back-off; until then the devices' tags are bad and say why.
"""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import Awaitable, Callable
from dataclasses import asdict, dataclass, field

from gateway.core.clock import NS_PER_MS, NS_PER_S, Clock
from gateway.core.connection import Connector
from gateway.core.errors import (
    ConnectionLost,
    DeviceRefused,
    EndpointBusy,
    FieldtwinError,
    ReplyTimeout,
    Unreachable,
    WireError,
    WrongDevice,
)
from gateway.core.values import Reason
from gateway.devices.config import BusConfig
from gateway.devices.register_device import RegisterDriver
from gateway.devices.transmitter import TransmitterDriver
from gateway.protocols.modbus.client import ModbusClient
from gateway.protocols.modbus.framings import framing_of
from gateway.protocols.modbus.refusals import Acknowledged, ServerBusy
from gateway.runtime.backoff import Backoff
from gateway.runtime.bridge_queue import GuestQueue
from gateway.runtime.tags import TagTable

MAX_JOBS = 256


def reason_of(error: FieldtwinError) -> Reason:
    """What a tag's quality says after `error`."""
    if isinstance(error, WrongDevice):
        return Reason.WRONG_DEVICE
    if isinstance(error, DeviceRefused):
        return Reason.REFUSED
    if isinstance(error, ReplyTimeout):
        return Reason.TIMEOUT
    return Reason.UNREACHABLE if isinstance(error, Unreachable) else Reason.WIRE_ERROR


@dataclass
class Job:
    """Something to do on the bus before the next poll. `done` is called with None or the error, once."""

    driver: RegisterDriver
    run: Callable[[], Awaitable[None]]
    done: Callable[[FieldtwinError | None], None]


@dataclass
class DeviceState:
    """What the bus knows about one of its devices."""

    driver: RegisterDriver
    online: bool = False
    error: str = "not asked yet"
    polls: int = 0
    poll_errors: int = 0
    backoff: Backoff = field(default_factory=lambda: Backoff(0.25, 10.0))
    next_try_ns: int = 0
    due_ns: dict[str, int] = field(default_factory=dict)
    triggered: set[str] = field(default_factory=set)


class ModbusBus:
    """Runs a bus until cancelled. `on_offline` is called with a driver whose device was lost."""

    def __init__(
        self,
        config: BusConfig,
        drivers: list[RegisterDriver],
        connector: Connector,
        clock: Clock,
        tags: TagTable,
        on_offline: Callable[[RegisterDriver], None],
    ) -> None:
        self.config = config
        self.devices = [DeviceState(driver) for driver in drivers]
        self.connected = False
        self.opens = 0
        self.error = ""
        self.down: FieldtwinError | None = None
        """Why the wire could not be opened when that was tried last; None while it is open, or was until just now."""
        self.guests = GuestQueue()
        self.guests.on_put = self._wake_up
        self._guest_was_last = False
        self._connector = connector
        self._clock = clock
        self._tags = tags
        self._on_offline = on_offline
        self._jobs: deque[Job] = deque()
        self._wake = asyncio.Event()
        self._idle = asyncio.Event()
        self._halted = False
        self._past: Counter[str] = Counter()
        self._client: ModbusClient | None = None

    # -- what others see ----------------------------------------------------------------------------------------------

    def online(self, driver: RegisterDriver) -> bool:
        """True while the device answers and is the right one."""
        return any(d.driver is driver and d.online for d in self.devices)

    def submit(self, job: Job) -> None:
        """Put a job in line, ahead of every poll. On a full queue, or without a connection, it fails at once."""
        if not self.connected:
            job.done(Unreachable(f"not connected: {self.error}", where=f"{self.config.name} {self.config.endpoint}"))
        elif len(self._jobs) >= MAX_JOBS:
            job.done(EndpointBusy("the bus has no room for another request", where=self.config.name))
        else:
            self._jobs.append(job)
            self._wake.set()

    def _wake_up(self) -> None:
        self._wake.set()

    def totals(self) -> Counter[str]:
        """Counters over all connections so far: requests, replies, timeouts..."""
        return self._past + Counter(asdict(self._client.counters)) if self._client else Counter(self._past)

    async def halt(self, timeout_s: float) -> None:
        """Send nothing more: return when the request under way has ended, or after `timeout_s` seconds."""
        self._halted = True
        self._wake.set()
        if self._client is not None:
            try:
                async with asyncio.timeout(timeout_s):
                    await self._idle.wait()
            except TimeoutError:
                pass  # a device that takes its time; the process ends all the same

    # -- running --------------------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Open, serve, and open again, until cancelled."""
        backoff = Backoff(0.25, 5.0)
        endpoint = self.config.endpoint
        while True:
            try:
                connection = await self._connector.open_bytes(endpoint)
            except Unreachable as e:
                self.down = e
                self._lost(e)
                self.guests.fail_all(e)
                await self._pause(backoff.next_s())
                continue
            client = ModbusClient.at(endpoint, connection, self._clock, timeout_s=self.config.timeout_s)
            self._client = client
            self.connected, self.error, self.down = True, "", None
            self.opens += 1
            try:
                for device in self.devices:
                    device.driver.attach_client(connection, client)
                    device.next_try_ns = 0
                await self._serve(backoff)
            except ConnectionLost as e:
                self._lost(e)
                await self._pause(backoff.next_s())
            finally:
                self._past.update(asdict(client.counters))
                self._client = None
                self.connected = False
                await client.aclose()

    async def _pause(self, seconds: float) -> None:
        await self._clock.sleep_until_ns(self._clock.monotonic_ns() + int(seconds * NS_PER_S))

    def _lost(self, error: FieldtwinError) -> None:
        self.connected, self.error = False, str(error)
        for device in self.devices:
            self._offline(device, error)
        while self._jobs:
            self._jobs.popleft().done(error)

    async def _serve(self, backoff: Backoff) -> None:
        while True:
            self._wake.clear()
            if self._halted:
                self._idle.set()
                await self._wake.wait()
                continue
            if self._jobs:
                await self._run_job(self._jobs.popleft())
                continue
            device, group, due_ns = self._next_poll()
            due = due_ns <= self._clock.monotonic_ns()
            if not (due and self._guest_was_last) and await self._carry_guest():
                backoff.reset()
            elif due and device is not None:
                self._guest_was_last = False
                await self._poll(device, group)
                backoff.reset()
            else:
                await self._sleep_or_job(due_ns)

    async def _carry_guest(self) -> bool:
        """One request of a bridge client, if any waits."""
        client = self._client
        guest = self.guests.take(self._clock.monotonic_ns()) if client is not None else None
        if guest is None or client is None:
            return False
        self._guest_was_last = True
        await self.guests.carry_out(guest, client, framing_of(self.config.endpoint) == "rtu")
        return True

    async def _sleep_or_job(self, until_ns: int) -> None:
        try:
            async with asyncio.timeout(max(0.0, (until_ns - self._clock.monotonic_ns()) / NS_PER_S)):
                await self._wake.wait()
        except TimeoutError:
            pass  # the next poll is due

    def _next_poll(self) -> tuple[DeviceState | None, str, int]:
        """The most overdue poll. A device that is away has only its next try."""
        best: tuple[int, int, DeviceState, str] | None = None
        for order, device in enumerate(self.devices):
            choices = list(device.due_ns.items()) if device.online else [("", device.next_try_ns)]
            for group, due_ns in choices:
                if best is None or (due_ns, order) < (best[0], best[1]):
                    best = (due_ns, order, device, group)
        if best is None:  # a bus without polls only carries jobs
            return None, "", self._clock.monotonic_ns() + NS_PER_S
        return best[2], best[3], best[0]

    async def _poll(self, device: DeviceState, group: str) -> None:
        device.polls += 1
        try:
            if not device.online:
                await self._bring_online(device)
            else:
                now_ns = self._clock.monotonic_ns()
                due_ns, every_ms = device.due_ns.pop(group), device.driver.config.poll.get(group)
                if every_ms is not None:  # else it was read once, after connecting
                    device.due_ns[group] = max(due_ns + every_ms * NS_PER_MS, now_ns)
                if await self._trigger(device, group, now_ns):
                    return
                await self._attempts(lambda: device.driver.receive(group))
        except ConnectionLost:
            raise
        except (WireError, WrongDevice, Unreachable) as e:
            device.poll_errors += 1
            self._offline(device, e)
        except DeviceRefused as e:
            self._refused(device, group, e)
        else:
            if device.online and group:
                device.error = ""
                device.backoff.reset()

    async def _trigger(self, device: DeviceState, group: str, now_ns: int) -> bool:
        """Where a device measures when asked: ask, and come back for the values; others have the bus meanwhile."""
        driver = device.driver
        wait_ms = driver.trigger_wait_ms(group)
        if not wait_ms or group in device.triggered:
            device.triggered.discard(group)
            return False
        if driver.may_trigger:
            await self._attempts(driver.trigger)
            device.triggered.add(group)
            device.due_ns[group] = self._clock.monotonic_ns() + wait_ms * NS_PER_MS
        else:
            names = [f"{driver.config.name}.{t.name}" for t in driver.profile.group(group)]
            self._tags.put_bad(names, Reason.NOT_SAMPLING)
        return True

    def _refused(self, device: DeviceState, group: str, error: DeviceRefused) -> None:
        """It answers, and says no to this group; the other groups go on.

        Busy (06) and acknowledge (05, it takes long) mean later: the last value lives on until it is stale, never a 0
        in its place, and the device is given time (MB-023, MB-024).
        """
        device.poll_errors += 1
        device.error = str(error)
        if isinstance(error, Acknowledged | ServerBusy) and device.online:
            device.due_ns[group] = self._clock.monotonic_ns() + int(device.backoff.next_s() * NS_PER_S)
            return
        names = [t.name for t in device.driver.profile.group(group)] if group else list(device.driver.profile.tags)
        self._tags.put_bad([f"{device.driver.config.name}.{n}" for n in names], reason_of(error))
        if not group:
            self._offline(device, error)

    async def _bring_online(self, device: DeviceState) -> None:
        """First contact, or contact again: is it the right device, and where do its mailboxes stand."""
        driver = device.driver
        await self._attempts(driver.identify)
        if isinstance(driver, TransmitterDriver):
            await self._attempts(driver.synchronise)
        now_ns = self._clock.monotonic_ns()
        device.online, device.error = True, ""
        device.backoff.reset()
        known = driver.config.expect
        once = [g for g in driver.plans if any(t.name not in known for t in driver.profile.group(g))]
        device.due_ns = dict.fromkeys([*driver.config.poll, *once], now_ns)

    def _offline(self, device: DeviceState, error: FieldtwinError) -> None:
        was_online = device.online
        device.online, device.error = False, str(error)
        device.next_try_ns = self._clock.monotonic_ns() + int(device.backoff.next_s() * NS_PER_S)
        self._tags.put_bad(device.driver.tag_names, reason_of(error))
        if was_online:
            self._on_offline(device.driver)

    async def _run_job(self, job: Job) -> None:
        try:
            await self._attempts(job.run)
        except ConnectionLost as e:
            job.done(e)
            raise
        except FieldtwinError as e:
            job.done(e)
        else:
            job.done(None)

    async def _attempts(self, what: Callable[[], Awaitable[None]]) -> None:
        """Try `1 + retries` times as long as the wire is at fault; what the device refuses is not asked again."""
        for left in range(self.config.retries, -1, -1):
            try:
                await what()
                return
            except WireError:
                if not left:
                    raise
