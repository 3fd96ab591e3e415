"""The data that a profile states about an emulated device.

These are the cells (registers and bits) and the encoding of values in them, the effects of reads and writes, and the answers of
functions without registers.

This module performs no I/O and does not depend on banks or recordings. Like all emulator code, it has its own encoder.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

from fieldtwin.emulators.codec import decode, encode
from fieldtwin.emulators.modbus.bank import BIT_TABLES, Access, CellSpan, Table
from fieldtwin.emulators.modbus.functions.fifo import MOST_READ, FifoQueues
from fieldtwin.emulators.modbus.functions.file_records import FileRecords
from fieldtwin.emulators.modbus.functions.identification import Identification
from fieldtwin.emulators.modbus.unit import UnitParts
from fieldtwin.gateway.core.files.profile import DeviceProfile, Effect, Tag

Peek = Callable[[Table, int], int]
"""A function that returns the value of one cell without the effects of a read."""


def cells_of(tag: Tag, value: float | str, exponent: int = 0) -> list[int]:
    """Return the contents of the cells that encode an engineering value. A value out of range is limited to the range.

    `exponent` is the value of the tag's scale-factor register. For a tag that is part of a register, the other bits of
    that register are 0.
    """
    at = tag.registers
    if isinstance(value, str):
        return encode(value, tag.type, tag.order, registers=at.count)
    if at.table in BIT_TABLES:
        return [int(bool(value))]
    raw = (value - tag.offset) / (tag.scale * 10.0**exponent)
    if tag.bits is not None:
        low, high = tag.bits
        return [round(min(max(raw, 0), (1 << (high - low + 1)) - 1)) << low]
    return encode(raw, tag.type, tag.order, registers=at.count)


def fits(tag: Tag, value: float | str, exponent: int = 0) -> bool:
    """Return whether the cells of `tag` can hold an engineering value, apart from rounding to the nearest step."""
    if isinstance(value, str):
        return len(value.encode("ascii", "replace")) <= 2 * tag.registers.count
    raw = (value - tag.offset) / (tag.scale * 10.0**exponent)
    if tag.type in ("float32", "float64") and tag.bits is None:
        return True
    if not math.isfinite(raw):
        return False
    if tag.registers.table in BIT_TABLES:
        return raw in (0, 1)
    if tag.bits is not None:
        low, high = tag.bits
        return 0 <= round(raw) < 1 << (high - low + 1)
    held = decode(encode(raw, tag.type, tag.order, registers=tag.registers.count), tag.type, tag.order)
    return not isinstance(held, str) and abs(held - raw) <= 1


def merged(tag: Tag, own: int, content: int) -> int:
    """Return the register value `own`, in which the bits of `tag` are replaced by those of `content`."""
    if tag.bits is None:
        return content
    low, high = tag.bits
    mask = (1 << (high - low + 1)) - 1 << low
    return own & ~mask | content & mask


def raw_of(tag: Tag, cells: Sequence[int]) -> float:
    """Return the number in the cells of `tag`, before scale and offset."""
    if tag.registers.table in BIT_TABLES:
        return cells[0]
    if tag.bits is not None:
        low, high = tag.bits
        return cells[0] >> low & (1 << (high - low + 1)) - 1
    return float(decode(cells, tag.type, tag.order))


def cells_held(tag: Tag, peek: Peek) -> list[int]:
    """Return the values of all cells of `tag`, each read with `peek`."""
    at = tag.registers
    return [peek(at.table, address) for address in range(at.address, at.end)]


def bytes_of(tag: Tag, cells: Sequence[int]) -> bytes:
    """Return the cells of `tag` as bytes: one byte for a bit, two bytes (the high byte first) for a register."""
    if tag.registers.table in BIT_TABLES:
        return bytes(cells)
    return b"".join(cell.to_bytes(2) for cell in cells)


def spans_of(profile: DeviceProfile) -> list[CellSpan]:
    """Return the cells of all tags, each once. A cell that belongs to several tags has the access rights of all of them."""
    read: dict[tuple[Table, int], bool] = {}
    written: dict[tuple[Table, int], bool] = {}
    for tag in profile.tags.values():
        at = tag.registers
        for cell in ((at.table, address) for address in range(at.address, at.end)):
            read[cell] = read.get(cell, False) or tag.readable
            written[cell] = written.get(cell, False) or tag.writable
    return [CellSpan(*cell, 1, _access(read[cell], written[cell])) for cell in read]


def _access(read: bool, written: bool) -> Access:
    return "ro" if not written else "rw" if read else "wo"


def parts_of(profile: DeviceProfile) -> UnitParts:
    """Return the functions of a profile without registers, with their answers: 11h, 14h, 15h, 18h and 2Bh."""
    form = profile.form
    fifos = FifoQueues(form.fifos, max((MOST_READ, *map(len, form.fifos.values())))) if form.fifos else None
    if fifos is not None:
        for address, content in form.fifos.items():
            fifos.push(address, *content)
    names = {number: text.encode("ascii", "replace") for number, text in form.identification.items()}
    return UnitParts(
        server_id=None if form.server_id is None else bytes.fromhex(form.server_id),
        server_data=bytes.fromhex(form.server_data),
        identification=Identification(names) if names else None,
        files=FileRecords(form.files) if form.files else None,
        fifos=fifos,
    )


class Effects:
    """A profile's `effects`: the values that tags get when a client reads or writes certain cells."""

    def __init__(self, effects: Iterable[Effect]) -> None:
        self._on_read = [e for e in effects if e.on_read]
        self._on_write = [e for e in effects if not e.on_read]

    def __bool__(self) -> bool:
        return bool(self._on_read or self._on_write)

    def of(self, table: Table, addresses: range, written: Sequence[int] | None) -> list[tuple[Tag, float]]:
        """Return the effects of a request that reads (`written` is None) or writes cells: the new values of tags, in the
        profile's order, as (tag, engineering value).

        Any cell of a tag triggers its effect. If the effect is bound to one value, that value must have been written as
        a whole.
        """
        effects = self._on_read if written is None else self._on_write
        return [
            pair
            for e in effects
            if touches(e.tag, table, addresses)
            and (e.value is None or written is None or _is(e.tag, e.value, addresses, written))
            for pair in e.sets
        ]


def touches(tag: Tag, table: Table, addresses: range) -> bool:
    """Return whether any cell of `tag` is among `addresses` of `table`."""
    at = tag.registers
    return at.table == table and at.address < addresses.stop and addresses.start < at.end


def _is(tag: Tag, value: float, addresses: range, values: Sequence[int]) -> bool:
    at = tag.registers
    if at.address < addresses.start or at.end > addresses.stop:
        return False
    written = list(values[at.address - addresses.start : at.end - addresses.start])
    if tag.bits is not None:
        low, high = tag.bits
        written = [written[0] & (1 << (high - low + 1)) - 1 << low]
    return written == cells_of(tag, value)
