"""Value faults of a CANopen node whose values come from a log, from a model, or from nobody: objects that hold something else.

The object's own value, where nobody plays it, is what it held when the fault began or what a client wrote since; it is there
again when the fault is over. Pure; it must never know frames nor SDO.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from fieldtwin.emulators.canopen import codec
from fieldtwin.emulators.canopen.dictionary import Dictionary, Key
from fieldtwin.emulators.canopen.node_data import NodeData
from fieldtwin.emulators.canopen.service import AnswersReads, Source
from fieldtwin.emulators.distortion import Distortions
from fieldtwin.emulators.models.played_objects import whole
from fieldtwin.gateway.core.profile import Tag


class DistortedObjects:
    """A node's value source around `source`. `data` is the node's, once there is one. Before a model its calls change nothing:
    the node asks `over` behind the model instead (`NodeContext.distort`)."""

    def __init__(
        self,
        tags: Iterable[Tag],
        dictionary: Dictionary,
        source: Source | None,
        *,
        has_model: bool = False,
        named: bool = False,
    ) -> None:
        """`named`: only what names a tag distorts it, not what is aimed at all tags."""
        self._named = named
        self.distortions = Distortions()
        self.data: NodeData | None = None
        self._source = source
        self._has_model = has_model
        self._tags: dict[Key, tuple[Tag, int]] = {}
        for tag in tags:
            entry = dictionary.entry(*tag.object) if tag.object is not None else None
            if tag.object is not None and entry is not None and not tag.is_text and codec.is_number(entry.data_type):
                self._tags[tag.object] = tag, entry.data_type
        self._own: dict[Key, bytes] = {}
        """What objects that nobody plays hold below their distortion."""
        self._given: dict[Key, bytes] = {}
        """What was made of them at last."""

    def __call__(self, now_ns: int) -> dict[Key, bytes]:
        values = {} if self._source is None else self._source(now_ns)
        return values if self._has_model else self.over(values, now_ns)

    def answer(self, key: Key, now_ns: int) -> bytes | None:
        """As `AnswersReads`."""
        raw = self._source.answer(key, now_ns) if isinstance(self._source, AnswersReads) else None
        known = self._tags.get(key)
        if raw is None or known is None or not self.distortions.of(known[0].name, named=self._named):
            return raw
        return self._distorted(*known, raw, now_ns)

    def over(self, values: Mapping[Key, bytes], now_ns: int) -> dict[Key, bytes]:
        """`values` with what is distorted instead, and with what nobody plays."""
        out = dict(values)
        if not self.distortions and not self._own:
            return out
        for key, known in self._tags.items():
            if not self.distortions.of(known[0].name, named=self._named):
                self._given.pop(key, None)
                if (own := self._own.pop(key, None)) is not None and key not in out:
                    out[key] = own  # it is over
                continue
            played = values.get(key)
            raw = played if played is not None else self._beneath(key)
            if raw is not None:
                out[key] = self._distorted(*known, raw, now_ns)
                if played is None:
                    self._given[key] = out[key]
        return out

    def _beneath(self, key: Key) -> bytes | None:
        """The value of an object that nobody plays; one that was written since is the object's own from then on."""
        if self.data is None or not self.data.has(*key):
            return None
        live = self.data.get(*key)
        if key not in self._own or live != self._given.get(key):
            self._own[key] = live
        return self._own[key]

    def _distorted(self, tag: Tag, data_type: int, raw: bytes, now_ns: int) -> bytes:
        value = codec.decode(data_type, raw) * tag.scale + tag.offset
        number = (self.distortions.apply(tag.name, value, now_ns, named=self._named) - tag.offset) / tag.scale
        if tag.type.startswith("float"):
            return codec.encode(data_type, number)
        return raw if math.isnan(number) else codec.encode(data_type, whole(number, data_type))
