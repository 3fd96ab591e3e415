"""The order of polls on a Modbus bus: the state of its devices, and the choice of the next poll.

This module does no I/O. Times are monotonic nanoseconds, which the caller passes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.histogram import Histogram
from fieldtwin.gateway.devices.config import DeviceConfig
from fieldtwin.gateway.devices.register_device import GroupReading, RegisterDriver
from fieldtwin.gateway.runtime.buses.backoff import Backoff
from fieldtwin.gateway.runtime.buses.modbus.probing import MARGIN_NS, Probing
from fieldtwin.gateway.runtime.buses.poll_schedule import PollSchedule, PollSlot, rates_of

FOREVER_NS = 2**62
"""The end of the free time of a bus on which no poll is planned."""


@dataclass
class DeviceState:
    """The bus's record of one of its devices.

    `tried` says that a request was sent to the device since the connection was opened. `polls` counts the groups that were read,
    and the attempts while the device did not answer.
    """

    driver: RegisterDriver
    schedule: PollSchedule
    backoff: Backoff
    online: bool = False
    tried: bool = False
    error: str = "not asked yet"
    polls: int = 0
    poll_errors: int = 0
    next_try_ns: int = 0
    busy_until_ns: int = 0
    """The end (ns) of the pause for groups to which the device answered "busy" (06) or "acknowledge" (05)."""
    reading: GroupReading | None = None
    """The group whose read is not complete (more transactions follow), or None; it has been due since `reading_due_ns`."""
    reading_due_ns: int = 0
    triggered: set[str] = field(default_factory=set)
    alone: bool = False
    """Whether this is the only device of its bus."""
    asked_ns: int = 0
    """The time of the last request to the device while it was away."""
    late_ns: int = 0
    """The duration of a reply that arrived after a shortened timeout; 0 if no reply was late."""
    last_cost_ns: int = 0
    """The time for which the device's last poll used the bus without success, although the device answered at first."""
    timeout_ns: int = 0
    """The timeout of the next request to the device; 0: the device's configured timeout."""
    answered_ns: int = 0
    """The time at which the device last answered a poll."""
    silences: int = 0
    """The number of consecutive polls without a reply, while the device counts as online."""
    fits: bool = True
    """Whether the next attempt can end before a different device misses a poll."""

    @property
    def retries_left(self) -> bool:
        """Return whether to repeat a request without a reply. False if the device may be absent and others need the bus."""
        return self.online or (self.alone and not self.backoff.failures)


def states_of(drivers: list[RegisterDriver], offset: float) -> list[DeviceState]:
    """Return the states of a bus's devices, with the phases of their groups; `offset` is that of `poll_schedule.spread`."""
    rates = rates_of([driver.config for driver in drivers], offset)
    alone = len(drivers) == 1
    return [_state(driver, rates[driver.config.name], alone) for driver in drivers]


def _state(driver: RegisterDriver, rates: dict[str, PollSlot], alone: bool) -> DeviceState:
    config, known = driver.config, driver.config.expect
    once = [
        group
        for group in driver.plans
        if group not in config.poll and any(t.name not in known for t in driver.profile.group(group))
    ]
    backoff = Backoff(config.backoff_first_s, config.backoff_limit_s)
    return DeviceState(driver, PollSchedule(rates, once), backoff, alone=alone)


def restate(device: DeviceState, config: DeviceConfig, rates: dict[str, PollSlot], now_ns: int) -> None:
    """Apply a new configuration to a device while no group of it is being read."""
    device.driver.reconfigure(config)
    device.backoff.restate(config.backoff_first_s, config.backoff_limit_s)
    device.schedule.restate(rates, config.phase, now_ns, there=device.online)
    device.triggered &= rates.keys()


