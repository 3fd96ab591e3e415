"""The interface between a node (bytes by index) and a device model (numbers).

A `DeviceModel` is a function of time: from the time, the recorded values and the values that clients wrote, it determines the
values of the device's objects and the time of its next call. The model must not depend on frames, SDO or PDOs, and the node must
not depend on the kind of device.

A recording holds the values that the device gave **with its factory settings**. A model converts them to the values that the
device gives with its present settings. Objects that the model does not mention are passed through.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Mapping

import msgspec

from fieldtwin.emulators.canopen.aborts import Abort, abort
from fieldtwin.emulators.canopen.eds import codec
from fieldtwin.emulators.canopen.eds.dictionary import Key
from fieldtwin.emulators.canopen.errors.emcy import Emergency
from fieldtwin.emulators.canopen.node_data import NodeData
from fieldtwin.emulators.canopen.service import NEVER, Core, NmtState, NodeService, ObjectSource

Number = int | float


class Objects:
    """A node's objects as numbers, to be read by a model."""

    def __init__(self, data: NodeData) -> None:
        self._data = data

    def has(self, index: int, subindex: int = 0) -> bool:
        return self._data.has(index, subindex)

    def number(self, index: int, subindex: int = 0, default: Number = 0) -> Number:
        """Return the live value, or `default` if the node has no such object."""
        number = self._data.decoded((index, subindex))
        return default if number is None else number

    def whole(self, index: int, subindex: int = 0, default: int = 0) -> int:
        """Return the live value of an integer object."""
        number = self._data.decoded((index, subindex))
        return int(default if number is None else number)

    def factory(self, index: int, subindex: int = 0, default: Number = 0) -> Number:
        """Return the factory value of the object."""
        entry = self._data.dictionary.entry(index, subindex)
        return default if entry is None else codec.decode(entry.data_type, self._data.factory(index, subindex))

    def channels(self, index: int) -> list[int]:
        """Return the subindices of an array, except subindex 0."""
        found = self._data.dictionary.objects.get(index)
        return sorted(sub for sub in found.entries if sub) if found else []


class Situation(msgspec.Struct, frozen=True):
    """The input of a model.

    `written` are the objects that SDO clients or RPDOs have just written, even if their value is unchanged. `errors` are the EMCY
    codes of all errors that are present in the node.
    """

    now_ns: int
    objects: Objects
    played: Mapping[Key, Number] = msgspec.field(default_factory=dict)
    written: Collection[Key] = ()
    errors: tuple[int, ...] = ()
    nmt: NmtState = NmtState.PRE_OPERATIONAL


class ModelOutput(msgspec.Struct, frozen=True):
    """The output of a model. Objects that the node does not have are ignored; numbers are rounded and limited to their
    type.

    A change of an object in `states` is an event for the TPDOs that map it; changes of `readings` are not events, because they
    change all the time. `clears` are the EMCY codes of errors that are over. `wake_at_ns` is the time of the next call, None if
    no call is needed.
    """

    states: Mapping[Key, Number] = msgspec.field(default_factory=dict)
    readings: Mapping[Key, Number] = msgspec.field(default_factory=dict)
    clears: tuple[int, ...] = ()
    wake_at_ns: int | None = None


class DeviceModel(ABC):
    """A model of the device behind the objects. All its inputs are in the `Situation`; it reads no clock and does no I/O."""

    @abstractmethod
    def power_on(self, situation: Situation) -> None:
        """Start the device after power-on or NMT reset node. Objects have their power-on values."""

    def refuse(self, key: Key, value: Number, objects: Objects) -> Abort | None:
        """Return the abort code if an SDO client may not write `value`, else None.

        Length and limits have been checked before.
        """
        return None

    @abstractmethod
    def step(self, situation: Situation) -> ModelOutput:
        """Advance the device to the present time.

        The node calls this at the requested time, after writes, and before each read; time never goes back.
        """


Distort = Callable[[Mapping[Key, bytes], int], dict[Key, bytes]]
"""A function for faults: it is called with all values that the device would hold without the faults, and now_ns, and returns the
values that the device holds instead.
"""


