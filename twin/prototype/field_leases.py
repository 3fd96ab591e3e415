"""Leases on the simulated field devices. The faults and values that a test runner injects last only as long as it renews its
lease.

A test runner (a scenario on a running system; messages call it *judge*) opens a lease on the control channel, injects faults
and sets values under the lease's id, and renews it. Even after kill -9 or a lost network, everything that the test runner
injected is removed when the lease ends: faults are cleared, and each device value is restored to that before the test runner's
first `set`. Only one test runner at a time can hold the lease, because the faults of one test runner would change the results
of another.

This module reads no clock. Times are arguments, in ns on the clock of the process of the field devices.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.twin.prototype.field_status import HeldLease, LeaseStatus

if TYPE_CHECKING:  # a test runner on a plant imports LEASE_S without emulators
    from fieldtwin.twin.prototype.field_faults import FieldFaults


LEASE_S = 10.0
"""Seconds after which a lease that was not renewed ends, unless the test runner asks for another time."""
MOST_LEASE_S = 60.0
MOST_ID = 100


class LeaseEnded(UsageError):
    """The lease has expired or was released: the faults and values under it have been removed."""


class LeaseTaken(UsageError):
    """Another test runner holds the lease."""


@dataclass
class _Lease:
    id: str
    until_ns: int
    faults: set[str] = field(default_factory=set)
    before: dict[tuple[str, str], float | None] = field(default_factory=dict)
    """The values that were set before this lease, by device and tag; None for a tag that was not set."""


class FieldLeases:
    """Manages the lease on `faults`. There is at most one lease at a time."""

    def __init__(self, faults: FieldFaults) -> None:
        self._faults = faults
        self._lease: _Lease | None = None
        self.expired = 0
        """Number of leases that ended because their test runner did not renew them."""

    @property
    def until_ns(self) -> int | None:
        """Return the time (ns) at which the lease ends unless it is renewed; None without a lease."""
        return None if self._lease is None else self._lease.until_ns

    def open(self, id: str, for_s: float, now_ns: int) -> None:
        """Open the lease `id` of a test runner for `for_s` seconds. Raises `LeaseTaken` while another test runner holds it."""
        self.expire(now_ns)
        if not id or len(id) > MOST_ID:
            raise UsageError("the lease's id", expected=f"1 to {MOST_ID} characters", got=repr(id)[:60])
        if self._lease is not None and self._lease.id != id:
            left_s = (self._lease.until_ns - now_ns) / NS_PER_S
            raise LeaseTaken(
                f"another test ({self._lease.id}) uses these simulated field devices",
                hint=f"wait until it ends; unless renewed, its lease expires in {left_s:.1f} s",
            )
        if self._lease is None:
            self._lease = _Lease(id, 0)
        self._lease.until_ns = now_ns + _duration_ns(for_s)

    def renew(self, id: str, for_s: float, now_ns: int) -> None:
        """Prolong the lease to `for_s` seconds from now. Raises `LeaseEnded`."""
        self.of(id, now_ns).until_ns = now_ns + _duration_ns(for_s)

    def of(self, id: str, now_ns: int) -> _Lease:
        """Return the lease with the identifier `id`. Raises `LeaseEnded` if it has ended."""
        self.expire(now_ns)
        if self._lease is None or self._lease.id != id:
            raise LeaseEnded(
                "the test's lease on the simulated field devices has ended: its faults and values were removed",
                expected=f"a lease that is renewed in time (every few seconds; it lasts {LEASE_S:g} s)",
            )
        return self._lease

    def inject(self, id: str, said: dict[str, Any], start_ns: int | None, now_ns: int) -> str:
        """Inject a fault under the lease and return the fault's id."""
        lease = self.of(id, now_ns)
        fault = self._faults.inject(said, start_ns)
        lease.faults.add(fault)
        return fault

    def set_value(self, id: str, device: str, tag: str, value: float | str | bool | None, now_ns: int) -> None:
        """Set a device value under the lease; None removes the set value. The end of the lease restores the earlier value."""
        lease, before = self.of(id, now_ns), self._faults.value_set(device, tag)
        self._faults.set_value(device, tag, value)
        lease.before.setdefault((device, tag), before)

    def release(self, id: str) -> None:
        """Remove everything injected under the lease `id`. Does nothing if that lease has already ended."""
        if self._lease is not None and self._lease.id == id:
            self._end()

    def expire(self, now_ns: int) -> bool:
        """End the lease if its time is over, and return whether it ended."""
        if self._lease is None or now_ns < self._lease.until_ns:
            return False
        self.expired += 1
        self._end()
        return True

    def _end(self) -> None:
        lease, self._lease = self._lease, None
        assert lease is not None
        for fault in sorted(lease.faults & set(self._faults.ids())):  # the test runner may have cleared some
            self._faults.clear(fault)
        for (device, tag), value in lease.before.items():
            self._faults.set_value(device, tag, value)

    def moved_to(self, faults: FieldFaults) -> None:
        """Move the lease to devices that were created again, whose faults are `faults`. The lease continues, but no fault or
        value belongs to it.
        """
        self._faults = faults
        if self._lease is not None:
            self._lease = _Lease(self._lease.id, self._lease.until_ns)

    def status(self, now_ns: int) -> LeaseStatus:
        """Return the lease's state for the control channel."""
        lease = self._lease
        held = None
        if lease is not None:
            left_s = max(0.0, (lease.until_ns - now_ns) / NS_PER_S)
            sets = [f"{device}.{tag}" for device, tag in lease.before]
            held = HeldLease(id=lease.id, left_s=round(left_s, 3), faults=sorted(lease.faults), set=sets)
        return LeaseStatus(held=held, expired=self.expired)


def _duration_ns(for_s: float) -> int:
    if not 0 < for_s <= MOST_LEASE_S:
        raise UsageError(
            "how long a lease lasts", expected=f"more than 0 s, at most {MOST_LEASE_S:g} s", got=f"{for_s}"
        )
    return round(for_s * NS_PER_S)
