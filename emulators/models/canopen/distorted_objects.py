"""Value faults of a CANopen node whose values come from a log, from a model, or only from its data sheet and clients.

If no source provides an object, its undistorted value is the value that it held when the fault began, or that a client has
written since then. This value is restored when the fault is over. This module does no I/O and must not depend on frames or SDO.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from fieldtwin.emulators.canopen.eds import codec
from fieldtwin.emulators.canopen.eds.dictionary import Dictionary, Key
from fieldtwin.emulators.canopen.node_data import NodeData
from fieldtwin.emulators.canopen.service import AnswersReads, ObjectSource
from fieldtwin.emulators.distortion import Distortions
from fieldtwin.emulators.models.canopen.played_objects import whole
from fieldtwin.gateway.core.files.profile import Tag


class DistortedObjects:
    """A source of a node's object values, for nodes with value faults: it takes the values from `source` and distorts them.

    `data` holds the live values of the node, and is set when the node exists. If the node has a model, a call of this object
    returns the values unchanged, because the node calls `over` after the model (`NodeContext.distort`).
    """

    def __init__(
        self,
        tags: Iterable[Tag],
        dictionary: Dictionary,
        source: ObjectSource | None,
        *,
        has_model: bool = False,
        named: bool = False,
    ) -> None:
        """Create the source. With `named`, a tag is distorted only by faults that name it, not by faults aimed at all tags."""
        self._named = named
        self.distortions = Distortions(counts_given=True)
        self.data: NodeData | None = None
        self._source = source
        self._has_model = has_model
        self._tags: dict[Key, tuple[Tag, int]] = {}
        self._played: Mapping[Key, str] = {}
        for tag in tags:
            entry = dictionary.entry(*tag.object) if tag.object is not None else None
            if tag.object is not None and entry is not None and not tag.is_text and codec.is_number(entry.data_type):
                self._tags[tag.object] = tag, entry.data_type
        self._own: dict[Key, bytes] = {}
        """The undistorted values of objects that no source provides."""
        self._given: dict[Key, bytes] = {}
        """The last distorted value of each object in `_own`."""

    def share(self, distortions: Distortions, names: Mapping[Key, str]) -> None:
        """Use the `distortions` of the recorded source, which distorts the objects in `names` (key: tag name) itself."""
        self.distortions, self._played = distortions, names
        distortions.counts_given = True

    def given(self, keys: Iterable[Key], now_ns: int) -> None:
        """Note that the node has sent the values of the objects `keys`: each fault that distorts one of them has taken effect."""
        if not self.distortions:
            return
        for key in keys:
            if key in self._played:
                self.distortions.gave(self._played[key], now_ns)
            elif key in self._tags:
                self.distortions.gave(self._tags[key][0].name, now_ns, named=self._named)

    def __call__(self, now_ns: int) -> dict[Key, bytes]:
        values = {} if self._source is None else self._source(now_ns)
        return values if self._has_model else self.over(values, now_ns)

    def answer(self, key: Key, now_ns: int) -> bytes | None:
        """Return the distorted value for an upload, see `AnswersReads`."""
        raw = self._source.answer(key, now_ns) if isinstance(self._source, AnswersReads) else None
        known = self._tags.get(key)
        if raw is None or known is None or not self.distortions.of(known[0].name, named=self._named):
            return raw
        return self._distorted(*known, raw, now_ns)

    def over(self, values: Mapping[Key, bytes], now_ns: int) -> dict[Key, bytes]:
        """Return `values` with the distorted values in place of the undistorted ones, and with distorted objects that no
        source provides.
        """
        out = dict(values)
        if not self.distortions and not self._own:
            return out
        for key, known in self._tags.items():
            if not self.distortions.of(known[0].name, named=self._named):
                self._given.pop(key, None)
                if (own := self._own.pop(key, None)) is not None and key not in out:
                    out[key] = own  # the fault is over
                continue
            played = values.get(key)
            raw = played if played is not None else self._beneath(key)
            if raw is not None:
                out[key] = self._distorted(*known, raw, now_ns)
                if played is None:
                    self._given[key] = out[key]
        return out

    def _beneath(self, key: Key) -> bytes | None:
        """Return the undistorted value of an object that no source provides; None if the node has no such object.

        It is the value that a client last wrote, or the value before the fault.
        """
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
