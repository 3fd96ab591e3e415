"""Node guarding and life guarding, on the side of the guarded node (CiA 301 v4.2, 7.2.8.2.1; 100Ch, 100Dh).

The answer to a guarding request carries the state and a toggle bit. After its first request a node expects the next
within the life time; otherwise it sends EMCY 8130h and reacts as 1029h demands. An active heartbeat producer disables guarding.
"""

from __future__ import annotations

from fieldtwin.emulators.canopen.errors import emcy
from fieldtwin.emulators.canopen.errors.error_control import ERROR_CONTROL, ErrorReaction
from fieldtwin.emulators.canopen.service import NEVER, Core, NodeService
from fieldtwin.gateway.core.clock import NS_PER_MS

_SOURCE = "life guarding"


class NodeGuarding(NodeService):
    """The guarded side: it answers guarding requests and monitors that they arrive."""

    due_ns: int = NEVER
    """The end of the life time."""

    def __init__(self, core: Core, emergency: emcy.Emergency, react: ErrorReaction) -> None:
        self._core = core
        self._emergency = emergency
        self._react = react
        self._toggle = 0
        self._guarded = False

    @property
    def waits(self) -> bool:
        return self._core.data.has(0x100C)

    def owns(self, index: int) -> bool:
        return index in (0x100C, 0x100D, 0x1017)

    def wrote(self, index: int, subindex: int, now_ns: int) -> None:
        self.due_ns = self._next_end(now_ns) if self._guarded else NEVER

    def reset(self, now_ns: int) -> None:
        self._toggle = 0
        self._guarded = False
        self.due_ns = NEVER

    def requested(self, now_ns: int) -> None:
        """Answer a remote frame that requests the state."""
        if self._core.data.number(0x1017) or not self._core.data.has(0x100C):
            self._core.counters.ignored += 1
            return
        self._core.send(ERROR_CONTROL + self._core.node_id, bytes([self._toggle << 7 | self._core.state]), now_ns)
        self._toggle ^= 1
        self._guarded = True
        self.due_ns = self._next_end(now_ns)
        self._emergency.clear_error(emcy.HEARTBEAT_LOST, now_ns, source=_SOURCE)

    def tick(self, now_ns: int) -> None:
        if now_ns >= self.due_ns:
            self.due_ns = NEVER
            self._guarded = False  # monitoring starts again with the next request
            self._emergency.raise_error(emcy.HEARTBEAT_LOST, now_ns, register=emcy.COMMUNICATION, source=_SOURCE)
            self._react(now_ns)

    def _next_end(self, now_ns: int) -> int:
        data = self._core.data
        life_ms = 0 if data.number(0x1017) else data.number(0x100C) * data.number(0x100D)
        return now_ns + life_ms * NS_PER_MS if life_ms else NEVER
