"""The schedule of a device's poll groups: each group has its own period and its own phase in that period.

Groups with the same period are spread over it in the file's order, so that a bus does not get all requests at the same time. All
times are on a grid that begins when the bus starts. A missed period is counted and skipped; the read is not made up for. This
module does no I/O. Times are monotonic nanoseconds, which the caller passes.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Mapping, Sequence
from typing import NamedTuple, TypeVar

from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.devices.config import DeviceConfig

K = TypeVar("K", bound=Hashable)
SOONER = 8
"""A group that is moving to its phase moves by at most 1/`SOONER` of its period each time that it is read."""


class PollSlot(NamedTuple):
    """A group's period, and the phase at which the group is read (0 to less than the period), in nanoseconds."""

    period_ns: int
    phase_ns: int


def spread(
    groups: Sequence[tuple[K, int]], stated_ms: Mapping[K, int] | None = None, offset: float = 0.0
) -> dict[K, PollSlot]:
    """Return a phase for each of `groups` (key, period in ms), which are all on one bus.

    The k-th of the n groups of one period P is at P x (k + offset) / n. `offset`, 0 to less than 1, shifts these phases,
    so that several buses are not polled at the same time. A configured phase is used as it is, modulo the period.
    """
    stated = stated_ms or {}
    members: dict[int, list[K]] = {}
    for key, period_ms in groups:
        if key not in stated:
            members.setdefault(period_ms, []).append(key)
    rates = {
        key: PollSlot(period_ms * NS_PER_MS, stated.get(key, 0) % period_ms * NS_PER_MS) for key, period_ms in groups
    }
    for period_ms, keys in members.items():
        period_ns = period_ms * NS_PER_MS
        for k, key in enumerate(keys):
            rates[key] = PollSlot(period_ns, min(int(period_ns * (k + offset) / len(keys)), period_ns - 1))
    return rates


def rates_of(configs: Sequence[DeviceConfig], offset: float = 0.0) -> dict[str, dict[str, PollSlot]]:
    """Return the rates of the groups of one bus's devices, by device name."""
    groups: list[tuple[tuple[str, str], int]] = []
    stated: dict[tuple[str, str], int] = {}
    for config in configs:
        groups += [((config.name, group), every_ms) for group, every_ms in config.poll.items()]
        stated |= {(config.name, group): phase_ms for group, phase_ms in config.phase.items()}
    rates = spread(groups, stated, offset)
    return {config.name: {group: rates[config.name, group] for group in config.poll} for config in configs}


class PollSchedule:
    """The schedule of one device: `rates` of the groups read cyclically, and `once` for those read only after connecting.

    `due_ns` holds for each group the time at which it is due; it is empty while the device is away. `missed` counts for each
    group the periods in which the device was online but not read.
    """

    def __init__(self, rates: Mapping[str, PollSlot], once: Sequence[str]) -> None:
        self._rates = dict(rates)
        self._once = tuple(once)
        self._epoch_ns = 0
        self._goal_ns: dict[str, int] = {}
        """The target phase of a group that is still moving to it."""
        self.due_ns: dict[str, int] = {}
        self.missed = dict.fromkeys(rates, 0)

    def anchor(self, epoch_ns: int) -> None:
        """Set the start of the grid to `epoch_ns`."""
        self._epoch_ns = epoch_ns

    def restate(self, rates: Mapping[str, PollSlot], stated: Collection[str], now_ns: int, *, there: bool) -> None:
        """Use `rates` from now on; it holds all groups that are read cyclically. `stated` are those with a configured
        phase.

        A group whose period changed is due one new period after its last slot, or now: no interval is shorter than the shorter of
        both periods, and none is longer than the longer. From there a group moves to its new phase in small steps, always
        earlier: until then, its intervals are up to an eighth shorter than its period, and never longer. A group with a
        configured phase moves there in one step, by at most half a period earlier or later. An overdue group stays overdue. A new
        group is read now if the device is online (`there`).
        """
        kept, self._rates = self._rates, dict(rates)
        self._goal_ns.clear()
        for group, rate in rates.items():
            self.missed.setdefault(group, 0)
            old, due_ns = kept.get(group), self.due_ns.get(group)
            if old is None:
                if there:
                    self.due_ns[group] = now_ns
            elif old.period_ns == rate.period_ns and (group not in stated or old.phase_ns == rate.phase_ns):
                self._rates[group] = old
            elif due_ns is not None:
                last_ns = due_ns - old.period_ns
                if group in stated and due_ns > now_ns:
                    due_ns = self._place(rate, max(now_ns, last_ns + rate.period_ns // 2))
                elif group not in stated:
                    due_ns = due_ns if due_ns <= now_ns else max(now_ns, last_ns + rate.period_ns)
                    self._rates[group] = PollSlot(rate.period_ns, (due_ns - self._epoch_ns) % rate.period_ns)
                self.due_ns[group] = due_ns
            if self._rates[group] != rate:
                self._goal_ns[group] = rate.phase_ns
        for group in kept.keys() - rates.keys():
            self.due_ns.pop(group, None)

    def _place(self, rate: PollSlot, after_ns: int) -> int:
        """Return the time (ns) of the first slot on the grid of `rate` after `after_ns`."""
        start_ns = self._epoch_ns + rate.phase_ns
        return start_ns + ((after_ns - start_ns) // rate.period_ns + 1) * rate.period_ns

    def start(self, now_ns: int) -> None:
        """Start polling an online device: every group is due once now, and later at its slots on the grid."""
        for group, phase_ns in self._goal_ns.items():
            self._rates[group] = self._rates[group]._replace(phase_ns=phase_ns)
        self._goal_ns.clear()
        self.due_ns = dict.fromkeys([*self._rates, *self._once], now_ns)

    def stop(self) -> None:
        """Stop polling, because the device is lost: no group is due, and no period counts as missed."""
        self.due_ns = {}

    def took(self, group: str, now_ns: int) -> None:
        """Note that `group` is being read now: it is due again at its next slot on the grid."""
        due_ns = self.due_ns.pop(group)
        rate = self._rates.get(group)
        if rate is None:
            return
        start_ns = self._epoch_ns + rate.phase_ns
        passed = (now_ns - start_ns) // rate.period_ns
        self.missed[group] += max(0, passed - (due_ns - start_ns) // rate.period_ns)
        self.due_ns[group] = start_ns + (passed + 1) * rate.period_ns
        if group in self._goal_ns:
            self._move_earlier(group, rate, now_ns)

    def _move_earlier(self, group: str, rate: PollSlot, now_ns: int) -> None:
        """Move a group that is being read now by one step towards its target phase."""
        step_ns, most_ns = (rate.phase_ns - self._goal_ns[group]) % rate.period_ns, rate.period_ns // SOONER
        if self.due_ns[group] - now_ns < rate.period_ns - most_ns:
            return  # this read is late, and the next one would follow too soon
        if step_ns <= most_ns:
            del self._goal_ns[group]
        else:
            step_ns = most_ns
        self.due_ns[group] -= step_ns
        self._rates[group] = PollSlot(rate.period_ns, (rate.phase_ns - step_ns) % rate.period_ns)

    def free_until_ns(self) -> int | None:
        """Return the time until which another task may use the bus without making a group miss its period.

        That is the middle of the period of the group that is due first; None if no group is read cyclically."""
        return min(
            (due + self._rates[g].period_ns // 2 for g, due in self.due_ns.items() if g in self._rates), default=None
        )

    def defer(self, group: str, until_ns: int) -> None:
        """Make `group` due at `until_ns` instead of its slot on the grid, because the device is busy or is measuring."""
        self.due_ns[group] = until_ns
