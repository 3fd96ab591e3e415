"""The heartbeat consumer (CiA 301, 7.2.8.2.2.2 and 7.2.8.3.2.2): the states of the nodes, and the loss of heartbeats.

The consumer does no I/O: its caller passes heartbeats and the time, and it returns events. Monitoring of a node starts at its
first heartbeat (CO-036). A late heartbeat within the consumer time is not an event (CO-037). A boot-up counts as a sign of life
of a node that is being monitored, but does not end a heartbeat loss: only a heartbeat does (CO-038).
"""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.protocols.canopen import cob_id
from fieldtwin.gateway.protocols.canopen.nmt.states import NmtState, NodeEvent, NodeEventKind, heartbeat_state

TWIN_BOOT_NS = 100 * NS_PER_MS
"""Two boot-ups within this time come from two nodes with the same ID, because one node does not boot so fast (CO-042)."""


@dataclass(slots=True)
class _Node:
    consumer_ns: int = 0
    state: NmtState | None = None
    monitored: bool = False
    lost: bool = False
    heard_ns: int = 0
    booted_ns: int | None = None
    boot_expected: bool = False

    @property
    def deadline_ns(self) -> int | None:
        watching = self.consumer_ns and self.monitored and not self.lost
        return self.heard_ns + self.consumer_ns if watching else None


class HeartbeatConsumer:
    """The states of up to 127 nodes. `ignored` counts messages that are not heartbeats."""

    def __init__(self) -> None:
        self._nodes: dict[int, _Node] = {}
        self.ignored = 0

    def monitor(self, node: int, consumer_ms: int) -> None:
        """Monitor `node` from its next heartbeat on; a time of 0 stops this. A node that is already monitored stays monitored."""
        known = self._node(cob_id.check_node(node))
        if not known.consumer_ns or not consumer_ms:
            known.monitored = known.lost = False
        known.consumer_ns = consumer_ms * NS_PER_MS

    def state(self, node: int) -> NmtState | None:
        """Return the last received state, or None if none was received. A lost node keeps its state: see `is_lost`."""
        known = self._nodes.get(node)
        return None if known is None else known.state

    def is_watched(self, node: int) -> bool:
        """Return whether the node has a consumer time and has sent a heartbeat (CO-036); a lost node stays watched."""
        known = self._nodes.get(node)
        return known is not None and known.consumer_ns > 0 and known.monitored

    def is_lost(self, node: int) -> bool:
        """Return whether the node's heartbeat is overdue."""
        known = self._nodes.get(node)
        return known is not None and known.lost

    def expect_boot_up(self, node: int) -> None:
        """Note that this master has requested the next boot-up of `node` (0: of every node)."""
        for known in self._nodes.values() if node == cob_id.ALL_NODES else [self._node(node)]:
            known.boot_expected = True

    def observe(self, node: int, data: bytes, t_ns: int) -> tuple[NodeEvent, ...]:
        """Handle a message of `node` on 700h + node ID, received at `t_ns`, and return the events that it causes."""
        state = heartbeat_state(data)
        if state is None:
            self.ignored += 1
            return ()
        known = self._node(node)
        events = list(self._overdue(node, known, t_ns))  # `check` may not have been called in between
        if state is NmtState.INITIALISING:
            events += self._booted(node, known, data, t_ns)
            return tuple(events)
        changed = state is not known.state
        known.state, known.monitored = state, True
        known.heard_ns = max(known.heard_ns, t_ns)
        if known.lost:
            known.lost = False
            events.append(NodeEvent(node, "heartbeat-back", state, data, t_ns))
        if changed:
            events.append(NodeEvent(node, "state", state, data, t_ns))
        return tuple(events)

    def check(self, now_ns: int) -> tuple[NodeEvent, ...]:
        """Return an event for each node that became overdue by `now_ns`; each is reported once."""
        return tuple(event for node, known in self._nodes.items() for event in self._overdue(node, known, now_ns))

    def deadline_ns(self, node: int) -> int | None:
        """Return when the node's heartbeat is overdue, or None while it is not watched."""
        known = self._nodes.get(node)
        return None if known is None else known.deadline_ns

    def next_deadline_ns(self) -> int | None:
        """Return when `check` is due next, or None while no node is watched."""
        deadlines = [d for known in self._nodes.values() if (d := known.deadline_ns) is not None]
        return min(deadlines, default=None)

    def _node(self, node: int) -> _Node:
        known = self._nodes.get(node)
        if known is None:
            known = self._nodes[node] = _Node()
        return known

    def _overdue(self, node: int, known: _Node, now_ns: int) -> tuple[NodeEvent, ...]:
        deadline_ns = known.deadline_ns
        if deadline_ns is None or now_ns <= deadline_ns:
            return ()
        known.lost = True
        return (NodeEvent(node, "heartbeat-lost", known.state, b"", now_ns),)

    def _booted(self, node: int, known: _Node, data: bytes, t_ns: int) -> list[NodeEvent]:
        kinds: list[NodeEventKind] = ["boot-up"]
        if known.booted_ns is not None and not known.boot_expected and t_ns - known.booted_ns < TWIN_BOOT_NS:
            kinds.append("conflict")
        unexpected = known.state is not None and not known.boot_expected
        known.booted_ns, known.boot_expected, known.state = t_ns, False, NmtState.INITIALISING
        known.heard_ns = max(known.heard_ns, t_ns)
        return [NodeEvent(node, kind, known.state, data, t_ns, unexpected) for kind in kinds]
