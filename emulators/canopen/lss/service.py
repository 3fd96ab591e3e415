"""The LSS service of a node: the NMT states in which the node answers, and the effect of a new node ID or bit rate (CiA 305 v3.0,
4.3 and 6.3).

A configured node takes a new node ID at the next reset; an unconfigured node boots with it as soon as LSS leaves the
configuration state. The bit rate changes after the switch delay; the node is silent for one switch delay before the change and
one after it.
"""

from __future__ import annotations

from collections.abc import Callable

from fieldtwin.emulators.canopen.lss.slave import BIT_RATES, FROM_SLAVE, UNCONFIGURED, Identity, LssSlave, LssStore
from fieldtwin.emulators.canopen.service import NEVER, Core, NodeService
from fieldtwin.gateway.core.clock import NS_PER_MS

_MUTE = "bit timing"


class LssService(NodeService):
    """The LSS slave of one node. It calls `boot` with the time when an unconfigured node has got a pending node ID."""

    due_ns: int = NEVER
    """The time at which the node may send again, with the new bit rate."""

    def __init__(self, core: Core, store: LssStore, boot: Callable[[int], None]) -> None:
        self._core = core
        self._boot = boot
        rates = core.data.dictionary.bit_rates or frozenset(BIT_RATES.values())
        self._slave = LssSlave(self._identity, core.node_id, rates, store)
        self.bit_rate: int | None = None

    def power_on(self) -> None:
        """Restore the stored settings at power-on."""
        self._slave.pending_id = self._slave.stored_id
        self.bit_rate = self._slave.stored_rate
        self.due_ns = NEVER
        self._core.mutes.discard(_MUTE)

    def adopt(self, now_ns: int) -> None:
        """Apply the pending node ID at a reset. The caller resets the live values."""
        if self._slave.pending_id != self._core.node_id:
            self._core.node_id = self._slave.pending_id
            self._core.note(now_ns, "lss", 0, 0, bytes([self._core.node_id]))
            self._core.data.rebase(0 if self._core.node_id == UNCONFIGURED else self._core.node_id)
        self._slave.adopt(self._core.node_id)

    def receive(self, data: bytes, now_ns: int) -> None:
        """Process a frame of the LSS master; a node in OPERATIONAL ignores it."""
        if self._core.operational:
            self._core.counters.ignored += 1
            return
        reply = self._slave.request(data)
        if reply is not None:
            self._core.send(FROM_SLAVE, reply, now_ns)
        if self._slave.activate_ms is not None:
            delay_ns, self._slave.activate_ms = self._slave.activate_ms * NS_PER_MS, None
            self.due_ns = now_ns + 2 * delay_ns
            self._core.mutes.add(_MUTE)
        unconfigured = self._core.node_id == UNCONFIGURED
        if unconfigured and not self._slave.configuring and self._slave.pending_id != UNCONFIGURED:
            self._boot(now_ns)

    def tick(self, now_ns: int) -> None:
        if now_ns >= self.due_ns:
            self.due_ns = NEVER
            self._core.mutes.discard(_MUTE)
            self.bit_rate = self._slave.pending_rate or self.bit_rate

    def _identity(self) -> Identity:
        number = self._core.data.number
        return number(0x1018, 1), number(0x1018, 2), number(0x1018, 3), number(0x1018, 4)
