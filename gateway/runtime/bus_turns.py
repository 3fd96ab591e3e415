"""Whose turn it is on a Modbus bus: its devices as the bus sees them, and the poll that goes next.

Pure: times are monotonic nanoseconds, passed in. It must never know a connection or what a poll does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

from gateway.core.clock import NS_PER_S
from gateway.devices.config import DeviceConfig
from gateway.devices.register_device import Reading, RegisterDriver
from gateway.runtime.backoff import Backoff
from gateway.runtime.poll_schedule import PollSchedule, Rate, spread


@dataclass
class DeviceState:
    """What the bus knows about one of its devices. `tried`: it was asked something since the connection was opened.
    `polls` counts groups that were read, and tries while it was away."""

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
    """It said that it is busy, and is given time until then."""
    reading: Reading | None = None
    """The group that is being read, of which some transactions are left; it began to be due at `reading_due_ns`."""
    reading_due_ns: int = 0
    triggered: set[str] = field(default_factory=set)

    @property
    def retries_left(self) -> bool:
        """Whether a request that nobody answers is worth repeating: not while the device is known to be away."""
        return self.online or not self.backoff.failures


def states_of(drivers: list[RegisterDriver], offset: float) -> list[DeviceState]:
    """The devices of a bus, each with its groups' places in their periods; `offset` keeps several buses apart."""
    rates = rates_of([driver.config for driver in drivers], offset)
    return [_state(driver, rates[driver.config.name]) for driver in drivers]


def rates_of(configs: Sequence[DeviceConfig], offset: float = 0.0) -> dict[str, dict[str, Rate]]:
    """By the names of the devices of one bus: the rates of their groups."""
    groups: list[tuple[tuple[str, str], int]] = []
    stated: dict[tuple[str, str], int] = {}
    for config in configs:
        groups += [((config.name, group), every_ms) for group, every_ms in config.poll.items()]
        stated |= {(config.name, group): phase_ms for group, phase_ms in config.phase.items()}
    rates = spread(groups, stated, offset)
    return {config.name: {group: rates[config.name, group] for group in config.poll} for config in configs}


def _state(driver: RegisterDriver, rates: dict[str, Rate]) -> DeviceState:
    config, known = driver.config, driver.config.expect
    once = [
        group
        for group in driver.plans
        if group not in config.poll and any(t.name not in known for t in driver.profile.group(group))
    ]
    return DeviceState(driver, PollSchedule(rates, once), Backoff(config.backoff_first_s, config.backoff_limit_s))


def restate(device: DeviceState, config: DeviceConfig, rates: dict[str, Rate], now_ns: int) -> None:
    """Another configuration for a device of which nothing is being read."""
    device.driver.reconfigure(config)
    device.backoff.restate(config.backoff_first_s, config.backoff_limit_s)
    device.schedule.restate(rates, config.phase, now_ns, there=device.online)
    device.triggered &= rates.keys()


class Turns:
    """The order of polls among `devices`. Tries of those that are away get at most `probe_share` of the time, over 0 to
    1, while others answer."""

    def __init__(self, devices: list[DeviceState], probe_share: float) -> None:
        self._devices = devices
        self._share = probe_share
        self._failed_ns = 0
        self._free_ns = 0

    def next(self, spaced_ns: Callable[[int], int], now_ns: int) -> tuple[DeviceState | None, str, int]:
        """The most overdue poll of those that may go now, else the one that may go first; and when that is.

        `spaced_ns` tells until when a unit has its pause. A device that is away has only its next try (group ""); a group
        of which some was read goes on before another one of its device begins.
        """
        best: tuple[int, int, int] | None = None
        found: tuple[DeviceState | None, str] = None, ""  # a bus without polls only carries jobs
        for order, device in enumerate(self._devices):
            if not device.online:
                if device.tried and any(not d.tried for d in self._devices):
                    continue  # first those that were not asked at all
                choices: Iterable[tuple[str, int]] = (("", self._try_ns(device)),)
            elif device.reading is not None:
                choices = ((device.reading.what, device.reading_due_ns),)
            else:
                choices = device.schedule.due_ns.items()
            ready_ns = spaced_ns(device.driver.config.address)
            if ready_ns < now_ns:
                ready_ns = now_ns
            for group, due_ns in choices:
                key = (due_ns if due_ns > ready_ns else ready_ns), due_ns, order
                if best is None or key < best:
                    best, found = key, (device, group)
        return *found, best[0] if best is not None else now_ns + NS_PER_S

    def restate(self, probe_share: float) -> None:
        """Another share, from the next try on."""
        self._share = probe_share

    def _try_ns(self, device: DeviceState) -> int:
        """When a device that is away is asked again. On a new connection each is asked once, whatever the share; polls
        that fell due during one such try go before the next."""
        return max(device.next_try_ns, self._free_ns) if device.tried else self._failed_ns

    def failed(self, begun_ns: int, now_ns: int, clear_ns: int) -> None:
        """A device had the bus in vain; the line can be used again at `clear_ns`, behind its quarantine. Those that answer
        have their share of the time before the next try."""
        self._failed_ns = now_ns
        if any(device.online for device in self._devices):
            self._free_ns = clear_ns + int((clear_ns - begun_ns) * (1 / self._share - 1))
