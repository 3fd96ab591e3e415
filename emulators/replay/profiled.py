"""A replayed unit that follows its device's profile where the recording has no answer.

Recorded answers come first. For other requests the profile states the functions, the registers per request, whether
half values are refused, what can be written and what cannot be read, and the answers of functions without registers. A
write that it permits is accepted and can be read back. Effects are those of the profile. The diagnostics (08, 0B, 0C)
that it names are computed by the unit, because a recorded answer would contain the counts of a different line. This module
performs no I/O, and has its own decoder.
"""

from __future__ import annotations

from fieldtwin.emulators.modbus.bank import Table
from fieldtwin.emulators.replay import requests
from fieldtwin.emulators.replay.own_functions import add_own_functions
from fieldtwin.emulators.replay.replay import ExchangeReplay, ReplayedReply
from fieldtwin.emulators.replay.requests import CellRequest
from fieldtwin.emulators.replay.unit import ReplayUnit
from fieldtwin.emulators.stated import Effects, cells_of, parts_of
from fieldtwin.gateway.core.files.profile import DeviceProfile

_CELL_FUNCTIONS = frozenset({0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F, 0x10})
_COUNTING = frozenset({0x08, 0x0B, 0x0C})
"""Functions that report counters of the serial line. A recorded answer would report those of the line of the recording."""


class ProfiledReplay(ReplayUnit):
    """Unit `unit_id` of a recording of a device that `profile` describes, device-specific functions included."""

    def __init__(self, profile: DeviceProfile, replay: ExchangeReplay, unit_id: int, name: str = "") -> None:
        super().__init__(replay, unit_id, name or profile.name, parts_of(profile))
        form = profile.form
        self._limits = form.limits
        self._effects = Effects(profile.effects)
        self._counting = _COUNTING & frozenset(form.limits.functions or ())
        stated = {0x11: form.server_id, 0x14: form.files, 0x15: form.files, 0x18: form.fifos, 0x2B: form.identification}
        self._stated = frozenset(function for function, said in stated.items() if said)
        self._undeclared = form.undeclared
        self._declared: set[tuple[Table, int]] = set()
        self._writable: set[tuple[Table, int]] = set()
        self._unreadable: set[tuple[Table, int]] = set()
        readable: set[tuple[Table, int]] = set()
        for tag in profile.tags.values():
            cells = {(tag.registers.table, tag.registers.address + i) for i in range(tag.registers.count)}
            self._declared |= cells
            self._writable |= cells if tag.writable else set()
            readable |= cells if tag.readable else set()
            self._unreadable |= set() if tag.readable else cells
        self._unreadable -= readable
        self._tables = {table for table, _ in self._declared}
        add_own_functions(self, profile)

    def computes(self, pdu: bytes) -> bool:
        if pdu[0] in self._stated:
            return not self.replay.was_recorded(self.unit_id, pdu)
        return pdu[0] in self._counting or super().computes(pdu)

    def recall(self, pdu: bytes) -> ReplayedReply:
        answer = self._recall(pdu)
        request = requests.parse_request(pdu) if self._effects else None
        if request is not None and answer.reply is not None and answer.reply[0] == pdu[0]:
            for tag, value in self._effects.of(request.table, request.addresses, request.values):
                at = tag.registers
                self.replay.put(self.unit_id, at.table, at.address, cells_of(tag, value))
        return answer

    def _recall(self, pdu: bytes) -> ReplayedReply:
        if self.replay.was_recorded(self.unit_id, pdu):
            return super().recall(pdu)
        request, allowed = requests.parse_request(pdu), self._limits.functions
        code = 0
        if allowed is not None and pdu[0] not in allowed:
            code = requests.ILLEGAL_FUNCTION
        elif request is not None:
            code = self._refusal(request)
        elif pdu[0] in _CELL_FUNCTIONS and allowed is not None:
            code = requests.ILLEGAL_ADDRESS if requests.leaves_the_table(pdu) else requests.ILLEGAL_VALUE
        if code:
            return self.replay.refuse(self.unit_id, pdu, code)
        if request is not None and self._undeclared != "exception":
            self._fill(request)
        if request is not None and request.values is not None and self._may_write(request):
            return self.replay.accept(self.unit_id, request, pdu)
        return super().recall(pdu)

    def _refusal(self, request: CellRequest) -> int:
        """Return 0, or the exception code that the profile requires: quantities are checked before addresses."""
        registers = request.table in ("holding", "input")
        pairs = registers and self._limits.even_only and request.function != 0x06
        most = self._limits.read_registers if request.values is None and registers else request.count
        if request.count > most or (pairs and request.count % 2):
            return requests.ILLEGAL_VALUE
        if pairs and request.address % 2:
            return requests.ILLEGAL_ADDRESS
        if request.values is None and any((request.table, a) in self._unreadable for a in request.addresses):
            return requests.ILLEGAL_ADDRESS
        if request.values is not None and not self._may_write(request):
            return requests.ILLEGAL_ADDRESS
        return 0

    def _fill(self, request: CellRequest) -> None:
        """Set the cells of the request to 0 that no tag names and that were not recorded."""
        if request.table in self._tables:
            for address in request.addresses:
                if (request.table, address) not in self._declared and not self.replay.knows(
                    self.unit_id, request.table, address
                ):
                    self.replay.put(self.unit_id, request.table, address, [0])

    def _may_write(self, request: CellRequest) -> bool:
        held = self._undeclared == "hold" and request.table in self._tables
        return all(
            (request.table, address) in self._writable or (held and (request.table, address) not in self._declared)
            for address in request.addresses
        )
