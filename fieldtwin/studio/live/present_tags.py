"""The present values of a gateway's tags, read without a request for each tag.

Numbers come from the process image, which holds values, qualities and times of all tags. Texts, which the image cannot
hold, come from the gateway. A change that the gateway has reported since then takes precedence, because the image is
published only once per PLC cycle.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from math import isfinite
from typing import Any

from msgspec import UNSET

from fieldtwin.capture.decoding.exchange import SECRET
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.image.image import Snapshot
from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.gateway.runtime.gateway_status import TagStatus
from fieldtwin.studio.live.tag_history import GOOD, Point, TagHistory
from fieldtwin.twin.site.system import System

_QUALITIES = {int(quality): str(quality) for quality in Quality}
_REASONS = {int(reason): str(reason) for reason in Reason}
_NEVER = Point(0, None, str(Quality.BAD), str(Reason.NEVER_READ))


class PresentTags:
    """The readable tags of a system. The values of `secrets` are masked."""

    def __init__(self, system: System, secrets: Collection[str], history: TagHistory) -> None:
        self._secrets = secrets
        self._history = history
        tags = {f"{d.name}.{t.name}": t for d in system.devices.values() for t in d.profile.tags.values() if t.readable}
        self.texts = [name for name, tag in tags.items() if tag.is_text]
        """The tags whose values `take_texts` needs."""
        self._numbers = [name for name, tag in tags.items() if not tag.is_text]
        self._order = list(tags)
        self.describe_values(system)
        self._texts: dict[str, Point] = {}
        self._texts_ns = 0

    def describe_values(self, system: System) -> None:
        """Take over the names of values from the profiles, which a reload can change."""
        self._words = {
            f"{device.name}.{tag.name}": dict(tag.values)
            for device in system.devices.values()
            for tag in device.profile.tags.values()
            if tag.values
        }

    def take_texts(self, tags: Mapping[str, tuple[Any, str, str, int]], now_ns: int) -> None:
        """Take over values, qualities, reasons and source times (ns) of `texts`, as of `now_ns`."""
        self._texts_ns = now_ns
        self._texts = {
            name: Point(t_ns, self._masked(name, value), quality, reason)
            for name, (value, quality, reason, t_ns) in tags.items()
        }

    def statuses(self, inputs: Snapshot, now_ns: int) -> dict[str, TagStatus]:
        """Return every tag with its age at `now_ns`."""
        points = dict(self._points(inputs)) | self._texts
        found = {}
        for name in self._order:
            point, since_ns = points.get(name, _NEVER), self._texts_ns if name in self._texts else inputs.t_ns
            latest = self._history.latest(name)
            if latest is not None and latest.t_ns > since_ns:
                point = latest if latest.quality == GOOD else latest._replace(t_ns=point.t_ns)
            found[name] = TagStatus(
                value=point.value,
                quality=point.quality,
                reason=point.reason,
                age_s=(now_ns - point.t_ns) / NS_PER_S if point.t_ns else None,
                text=self._text(name, point.value),
            )
        return found

    def missing(self, inputs: Snapshot) -> list[tuple[str, Point]]:
        """Return the points that are not in the history at the time of the snapshot: values that became stale, and lost changes.

        The history must have all changes that the gateway reported up to the snapshot.
        """
        known = [(name, point, inputs.t_ns) for name, point in self._points(inputs)]
        known += [(name, point, self._texts_ns) for name, point in self._texts.items()]
        found = []
        for name, point, t_ns in known:
            latest = self._history.latest(name)
            if latest is None or (latest.t_ns <= t_ns and latest[1:] != point[1:]):
                found.append((name, point._replace(t_ns=t_ns)))
        return found

    def _points(self, inputs: Snapshot) -> Iterator[tuple[str, Point]]:
        """Return value, quality, reason and source time of each number."""
        if not inputs.counter:
            return
        index, times_ns = inputs.shape.index, inputs.shape.times.unpack(inputs.stamps)
        for name in self._numbers:
            n = index[name]
            quality, reason = _QUALITIES[inputs.qualities[n]], _REASONS[inputs.reasons[n]]
            yield name, Point(times_ns[n], self._masked(name, inputs.values[n]), quality, reason)

    def _masked(self, name: str, value: Any) -> Any:
        return SECRET if name in self._secrets else plain(value)

    def _text(self, name: str, value: Any) -> Any:
        words = self._words.get(name)
        return words.get(int(value), UNSET) if words and isinstance(value, int | float) else UNSET


def plain(value: Any) -> Any:
    """Return a value as JSON can hold it: None for a number that is not finite."""
    return None if isinstance(value, float) and not isfinite(value) else value
