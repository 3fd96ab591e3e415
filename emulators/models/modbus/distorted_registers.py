"""Value faults of a Modbus device with a model: its registers hold different values while a fault is active.

The undistorted values continue to change: clients write them, effects change them, and they are read again after the
fault is over. This module does no I/O, and values change only when the device handles a request.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from fieldtwin.emulators.distortion import Distortions
from fieldtwin.emulators.journal import DeviceValueLog
from fieldtwin.emulators.modbus.bank import BIT_TABLES, RegisterBank, Table
from fieldtwin.emulators.stated import Peek, bytes_of, cells_of, merged, raw_of, touches
from fieldtwin.gateway.core.files.profile import DeviceProfile, Tag


class DistortedRegisters(RegisterBank):
    """The registers of a device with value faults. `bank` holds the undistorted values of the device that `profile` describes,
    and `peek` returns one of its cells without the effects of a read.

    A distorted value that a client reads is recorded in `journal` as a value that the device held.
    """

    def __init__(
        self,
        bank: RegisterBank,
        peek: Peek,
        profile: DeviceProfile,
        journal: DeviceValueLog,
        tags: Iterable[Tag] | None = None,
        distortions: Distortions | None = None,
    ) -> None:
        """Create the bank. If `tags` is given, only these tags are distorted, and only by faults that name them.

        By default all faults distort all tags. `distortions` may be shared with the object that distorts the other tags.
        """
        self._named = tags is not None
        self.distortions = Distortions() if distortions is None else distortions
        self._peek = peek
        self.bank = bank
        self._journal = journal
        all_tags = profile.tags.values() if tags is None else tags
        self._tags = [t for t in all_tags if t.readable and not t.is_text]
        self._scales = {t.name: profile.tags.get(t.scale_by) for t in self._tags if t.scale_by is not None}
        self._noted: set[str] = set()

    def read(self, table: Table, address: int, count: int, now_ns: int) -> Sequence[int]:
        cells = self.bank.read(table, address, count, now_ns)
        if not self.distortions and not self._noted:
            return cells
        held = list(cells)
        for tag in self._tags:
            if not touches(tag, table, range(address, address + count)):
                continue
            at = tag.registers
            own = [
                cells[a - address] if 0 <= a - address < count else self._peek(table, a)
                for a in range(at.address, at.end)
            ]
            if self.distortions.of(tag.name, named=self._named):
                for cell, content in zip(range(at.address, at.end), self._cells(tag, own, now_ns), strict=True):
                    if address <= cell < address + count:
                        held[cell - address] = merged(tag, held[cell - address], content)
            elif tag.name in self._noted:  # the fault is over: the undistorted value is held again
                self._noted.discard(tag.name)
                self._journal.note(tag.name, bytes_of(tag, own), now_ns)
        return held

    def check_read(self, table: Table, address: int, count: int, now_ns: int) -> None:
        self.bank.check_read(table, address, count, now_ns)

    def write(self, table: Table, address: int, values: Sequence[int], now_ns: int) -> None:
        self.bank.write(table, address, values, now_ns)

    def _cells(self, tag: Tag, own: list[int], now_ns: int) -> list[int]:
        """Return the distorted cells of the tag that replace its `own` cells."""
        by = self._scales.get(tag.name)
        exponent = 0 if by is None else int(raw_of(by, [self._peek(by.registers.table, by.registers.address)]))
        raw = raw_of(tag, own) * tag.scale * 10.0**exponent + tag.offset
        value = self.distortions.apply(tag.name, raw, now_ns, named=self._named)
        if math.isnan(value) and (tag.bits is not None or tag.registers.table in BIT_TABLES):
            return own  # bits cannot express "no number"
        cells = [merged(tag, a, b) for a, b in zip(own, cells_of(tag, value, exponent), strict=True)]
        self._noted.add(tag.name)
        self._journal.note(tag.name, bytes_of(tag, cells), now_ns)
        return cells
