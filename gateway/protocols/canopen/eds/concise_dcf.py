"""The concise DCF (CiA 302-3, object 1F22h): a node's configuration as one block of bytes, converted from a DCF.

Format, all little-endian: UNSIGNED32 number of entries; then for each entry UNSIGNED16 index, UNSIGNED8 subindex,
UNSIGNED32 size in bytes, and the data. This module only converts; it sends nothing.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass

from fieldtwin.gateway.core.errors import Desync, FileInvalid, UsageError
from fieldtwin.gateway.protocols.canopen.eds.datatypes import DataType, encode
from fieldtwin.gateway.protocols.canopen.eds.dictionary import DictionaryEntry, ObjectDictionary

_COUNT = struct.Struct("<I")
_HEAD = struct.Struct("<HBI")
MAX_SETTINGS = 65_535

CONFIGURATION_DATE = 0x1020
_NEVER = frozenset({0x1003, 0x1010, 0x1011, CONFIGURATION_DATE, *range(0x1F50, 0x1F58)})
"""Objects that are never written: histories, commands, program control, and the date, which is written last and separately."""

_PDO_COMMUNICATION = (range(0x1400, 0x1600), range(0x1800, 0x1A00))
_TO_MAPPING = 0x200
_PDO_INVALID = 1 << 31


@dataclass(frozen=True, slots=True)
class Setting:
    """One object and the bytes that are written to it."""

    index: int
    subindex: int
    data: bytes

    def __str__(self) -> str:
        return f"{self.index:04X}h:{self.subindex:02X} = {self.data.hex(' ') or 'nothing'}"


def encode_concise(settings: Iterable[Setting]) -> bytes:
    """Return the settings as the block of bytes that 1F22h holds."""
    listed = list(settings)
    if len(listed) > MAX_SETTINGS:
        raise UsageError("a concise DCF", expected=f"at most {MAX_SETTINGS} entries", got=str(len(listed)))
    parts = [_COUNT.pack(len(listed))]
    for setting in listed:
        parts += [_HEAD.pack(setting.index, setting.subindex, len(setting.data)), setting.data]
    return b"".join(parts)


def decode_concise(data: bytes) -> tuple[Setting, ...]:
    """Return the settings in a block. Raises `Desync` if it is too short, too long, or announces too many entries."""
    if len(data) < _COUNT.size:
        raise Desync("a concise DCF", expected="at least 4 bytes", got=str(len(data)))
    (count,) = _COUNT.unpack_from(data)
    if count > MAX_SETTINGS:
        raise Desync("a concise DCF", expected=f"at most {MAX_SETTINGS} entries", got=str(count))
    settings, at = [], _COUNT.size
    for number in range(1, count + 1):
        if at + _HEAD.size > len(data):
            raise Desync(f"a concise DCF ends before entry {number} of {count}", got=f"{len(data)} bytes")
        index, subindex, size = _HEAD.unpack_from(data, at)
        at += _HEAD.size
        if size > len(data) - at:
            raise Desync(
                f"entry {number} of a concise DCF ({index:04X}h:{subindex:02X})",
                expected=f"{size} bytes",
                got=f"{len(data) - at}",
            )
        settings.append(Setting(index, subindex, data[at : at + size]))
        at += size
    if at != len(data):
        raise Desync(f"{len(data) - at} bytes after the last entry of a concise DCF")
    return tuple(settings)


def settings_of(dictionary: ObjectDictionary) -> tuple[Setting, ...]:
    """Return the settings of a DCF (its ParameterValues), in an order that a node accepts.

    PDOs follow the procedure of CiA 301, 7.5.2.36 and 7.5.2.38. First the PDO is made invalid and its number of mapped objects is
    set to 0. Then the mapped objects, their number, the other parameters and finally the COB-ID are written. Raises `FileInvalid`
    for a value that does not fit its type.
    """
    wanted = {
        (entry.index, entry.subindex): Setting(entry.index, entry.subindex, _bytes_of(entry, dictionary.path))
        for entry in dictionary
        if entry.configured and entry.writable and entry.index not in _NEVER
    }
    pdos = sorted(
        {index for index, _ in wanted for area in _PDO_COMMUNICATION if index in area or index - 0x200 in area}
    )
    pdos = sorted({index if _is_communication(index) else index - _TO_MAPPING for index in pdos})
    ordered = [s for (index, _), s in wanted.items() if not _is_pdo(index)]
    for communication in pdos:
        ordered += _pdo(communication, wanted, dictionary)
    return tuple(ordered)


def configuration_date(dictionary: ObjectDictionary) -> tuple[int, int] | None:
    """Return the expected configuration date and time (1F26h, 1F27h), or None if the DCF does not set 1020h:01 and :02.

    The date is in days since 1984-01-01, the time in milliseconds since midnight.
    """
    entries = [dictionary.get(CONFIGURATION_DATE, sub) for sub in (1, 2)]
    values = [e.default for e in entries if e is not None and e.configured and isinstance(e.default, int)]
    return (values[0], values[1]) if len(values) == 2 else None


def _is_communication(index: int) -> bool:
    return any(index in area for area in _PDO_COMMUNICATION)


def _is_pdo(index: int) -> bool:
    return _is_communication(index) or _is_communication(index - _TO_MAPPING)


def _pdo(index: int, wanted: dict[tuple[int, int], Setting], dictionary: ObjectDictionary) -> list[Setting]:
    """Return the settings of the PDO with the communication record `index`, in the order that `settings_of` describes."""
    mapping = index + _TO_MAPPING
    cob_id = wanted.get((index, 1))
    held = dictionary.get(index, 1)
    if cob_id is None and held is not None and isinstance(held.default, int):  # needed to switch the PDO off and on
        cob_id = Setting(index, 1, held.default.to_bytes(4, "little"))
    mapped = [s for (i, sub), s in wanted.items() if i == mapping and sub]
    number = wanted.get((mapping, 0))
    rest = [s for (i, sub), s in wanted.items() if i == index and sub > 1]
    ordered: list[Setting] = []
    if cob_id is not None:
        off = int.from_bytes(cob_id.data, "little") | _PDO_INVALID
        ordered.append(Setting(index, 1, off.to_bytes(4, "little")))
    if number is not None:
        ordered += [Setting(mapping, 0, b"\0"), *mapped, number]
    ordered += rest
    return ordered + ([cob_id] if cob_id is not None else [])


def _bytes_of(entry: DictionaryEntry, path: str) -> bytes:
    where = f"[{entry.index:04X}sub{entry.subindex:X}] ParameterValue of {entry.name!r}"
    if entry.default is None:
        kind = DataType(entry.type_code).name
        raise FileInvalid(
            f"{where} cannot be read", path=path, expected=f"a value of type {kind}, or the file of a DOMAIN"
        )
    try:
        return encode(entry.type_code, entry.default)
    except UsageError as e:
        raise FileInvalid(f"{where}: {e.message}", path=path, expected=e.expected, got=e.got) from e
