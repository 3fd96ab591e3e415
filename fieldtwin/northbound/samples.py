"""The samples of the process image that a client gets: value, quality, reason and source time of each tag.

The source time of a good value is the time at which the device's reply with it was complete. If a value turns bad or uncertain
without a new reply, it is the time of the publication with which the gateway reported that (as in OPC 10000-4, 7.11.3), so that
an archive of a client does not overwrite the last good value. All times are monotonic nanoseconds, as in the image.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from fieldtwin.gateway.core.image.snapshot import Snapshot
from fieldtwin.gateway.core.values import Quality, Reason, Scalar

_GOOD, _BAD = int(Quality.GOOD), int(Quality.BAD)
_MEANINGS = {(int(quality), int(reason)): (quality, reason) for quality in Quality for reason in Reason}
_QUALITIES = {str(quality): int(quality) for quality in Quality}
_REASONS = {str(reason): int(reason) for reason in Reason}


class Sample(NamedTuple):
    """A value of a tag. The value is None if its quality is bad."""

    value: Scalar | None
    quality: Quality
    reason: Reason
    source_ns: int


class _TagState:
    """The latest sample of a tag, and the columns of the image from which it was made."""

    __slots__ = ("columns", "index", "name", "sample")

    def __init__(self, name: str, index: int = -1) -> None:
        self.name = name
        self.index = index
        self.columns: tuple[Scalar | None, int, int, int] | None = None
        self.sample: Sample | None = None

    def take(self, columns: tuple[Scalar | None, int, int, int], noticed_ns: int) -> Sample | None:
        """Take over value, quality, reason and time of the tag. Return its new sample, or None if nothing has changed."""
        if columns == self.columns:
            return None
        value, quality, reason, t_ns = columns
        before, self.columns = self.columns, columns
        meaning, last = _MEANINGS[quality, reason], self.sample
        if quality == _GOOD:
            source_ns = t_ns
        elif last is None or meaning != (last.quality, last.reason):
            is_new = before is not None and t_ns > before[3]
            source_ns = t_ns if is_new and quality != _BAD else max(noticed_ns, t_ns)
        else:
            source_ns = max(last.source_ns, t_ns)
        sample = Sample(None if quality == _BAD else value, *meaning, source_ns)
        if sample == last:
            return None
        self.sample = sample
        return sample


class ImageSamples:
    """The samples of some tags of a region of the process image.

    If the region was not published for `lost_ns`, its writer is dead, and all values are bad with the reason `if_lost`. If the
    writer has stopped intentionally, they are bad with the reason `NOT_OPERATIONAL`.
    """

    def __init__(self, names: Iterable[str], lost_ns: int, if_lost: Reason) -> None:
        self._names = list(names)
        self._lost_ns = lost_ns
        self._if_lost = int(if_lost)
        self._states: list[_TagState] | None = None
        self._seen: tuple[object, ...] | None = None

    def changes(self, region: Snapshot, now_ns: int) -> Iterator[tuple[str, Sample]]:
        """Yield each tag whose sample has changed since the last call, with its sample. Nothing before the first publication."""
        if not region.counter:
            return
        lost = self._lost_reason(region, now_ns)
        seen = (region.values, region.qualities, region.reasons, region.stamps, lost)
        if seen == self._seen:
            return
        self._seen = seen
        if self._states is None:
            self._states = [_TagState(name, region.shape.index[name]) for name in self._names]
        noticed_ns = region.t_ns if lost != self._if_lost else region.t_ns + self._lost_ns
        times_ns = region.shape.times.unpack(region.stamps)
        values, qualities, reasons = region.values, region.qualities, region.reasons
        for state in self._states:
            n = state.index
            quality, reason = (_BAD, lost) if lost else (qualities[n], reasons[n])
            sample = state.take((values[n], quality, reason, times_ns[n]), noticed_ns)
            if sample is not None:
                yield state.name, sample

    def _lost_reason(self, region: Snapshot, now_ns: int) -> int:
        if region.age_ns(now_ns) > self._lost_ns:
            return self._if_lost
        return int(Reason.NOT_OPERATIONAL) if region.stopped else int(Reason.NONE)


class TextSamples:
    """The samples of text tags, which the process image cannot hold. They come from the gateway's answers to `watch`."""

    def __init__(self, names: Iterable[str], binary: Iterable[str]) -> None:
        """Create the samples of the tags `names`. The gateway shows the values of those in `binary` as hex."""
        self.names = list(names)
        self._binary = frozenset(binary)
        self._states = {name: _TagState(name) for name in self.names}

    def changes(self, tags: Mapping[str, list[Any]], now_ns: int) -> Iterator[tuple[str, Sample]]:
        """Yield each tag whose sample has changed. `tags` are value, quality, reason and source time by tag."""
        for name, (value, quality, reason, t_ns) in tags.items():
            own = bytes.fromhex(value) if name in self._binary and value is not None else value
            sample = self._states[name].take((own, _QUALITIES[quality], _REASONS[reason], t_ns), now_ns)
            if sample is not None:
                yield name, sample

    def lost(self, now_ns: int) -> Iterator[tuple[str, Sample]]:
        """Yield each tag whose sample changes because the gateway does not answer any more: its value is bad from now on."""
        for name, state in self._states.items():
            t_ns = state.columns[3] if state.columns is not None else 0
            sample = state.take((None, _BAD, int(Reason.GATEWAY_DEAD), t_ns), now_ns)
            if sample is not None:
                yield name, sample
