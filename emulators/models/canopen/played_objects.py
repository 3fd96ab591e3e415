"""Recorded signals as CANopen objects: TPDOs and SDO uploads send the signals' values at the present time of the emulator."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from math import isnan

from fieldtwin.emulators.canopen.eds.codec import encode, held_encoder, integer_range
from fieldtwin.emulators.canopen.eds.dictionary import Dictionary
from fieldtwin.emulators.distortion import Distortions
from fieldtwin.emulators.journal import DeviceValueLog
from fieldtwin.emulators.signals import Signals
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.profile import Tag

Key = tuple[int, int]


class PlayedObjects:
    """A node's value source from recorded signals: called with the time, it returns raw values by (index, subindex).

    Signals are in engineering units under the names of the tags; scale and offset of the profile and the data type of
    the EDS convert them to object values. Raises `FileInvalid` for a tag whose object the EDS does not have, and if no
    signal has the name of a tag.
    """

    def __init__(self, tags: Iterable[Tag], dictionary: Dictionary, player: Signals) -> None:
        self.distortions = Distortions()
        self._player = player
        self._objects: list[tuple[str, Key, float, float, bool, Callable[[int | float], bytes]]] = []
        """For each object: the tag name, the object, scale and offset, whether the type can express "no value", and the
        encoder of the object's bytes.
        """
        for tag in tags:
            if tag.object is None or tag.name not in player.names:
                continue
            entry = dictionary.entry(*tag.object)
            if entry is None:
                index, subindex = tag.object
                raise FileInvalid(f"the EDS has no object {index:04X}h:{subindex:02X} for tag {tag.name!r}")
            is_float = tag.type.startswith("float")
            encoder: Callable[[int | float], bytes] = partial(encode if is_float else _encode_whole, entry.data_type)
            if not is_float and integer_range(entry.data_type) is not None:
                encoder = held_encoder(entry.data_type)
            self._objects.append((tag.name, tag.object, tag.scale, tag.offset, is_float, encoder))
        if not self._objects:
            raise FileInvalid(
                "the recording has no signal of this device",
                path=player.path,
                expected="signals under names of its tags",
                got=", ".join(player.names),
            )

    @property
    def names(self) -> dict[Key, str]:
        """Return the tag of each object that has a recorded signal."""
        return {key: name for name, key, *_ in self._objects}

    def __call__(self, now_ns: int) -> dict[Key, bytes]:
        values = self._player.values(now_ns)
        out: dict[Key, bytes] = {}
        distorted = bool(self.distortions)
        for name, key, scale, offset, is_float, encoded in self._objects:
            value = values[name]
            if distorted:
                value = self.distortions.apply(name, value, now_ns)
            number = (value - offset) / scale
            if not is_float and isnan(number):
                continue  # an integer cannot express "no value": the object keeps its value
            out[key] = encoded(number)
        return out


def whole(number: float, data_type: int) -> int:
    """Return the nearest integer that the type can hold, because a device's converters saturate."""
    bounds = integer_range(data_type)
    if bounds is None:
        return round(number)
    return round(min(max(number, bounds[0]), bounds[1]))


def _encode_whole(data_type: int, number: float) -> bytes:
    return encode(data_type, whole(number, data_type))


class HeldObjects:
    """The journal of a node's object values by the profile's tags, used as `NodeContext.held` in a prototype run."""

    def __init__(self, tags: Iterable[Tag]) -> None:
        self.journal = DeviceValueLog()
        self._names: dict[Key, list[str]] = {}
        for tag in tags:
            if tag.object is not None:
                self._names.setdefault(tag.object, []).append(tag.name)

    def __call__(self, values: Mapping[Key, bytes], now_ns: int) -> None:
        for key, raw in values.items():
            for name in self._names.get(key, ()):
                self.journal.note(name, raw, now_ns)
