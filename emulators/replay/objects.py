"""A recorded CANopen node, holding again what it held: its object dictionary and its PDO stream, from a log of the bus.

Resolved object by object (SPEC ruling 3): what an SDO transfer or a TPDO carried is a value of an object at a time, however the
next master reads it. What the recorded master wrote is a setting: the node starts with what was there first and then holds what
is written. Everything else is read at the emulator's clock. Block transfers are not followed. Pure; it knows no files.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable

from emulators.canopen.dictionary import Dictionary, Key
from emulators.canopen.node_data import COMMUNICATION, NodeData
from emulators.canopen.pdo import PdoParameters, pdo_indices
from emulators.canopen.sdo_channels import REQUEST, RESPONSE
from emulators.context import UsedUp, WhenUsedUp
from gateway.core.canframe import CanFrame
from gateway.core.clock import NS_PER_S

MAX_VALUES = 1_000_000
"""Changes of objects that are kept; later ones are counted in `dropped`."""

_PDO_PARAMETERS = range(0x1400, 0x1C00)
_NEVER_INITIAL = frozenset({0x1001, 0x1003})


class RecordedObjects:
    """A node's value source. `initial` are the values that the node begins with (for `NodeContext.factory`).

    Time begins with the first call. After the log's end values hold, begin again, or raise `UsedUp`, as `when_used_up` says.
    """

    def __init__(
        self,
        frames: Iterable[tuple[float, CanFrame]],
        dictionary: Dictionary,
        node_id: int,
        when_used_up: WhenUsedUp = WhenUsedUp.HOLD,
    ) -> None:
        self.initial: dict[Key, bytes] = {}
        self.dropped = 0
        self.duration_s = 0.0
        self._when_used_up = when_used_up
        self._began_ns: int | None = None
        self._node_id = node_id
        self._data = NodeData(dictionary, node_id)
        self._tpdos = [PdoParameters(self._data, index) for index in pdo_indices(self._data, 0x1800)]
        self._times: dict[Key, list[float]] = {}
        self._values: dict[Key, list[bytes]] = {}
        self._count = 0
        self._written: set[Key] = set()
        self._transfer: tuple[Key, bool, bytearray] | None = None
        self._learn(frames)

    def __call__(self, now_ns: int) -> dict[Key, bytes]:
        self._began_ns = now_ns if self._began_ns is None else self._began_ns
        at_s = (now_ns - self._began_ns) / NS_PER_S
        if at_s > self.duration_s and self._when_used_up is WhenUsedUp.ERROR:
            raise UsedUp(f"the log of node {self._node_id} is over after {self.duration_s:.3f} s")
        if self._when_used_up is WhenUsedUp.LOOP and self.duration_s:
            at_s %= self.duration_s
        return {key: self._values[key][max(bisect_right(times, at_s) - 1, 0)] for key, times in self._times.items()}

    def _learn(self, frames: Iterable[tuple[float, CanFrame]]) -> None:
        began_s: float | None = None
        for t_s, frame in frames:
            began_s = t_s if began_s is None else began_s
            self.duration_s = max(t_s - began_s, 0.0)
            if frame.extended or frame.remote:
                continue
            if frame.can_id == REQUEST + self._node_id and len(frame.data) == 8:
                self._request(frame.data)
            elif frame.can_id == RESPONSE + self._node_id and len(frame.data) == 8:
                self._response(frame.data)
            else:
                self._pdo(frame)
        for key in self._written:
            self._times.pop(key, None)
            self._values.pop(key, None)
        for key in [key for key in self._times if key[0] in COMMUNICATION]:
            del self._times[key], self._values[key]

    def _request(self, data: bytes) -> None:
        command, key = data[0] >> 5, (int.from_bytes(data[1:3], "little"), data[3])
        if command == 1:
            size = 4 - (data[0] >> 2 & 3) if data[0] & 1 else self._size(key, 4)
            self._transfer = (key, True, bytearray(data[4 : 4 + size] if data[0] & 2 else b""))
        elif command == 2:
            self._transfer = (key, False, bytearray())
        elif command == 0 and self._transfer is not None and self._transfer[1]:
            self._transfer[2].extend(data[1 : 8 - (data[0] >> 1 & 7)])
        elif command > 3:
            self._transfer = None

    def _response(self, data: bytes) -> None:
        """A download is over with what the node says to it: that there is no more, or the next request."""
        if self._transfer is None:
            return
        command, (key, download, raw) = data[0] >> 5, self._transfer
        if download and command in (1, 3):
            if len(raw) == self._size(key, len(raw)) and raw:
                self._written.add(key)
                self._note(key, bytes(raw))
        elif command == 2 and not download and data[0] & 2:
            size = 4 - (data[0] >> 2 & 3) if data[0] & 1 else self._size(key, 4)
            self._note(key, data[4 : 4 + size])
        elif command == 0 and not download:
            raw += data[1 : 8 - (data[0] >> 1 & 7)]
            if data[0] & 1:
                self._note(key, bytes(raw))
        elif command > 3:
            self._transfer = None

    def _pdo(self, frame: CanFrame) -> None:
        for parameters in self._tpdos:
            if not parameters.valid or parameters.can_id != frame.can_id:
                continue
            packed, position = int.from_bytes(frame.data, "little"), 0
            for mapped in parameters.mapping():
                value = packed >> position & ((1 << mapped.bits) - 1)
                position += mapped.bits
                if position <= 8 * len(frame.data):
                    self._note(mapped.key, value.to_bytes((mapped.bits + 7) // 8, "little"))

    def _note(self, key: Key, raw: bytes) -> None:
        entry = self._data.dictionary.entry(*key)
        if entry is None or (entry.size is not None and entry.size != len(raw)):
            return
        if key not in self._written and key[0] not in _NEVER_INITIAL:
            self.initial.setdefault(key, raw)
        if key[0] in _PDO_PARAMETERS:
            self._data.put(*key, raw)  # from here on TPDOs carry what this says
        values = self._values.setdefault(key, [])
        if values and values[-1] == raw:
            return
        if self._count >= MAX_VALUES:
            self.dropped += 1
            return
        self._count += 1
        values.append(raw)
        self._times.setdefault(key, []).append(self.duration_s)

    def _size(self, key: Key, default: int) -> int:
        entry = self._data.dictionary.entry(*key)
        return default if entry is None or entry.size is None else entry.size
