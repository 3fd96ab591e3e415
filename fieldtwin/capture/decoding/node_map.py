"""The knowledge about a CANopen node without querying it: its tags, its objects' types, and the content of its PDOs.

At first it comes from the profile, its EDS and the system file. Observed transfers then update it, so that a mapping applies
as soon as it was written over SDO. The module reads the EDS and has no other input or output.
"""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.capture.decoding.exchange import SECRET, TouchedSpan
from fieldtwin.capture.decoding.tags import TagMap, show_value
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.core.values import Scalar
from fieldtwin.gateway.devices.canopen_rpdo import BITS
from fieldtwin.gateway.devices.config import DeviceConfig
from fieldtwin.gateway.protocols.canopen.cob_id import RPDO1_BASE, TPDO_BASES
from fieldtwin.gateway.protocols.canopen.configure import (
    PDO_INVALID,
    RPDO_COMMUNICATION,
    RPDO_MAPPING,
    TPDO_COMMUNICATION,
    TPDO_MAPPING,
    TPDO_MAX,
    PdoConfig,
)
from fieldtwin.gateway.protocols.canopen.eds.datatypes import decode
from fieldtwin.gateway.protocols.canopen.eds.dictionary import ObjectDictionary, load_dictionary
from fieldtwin.gateway.protocols.canopen.pdo.mapping import PdoEntry, PdoMapping

_PARAMETERS = range(RPDO_COMMUNICATION, TPDO_MAPPING + TPDO_MAX)
_MAPPINGS = frozenset((*range(RPDO_MAPPING, TPDO_COMMUNICATION), *range(TPDO_MAPPING, TPDO_MAPPING + TPDO_MAX)))
_KINDS = (("TPDO", TPDO_COMMUNICATION, TPDO_MAPPING), ("RPDO", RPDO_COMMUNICATION, RPDO_MAPPING))


@dataclass(frozen=True, slots=True)
class Pdo:
    """A PDO of a node: its name such as ``TPDO1``, whether the node sends it, and its content; None if that is not known."""

    node: int
    name: str
    sends: bool
    mapping: PdoMapping | None


