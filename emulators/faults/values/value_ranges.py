"""The numbers that the registers or object of a tag can hold, and which of them lie outside of its declared range.

Values are in engineering units. A tag whose scale factor is in a separate register (`scale_by`) has no fixed
limits: the factor is known only while the device runs.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from fieldtwin.emulators.faults.fault import Fault, ValueFault
from fieldtwin.emulators.faults.wrong_aim import WrongAim
from fieldtwin.gateway.core.files.profile import INTEGER_RANGES, Tag

PLAUSIBLE = 1.0e9
"""The value with which a fault puts a float out of range, unless the declared range includes it."""
FLOAT_LIMITS = {"float32": 3.4028234663852886e38, "float64": 1.7976931348623157e308}
"""The largest finite numbers (IEEE 754)."""
_MOST_SENTINELS = 64
"""The number of neighbours of a limit that may be sentinels, which mean "no value" and not a value out of range."""


def numbers(tags: Iterable[Tag]) -> list[Tag]:
    """Return the tags that a value fault can change: readable tags that are numbers."""
    return [tag for tag in tags if tag.readable and not tag.is_text]


def limits(tag: Tag) -> tuple[float, float] | None:
    """Return the smallest and the largest value that the type of `tag` can carry; None if there are no fixed limits."""
    if tag.scale_by is not None:
        return None
    raw = _raw_limits(tag)
    if raw is None:
        return None
    low, high = sorted(limit * tag.scale + tag.offset for limit in raw)
    return low, high


def check_value(tag: Tag, value: float, name: str, hint: str = "") -> None:
    """Raise `WrongAim` for a number that the type of `tag` cannot carry, because the device would hold a different number."""
    found = limits(tag)
    if found is None or math.isnan(value) or (math.isinf(value) and tag.type in FLOAT_LIMITS):
        return
    low, high = found
    margin = 0.0 if tag.type in FLOAT_LIMITS else abs(tag.scale) / 2
    if not low - margin <= value <= high + margin:
        raise WrongAim("value", f"{name} cannot hold {value:g}", expected=_in_words(tag, low, high), hint=hint)


def beyond(tag: Tag, name: str) -> float:
    """Return a value outside of the declared range of `tag`: the largest that its type can carry, or else the smallest.

    If no range is declared, it is the largest value of the type. For a tag with a separate scale factor, infinity
    represents the largest raw number; the device limits it. Raises `WrongAim` if the type carries no value outside of the
    range.
    """
    if tag.scale_by is not None:
        return math.inf
    if tag.type in FLOAT_LIMITS:
        most = FLOAT_LIMITS[tag.type]
        candidates = [PLAUSIBLE, most, -PLAUSIBLE, -most]
    else:
        low, high = _raw_limits(tag) or (0, 0)
        ends = (_no_sentinel(tag, high, -1), _no_sentinel(tag, low, 1))
        candidates = sorted((raw * tag.scale + tag.offset for raw in ends), reverse=True)
    if tag.range is None:
        if not tag.is_bit:
            return candidates[0]
        raise WrongAim(
            "register", f"{name} is a bit, and no value of a bit is out of range", expected="a different tag"
        )
    outside = (value for value in candidates if not tag.range[0] <= value <= tag.range[1])
    found = next(outside, None)
    if found is None:
        low, high = limits(tag) or (0.0, 0.0)
        raise WrongAim(
            "register",
            f"{name} cannot be out of its range {tag.range[0]:g} to {tag.range[1]:g}: its type carries no other value",
            expected=f"a tag whose type carries more than its range; this one carries {_in_words(tag, low, high)}",
        )
    return found


def check_fault(fault: Fault, register: str, tags: Iterable[Tag], device: str = "") -> None:
    """Raise `WrongAim` for a fault that would give tags of `device` a value which they cannot hold.

    `register` is the name of the tag that the fault is aimed at; "" means that it changes all `tags` of the device.
    """
    if not isinstance(fault, ValueFault) or "value" not in fault.form.model_fields:
        return
    value: float | None = fault.parameters.value
    whose = f"{device}." if device else ""
    refused: list[WrongAim] = []
    struck = [tag for tag in numbers(tags) if register in ("", tag.name)]
    for tag in struck:
        try:
            if value is None:
                beyond(tag, f"{whose}{tag.name}")
            else:
                hint = "" if register else "say `register: TAG`: without it the fault affects every tag of the device"
                check_value(tag, value, f"{whose}{tag.name}", hint)
        except WrongAim as e:
            refused.append(e)
    if refused and (value is not None or len(refused) == len(struck)):
        raise refused[0]


def _in_words(tag: Tag, low: float, high: float) -> str:
    unit = f" {tag.unit}" if tag.unit else ""
    bits = "" if tag.bits is None else f", bits {tag.bits[0]} to {tag.bits[1]}"
    return f"{low:g} to {high:g}{unit} ({tag.type}{bits})"


def _raw_limits(tag: Tag) -> tuple[float, float] | None:
    if tag.bits is not None:
        return 0, (1 << (tag.bits[1] - tag.bits[0] + 1)) - 1
    if tag.at is not None and tag.at.table in ("coil", "discrete"):
        return 0, 1
    if tag.type in FLOAT_LIMITS:
        return -FLOAT_LIMITS[tag.type], FLOAT_LIMITS[tag.type]
    return INTEGER_RANGES.get(tag.type)


def _no_sentinel(tag: Tag, raw: float, step: int) -> float:
    """Return `raw`, or the nearest number that the profile does not declare to mean "no value"."""
    for _ in range(_MOST_SENTINELS):
        if tag.at is None or int(raw) % (1 << 16 * tag.at.count) not in tag.sentinels:
            break
        raw += step
    return raw
