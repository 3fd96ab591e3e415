"""The errors that a node has reported: the last emergency messages and the errors that are still active. Limited in size."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from fieldtwin.gateway.protocols.canopen.emcy import Emcy

MAX_ENTRIES = 32
MAX_ACTIVE = 32


@dataclass(frozen=True, slots=True)
class EmcyEntry:
    """An emergency message and its time of reception (monotonic, ns)."""

    t_ns: int
    emcy: Emcy


class EmcyLog:
    """The log of one node. `total` counts all messages, `forgotten` those that were removed because the log was full."""

    def __init__(self) -> None:
        self._entries: deque[EmcyEntry] = deque(maxlen=MAX_ENTRIES)
        self._active: dict[int, None] = {}
        self.total = 0

    def add(self, emcy: Emcy, t_ns: int) -> None:
        """Add a message.

        An error reset ends all errors, unless its error register says that some are left (CO-054). The message does not say which
        errors ended, so all are kept until the register is clear.
        """
        self.total += 1
        self._entries.append(EmcyEntry(t_ns, emcy))
        if not emcy.is_reset:
            self._active[emcy.code] = None
            if len(self._active) > MAX_ACTIVE:
                del self._active[next(iter(self._active))]
        elif not emcy.register:
            self._active.clear()

    def restarted(self) -> None:
        """Forget the active errors because the node booted and will report its present errors again. The history is kept."""
        self._active.clear()

    @property
    def forgotten(self) -> int:
        return self.total - len(self._entries)

    @property
    def entries(self) -> tuple[EmcyEntry, ...]:
        """Return the entries, newest first, as in 1003h."""
        return tuple(reversed(self._entries))

    @property
    def active(self) -> tuple[int, ...]:
        """Return the codes of the active errors, in the order in which they were reported."""
        return tuple(self._active)
