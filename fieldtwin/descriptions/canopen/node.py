"""A CANopen node as an EDS, DCF, XDD or XDC describes it: the part that these formats have in common.

Values stay texts in the notation of CiA 306 (``0x10``, ``$NODEID+0x180``), because a number would lose the node ID in them. The
gateway's `ObjectDictionary` holds numbers, and no description of the device as a whole.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from fieldtwin.gateway.protocols.canopen.pdo.mapping import MAX_ENTRIES

VAR, ARRAY, RECORD, DOMAIN = 0x7, 0x8, 0x9, 0x2
"""Object codes (CiA 301, table 42)."""
LARGEST_KBIT = 1000


@dataclass(frozen=True, slots=True)
class NodeValue:
    """One value of the object dictionary: a sub-object, or subindex 0 of an object with one value.

    `type_code` is that of CiA 301, 7.4.7 (see `datatypes.DataType`). `access` is ro, wo, rw, rwr, rww or const. `default`, `low`,
    `high` and `configured` are texts in the notation of CiA 306, empty if not stated. A DCF or XDC sets the value `configured`.
    `unit`, `factor` and `remark` are the keys Unit, Factor and Description of the `canopen` package, which are not in CiA 306.
    `offset` is added to raw value x factor, and `names` are the names of raw values; only an XDD has a place for them.
    """

    index: int
    subindex: int
    name: str
    type_code: int
    access: str
    default: str = ""
    low: str = ""
    high: str = ""
    mappable: bool = False
    configured: str = ""
    unit: str = ""
    factor: str = ""
    remark: str = ""
    offset: str = ""
    names: tuple[tuple[int, str], ...] = ()

    @property
    def place(self) -> str:
        """Return the index and subindex for messages, ``6040h:00``."""
        return f"{self.index:04X}h:{self.subindex:02X}"


@dataclass(frozen=True, slots=True)
class NodeObject:
    """An object with its values in order of the subindex. `code` is its object code: VAR, ARRAY, RECORD or DOMAIN."""

    index: int
    name: str
    code: int
    values: tuple[NodeValue, ...]

    @property
    def is_single(self) -> bool:
        """Return whether the object is one value without subindexes."""
        return self.code in (VAR, DOMAIN)


@dataclass(frozen=True, slots=True)
class NodeDescription:
    """All objects of a device, in order of the index.

    `device` holds the keys of [DeviceInfo] that are known, such as ``VendorName`` and ``BaudRate_250``. `node_id` and
    `bitrate_kbit` are those of a DCF or XDC, None if it does not state them.
    """

    objects: tuple[NodeObject, ...]
    device: Mapping[str, str] = field(default_factory=dict)
    node_id: int | None = None
    bitrate_kbit: int | None = None
    node_name: str = ""

    def values(self) -> Iterator[NodeValue]:
        """Yield all values in order of index and subindex."""
        for each in self.objects:
            yield from each.values

    def value(self, index: int, subindex: int) -> NodeValue | None:
        """Return one value, or None if the device does not have it."""
        return next((v for v in self.values() if (v.index, v.subindex) == (index, subindex)), None)


def number_of(text: str, node_id: int) -> int | None:
    """Return the number of a text such as ``$NODEID+0x180``; None if it is empty or not a number."""
    total = 0
    for part in text.replace(" ", "").upper().split("+"):
        try:
            total += node_id if part == "$NODEID" else int(part, 0)
        except ValueError:
            return None
    return total


def numbers_of(record: NodeObject, node_id: int) -> dict[int, int]:
    """Return the numbers of a record by subindex. The values that a DCF or XDC sets have precedence over the defaults."""
    found = {v.subindex: number_of(v.configured or v.default, node_id) for v in record.values}
    return {subindex: number for subindex, number in found.items() if number is not None}


def mapped_words(mapping: NodeObject, node_id: int) -> list[int]:
    """Return the entries of a mapping parameter in order, 0 for one without a number (CiA 301, 7.5.2.36 and 7.5.2.38)."""
    words = numbers_of(mapping, node_id)
    return [words.get(sub, 0) for sub in range(1, min(words.get(0, 0), MAX_ENTRIES) + 1)]
