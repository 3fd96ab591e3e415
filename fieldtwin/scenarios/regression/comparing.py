"""Compare two runs of a system by meaning: states and their order, values, qualities, latencies.

The older run is the reference for the newer one. Bytes are not compared, so a change without an observable effect is not a
difference.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import median

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.scenarios.regression.run_history import RunHistory, ValueChange

MOST_SHOWN = 1_000


@dataclass(frozen=True)
class Allowed:
    """The differences between two runs that are allowed.

    Times may differ by `window_s`, values by the fraction `share` or, for the fields in `amounts`, by the amount given there,
    latencies by `latency_share` or `latency_ms`, whichever is more. Fields of `ignored` (or a whole device or program) are left
    out.
    """

    window_s: float = 1.0
    share: float = 0.01
    amounts: dict[str, float] = field(default_factory=dict)
    latency_share: float = 0.5
    latency_ms: float = 20.0
    ignored: frozenset[str] = frozenset()

    def leaves_out(self, name: str) -> bool:
        return name in self.ignored or name.partition(".")[0] in self.ignored

    def near(self, name: str, old: object, new: object) -> bool:
        """Return whether both values are equal within the tolerance."""
        if isinstance(old, bool) or isinstance(new, bool):
            return old is new
        if isinstance(old, int | float) and isinstance(new, int | float):
            if old != old or new != new:
                return old != old and new != new
            return abs(old - new) <= self.amounts.get(name, self.share * max(abs(old), abs(new)))
        return old == new


@dataclass(frozen=True, slots=True)
class RunDifference:
    """A difference between two runs.

    `what` is field, value, quality, order, time, latency or problem; `where` is the field, or the device and the
    request; `times` is how often it occurred, and `t_s` the time of the first occurrence.
    """

    what: str
    where: str
    expected: str
    got: str
    t_s: float | None = None
    times: int = 1

    def __str__(self) -> str:
        when = "" if self.t_s is None else f" at {self.t_s:.3f} s"
        often = f" ({self.times} times)" if self.times > 1 else ""
        return f"{self.where}{when}: {self.what}: expected {self.expected}, got {self.got}{often}"


@dataclass(frozen=True)
class RunComparison:
    """The result of comparing two runs: the number of `compared` fields and services, the `differences`, the lengths in s."""

    compared: int
    differences: tuple[RunDifference, ...]
    old_s: float = 0.0
    new_s: float = 0.0

    @property
    def common_s(self) -> float:
        """Return the time that both runs cover. Anything after it was not compared."""
        return min(self.old_s, self.new_s)

    @property
    def same(self) -> bool:
        """Return whether nothing became worse or different; False if nothing was compared."""
        return bool(self.compared) and not self.differences


def compare(old: RunHistory, new: RunHistory, allowed: Allowed | None = None) -> RunComparison:
    """Compare `new` with `old`. Events of the longer run after the end of the shorter one are ignored."""
    allowed = allowed or Allowed()
    end_ns = min(old.end_ns, new.end_ns)
    found: list[RunDifference] = []
    compared = 0
    for before, after, judge in ((old.states, new.states, _states), (old.tags, new.tags, _values)):
        for name in sorted(before | after):
            if allowed.leaves_out(name):
                continue
            one, other = _until(before.get(name, []), end_ns), _until(after.get(name, []), end_ns)
            if not one and not other:
                continue  # absent from both runs in their common time
            compared += 1
            if bool(one) != bool(other):
                there, missing = "there", "not there"
                found.append(RunDifference("field", name, there if one else missing, there if other else missing))
            else:
                window_ns = max(round(allowed.window_s * NS_PER_S), old.pace_ns(name), new.pace_ns(name))
                found += judge(name, one, other, end_ns, window_ns, allowed)
    compared += sum(bool(times) and bool(new.latency_ns.get(key)) for key, times in old.latency_ns.items())
    found += _latencies(old, new, allowed) + _problems(old, new, allowed)
    return RunComparison(compared, tuple(found[:MOST_SHOWN]), old.end_ns / NS_PER_S, new.end_ns / NS_PER_S)


def _until(changes: list[ValueChange], end_ns: int) -> list[ValueChange]:
    return [change for change in changes if change.t_ns <= end_ns]


def _states(
    name: str, old: list[ValueChange], new: list[ValueChange], end_ns: int, window_ns: int, allowed: Allowed
) -> list[RunDifference]:
    """Compare states: both runs must have the same values in the same order, at times that differ by at most `window_ns`.

    In the last `window_ns`, one of the runs may have one more value.
    """
    for one, other in zip(old, new, strict=False):
        if not allowed.near(name, one.value, other.value):
            return [RunDifference("order", name, str(one), str(other), other.t_ns / NS_PER_S)]
        if abs(one.t_ns - other.t_ns) > window_ns:
            return [_otherwhen(name, one, other)]
    rest = old[len(new) :] or new[len(old) :]
    if rest and rest[0].t_ns < end_ns - window_ns:
        nothing = "nothing more"
        missing = len(old) > len(new)
        said = str(rest[0])
        return [
            RunDifference(
                "order", name, said if missing else nothing, nothing if missing else said, rest[0].t_ns / NS_PER_S
            )
        ]
    return []


def _otherwhen(name: str, one: ValueChange, other: ValueChange) -> RunDifference:
    return RunDifference(
        "time",
        name,
        f"{one} at {one.t_ns / NS_PER_S:.3f} s",
        f"at {other.t_ns / NS_PER_S:.3f} s",
        other.t_ns / NS_PER_S,
    )


def _values(
    name: str, old: list[ValueChange], new: list[ValueChange], end_ns: int, window_ns: int, allowed: Allowed
) -> list[RunDifference]:
    """Compare values: each value of one run must also have occurred in the other run, within `window_ns`."""
    for one, other, swapped in ((old, new, False), (new, old, True)):
        unmatched = list(_unmatched(name, one, other, end_ns, window_ns, allowed))
        if not unmatched:
            continue
        first, near_by = unmatched[0]
        what = "value" if near_by is not None and near_by.quality == first.quality else "quality"
        there, here = str(first), "nothing" if near_by is None else str(near_by)
        expected, got = (here, there) if swapped else (there, here)
        return [RunDifference(what, name, expected, got, first.t_ns / NS_PER_S, len(unmatched))]
    return []


def _unmatched(
    name: str, one: list[ValueChange], other: list[ValueChange], end_ns: int, window_ns: int, allowed: Allowed
) -> list[tuple[ValueChange, ValueChange | None]]:
    times = [change.t_ns for change in other]
    found: list[tuple[ValueChange, ValueChange | None]] = []
    for change in one:
        if change.t_ns > end_ns - window_ns:
            break  # the other run may have ended before it
        first = max(0, bisect_right(times, change.t_ns - window_ns) - 1)
        last = bisect_right(times, change.t_ns + window_ns)
        around = other[first:last]
        if not any(_alike(name, change, seen, allowed) for seen in around) and not _between(name, change, around):
            found.append((change, around[len(around) // 2] if around else None))
    return found


def _alike(name: str, one: ValueChange, other: ValueChange, allowed: Allowed) -> bool:
    (value, quality), (seen, seen_quality) = one.says(), other.says()
    return quality == seen_quality and (quality == "bad" or allowed.near(name, value, seen))


def _between(name: str, change: ValueChange, around: Sequence[ValueChange]) -> bool:
    """Return whether the other run had values below and above this one, so that it passed the value between two samples."""
    value = change.value
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    seen = [c.value for c in around if c.quality == change.quality and isinstance(c.value, int | float)]
    return len(seen) >= 2 and min(seen) <= value <= max(seen)


def _latencies(old: RunHistory, new: RunHistory, allowed: Allowed) -> list[RunDifference]:
    """Compare the medians of response times; only a slower response is a difference."""
    found = []
    for key, before in sorted(old.latency_ns.items()):
        after = new.latency_ns.get(key, [])
        if allowed.leaves_out(key[0]) or not before:
            continue
        where = " ".join(key)
        if not after:
            found.append(RunDifference("latency", where, f"{len(before)} answers", "none"))
            continue
        was, now = median(before) / 1e6, median(after) / 1e6
        if now > was + max(allowed.latency_ms, allowed.latency_share * was):
            found.append(RunDifference("latency", where, f"{was:.1f} ms", f"{now:.1f} ms"))
    return found


def _problems(old: RunHistory, new: RunHistory, allowed: Allowed) -> list[RunDifference]:
    """Compare the numbers of requests without a good answer; a new or much more frequent problem is a difference."""
    found = []
    for key, now in sorted(new.problems.items()):
        was = old.problems[key]
        share, before = now / max(1, new.asked[key[:2]]), was / max(1, old.asked[key[:2]])
        if allowed.leaves_out(key[0]) or now <= was or share <= before * 1.5 + 0.01:
            continue
        found.append(
            RunDifference("problem", " ".join(key[:2]), f"{key[2]} {was} times", f"{now} times of {new.asked[key[:2]]}")
        )
    return found
