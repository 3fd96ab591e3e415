"""Layer setting services on the LSS slave: the LSS master selects a node by its identity and sets its node ID and bit rate
(CiA 305 v3.0, clause 6).

`LssSlave` does no I/O: it takes the LSS master's 8 bytes and returns the slave's 8 bytes or None. It must not depend on the bus
or NMT: the node reads a new node ID or bit rate from `pending_id`, `stored_id` and `pending_rate`, and applies it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

FROM_MASTER, FROM_SLAVE = 0x7E5, 0x7E4
UNCONFIGURED = 255
"""The node ID of an unconfigured node."""

BIT_RATES = {0: 1_000_000, 1: 800_000, 2: 500_000, 3: 250_000, 4: 125_000, 6: 50_000, 7: 20_000, 8: 10_000}
"""Standard table 0 (CiA 305, table 1): index and bit/s."""

_SWITCH_GLOBAL, _NODE_ID, _BIT_TIMING, _ACTIVATE, _STORE = 0x04, 0x11, 0x13, 0x15, 0x17
_SELECTIVE, _SELECTED = range(0x40, 0x44), 0x44
_IDENTIFY, _IDENTIFIED = range(0x46, 0x4C), 0x4F
_IDENTIFY_UNCONFIGURED, _UNCONFIGURED_HERE = 0x4C, 0x50
_FASTSCAN, _CONFIRM_ALL = 0x51, 0x80
_INQUIRE, _INQUIRE_NODE_ID = range(0x5A, 0x5E), 0x5E

Identity = tuple[int, int, int, int]
"""Vendor ID, product code, revision, serial number: 1018h:01 to 04."""


class LssStore(Enum):
    """The results of the store command. The values are the error codes of its reply."""

    WORKS = 0
    UNSUPPORTED = 1
    FAILS = 2


@dataclass(slots=True)
class LssSlave:
    """One LSS slave. `rates` are the bit rates that it supports, in bit/s."""

    identity: Callable[[], Identity]
    node_id: int
    rates: frozenset[int]
    store: LssStore = LssStore.WORKS
    configuring: bool = False
    pending_id: int = field(init=False)
    stored_id: int = field(init=False)
    pending_rate: int | None = None
    stored_rate: int | None = None
    activate_ms: int | None = None
    """The switch delay in ms of an activated bit timing. The node reads and clears it."""
    _selected: int = 0
    _identified: int = 0
    _scanned: int = 0

    def __post_init__(self) -> None:
        self.pending_id = self.stored_id = self.node_id

    def adopt(self, node_id: int) -> None:
        """Set the node ID that the node now has, and return to the waiting state."""
        self.node_id = self.pending_id = node_id
        self.configuring = False
        self._selected = self._identified = self._scanned = 0

    def request(self, data: bytes) -> bytes | None:
        """Process one frame of the LSS master; a frame without exactly 8 bytes is ignored."""
        if len(data) != 8:
            return None
        command = data[0]
        if command == _SWITCH_GLOBAL:
            self.configuring = data[1] == 1 if data[1] in (0, 1) else self.configuring
            return None
        if command in _SELECTIVE:
            return self._select(command - _SELECTIVE.start, _number(data))
        if command in _IDENTIFY:
            return self._identify(command - _IDENTIFY.start, _number(data))
        if command == _IDENTIFY_UNCONFIGURED:
            return _reply(_UNCONFIGURED_HERE) if self.node_id == UNCONFIGURED else None
        if command == _FASTSCAN:
            return self._scan(_number(data), *data[5:8])
        return self._configure(command, data) if self.configuring else None

    def _configure(self, command: int, data: bytes) -> bytes | None:
        if command == _NODE_ID:
            good = 1 <= data[1] <= 127 or data[1] == UNCONFIGURED
            self.pending_id = data[1] if good else self.pending_id
            return _reply(command, 0 if good else 1)
        if command == _BIT_TIMING:
            rate = BIT_RATES.get(data[2]) if data[1] == 0 else None
            self.pending_rate = rate if rate in self.rates else self.pending_rate
            return _reply(command, 0 if rate in self.rates else 1)
        if command == _ACTIVATE:
            self.activate_ms = int.from_bytes(data[1:3], "little")
            return None
        if command == _STORE:
            if self.store is LssStore.WORKS:
                self.stored_id, self.stored_rate = self.pending_id, self.pending_rate
            return _reply(command, self.store.value)
        if command in _INQUIRE:
            return bytes([command]) + self.identity()[command - _INQUIRE.start].to_bytes(4, "little") + bytes(3)
        return _reply(command, self.node_id) if command == _INQUIRE_NODE_ID else None

    def _select(self, part: int, number: int) -> bytes | None:
        """Process one of the four frames that select a slave. If all match in order, the fourth one switches to the
        configuration state.
        """
        if self.configuring:
            return None
        in_turn = part in (0, self._selected) and self.identity()[part] == number
        self._selected = part + 1 if in_turn else 0
        if self._selected < 4:
            return None
        self._selected, self.configuring = 0, True
        return _reply(_SELECTED)

    def _identify(self, part: int, number: int) -> bytes | None:
        """Process one of the six frames that ask for slaves by identity: vendor, product, lowest and highest revision, lowest
        and highest serial number.
        """
        vendor, product, revision, serial = self.identity()
        matches = (
            number == vendor,
            number == product,
            number <= revision,
            revision <= number,
            number <= serial,
            serial <= number,
        )
        self._identified = part + 1 if part in (0, self._identified) and matches[part] else 0
        if self._identified < len(matches):
            return None
        self._identified = 0
        return _reply(_IDENTIFIED)

    def _scan(self, number: int, bits: int, part: int, following: int) -> bytes | None:
        """Answer fastscan: only unconfigured nodes answer, and only for the part of the identity that is being scanned."""
        if self.node_id != UNCONFIGURED or self.configuring:
            return None
        if bits == _CONFIRM_ALL:
            self._scanned = 0
            return _reply(_IDENTIFIED)
        if bits > 31 or part > 3 or following > 3 or part != self._scanned:
            return None
        if (self.identity()[part] ^ number) >> bits:
            return None
        if bits == 0:
            self.configuring = part == 3 and following < part
            self._scanned = following
        return _reply(_IDENTIFIED)


def _number(data: bytes) -> int:
    return int.from_bytes(data[1:5], "little")


def _reply(command: int, value: int = 0) -> bytes:
    return bytes([command, value]) + bytes(6)
