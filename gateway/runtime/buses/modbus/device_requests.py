"""The requests that a Modbus bus sends to a device: first contact, triggers and reads, each repeated as configured."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import TypeVar

from fieldtwin.gateway.core.clock import NS_PER_MS, Clock
from fieldtwin.gateway.core.errors import ReplyTimeout, WireError
from fieldtwin.gateway.core.values import Reason
from fieldtwin.gateway.devices.config import BusConfig
from fieldtwin.gateway.devices.transmitter import TransmitterDriver
from fieldtwin.gateway.runtime.buses.modbus.bus_turns import DeviceState
from fieldtwin.gateway.runtime.tags import TagTable

T = TypeVar("T")


class DeviceRequests:
    """The requests to the devices of one bus. Values that a device does not sample yet become bad in `tags`."""

    def __init__(self, config: BusConfig, clock: Clock, tags: TagTable) -> None:
        self._config = config
        self._clock = clock
        self._tags = tags

    def restate(self, config: BusConfig) -> None:
        """Apply a new configuration from the next request on."""
        self._config = config

    async def bring_online(self, device: DeviceState) -> str:
        """Contact a device for the first time, or again after a loss, and return the group to read first.

        This checks the device's identity and reads the state of its mailboxes. If no identity is configured, the device is online
        once it answers.
        """
        driver = device.driver
        if driver.learnt.missing:
            driver.ask_again()
        await self.attempts(device, driver.identify)
        if isinstance(driver, TransmitterDriver):
            await self.attempts(device, driver.synchronise)
        device.schedule.start(self._clock.monotonic_ns())
        group = next(iter(device.schedule.due_ns), "")
        # A device from which nothing is ever read counts as online, because no poll can show whether it is.
        device.online = bool(driver.config.expect) or isinstance(driver, TransmitterDriver) or not group
        if device.online:
            device.error = ""
            return group
        return group if device.alone else min(device.schedule.due_ns, key=driver.cost)

    async def turn(self, device: DeviceState, group: str) -> None:
        """Carry out the next transaction of `group`: its trigger, its first read, or a later read."""
        if not group:
            return
        driver, reading = device.driver, device.reading
        if reading is None:
            now_ns = self._clock.monotonic_ns()
            device.reading_due_ns = device.schedule.due_ns[group]
            device.schedule.took(group, now_ns)
            if driver.profile.form.trigger is not None and await self._trigger(device, group, now_ns):
                return
            reading = device.reading = driver.begin(group)
        going = reading
        if await self.attempts(device, lambda: driver.read_next(going), later=True):
            device.reading = None
            driver.finish(reading)

    async def _trigger(self, device: DeviceState, group: str, now_ns: int) -> bool:
        """Start a measurement of a device that measures on request. Return True if the values have to be read later.

        The bus serves other devices until then. Without permission to trigger, the values become bad.
        """
        driver = device.driver
        wait_ms = driver.trigger_wait_ms(group)
        if not wait_ms or group in device.triggered:
            device.triggered.discard(group)
            return False
        if driver.may_trigger:
            await self.attempts(device, driver.trigger)
            device.triggered.add(group)
            device.schedule.defer(group, self._clock.monotonic_ns() + wait_ms * NS_PER_MS)
        else:
            names = [f"{driver.config.name}.{t.name}" for t in driver.profile.group(group)]
            self._tags.put_bad(names, Reason.NOT_SAMPLING)
        return True

    def retries_of(self, device: DeviceState) -> int:
        """Return how often a request to this device is repeated after a communication error."""
        stated = device.driver.config.retries
        return self._config.retries if stated is None else stated

    async def attempts(self, device: DeviceState | None, what: Callable[[], Awaitable[T]], *, later: bool = False) -> T:
        """Send a request up to `1 + retries` times, as long as it fails with a communication error.

        A request that the device refuses is not repeated, and a device that was away gets only one request. With `later`, a
        timeout is raised without a repetition if other devices wait for the bus.
        """
        retries = self._config.retries
        if device is not None:
            retries = self.retries_of(device) if device.retries_left else 0
        while True:
            try:
                return await what()
            except WireError as e:
                wait = later and isinstance(e, ReplyTimeout) and device is not None and not device.alone
                if not retries or wait:
                    raise
                retries -= 1
