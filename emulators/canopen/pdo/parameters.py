"""Common parts of TPDOs and RPDOs: communication and mapping parameters, and the rules for changing them.

CiA 301 v4.2, 7.5.2.35 to 7.5.2.38. A PDO is changed in five steps: invalidate it (bit 31 of its COB-ID), set the
mapping's subindex 0 to zero, write the entries, set subindex 0, make it valid again. Any other order is refused.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec

from fieldtwin.emulators.canopen.aborts import Abort, abort
from fieldtwin.emulators.canopen.eds.dictionary import Key
from fieldtwin.emulators.canopen.node_data import NodeData
from fieldtwin.gateway.core.clock import NS_PER_MS

COB_ID, TYPE, INHIBIT, EVENT, SYNC_START = 1, 2, 3, 5, 6
"""Subindices of a communication parameter record."""

INVALID = 1 << 31
NO_REMOTE = 1 << 30
EXTENDED = 1 << 29
INHIBIT_UNIT_NS = 100_000
MAX_BITS = 64
MAPPING_OFFSET = 0x200

_RESTRICTED = (
    range(0x080),
    range(0x101, 0x181),
    range(0x581, 0x600),
    range(0x601, 0x680),
    range(0x6E0, 0x700),
    range(0x701, 0x800),
)
"""CAN identifiers that no PDO may use (CiA 301, table 41)."""


@dataclass(frozen=True, slots=True)
class Mapped:
    """One mapping entry: an object and its length in bits."""

    index: int
    subindex: int
    bits: int

    @classmethod
    def from_value(cls, value: int) -> Mapped:
        return cls(value >> 16, value >> 8 & 0xFF, value & 0xFF)

    @property
    def key(self) -> Key:
        return self.index, self.subindex


class PdoSettings(msgspec.Struct, frozen=True):
    """The parameters of one PDO. `valid` says that it exists and has an 11-bit identifier (29 bits are not supported).

    `mapping` holds the entries in use, `length` the number of bytes that they fill. `whole` says that each entry is a whole
    object, so that a PDO is the concatenation of their bytes.
    """

    can_id: int
    valid: bool
    remote_allowed: bool
    type: int
    inhibit_ns: int
    event_ns: int
    sync_start: int
    mapping: tuple[Mapped, ...]
    keys: tuple[Key, ...]
    length: int
    whole: bool


class PdoParameters:
    """A view of one PDO's parameters in the live values. `index` is that of its communication parameter record."""

    def __init__(self, data: NodeData, index: int) -> None:
        self._data = data
        self.index = index
        self.map_index = index + MAPPING_OFFSET
        self.transmit = index >= 0x1800
        self._settings: PdoSettings | None = None
        self._settings_of = -1
        """The version of the values from which `_settings` were read."""

    @property
    def settings(self) -> PdoSettings:
        """Return the present parameters; they are read again only after a communication object has changed."""
        if self._settings is None or self._settings_of != self._data.version:
            self._settings, self._settings_of = self._read(), self._data.version
        return self._settings

    @property
    def cob(self) -> int:
        """Return the raw COB-ID entry. A PDO without this entry does not exist."""
        return self._data.number(self.index, COB_ID, INVALID)

    @property
    def valid(self) -> bool:
        """Return whether the PDO is valid, see `PdoSettings`."""
        return not self.cob & (INVALID | EXTENDED)

    def _read(self) -> PdoSettings:
        number, cob, mapping = self._data.number, self.cob, self._read_mapping()
        sizes = [self._data.size(mapped.key) for mapped in mapping]
        return PdoSettings(
            can_id=cob & 0x7FF,
            valid=self.valid,
            remote_allowed=not cob & NO_REMOTE,
            type=number(self.index, TYPE, 255),
            inhibit_ns=number(self.index, INHIBIT) * INHIBIT_UNIT_NS,
            event_ns=number(self.index, EVENT) * NS_PER_MS,
            sync_start=number(self.index, SYNC_START),
            mapping=mapping,
            keys=tuple(mapped.key for mapped in mapping),
            length=(sum(mapped.bits for mapped in mapping) + 7) // 8,
            whole=all(size is not None and 8 * size == m.bits for m, size in zip(mapping, sizes, strict=True)),
        )

    def _read_mapping(self) -> tuple[Mapped, ...]:
        """Return the mapping of the PDO. It is empty if the objects exceed the length of a PDO, because a data sheet can have
        invalid defaults.
        """
        count = self._data.number(self.map_index)
        entries = tuple(Mapped.from_value(self._data.number(self.map_index, sub)) for sub in range(1, count + 1))
        return entries if sum(entry.bits for entry in entries) <= MAX_BITS else ()

    def check_communication(self, subindex: int, raw: bytes) -> None:
        """Check whether a communication parameter may take this value. Raises `SdoAborted`."""
        value = int.from_bytes(raw, "little")
        if subindex == COB_ID:
            self._check_cob(value)
        elif subindex == TYPE:
            reserved = range(241, 254) if not self.transmit else range(241, 252)
            if value in reserved:
                raise abort(self.index, subindex, Abort.VALUE)
        elif subindex in (INHIBIT, SYNC_START) and self.valid:
            raise abort(self.index, subindex, Abort.VALUE)

    def check_mapping(self, subindex: int, raw: bytes) -> None:
        """Check whether a mapping parameter may take this value. Raises `SdoAborted`."""
        value = int.from_bytes(raw, "little")
        if self.valid or (subindex != 0 and self._data.number(self.map_index) != 0):
            raise abort(self.map_index, subindex, Abort.DEVICE_STATE)
        if subindex != 0:
            if value:
                self._check_mapped(subindex, Mapped.from_value(value))
            return
        if any(not self._data.has(self.map_index, sub) for sub in range(1, value + 1)):
            raise abort(self.map_index, 0, Abort.MAPPING_TOO_LONG)
        entries = [Mapped.from_value(self._data.number(self.map_index, sub)) for sub in range(1, value + 1)]
        for entry in entries:
            self._check_mapped(0, entry)
        if sum(entry.bits for entry in entries) > MAX_BITS:
            raise abort(self.map_index, 0, Abort.MAPPING_TOO_LONG)

    def _check_cob(self, value: int) -> None:
        if value & INVALID:
            return
        changed_while_valid = self.valid and (value ^ self.cob) & 0x3FFFFFFF
        restricted = any((value & 0x7FF) in ids for ids in _RESTRICTED)
        if changed_while_valid or value & 0x3FFFF800 or restricted:
            raise abort(self.index, COB_ID, Abort.VALUE)

    def _check_mapped(self, subindex: int, mapped: Mapped) -> None:
        dictionary = self._data.dictionary
        if not self.transmit and mapped.subindex == 0 and mapped.index in dictionary.dummies:
            return
        entry = dictionary.entry(*mapped.key)
        if entry is None:
            raise abort(self.map_index, subindex, Abort.NO_OBJECT)
        directions = ("ro", "rw", "rwr", "const") if self.transmit else ("wo", "rw", "rww")
        size = entry.size
        lengths = () if size is None else (1, 8) if entry.data_type == 0x01 else (8 * size,)
        if not entry.mappable or entry.access not in directions or mapped.bits not in lengths:
            raise abort(self.map_index, subindex, Abort.NOT_MAPPABLE)


def pdo_indices(data: NodeData, first: int) -> list[int]:
    """Return the communication parameter records that the node has among the 512 from `first` on."""
    return [index for index in sorted(data.dictionary.objects) if first <= index < first + 0x200]
