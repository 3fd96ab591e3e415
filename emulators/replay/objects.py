"""Replays a recorded CANopen node: its object dictionary and its PDO stream, from a log of the bus.

Values are resolved object by object (docs/explanation/paper.md, ruling 3), so the next client may read in a different order.
Uploaded values are returned in recorded order, one value for each upload of the object. Values that were sent in TPDOs are
signals: TPDOs and SDO uploads return the value at the time of the emulator's clock. Values that the recorded client wrote are
settings: the node starts with the first recorded value and then holds what is written. An object that was only ever refused with
an abort is refused again. Block transfers are not evaluated. `CanLog` reads the log file.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable

from fieldtwin.emulators.canopen.aborts import Abort
from fieldtwin.emulators.canopen.eds.dictionary import Dictionary, Key
from fieldtwin.emulators.canopen.errors.error_control import ERROR_CONTROL
from fieldtwin.emulators.canopen.node_data import COMMUNICATION, NodeData
from fieldtwin.emulators.canopen.pdo.parameters import PdoParameters, pdo_indices
from fieldtwin.emulators.canopen.sdo.channels import REQUEST, RESPONSE
from fieldtwin.emulators.context import EndOfRecording, UsedUp
from fieldtwin.emulators.replay.can_log import CanLog
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import UsageError

MAX_VALUES = 1_000_000
"""The largest number of changes of objects that are kept; `dropped` counts the later ones."""

_PDO_PARAMETERS = range(0x1400, 0x1C00)
_SDO_SERVERS = range(RESPONSE + 1, RESPONSE + 128)
_OF_THE_OBJECT = 0x06
"""Abort codes that begin with this byte concern the object."""
_OF_THE_DEVICE = 0x08
"""Abort codes that begin with this byte depend on the state of the device, such as an empty error history. They are replayed only
for objects that the data sheet lacks, because a declared object has its own rules. Other codes concern the transfer."""

_ABORTS = frozenset(Abort)
_NEVER_INITIAL = frozenset({0x1001, 0x1003})


def node_of(log: CanLog, node_id: int) -> int:
    """Return the node ID to use in a log: `node_id` if it occurs, else the only node that was accessed by SDO.

    Raises `UsageError`.
    """
    ids = {frame.can_id for _, frame in log.frames() if not (frame.extended or frame.remote)}
    asked = sorted(can_id & 0x7F for can_id in ids if can_id in _SDO_SERVERS)
    if not asked or node_id in asked or ERROR_CONTROL + node_id in ids:
        return node_id
    if len(asked) == 1:
        return asked[0]
    raise UsageError(
        f"the log has no frames of node {node_id}",
        where=str(log.path),
        expected="its SDO replies or heartbeats",
        got=", ".join(f"node {node}" for node in asked),
    )


def recorded_objects(log: CanLog, dictionary: Dictionary, node_id: int) -> RecordedObjects:
    """Return the recorded objects of a node in a log. The emulated node has the ID `node_id`, which may differ from the log.

    Raises `FileInvalid` or `UsageError`.
    """
    then = node_of(log, node_id)
    objects = RecordedObjects(log.frames(), dictionary, then, log.at_end, log.speed)
    if not objects.initial:
        raise UsageError(f"the log has no object of node {then} that is in its data sheet", where=str(log.path))
    if then != node_id:  # identifiers that contain the node ID get the ID of the emulated node
        own = {entry.key for entry in dictionary.entries() if entry.node_relative}
        objects.initial = {key: raw for key, raw in objects.initial.items() if key not in own}
    return objects


class RecordedObjects:
    """The recorded object values of a node. `initial` are the values at the start (for `NodeContext.factory`), `refusals` are the
    objects whose transfers the node aborts (for `NodeContext.refusals`).

    Time begins with the first call and runs `speed` times as fast as recorded. After the end of the log `when_used_up` determines
    whether signals hold their value, start again, or raise `UsedUp`; the same applies to each object whose uploaded values are
    used up.
    """

    def __init__(
        self,
        frames: Iterable[tuple[int, CanFrame]],
        dictionary: Dictionary,
        node_id: int,
        when_used_up: EndOfRecording = EndOfRecording.HOLD,
        speed: float = 1.0,
    ) -> None:
        self.initial: dict[Key, bytes] = {}
        self.refusals: dict[Key, Abort] = {}
        self.dropped = 0
        self.duration_s = 0.0
        self._when_used_up = when_used_up
        self._speed = speed
        self._began_ns: int | None = None
        self._node_id = node_id
        self._data = NodeData(dictionary, node_id)
        self._tpdos = [PdoParameters(self._data, index) for index in pdo_indices(self._data, 0x1800)]
        self._times: dict[Key, list[float]] = {}
        self._values: dict[Key, list[bytes]] = {}
        self._answers: dict[Key, list[bytes]] = {}
        self._next: dict[Key, int] = {}
        self._sent: set[Key] = set()  # objects whose values the node sent in TPDOs
        self._given: set[Key] = set()  # objects whose values the node returned to SDO uploads
        self._count = 0
        self._written: set[Key] = set()
        self._transfer: tuple[Key, bool, bytearray] | None = None
        self._learn(frames)

    def __call__(self, now_ns: int) -> dict[Key, bytes]:
        self._began_ns = now_ns if self._began_ns is None else self._began_ns
        at_s = (now_ns - self._began_ns) / NS_PER_S * self._speed
        if at_s > self.duration_s and self._when_used_up is EndOfRecording.ERROR:
            raise UsedUp(f"the log of node {self._node_id} ends after {self.duration_s:.3f} s")
        if self._when_used_up is EndOfRecording.LOOP and self.duration_s:
            at_s %= self.duration_s
        return {key: self._values[key][max(bisect_right(times, at_s) - 1, 0)] for key, times in self._times.items()}

    def answer(self, key: Key, now_ns: int) -> bytes | None:
        """Return the next uploaded value of an object; None if it was sent in a TPDO, written, or never uploaded."""
        answers = self._answers.get(key)
        if answers is None:
            return None
        at = self._next.get(key, 0)
        if at >= len(answers) and self._when_used_up is EndOfRecording.ERROR:
            raise UsedUp(f"the log has no further value of {key[0]:04X}h:{key[1]:02X} of node {self._node_id}")
        if at >= len(answers) and self._when_used_up is EndOfRecording.LOOP:
            at = 0
        self._next[key] = at + 1
        return answers[min(at, len(answers) - 1)]

    def _learn(self, frames: Iterable[tuple[int, CanFrame]]) -> None:
        began_ns: int | None = None
        for t_ns, frame in frames:
            began_ns = t_ns if began_ns is None else began_ns
            self.duration_s = max(t_ns - began_ns, 0) / NS_PER_S
            if frame.extended or frame.remote:
                continue
            if frame.can_id == REQUEST + self._node_id and len(frame.data) == 8:
                self._request(frame.data)
            elif frame.can_id == RESPONSE + self._node_id and len(frame.data) == 8:
                self._response(frame.data)
            else:
                self._pdo(frame)
        for key in set(self._times) - self._sent:
            del self._times[key], self._values[key]
        for key in [key for key in self._times if key in self._written or key[0] in COMMUNICATION]:
            del self._times[key], self._values[key]
        for key in [k for k in self._answers if k in self._sent or k in self._written or k[0] in COMMUNICATION]:
            del self._answers[key]
        for key in [key for key in self.refusals if key in self._given or key in self._written]:
            del self.refusals[key]

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
        """Process an SDO response of the node. A download is recorded when the node has acknowledged all of its bytes."""
        if self._transfer is None:
            return
        command, (key, download, raw) = data[0] >> 5, self._transfer
        if download and command in (1, 3):
            if len(raw) == self._size(key, len(raw)) and raw:
                self._written.add(key)
                self._note(key, bytes(raw))
        elif command == 2 and not download and data[0] & 2:
            size = 4 - (data[0] >> 2 & 3) if data[0] & 1 else self._size(key, 4)
            self._uploaded(key, data[4 : 4 + size])
        elif command == 0 and not download:
            raw += data[1 : 8 - (data[0] >> 1 & 7)]
            if data[0] & 1:
                self._uploaded(key, bytes(raw))
        elif command > 3:
            code = int.from_bytes(data[4:8], "little")
            unknown = self._data.dictionary.entry(*key) is None
            concerns_object = code >> 24 == _OF_THE_OBJECT or (unknown and code >> 24 == _OF_THE_DEVICE)
            if command == 4 and not download and concerns_object and code in _ABORTS:
                self.refusals.setdefault(key, Abort(code))
            self._transfer = None

    def _uploaded(self, key: Key, raw: bytes) -> None:
        """Record a whole value that the node returned to an upload."""
        self._transfer = None
        if not self._fits(key, raw):
            return
        self._given.add(key)
        if self._count < MAX_VALUES:
            self._count += 1
            self._answers.setdefault(key, []).append(raw)
        else:
            self.dropped += 1
        self._note(key, raw)

    def _pdo(self, frame: CanFrame) -> None:
        for parameters in self._tpdos:
            settings = parameters.settings
            if not settings.valid or settings.can_id != frame.can_id:
                continue
            packed, position = int.from_bytes(frame.data, "little"), 0
            for mapped in settings.mapping:
                value = packed >> position & ((1 << mapped.bits) - 1)
                position += mapped.bits
                if position <= 8 * len(frame.data):
                    self._sent.add(mapped.key)
                    self._note(mapped.key, value.to_bytes((mapped.bits + 7) // 8, "little"))

    def _note(self, key: Key, raw: bytes) -> None:
        if not self._fits(key, raw):
            return
        if key not in self._written and key[0] not in _NEVER_INITIAL:
            self.initial.setdefault(key, raw)
        if key[0] in _PDO_PARAMETERS:
            self._data.put(*key, raw)  # the TPDOs of the node carry the new value from now on
        values = self._values.setdefault(key, [])
        if values and values[-1] == raw:
            return
        if self._count >= MAX_VALUES:
            self.dropped += 1
            return
        self._count += 1
        values.append(raw)
        self._times.setdefault(key, []).append(self.duration_s)

    def _fits(self, key: Key, raw: bytes) -> bool:
        entry = self._data.dictionary.entry(*key)
        return entry is not None and entry.size in (None, len(raw))

    def _size(self, key: Key, default: int) -> int:
        entry = self._data.dictionary.entry(*key)
        return default if entry is None or entry.size is None else entry.size
