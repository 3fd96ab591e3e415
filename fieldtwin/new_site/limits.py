"""Choose the value of a device that a new site supervises, its limits, and the output that a program may command.

The numbers are placeholders that fit the tag's type: the user replaces them with those of the process.
"""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.gateway.core.files.profile import DeviceProfile, Tag

NEVER_POLLED = ("identity", "setup")
"""Poll groups that are read only once, after the connection is made."""
_PERCENT = (0.0, 100.0)
_SETPOINT = {"set", "setpoint", "wanted", "target", "reference"}
"""Parts of names that show that a value is a setpoint and not a measurement."""
_PARAMETER = {
    "alarm",
    "delay",
    "filter",
    "gain",
    "limit",
    "max",
    "min",
    "offset",
    "threshold",
    "time",
    "timeout",
    "warning",
}
"""Parts of names that show that a value is a parameter of the device and not a setpoint of the process."""
_FEW = 10
"""A range with fewer whole numbers than this has no room for two limits."""


@dataclass(frozen=True, slots=True)
class Limits:
    """The usual value, the alarm limits around it, and a value beyond the high limit, in engineering units."""

    low: float
    usual: float
    high: float
    beyond: float


@dataclass(frozen=True, slots=True)
class Output:
    """A tag that the program commands, and its two values. `samples` states whether it is a sampling period."""

    tag: Tag
    on: float
    off: float
    samples: bool = False


def supervised(profile: DeviceProfile) -> Tag | None:
    """Return the tag that the program and the scenarios of a new site watch; None if the profile has no number to watch.

    Values for which the profile states a plausible range come first, then measured values with a unit, then other read-only
    numbers, then setpoints, and the scale factors of other tags last.
    """
    sampled = profile.sampled
    factors = {tag.scale_by for tag in profile.tags.values()}
    plausible = {rule.tag for rule in profile.form.identify if rule.between is not None}
    candidates = [
        tag
        for tag in profile.tags.values()
        if tag.readable
        and not (tag.is_text or tag.counter or tag.secret)
        and (sampled is None or (tag.poll == sampled.poll and tag.name not in (sampled.count, sampled.period)))
    ]
    return min(candidates, key=lambda tag: (tag.name not in plausible, tag.name in factors, *_rank(tag)), default=None)


def _rank(tag: Tag) -> tuple[bool, ...]:
    """Return the sort key of a tag; of equal ones, the first in the profile is taken."""
    return (
        tag.poll in NEVER_POLLED,
        tag.writable,
        bool(_SETPOINT & set(tag.name.split("_"))),
        bool(tag.values),
        tag.scale_by is not None,
        not tag.unit,
        tag.bits is not None,
    )


def limits_of(profile: DeviceProfile, tag: Tag) -> Limits:
    """Return the range in which the profile's `identify` expects the value, else placeholders within the limits of its type."""
    low, high = tag.limits or _PERCENT
    between = next((rule.between for rule in profile.form.identify if rule.tag == tag.name), None)
    if between is not None:
        low, high = between
        return Limits(low, (low + high) / 2, high, high + (high - low) / 10)
    if tag.values:
        known = [number for number, _ in tag.values]
        usual = float(max(known)) if profile.inbox is not None else float(min(known))
        return Limits(min(known), usual, max(known), max(known) + 1)
    if low <= 0 and high >= 100:
        low, high = _PERCENT
    if tag.is_integer and high - low < _FEW:
        return Limits(low, low, high - 1, high)
    width = high - low
    return Limits(*(round(low + part * width, 6) for part in (0.2, 0.5, 0.8, 0.9)))


def commanded(profile: DeviceProfile, watched: Tag | None) -> Output | None:
    """Return the output that a program may command without knowledge of the process; None if the device has no such tag.

    For a sensor with a sampling period, it is this period. For any other device whose supervised value is a measurement, it is
    the first setpoint that is polled, has a range, is not marked as dangerous, and does not have the name of a parameter.
    """
    if profile.sampled is not None:
        period = profile.tags[profile.sampled.period]
        return Output(period, 1, 0, samples=True) if period.writable else None
    if watched is None or watched.writable or watched.type == "bool":
        return None
    for tag in profile.tags.values():
        harmless = not (tag.danger or tag.nonvolatile or tag.secret or tag.is_text or tag.bits or tag.scale_by)
        harmless = harmless and _PARAMETER.isdisjoint(tag.name.split("_"))
        if tag.writable and tag.readable and harmless and tag.poll not in NEVER_POLLED and tag.range is not None:
            low, high = tag.range
            return Output(tag, high, max(low, 0) if high > 0 else low)
    return None