class NodeMap:
    """The tags, objects and PDOs of one node, as far as they are known."""

    def __init__(self, config: DeviceConfig) -> None:
        self.name = config.name
        self.node = config.address
        self.tags = TagMap(config.profile)
        self._dictionary = _dictionary(config)
        self._held: dict[tuple[int, int], int] = {}
        for entry in self._dictionary or ():
            if entry.index in _PARAMETERS and isinstance(entry.default, int):
                self._held[entry.index, entry.subindex] = entry.default
        self._configured(config)
        self.pdos = self._find()

    def learn(self, index: int, subindex: int, data: bytes) -> bool:
        """Note an object's observed value; return True when it changed the node's PDOs."""
        if index not in _PARAMETERS or not 1 <= len(data) <= 4:
            return False
        value = int.from_bytes(data, "little")
        if self._held.get((index, subindex)) == value:
            return False
        self._held[index, subindex] = value
        self.pdos = self._find()
        return True

    def value(
        self, index: int, subindex: int, data: bytes, t_ns: int
    ) -> tuple[dict[str, Scalar | None], Scalar | None]:
        """Return tags by name, and the value of the object: that of its tag, else decoded by its type in the EDS, else in hex."""
        tags = self.tags.of_object(index, subindex, data, t_ns)
        if tags:
            return tags, next(iter(tags.values()))
        entry = self._dictionary.get(index, subindex) if self._dictionary else None
        if entry is not None:
            try:
                value = decode(entry.type_code, data)
                return {}, value.hex() if isinstance(value, bytes) else value
            except FieldtwinError:
                pass  # a size other than the type's: shown as hex
        return {}, data.hex()

    def named(self, index: int, subindex: int) -> str:
        """Return a name such as ``6010h:00 slope_long``: the tag, else the EDS's name of the object, else the number alone."""
        number, tag = f"{index:04X}h:{subindex:02X}", self.tags.by_object.get((index, subindex))
        entry = self._dictionary.get(index, subindex) if self._dictionary else None
        name = tag.name if tag else entry.name.rpartition(".")[2] if entry else ""
        return f"{number} {name}".rstrip()

    def said(self, index: int, subindex: int, data: bytes, t_ns: int) -> str:
        """Return the value of an object as text: a tag with its unit, and identifiers and mappings of a PDO in their usual
        notation.
        """
        word = int.from_bytes(data, "little")
        if len(data) == 4 and index in _PARAMETERS:
            if index not in _MAPPINGS and subindex == 1:
                return f"{word & 0x7FF:03X}h" + (" (off)" if word & PDO_INVALID else "")
            if index in _MAPPINGS and subindex:
                return str(PdoEntry.from_word(word))
        if self.tags.secrets((TouchedSpan("read", "object", index, 1, subindex),)):
            return SECRET
        tags, value = self.value(index, subindex, data, t_ns)
        if not tags:
            return show_value(value) if not isinstance(value, str) or value != data.hex() else data.hex(" ")
        text = self.tags.show(tags)
        return text.removeprefix(f"{next(iter(tags))} ")

    def _configured(self, config: DeviceConfig) -> None:
        """Apply the system file's configuration, which overrides the factory settings."""
        boot = config.canopen
        for pdo in boot.tpdos or ():
            self._set(TPDO_COMMUNICATION, TPDO_MAPPING, pdo)
        for pdo in boot.rpdos or ():
            self._set(RPDO_COMMUNICATION, RPDO_MAPPING, pdo)
        if config.tpdo1:
            first = PdoConfig(1, TPDO_BASES[0] + self.node, True, 254, 0, self._mapping(config.tpdo1.tags))
            self._set(TPDO_COMMUNICATION, TPDO_MAPPING, first)
        if boot.rpdo1:
            first = PdoConfig(1, RPDO1_BASE + self.node, True, 255, None, self._mapping(boot.rpdo1.tags))
            self._set(RPDO_COMMUNICATION, RPDO_MAPPING, first)

    def _mapping(self, names: tuple[str, ...]) -> PdoMapping:
        tags = [self.tags.profile.tags[name] for name in names]
        return PdoMapping.of((*t.object, BITS[t.type]) for t in tags if t.object)

    def _set(self, communication: int, mapping: int, pdo: PdoConfig) -> None:
        at = pdo.number - 1
        self._held[communication + at, 1] = pdo.cob_id | (0 if pdo.enabled else PDO_INVALID)
        self._held[mapping + at, 0] = len(pdo.mapping.entries)
        for sub, entry in enumerate(pdo.mapping.entries, 1):
            self._held[mapping + at, sub] = entry.word

    def _find(self) -> dict[int, Pdo]:
        """Return the existing PDOs by COB-ID."""
        found = {}
        for kind, communication, mapping in _KINDS:
            for (index, sub), cob in self._held.items():
                if sub == 1 and 0 <= (at := index - communication) < TPDO_MAX and not cob & PDO_INVALID:
                    name = f"{kind}{at + 1}"
                    found[cob & 0x7FF] = Pdo(self.node, name, kind == "TPDO", self._mapped(mapping + at))
        return found

    def _mapped(self, record: int) -> PdoMapping | None:
        count = self._held.get((record, 0), 0)
        words = [self._held.get((record, sub), 0) for sub in range(1, min(count, 64) + 1)]
        try:
            return PdoMapping(tuple(PdoEntry.from_word(word) for word in words)) if words else None
        except FieldtwinError:
            return None


def _dictionary(config: DeviceConfig) -> ObjectDictionary | None:
    """Return the node's EDS; None without one or if it cannot be read, which does not affect the run."""
    path = config.profile.eds_path
    try:
        return load_dictionary(path, config.address) if path else None
    except FieldtwinError:
        return None
