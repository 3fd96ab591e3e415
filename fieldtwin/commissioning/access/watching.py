"""Read values of one device repeatedly: a bounded history of each, and a sparkline of it.

This module must never write, and never reads faster than requested. It prints nothing.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import AsyncGenerator, Mapping, Sequence
from dataclasses import dataclass, field

from fieldtwin.commissioning.access.point import Point, PointValue
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.files.profile import Tag

MOST_SAMPLES = 3600
"""Number of samples of a tag that are kept for a sparkline and a plot; older ones are counted and dropped."""
BLOCKS = "▁▂▃▄▅▆▇█"
GAP = " "


@dataclass
class History:
    """The history of a tag: times in seconds since the start, and values, with None for a sample without a good number.

    `least` and `most` are the extremes of all samples, including those that were dropped.
    """

    times_s: deque[float] = field(default_factory=lambda: deque(maxlen=MOST_SAMPLES))
    values: deque[float | None] = field(default_factory=lambda: deque(maxlen=MOST_SAMPLES))
    samples: int = 0
    bad: int = 0
    changes: int = 0
    least: float = math.inf
    most: float = -math.inf
    _last: object = None

    def add(self, t_s: float, answer: PointValue) -> None:
        value = answer.value.value
        good = answer.value.good
        number = float(value) if isinstance(value, int | float) and good else None
        self.times_s.append(t_s)
        self.values.append(number)
        self.samples += 1
        self.bad += not good
        if good:
            self.changes += self.samples > 1 and self._last is not None and answer.value.raw != self._last
            self._last = answer.value.raw
        if number is not None:
            self.least, self.most = min(self.least, number), max(self.most, number)

    def sparkline(self, width: int) -> str:
        """Return the last `width` samples as blocks between their smallest and largest; a missing value is a blank."""
        return sparkline(list(self.values)[-width:])


def sparkline(values: Sequence[float | None]) -> str:
    """Return one block character per value, a blank for None. A constant value is a line in the middle."""
    known = [v for v in values if v is not None]
    if not known:
        return GAP * len(values)
    low, high = min(known), max(known)
    span = high - low
    if not span or not math.isfinite(span):
        return "".join(GAP if v is None else BLOCKS[3] for v in values)
    top = len(BLOCKS) - 1
    return "".join(GAP if v is None else BLOCKS[min(top, int((v - low) / span * len(BLOCKS)))] for v in values)


@dataclass(frozen=True, slots=True)
class Sample:
    """The results of one reading of all tags: its time in seconds since the first reading, and the values. `late_s` is its
    delay.
    """

    number: int
    t_s: float
    answers: Mapping[str, PointValue]
    late_s: float


async def samples(
    point: Point,
    tags: Sequence[Tag],
    clock: Clock,
    every_s: float,
    count: int | None = None,
    for_s: float | None = None,
) -> AsyncGenerator[Sample, None]:
    """Yield a sample every `every_s` seconds: `count` samples, those that begin within `for_s` seconds, or until closed.

    If reading takes longer than `every_s`, the next sample is late; missed samples are not made up for.
    """
    start_ns = due_ns = clock.monotonic_ns()
    end_ns = None if for_s is None else start_ns + round(for_s * NS_PER_S)
    number = 0
    while count is None or number < count:
        if end_ns is not None and due_ns >= end_ns:
            await clock.sleep_until_ns(end_ns)
            return
        await clock.sleep_until_ns(due_ns)
        now_ns = clock.monotonic_ns()
        answers = await point.read(tags)
        number += 1
        yield Sample(number, (now_ns - start_ns) / NS_PER_S, answers, (now_ns - due_ns) / NS_PER_S)
        due_ns = max(due_ns + round(every_s * NS_PER_S), clock.monotonic_ns())
