"""The state of one alarm: the alarm state transition diagram of ISA-18.2-2016 and IEC 62682, with delays and shelving.

    state                     ISA-18.2   condition   acknowledged
    normal                    NORM       false       yes
    active_unacknowledged     UNACK      true        no
    active_acknowledged       ACKED      true        yes
    returned_unacknowledged   RTNUN      false       no
    shelved                   SHLVD      either      -

This module has no clock and does no I/O: the caller passes `now_ns` (monotonic time in ns).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

NEVER_DUE_NS = 2**63 - 1


class AlarmState(Enum):
    """The states. An alarm that needs no acknowledgement is `normal`, `active_acknowledged` or `shelved`."""

    NORMAL = "normal"
    UNACKNOWLEDGED = "active_unacknowledged"
    ACKNOWLEDGED = "active_acknowledged"
    RETURNED = "returned_unacknowledged"
    SHELVED = "shelved"


ALARM_STATES = tuple(state.value for state in AlarmState)
ACKNOWLEDGEABLE = (AlarmState.UNACKNOWLEDGED, AlarmState.RETURNED)


@dataclass(slots=True)
class AlarmStateMachine:
    """One alarm. `on_delay_ns` and `off_delay_ns` are the times in ns for which the condition must be true before the alarm
    becomes active, and false before it returns to normal.

    `is_active` is the condition after these delays, also while the alarm is shelved.
    """

    on_delay_ns: int = 0
    off_delay_ns: int = 0
    needs_acknowledgement: bool = True
    is_active: bool = False
    _is_unacknowledged: bool = False
    _shelved_until_ns: int = 0
    """The end of shelving; 0: the alarm is not shelved."""
    _differs_since_ns: int | None = None
    """The time since which the condition has differed from `is_active` without interruption."""

    @property
    def state(self) -> AlarmState:
        """Return the present state."""
        if self._shelved_until_ns:
            return AlarmState.SHELVED
        if self.is_active:
            return AlarmState.UNACKNOWLEDGED if self._is_unacknowledged else AlarmState.ACKNOWLEDGED
        return AlarmState.RETURNED if self._is_unacknowledged else AlarmState.NORMAL

    @property
    def due_ns(self) -> int:
        """Return the time at which the state changes if the condition stays as it was in the last `step`."""
        due_ns = self._shelved_until_ns or NEVER_DUE_NS
        return due_ns if self._differs_since_ns is None else min(due_ns, self._differs_since_ns + self._delay_ns)

    @property
    def shelved_until_ns(self) -> int:
        """Return the end of shelving; 0 if the alarm is not shelved."""
        return self._shelved_until_ns

    @property
    def _delay_ns(self) -> int:
        return self.off_delay_ns if self.is_active else self.on_delay_ns

    def step(self, condition: bool | None, now_ns: int) -> None:
        """Take the condition as it is now. None means that it is unknown: the state stays, and a running delay begins again."""
        if condition is None or condition == self.is_active:
            self._differs_since_ns = None
        else:
            if self._differs_since_ns is None:
                self._differs_since_ns = now_ns
            if now_ns - self._differs_since_ns >= self._delay_ns:
                self._differs_since_ns = None
                self.is_active = condition
                if condition:
                    self._is_unacknowledged = self.needs_acknowledgement
        if self._shelved_until_ns and now_ns >= self._shelved_until_ns:
            self.unshelve()

    def acknowledge(self) -> None:
        """Acknowledge the alarm. In a state that is not in `ACKNOWLEDGEABLE`, nothing changes."""
        if self.state in ACKNOWLEDGEABLE:
            self._is_unacknowledged = False

    def shelve(self, until_ns: int) -> None:
        """Shelve the alarm until `until_ns`, which replaces the end of an earlier shelving."""
        self._shelved_until_ns = until_ns

    def unshelve(self) -> None:
        """End shelving. The alarm is then normal, or active and not acknowledged. If it is not shelved, nothing changes."""
        if self._shelved_until_ns:
            self._shelved_until_ns = 0
            self._is_unacknowledged = self.is_active and self.needs_acknowledgement
