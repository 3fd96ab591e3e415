"""The live values of one emulated node: bytes by (index, subindex), with the values that reset restores and 1010h stores.

This module has only generic rules (existence, access, length, limits). The services implement the *meaning* of objects. This
module must not depend on the bus or the time.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from enum import IntEnum

from fieldtwin.emulators.canopen.aborts import Abort, abort
from fieldtwin.emulators.canopen.eds import codec
from fieldtwin.emulators.canopen.eds.dictionary import Dictionary, Key, SubindexEntry
from fieldtwin.gateway.core.errors import UsageError

COMMUNICATION = range(0x1000, 0x2000)
_NEVER_STORED = frozenset({0x1001, 0x1003, 0x1010, 0x1011})


class ParameterGroup(IntEnum):
    """The parameter groups of 1010h and 1011h by subindex (CiA 301, 7.5.2.13)."""

    ALL = 1
    COMMUNICATION = 2
    APPLICATION = 3

    def holds(self, index: int) -> bool:
        if self is ParameterGroup.ALL:
            return True
        return (index in COMMUNICATION) == (self is ParameterGroup.COMMUNICATION)


class NodeData:
    """Values of one node. `factory` replaces defaults of the data sheet (a serial number); its keys must exist."""

    def __init__(self, dictionary: Dictionary, node_id: int, factory: Mapping[Key, bytes] | None = None) -> None:
        self.dictionary = dictionary
        self.types = {entry.key: entry.data_type for entry in dictionary.entries()}
        """The data type of every entry."""
        self._sizes = {entry.key: entry.size for entry in dictionary.entries()}
        self._given = dict(factory or {})
        for key, raw in self._given.items():
            self._sized(key, raw)
        self._factory: dict[Key, bytes] = {}
        self.rebase(node_id)
        self._stored: dict[Key, bytes] = {}
        self._live: dict[Key, bytes] = dict(self._factory)
        self._decoded: dict[Key, int | float] = {}
        self.version = 0
        """The number of changes of communication objects. It tells services when the results that they derived from these
        objects are out of date.
        """

    def rebase(self, node_id: int) -> None:
        """Set the factory values of a node with this node ID; live values stay until a reset."""
        self.node_id = node_id
        self._factory = {entry.key: entry.initial(node_id) for entry in self.dictionary.entries()} | self._given

    def find(self, index: int, subindex: int) -> SubindexEntry:
        """Return the entry. Raises `SdoAborted` with 06020000 or 06090011 if it does not exist."""
        entry = self.dictionary.entry(index, subindex)
        if entry is None:
            missing_object = index not in self.dictionary
            raise abort(index, subindex, Abort.NO_OBJECT if missing_object else Abort.NO_SUBINDEX)
        return entry

    def has(self, index: int, subindex: int = 0) -> bool:
        return (index, subindex) in self._live

    def get(self, index: int, subindex: int = 0) -> bytes:
        """Return the live value. The entry must exist."""
        return self._live[index, subindex]

    def factory(self, index: int, subindex: int = 0) -> bytes:
        """Return the factory value. The entry must exist."""
        return self._factory[index, subindex]

    def size(self, key: Key) -> int | None:
        """Return the number of bytes of the entry's values; None if it varies or the entry does not exist."""
        return self._sizes.get(key)

    def joined(self, keys: Iterable[Key]) -> bytes:
        """Return the concatenated live values of these entries. They must exist."""
        return b"".join(map(self._live.__getitem__, keys))

    def number(self, index: int, subindex: int = 0, default: int = 0) -> int:
        """Return the live value as an unsigned integer, or `default` if the node has no such entry."""
        raw = self._live.get((index, subindex))
        return default if raw is None else int.from_bytes(raw, "little")

    def decoded(self, key: Key) -> int | float | None:
        """Return the live value as a number of its type; None if the node has no such entry. Cached until the value
        changes.

        Raises the errors of `codec.decode` for a value that it cannot decode.
        """
        number = self._decoded.get(key)
        if number is None and key in self.types:
            number = self._decoded[key] = codec.decode(self.types[key], self._live[key])
        return number

    def put(self, index: int, subindex: int, raw: bytes) -> bool:
        """Set a value for the device itself, not for a client, so that read-only entries are allowed. Return whether it changed.

        Raises `UsageError` if the entry does not exist or the length is not that of its type.
        """
        key = (index, subindex)
        if self._live.get(key) == raw:
            return False
        if self._sizes.get(key, -1) != len(raw):
            self._sized(key, raw)
        self._live[key] = bytes(raw)
        self._decoded.pop(key, None)
        if index < 0x2000:
            self.version += 1
        return True

    def put_all(self, values: Mapping[Key, bytes]) -> list[Key]:
        """Set several values like `put`. Return the keys of the values that changed."""
        live = self._live
        return [key for key, raw in values.items() if live.get(key) != raw and self.put(*key, raw)]

    def put_number(self, index: int, subindex: int, value: int) -> None:
        """Call `put` with an unsigned value; does nothing if the node has no such entry."""
        entry = self.dictionary.entry(index, subindex)
        if entry is not None and entry.size is not None:
            self.put(index, subindex, value.to_bytes(entry.size, "little"))

    def check_value(self, entry: SubindexEntry, raw: bytes) -> None:
        """Check length and limits of a value from the bus. Raises `SdoAborted` (06070012/13, 06090031/32)."""
        self.check_size(entry, len(raw))
        if not codec.is_number(entry.data_type):
            return
        value = codec.decode(entry.data_type, raw)
        high = 1 if entry.data_type == codec.BOOLEAN and entry.high is None else entry.high
        # The comparison is written in this way so that a NaN violates every limit.
        if high is not None and not value <= high:
            raise abort(entry.index, entry.subindex, Abort.VALUE_HIGH)
        if entry.low is not None and not value >= entry.low:
            raise abort(entry.index, entry.subindex, Abort.VALUE_LOW)

    @staticmethod
    def check_size(entry: SubindexEntry, size: int) -> None:
        """Check the length of a value from the bus. Raises `SdoAborted` (06070012/13)."""
        if entry.size is not None and size != entry.size:
            raise abort(entry.index, entry.subindex, Abort.TOO_LONG if size > entry.size else Abort.TOO_SHORT)

    def reset(self, *, communication_only: bool) -> None:
        """Restore the power-on values: the stored values if there are any, else the factory values (CiA 301, 7.3.2.2.1)."""
        self.version += 1
        self._decoded.clear()
        for key, raw in self._factory.items():
            if not communication_only or key[0] in COMMUNICATION:
                self._live[key] = self._stored.get(key, raw)

    def store(self, group: ParameterGroup) -> None:
        """Keep the live values of the group's writable entries over resets (1010h)."""
        for entry in self.dictionary.entries():
            if entry.writable and group.holds(entry.index) and entry.index not in _NEVER_STORED:
                self._stored[entry.key] = self._live[entry.key]

    def forget(self, group: ParameterGroup) -> None:
        """Make the factory values the power-on values again (1011h). Live values stay until a reset."""
        self._stored = {key: raw for key, raw in self._stored.items() if not group.holds(key[0])}

    def _sized(self, key: Key, raw: bytes) -> None:
        entry = self.dictionary.entry(*key)
        where = f"object {key[0]:04X}h:{key[1]:02X}"
        if entry is None:
            raise UsageError("the emulated node has no such object", where=where, got=self.dictionary.path)
        if entry.size is not None and len(raw) != entry.size:
            raise UsageError(
                "a value of the wrong length", where=where, expected=f"{entry.size} bytes", got=f"{len(raw)} bytes"
            )