class Behaviour(NodeService):
    """The connection of a model with its node. It is also the node's source of values (see `service.ObjectSource`)."""

    def __init__(
        self, model: DeviceModel, source: ObjectSource | None, data: NodeData, distort: Distort | None = None
    ) -> None:
        self._distort = distort
        self._model = model
        self._source = source
        self._data = data
        self._objects = Objects(data)
        self.asks_at_ns = NEVER
        """The time of the next call of the model."""
        self._numeric = {key: data_type for key, data_type in data.types.items() if codec.is_number(data_type)}
        self._encoders: dict[Key, Callable[[Number], bytes] | None] = {}
        """Encoders by object, for objects that the model has mentioned; None for an object that the node does not have."""
        self._seen: tuple[int, ...] = ()
        self._states: Mapping[Key, Number] = {}
        self._encoded_states: dict[Key, bytes] = {}
        """The last states of the model as numbers and as bytes, which change rarely."""

    def connect(self, core: Core, emergency: Emergency, changed: Callable[[Iterable[Key], int], None]) -> None:
        """Connect the parts of the node that the model's output changes. Call it once, before anything else."""
        self._core = core
        self._emergency = emergency
        self._changed = changed

    def __call__(self, now_ns: int) -> dict[Key, bytes]:
        """Return the present values, from the recording and the model."""
        return self._step(now_ns)

    def power_on(self, now_ns: int) -> None:
        """Start the model after reset node: the objects have their stored or factory values again."""
        self._model.power_on(msgspec.structs.replace(self._situation(now_ns, (), self._played(now_ns)), errors=()))

    def written(self, keys: Collection[Key], now_ns: int) -> None:
        """Process a write of these objects by an RPDO."""
        self._step(now_ns, keys)

    def owns(self, index: int) -> bool:
        return index >= 0x2000

    def check_write(self, index: int, subindex: int, raw: bytes) -> None:
        entry = self._data.dictionary.entry(index, subindex)
        if entry is not None and codec.is_number(entry.data_type):
            code = self._model.refuse((index, subindex), codec.decode(entry.data_type, raw), self._objects)
            if code is not None:
                raise abort(index, subindex, code)

    def wrote(self, index: int, subindex: int, now_ns: int) -> None:
        self._step(now_ns, ((index, subindex),))

    def reset(self, now_ns: int) -> None:
        self._step(now_ns)

    def state_changed(self, now_ns: int) -> None:
        self._step(now_ns)

    @property
    def due_ns(self) -> int:
        """Return the time that the model requested, or 0 if errors have appeared or gone since the last step."""
        return self.asks_at_ns if self._emergency.active == self._seen else 0

    def tick(self, now_ns: int) -> None:
        self._step(now_ns)

    # -- inside ---------------------------------------------------------------------------------------------------------

    def _step(self, now_ns: int, written: Collection[Key] = ()) -> dict[Key, bytes]:
        played = self._played(now_ns)
        outcome = self._model.step(self._situation(now_ns, written, played))
        self.asks_at_ns = NEVER if outcome.wake_at_ns is None else outcome.wake_at_ns
        for code in outcome.clears:
            self._emergency.clear_error(code, now_ns)
        self._seen = self._emergency.active
        if outcome.states != self._states:
            self._states, self._encoded_states = outcome.states, self._encoded(outcome.states)
        encoded_states = self._encoded_states
        values = {**played, **self._encoded(outcome.readings), **encoded_states}
        if self._distort is not None:
            values = self._distort(values, now_ns)
            encoded_states = {key: values[key] for key in encoded_states}
        events = self._data.put_all(encoded_states)
        for key in events:
            self._core.note(now_ns, "set", *key, encoded_states[key])
        if events:
            self._changed(events, now_ns)
        return values

    def _situation(self, now_ns: int, written: Collection[Key], played: Mapping[Key, bytes]) -> Situation:
        numeric = self._numeric
        numbers = {key: codec.decode(numeric[key], raw) for key, raw in played.items() if key in numeric}
        return Situation(now_ns, self._objects, numbers, written, self._emergency.active, self._core.state)

    def _played(self, now_ns: int) -> dict[Key, bytes]:
        return {} if self._source is None else self._source(now_ns)

    def _encoded(self, numbers: Mapping[Key, Number]) -> dict[Key, bytes]:
        out: dict[Key, bytes] = {}
        encoders = self._encoders
        for key, number in numbers.items():
            if key not in encoders:
                data_type = self._data.types.get(key)
                encoders[key] = None if data_type is None else codec.held_encoder(data_type)
            encode = encoders[key]
            if encode is not None:
                out[key] = encode(number)
        return out