class Turns:
    """The order of polls among `devices`, and of the probes of devices that are away. `Probing` describes `share`."""

    def __init__(self, devices: list[DeviceState], share: float, t35_ns: int = 0) -> None:
        self._devices = devices
        self._probing = Probing(share, t35_ns)
        self._failed_ns = 0
        self.doubt_ns = 0
        """Devices that answered a poll since this time are polled before the others; repetitions come last."""

    def next(
        self, spaced_ns: Callable[[int], int], now_ns: int, latency: Histogram, bus_timeout_s: float = 1.0
    ) -> tuple[DeviceState | None, str, int]:
        """Return the next poll and its time: the most overdue poll that may start now, else the poll that may start first.

        `spaced_ns` returns the end of a unit's pause; `latency` holds the recent latencies. A device that is away has only its
        next probe (group ""), for which its `timeout_ns` is set. A group that is partly read is completed before another group of
        its device begins.
        """
        best: tuple[int, int, int, int] | None = None
        found: tuple[DeviceState | None, str] = None, ""  # a bus without polls only carries jobs
        doubt_ns = self.doubt_ns
        away: list[tuple[int, DeviceState, int]] = []
        for order, device in enumerate(self._devices):
            ready_ns = spaced_ns(device.driver.config.address)
            if ready_ns < now_ns:
                ready_ns = now_ns
            if not device.online:
                away.append((order, device, ready_ns))
                continue
            choices: Iterable[tuple[str, int]]
            if device.reading is not None:
                choices = ((device.reading.what, device.reading_due_ns),)
            else:
                choices = device.schedule.due_ns.items()
            for group, due_ns in choices:
                at_ns = due_ns if due_ns > ready_ns else ready_ns
                doubt = 0 if device.answered_ns >= doubt_ns else 2 if device.silences else 1
                key = at_ns, doubt, due_ns, order
                if best is None or key < best:
                    best, found = key, (device, group)
        if away:
            free_ns = self._free_until_ns(best[0] if best is not None else None, now_ns)
            probe = self._next_probe(away, now_ns, free_ns, latency.recent_longest_ns, bus_timeout_s)
            if best is None or probe[0] < (best[0], best[2]):
                return probe[1], "", probe[0][0]
        return *found, best[0] if best is not None else now_ns + NS_PER_S

    def restate(self, share: float) -> None:
        """Set a new share, from the next probe on."""
        self._probing.restate(share)

    def _free_until_ns(self, poll_ns: int | None, now_ns: int) -> int | None:
        """Return the time until which the devices that answer do not need the bus: `now_ns` while a poll is due.

        Return None if no device answers."""
        online = [device for device in self._devices if device.online]
        if not online:
            return None
        if poll_ns is not None and poll_ns <= now_ns:
            return now_ns
        ends = [end for device in online if (end := device.schedule.free_until_ns()) is not None]
        return min(ends, default=FOREVER_NS)

    def _next_probe(
        self,
        away: list[tuple[int, DeviceState, int]],
        now_ns: int,
        free_ns: int | None,
        seen_ns: int,
        bus_timeout_s: float,
    ) -> tuple[tuple[int, int], DeviceState]:
        """Return the next device to probe of those that are away, the time of the probe, and the time since when the device
        waits.

        Devices to which no request was sent yet come first, then the device whose last request is the oldest.
        """
        untried = [entry for entry in away if not entry[1].tried]
        best: tuple[tuple[int, int, int, int], DeviceState] | None = None
        for order, device, ready_ns in untried or away:
            due_ns = device.next_try_ns if device.tried else self._failed_ns
            ready_ns = max(ready_ns, due_ns)
            at_ns = self._probe_ns(device, ready_ns, now_ns, free_ns, seen_ns, bus_timeout_s)
            key = at_ns, due_ns, device.asked_ns, order
            if best is None or key < best[0]:
                best = key, device
        assert best is not None
        return best[0][:2], best[1]

    def _probe_ns(
        self,
        device: DeviceState,
        ready_ns: int,
        now_ns: int,
        free_ns: int | None,
        seen_ns: int,
        bus_timeout_s: float,
    ) -> int:
        """Return the time from which `device` may be probed, not before `ready_ns`, and set the timeout of that probe."""
        own_ns = _own_ns(device, bus_timeout_s)
        probing, failures, late_ns = self._probing, device.backoff.failures, device.late_ns
        device.fits = True
        if len(self._devices) == 1:
            device.timeout_ns = 0
            return ready_ns
        if free_ns is None:
            device.timeout_ns = probing.growing_ns(own_ns, seen_ns, late_ns, failures)
            return ready_ns
        device.timeout_ns = probing.short_ns(own_ns, seen_ns, late_ns)
        if ready_ns > now_ns:
            return ready_ns
        device.fits = probing.fits(max(device.timeout_ns + MARGIN_NS, device.last_cost_ns), now_ns, free_ns)
        if device.tried and probing.long_may_go(failures, now_ns):
            device.timeout_ns, device.fits = own_ns, False
        return probing.may_go_ns(device.fits, now_ns)

    def short_s(self, device: DeviceState, seen_ns: int, bus_timeout_s: float) -> float:
        """Return the shortened timeout of a device, in seconds."""
        return self._probing.short_ns(_own_ns(device, bus_timeout_s), seen_ns, device.late_ns) / NS_PER_S

    def failed(self, device: DeviceState, begun_ns: int, now_ns: int, clear_ns: int) -> None:
        """Note that `device` used the bus without success; the bus can be used again at `clear_ns`, after its
        quarantine."""
        self._failed_ns = now_ns
        if any(other.online for other in self._devices):
            self._probing.took(begun_ns, clear_ns, device.fits)


def _own_ns(device: DeviceState, bus_timeout_s: float) -> int:
    """Return the device's normal timeout in ns."""
    own_s = device.driver.config.timeout_s
    return round((bus_timeout_s if own_s is None else own_s) * NS_PER_S)
