"""One object of a dictionary and one subindex of it, as a data sheet describes them. Frozen; no live values."""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.emulators.canopen.eds import codec

Key = tuple[int, int]
"""The address of an object: (index, subindex)."""

VAR, ARRAY, RECORD, DOMAIN_OBJECT = 0x07, 0x08, 0x09, 0x02


@dataclass(frozen=True, slots=True)
class SubindexEntry:
    """One subindex. `default` is in bytes as sent; with `node_relative` the node ID is added to it.

    `size` is the value's length in bytes, None if the length varies. `low` and `high` are inclusive. `configured` says that
    `default` is the ParameterValue of a DCF and not the factory value.
    """

    index: int
    subindex: int
    name: str
    data_type: int
    access: str
    mappable: bool
    default: bytes
    node_relative: bool = False
    low: int | float | None = None
    high: int | float | None = None
    configured: bool = False

    @property
    def key(self) -> Key:
        return self.index, self.subindex

    @property
    def size(self) -> int | None:
        return codec.size_bytes(self.data_type)

    @property
    def readable(self) -> bool:
        return self.access != "wo"

    @property
    def writable(self) -> bool:
        return self.access in ("rw", "rwr", "rww", "wo")

    def initial(self, node_id: int) -> bytes:
        """Return the default value of a node with this node ID."""
        if not self.node_relative:
            return self.default
        return codec.encode(self.data_type, int(codec.decode(self.data_type, self.default)) + node_id)


@dataclass(frozen=True, slots=True)
class DictionaryObject:
    """One index: a VAR has only subindex 0; an ARRAY or RECORD has the subindices that the data sheet lists."""

    index: int
    name: str
    kind: int
    entries: dict[int, SubindexEntry]
