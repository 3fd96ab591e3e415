"""PDOs that a data sheet declares without their own sections: ``CompactPDO`` of CiA 306-1 v1.4, 4.5.2.

The mask lists the subindices of the communication parameters that the device has: bit 0 for subindex 1, and so on.
``NrOfRXPDO`` and ``NrOfTXPDO`` give the number of PDOs. Those without sections are created here without mapped objects,
with the identifiers of the predefined connection set as far as it defines them.
"""

from __future__ import annotations

from fieldtwin.emulators.canopen.eds.entries import RECORD, DictionaryObject, SubindexEntry
from fieldtwin.emulators.canopen.eds.text import Section

_U8, _U16, _U32 = 0x05, 0x06, 0x07
_PARAMETERS = {1: ("COB-ID", _U32), 2: ("Transmission type", _U8), 3: ("Inhibit time", _U16)} | {
    4: ("Compatibility entry", _U8),
    5: ("Event timer", _U16),
    6: ("SYNC start value", _U8),
}
_ROOM = 8
"""The largest number of mapped objects: the 64 bits of a PDO hold 8 objects of one byte."""
_INVALID = 1 << 31
_PREDEFINED = 4
_MAX_PDOS = 512


def implied_pdos(info: Section, objects: dict[int, DictionaryObject]) -> dict[int, DictionaryObject]:
    """Return communication and mapping parameters of the PDOs that have no section.

    Raises `FileInvalid` for impossible counts.
    """
    mask = info.number("CompactPDO", 0)
    made: dict[int, DictionaryObject] = {}
    if not mask:
        return made
    for key, first, base in (("NrOfRXPDO", 0x1400, 0x200), ("NrOfTXPDO", 0x1800, 0x180)):
        count = info.number(key, 0)
        if not 0 <= count <= _MAX_PDOS:
            raise info.error(key, key, expected=f"0 to {_MAX_PDOS}", got=str(count))
        described = {index for index in objects if first <= index < first + _MAX_PDOS}
        free = (number for number in range(_MAX_PDOS) if first + number not in described)
        numbers = [next(free) for _ in range(count - len(described))]
        for number in numbers:
            index = first + number
            made[index] = _communication(index, mask, number, base)
            made[index + 0x200] = _mapping(index + 0x200)
        if numbers:
            info.note(f"{len(numbers)} of {count} PDOs from {first:04X}h on are made by CompactPDO", "CompactPDO")
    return made


def _communication(index: int, mask: int, number: int, base: int) -> DictionaryObject:
    predefined = number < _PREDEFINED
    cob_id = base + 0x100 * number if predefined else _INVALID
    entries: dict[int, SubindexEntry] = {}
    for sub, (name, data_type) in _PARAMETERS.items():
        if mask >> (sub - 1) & 1:
            value = {1: cob_id, 2: 255}.get(sub, 0)
            entries[sub] = _entry(index, sub, name, data_type, value, relative=predefined and sub == 1)
    entries[0] = _entry(index, 0, "Highest subindex supported", _U8, max(entries, default=0), access="const")
    return DictionaryObject(index, f"PDO {number + 1} communication", RECORD, entries)


def _mapping(index: int) -> DictionaryObject:
    entries = {sub: _entry(index, sub, f"Mapped object {sub}", _U32, 0) for sub in range(1, _ROOM + 1)}
    entries[0] = _entry(index, 0, "Number of mapped objects", _U8, 0)
    return DictionaryObject(index, f"PDO {(index & 0x1FF) + 1} mapping", RECORD, entries)


def _entry(
    index: int, sub: int, name: str, data_type: int, value: int, *, access: str = "rw", relative: bool = False
) -> SubindexEntry:
    size = {_U8: 1, _U16: 2, _U32: 4}[data_type]
    return SubindexEntry(index, sub, name, data_type, access, False, value.to_bytes(size, "little"), relative)
