"""Error control: heartbeat producer (1017h), heartbeat consumer (1016h) and the reaction to communication errors (1029h).

CiA 301 v4.2, 7.2.8 and 7.5.2.19 to 20. A node without 1017h produces no heartbeat.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from fieldtwin.emulators.canopen.aborts import Abort, abort
from fieldtwin.emulators.canopen.errors import emcy
from fieldtwin.emulators.canopen.service import NEVER, Core, NmtState, NodeService
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_MS

ERROR_CONTROL = 0x700


class ErrorReaction:
    """Carries out the reaction to a communication error that 1029h:01 selects."""

    def __init__(self, core: Core, change_state: Callable[[NmtState, int], None]) -> None:
        self._core = core
        self._change_state = change_state

    def __call__(self, now_ns: int) -> None:
        """React to a communication error as the value of 1029h:01 demands (CiA 301, 7.5.2.32).

        0: go from OPERATIONAL to PRE-OPERATIONAL. 1: no change. 2: go to STOPPED."""
        reaction = self._core.data.number(0x1029, 1)
        if reaction == 0 and self._core.operational:
            self._change_state(NmtState.PRE_OPERATIONAL, now_ns)
        elif reaction == 2 and self._core.state is not NmtState.INITIALISING:
            self._change_state(NmtState.STOPPED, now_ns)


class HeartbeatProducer(NodeService):
    """The producer that sends the state every 1017h milliseconds. A newly written period begins immediately, with a heartbeat."""

    due_ns: int = NEVER
    """The time at which the next heartbeat must be sent."""

    def __init__(self, core: Core) -> None:
        self._core = core

    @property
    def waits(self) -> bool:
        return self._core.data.has(0x1017)

    def owns(self, index: int) -> bool:
        return index == 0x1017

    def wrote(self, index: int, subindex: int, now_ns: int) -> None:
        self.due_ns = now_ns if self._period_ns() else NEVER

    def reset(self, now_ns: int) -> None:
        """Schedule the heartbeat. The boot-up message counts as the first heartbeat."""
        period_ns = self._period_ns()
        self.due_ns = now_ns + period_ns if period_ns else NEVER

    def tick(self, now_ns: int) -> None:
        if now_ns < self.due_ns:
            return
        self._core.counters.heartbeats += 1
        self._core.send(ERROR_CONTROL + self._core.node_id, bytes([self._core.state]), now_ns)
        period_ns = self._period_ns()
        self.due_ns += period_ns
        if self.due_ns <= now_ns:  # late by more than a period: skip heartbeats, and never send several at once
            self.due_ns = now_ns + period_ns

    def _period_ns(self) -> int:
        return self._core.data.number(0x1017) * NS_PER_MS


@dataclass(slots=True)
class _Watched:
    period_ns: int
    deadline_ns: int = NEVER
    lost: bool = False


class HeartbeatConsumer(NodeService):
    """The monitor of the nodes of 1016h, each from its first heartbeat on. A loss causes EMCY 8130h and the reaction of 1029h."""

    due_ns: int = NEVER
    """The time at which the first missing heartbeat is detected."""

    def __init__(self, core: Core, emergency: emcy.Emergency, react: ErrorReaction) -> None:
        self._core = core
        self._emergency = emergency
        self._react = react
        self._watched: dict[int, _Watched] = {}

    @property
    def lost(self) -> tuple[int, ...]:
        """Return the node IDs whose heartbeat is missing."""
        return tuple(sorted(node for node, watched in self._watched.items() if watched.lost))

    @property
    def waits(self) -> bool:
        return bool(self._subs())

    def owns(self, index: int) -> bool:
        return index == 0x1016

    def check_write(self, index: int, subindex: int, raw: bytes) -> None:
        node, period_ms = _split(int.from_bytes(raw, "little"))
        others = [_split(self._core.data.number(0x1016, sub)) for sub in self._subs() if sub != subindex]
        if period_ms and 1 <= node <= 127 and any(other == node and time for other, time in others):
            raise abort(index, subindex, Abort.INCOMPATIBLE)

    def wrote(self, index: int, subindex: int, now_ns: int) -> None:
        self._configure()
        self._clear_if_all_heard(now_ns)  # 1016h may have changed, so that the missing node is not monitored now

    def reset(self, now_ns: int) -> None:
        self._watched.clear()
        self._configure()

    def heard(self, frame: CanFrame, now_ns: int) -> None:
        """Process an error control frame of a different node."""
        watched = self._watched.get(frame.can_id - ERROR_CONTROL)
        if watched is None:
            return
        if len(frame.data) != 1 or frame.data[0] not in set(NmtState):
            self._core.counters.ignored += 1
        elif frame.data[0] == NmtState.INITIALISING:
            # a boot-up message is not a heartbeat: monitoring starts again with the first heartbeat
            watched.deadline_ns = NEVER
        else:
            watched.deadline_ns = now_ns + watched.period_ns
            watched.lost = False
            self._clear_if_all_heard(now_ns)
        self._find_due()

    def tick(self, now_ns: int) -> None:
        for watched in self._watched.values():
            if now_ns >= watched.deadline_ns:
                watched.deadline_ns = NEVER
                watched.lost = True
                self._emergency.raise_error(emcy.HEARTBEAT_LOST, now_ns, register=emcy.COMMUNICATION)
                self._react(now_ns)
        self._find_due()

    def _find_due(self) -> None:
        self.due_ns = min((watched.deadline_ns for watched in self._watched.values()), default=NEVER)

    def _clear_if_all_heard(self, now_ns: int) -> None:
        if not self.lost:
            self._emergency.clear_error(emcy.HEARTBEAT_LOST, now_ns)

    def _subs(self) -> list[int]:
        found = self._core.data.dictionary.objects.get(0x1016)
        return [sub for sub in found.entries if sub] if found else []

    def _configure(self) -> None:
        """Apply 1016h; unchanged entries keep their monitoring state."""
        wanted = dict(_split(self._core.data.number(0x1016, sub)) for sub in self._subs())
        before, self._watched = self._watched, {}
        for node, period_ms in wanted.items():
            if period_ms and 1 <= node <= 127:
                kept = before.get(node)
                same = kept is not None and kept.period_ns == period_ms * NS_PER_MS
                self._watched[node] = kept if kept is not None and same else _Watched(period_ms * NS_PER_MS)
        self._find_due()


def _split(value: int) -> tuple[int, int]:
    """Return the node ID and milliseconds of a consumer heartbeat time."""
    return value >> 16 & 0xFF, value & 0xFFFF
