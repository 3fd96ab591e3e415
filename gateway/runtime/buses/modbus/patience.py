"""The time for which a Modbus bus waits for the reply of one device while other devices also need the bus.

This module does no I/O. Times are monotonic nanoseconds, which the caller passes.
"""

from __future__ import annotations

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.histogram import Histogram
from fieldtwin.gateway.devices.config import BusConfig
from fieldtwin.gateway.protocols.modbus.unit_timing import UnitTiming
from fieldtwin.gateway.runtime.buses.modbus.bus_turns import DeviceState, Turns

ALARM_NS = 10 * NS_PER_S
"""The time for which the devices of a bus are polled with shortened timeouts after one of them stopped answering."""


class Patience:
    """The timeouts of the devices of one bus that are online. `latency` holds the response times of the bus."""

    def __init__(self, config: BusConfig, turns: Turns, latency: Histogram) -> None:
        self._config = config
        self._turns = turns
        self._latency = latency
        self._alarm_until_ns = 0
        """The time until which devices that answer are polled with shortened timeouts, because one of them stopped
        answering."""

    def restate(self, config: BusConfig) -> None:
        """Apply a new configuration from the next request on."""
        self._config = config

    def timeout_s(self, device: DeviceState, now_ns: int) -> float:
        """Return the timeout in seconds for a device that is online, while other devices also need the bus."""
        if now_ns < self._alarm_until_ns:
            return self._turns.short_s(device, self._latency.recent_longest_ns, self._config.timeout_s)
        return self.own_s(device)

    def own_s(self, device: DeviceState) -> float:
        """Return the configured timeout of a device in seconds."""
        stated_s = device.driver.config.timeout_s
        return self._config.timeout_s if stated_s is None else stated_s

    def fell_silent(self, device: DeviceState, begun_ns: int, now_ns: int) -> bool:
        """Note that a device that was online did not answer a request sent at `begun_ns`; return whether its timeout was
        shortened.

        Several devices often stop answering together, because of a cut cable. So for `ALARM_NS` the other devices are also polled
        with shortened timeouts. Otherwise each absent device would cost its whole timeout, while the devices that still answer
        wait.
        """
        shortened = self.timeout_s(device, begun_ns) < self.own_s(device)
        if begun_ns >= self._alarm_until_ns:
            self._turns.doubt_ns = begun_ns
        self._alarm_until_ns = now_ns + ALARM_NS
        return shortened

    def heard_late(self, devices: list[DeviceState], units: UnitTiming, now_ns: int) -> None:
        """Handle devices that answered after their shortened timeout but within their own.

        These devices are present, so their next requests are sent at once, with a longer timeout.
        """
        for device in devices:
            late_ns = units.late_ns.get(device.driver.config.address)
            if late_ns is not None and late_ns <= self.own_s(device) * NS_PER_S:
                device.late_ns, device.next_try_ns = max(device.late_ns, late_ns), now_ns
        units.late_ns.clear()
