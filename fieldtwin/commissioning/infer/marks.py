"""Classify values by their behaviour over time: a counter, a state, a time of day, or a scaled copy of another value.

The module does no I/O. A mark needs enough observations; a mere resemblance becomes a note that begins with "perhaps".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from itertools import pairwise

from fieldtwin.commissioning.infer.fields import FEWEST_PASSES, Interpretation
from fieldtwin.commissioning.infer.joint import toggled_bits

FEWEST_STEPS = 5
MOST_STATES, LARGEST_STATE = 8, 255
LARGEST_CODE = 15
"""A register with a larger value than this is a status word rather than a state, if it behaves like both."""
DAY_S = 86_400
SCALES = (1.0, 10.0, 100.0, 1000.0, 10_000.0)
_MAINS = (
    ((49.5, 50.5), "mains frequency", "Hz"),
    ((59.5, 60.5), "mains frequency", "Hz"),
    ((215.0, 245.0), "mains voltage", "V"),
    ((380.0, 420.0), "mains voltage, phase to phase", "V"),
)


def marked(reading: Interpretation, times_s: Sequence[float]) -> Interpretation:
    """Return `reading` with its marks and notes. `times_s`: the time of each pass, in seconds since 1970 UTC."""
    if reading.type == "string":
        return reading
    known = [(float(v), t) for v, t in zip(reading.values, times_s, strict=True) if not math.isnan(float(v))]
    if len(known) < len(times_s):
        passes = f"NaN in {len(times_s) - len(known)} of {len(times_s)} passes: " if known else ""
        note = f"{passes}perhaps not available"
        reading = replace(reading, notes=(*reading.notes, note))
    if not reading.moves:
        return reading
    numbers, times_s = [n for n, _ in known], [t for _, t in known]
    whole = "int" in reading.type or reading.type.startswith("bcd")
    marks, notes = list(reading.marks), list(reading.notes)
    steps = [b - a for a, b in pairwise(numbers)]
    elapsed = [b - a for a, b in pairwise(times_s)]
    up = sum(s > 0 for s in steps)
    if whole and _is_time(numbers, times_s):
        marks.append("timestamp")
    elif whole and len(steps) >= FEWEST_STEPS and _runs_with(steps, elapsed):
        marks.append("seconds")
        notes.append("counts seconds, as an uptime does")
    elif len(steps) >= FEWEST_STEPS and all(s >= 0 for s in steps) and up >= max(3, 0.5 * len(steps)):
        marks.append("counter")
    elif whole and reading.registers == 1 and max(numbers) > LARGEST_CODE and (bits := _bits(reading)):
        marks.append("bits")
        notes.append(_bits_note(bits))
    elif whole and _is_state(numbers, steps):
        marks.append("enumeration")
    elif whole and reading.registers == 1 and (bits := _bits(reading)):
        marks.append("bits")
        notes.append(_bits_note(bits))
    elif all(s >= 0 for s in steps) and up:
        notes.append("only increased: perhaps a counter")
    return replace(reading, marks=tuple(marks), notes=tuple(notes + _likeness(reading, numbers, whole=whole)))


def _bits(reading: Interpretation) -> tuple[int, ...]:
    return toggled_bits([int(v) & 0xFFFF for v in reading.values])


def _bits_note(bits: Sequence[int]) -> str:
    return f"a status word: {'bit' if len(bits) == 1 else 'bits'} {', '.join(map(str, bits))} changed"


def _is_time(numbers: Sequence[float], times_s: Sequence[float]) -> bool:
    """Return whether the values are seconds since 1970 that advance with time and differ from it by less than a day (time
    zones).
    """
    near = all(abs(n - t) < DAY_S for n, t in zip(numbers, times_s, strict=True))
    shifts = [n - t for n, t in zip(numbers, times_s, strict=True)]
    return near and max(shifts) - min(shifts) <= 2 + 0.01 * (times_s[-1] - times_s[0])


def _runs_with(steps: Sequence[float], elapsed: Sequence[float]) -> bool:
    """Return whether the value advances by one per second. The intervals between passes must be long enough to exclude a
    count of passes.
    """
    total = sum(elapsed)
    return (
        total >= 20
        and max(elapsed) > 1.5
        and all(abs(s - e) <= 1.5 + 0.02 * e for s, e in zip(steps, elapsed, strict=True))
        and abs(sum(steps) - total) <= 2 + 0.02 * total
    )


def _is_state(numbers: Sequence[float], steps: Sequence[float]) -> bool:
    """Return whether the values are few small numbers near 0, each held for a while. A value that changes constantly is not a
    state.
    """
    states = set(numbers)
    changes = sum(s != 0 for s in steps)
    return (
        len(numbers) >= 2 * FEWEST_PASSES
        and 2 <= len(states) <= min(MOST_STATES, len(numbers) // 3)
        and min(states) >= 0
        and max(states) <= LARGEST_STATE
        and 2 <= changes <= len(steps) / 4
    )


def _likeness(reading: Interpretation, numbers: Sequence[float], *, whole: bool) -> list[str]:
    """Return a note if all values lie in the usual range of a mains frequency or voltage."""
    if reading.type.startswith("float") or whole:
        for scale in SCALES if whole else (1.0,):
            for (low, high), what, unit in _MAINS:
                if scale == 1.0 and whole:
                    continue
                if all(low <= n / scale <= high for n in numbers):
                    return [f"perhaps {what} in {1 / scale:g} {unit}" if whole else f"perhaps {what} in {unit}"]
    return []


def with_scales(readings: Sequence[Interpretation]) -> list[Interpretation]:
    """Set the scale of integers: if an integer equals, in every pass, a float of the same device times a power of ten, that
    power is its scale."""
    floats = [r for r in readings if r.type.startswith("float") and r.moves and r.probability >= 0.8]
    return [_scaled(r, floats) if "int" in r.type and r.moves else r for r in readings]


def _scaled(reading: Interpretation, floats: Sequence[Interpretation]) -> Interpretation:
    """Return the reading with its scale, if it equals a float times a power of ten in all passes. Its values must vary enough
    for that to be significant.
    """
    numbers = [float(v) for v in reading.values]
    spread = max(numbers) - min(numbers)
    if len(numbers) < FEWEST_PASSES or len(set(numbers)) < 4 or spread < 5:
        return reading
    for other in floats:
        theirs = [float(v) for v in other.values]
        for scale in SCALES:
            if all(abs(n - v * scale) <= 1.01 for n, v in zip(numbers, theirs, strict=True)):
                note = f"is {other.table}:{other.address} times {scale:g}"
                return replace(reading, scale=1 / scale, notes=(*reading.notes, note))
    return reading


_CLOCK = ("year", "month", "day", "hour", "minute", "second")


def clock_fields(
    table: str, address: int, words: Sequence[Sequence[int]], times_s: Sequence[float]
) -> list[Interpretation]:
    """Find date-and-time clocks in `words`, the words of neighbouring registers from `address` on. Return a reading for each
    register.

    A clock has six registers, from year to second or from second to year, as numbers or as BCD. In each pass they must give a
    date that differs from the pass's time by less than a day (time zones) and advances with it.
    """
    found: list[Interpretation] = []
    start = 0
    while start + 6 <= len(words):
        stretch = words[start : start + 6]
        for backwards in (False, True):
            for bcd in (False, True):
                rows = list(zip(*(reversed(stretch) if backwards else stretch), strict=True))
                if _is_clock([_clock_s(row, bcd=bcd) for row in rows], times_s):
                    names = _CLOCK[::-1] if backwards else _CLOCK
                    found += [
                        _clock_reading(table, address + start + i, n, stretch[i], bcd) for i, n in enumerate(names)
                    ]
                    start += 5
                    break
            else:
                continue
            break
        start += 1
    return found


def _clock_s(row: Sequence[int], *, bcd: bool) -> float | None:
    """Return the seconds since 1970 of `row` (year, month, day, hour, minute, second, taken as UTC); None if it is not a date."""
    parts = [f"{w:x}" for w in row] if bcd else [str(w) for w in row]
    if not all(p.isdecimal() for p in parts):
        return None
    year, month, day, hour, minute, second = map(int, parts)
    try:
        return datetime(year + 2000 if year < 100 else year, month, day, hour, minute, second, tzinfo=UTC).timestamp()
    except (ValueError, OverflowError):
        return None


def _is_clock(clock_s: Sequence[float | None], times_s: Sequence[float]) -> bool:
    shifts = [c - t for c, t in zip(clock_s, times_s, strict=True) if c is not None]
    moved = len(set(clock_s)) > 1
    return (
        len(shifts) == len(times_s) >= 3 and moved and max(map(abs, shifts)) < DAY_S and max(shifts) - min(shifts) <= 3
    )


def _clock_reading(table: str, address: int, name: str, words: Sequence[int], bcd: bool) -> Interpretation:
    kind = "bcd16" if bcd else "uint16"
    values = tuple(int(f"{w:x}") if bcd else w for w in words)
    return Interpretation(
        table, address, 1, kind, "ABCD", 0.9999, values, marks=("timestamp",), notes=(f"the {name} of a clock",)
    )
