"""Checks an expectation at the present time: of a tag, or of the requests seen on a device's bus.

The functions return (expected, got) as text, or None if the expectation is met.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from fieldtwin.capture.decoding.exchange import SECRET, DecodedExchange
from fieldtwin.emulators.faults.schema import seconds
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.conditions.decimals import as_decimal
from fieldtwin.gateway.devices.codec import decode, decode_little
from fieldtwin.scenarios.bench import Bench, TagReading
from fieldtwin.scenarios.language.words import BoundsForm, Expect, WireForm
from fieldtwin.twin.site.system import System

Said = tuple[str, str] | None
LIKE_S = 0.5
"""A value may be that which its device held up to this time (s) before the value's own time, because replies take time."""


@dataclass
class ExpectationInput:
    """The data that an expectation can use: the bench, the start of the check, and the exchanges seen.

    `stimulus_s` is the time of the last stimulus to the system; exchanges count from then.
    """

    bench: Bench
    system: System
    since_s: float
    stimulus_s: float
    exchanges: Iterable[DecodedExchange]
    updates: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in self.bench.names():
            reading = self.bench.reading(name)
            self.updates[name] = reading.updates if reading is not None else 0


async def check_tag(expect: Expect, watched: ExpectationInput) -> Said:
    """Check value, quality and rate of a tag now, and whether its value equals the value that its device held."""
    assert expect.tag is not None
    reading = watched.bench.reading(expect.tag)
    if expect.updates_per_s is not None:
        low, high = expect.updates_per_s
        took_s = watched.bench.now_s() - watched.since_s
        count = (reading.updates if reading is not None else 0) - watched.updates.get(expect.tag, 0)
        rate = count / took_s if took_s else 0.0
        if not low <= rate <= high:
            return f"{expect.tag}: {low:g} to {high:g} updates/s", f"{rate:.3g} in {took_s:g} s"
    if reading is None:
        return f"{expect.tag} published", "never published"
    said = await _check_value(expect, watched, reading)
    return said if said is None or not is_secret(watched.system, expect.tag) else (f"{expect.tag}", SECRET)


def is_secret(system: System, name: str) -> bool:
    """Return whether the value of DEVICE.TAG must not be shown."""
    device, _, tag = name.rpartition(".")
    found = system.devices[device].profile.tags.get(tag) if device in system.devices else None
    return found is not None and found.secret


async def _check_value(expect: Expect, watched: ExpectationInput, reading: TagReading) -> Said:
    assert expect.tag is not None
    # the quality has not turned bad, because the tag never had a value
    if expect.quality is not None and reading.value is None:
        return f"{expect.tag} {expect.quality}", f"no value yet, {reading.quality} ({reading.reason.replace('_', ' ')})"
    if expect.quality is not None and reading.quality != expect.quality:
        return f"{expect.tag} {expect.quality}", f"{reading.quality} ({reading.reason})"
    wanted = watched.system.number_of(expect.tag, expect.value)
    if wanted is not None and not _near(reading.value, wanted, expect.tolerance):
        within = f" ± {expect.tolerance:g}" if expect.tolerance else ""
        return f"{expect.tag} {expect.value}{within}", str(as_decimal(reading.value))
    if expect.like is not None:
        return await _like_held(expect, watched, reading.value, reading.age_s)
    return None


async def _like_held(expect: Expect, watched: ExpectationInput, value: object, reading_age_s: float) -> Said:
    """Compare the tag's value with the value that its device holds now, or held when the tag was read."""
    assert expect.tag is not None
    device, _, name = expect.tag.rpartition(".")
    tag = watched.system.devices[device].profile.tags[name]
    held = await watched.bench.held(expect.tag)
    can = watched.system.buses[watched.system.devices[device].bus].endpoint.is_can
    since_s = watched.bench.now_s() - reading_age_s - LIKE_S
    truths = [(decode_little if can else decode)(tag, raw, 0).value for raw in held_since(held, since_s)]
    if any(_near(value, truth, expect.tolerance) for truth in truths if truth is not None):
        return None
    seen, last = as_decimal(value), as_decimal(truths[-1]) if truths else "nothing"
    return f"{expect.tag} as the device's value, ± {expect.tolerance:g}", f"{seen!r}; the device holds {last!r}"


def held_since(held: Sequence[tuple[float, bytes]], since_s: float) -> list[bytes]:
    """Return the raw values that a device held at any time from `since_s` on. The first may have been set before `since_s`.

    `held` gives each value with the time from which it was held, in order.
    """
    first = sum(t_s <= since_s for t_s, _ in held)
    return [raw for _, raw in held[max(0, first - 1) :]]


def _near(value: object, truth: object, tolerance: float) -> bool:
    if isinstance(value, int | float) and isinstance(truth, int | float) and not isinstance(value, bool):
        difference: float = abs(as_decimal(value) - as_decimal(truth))
        return difference <= tolerance
    return value == truth


def check_exchanges(expect: Expect, watched: ExpectationInput) -> Said:
    """Check how often an exchange occurred on a device's bus since the last stimulus, or its rate per second since
    the step began.
    """
    assert expect.wire is not None
    since_s = watched.since_s if expect.requests_per_s is not None else watched.stimulus_s
    seen = [
        x
        for x in watched.exchanges
        if x.device == expect.wire and x.t_ns >= since_s * NS_PER_S and wire_matches(expect, x)
    ]
    if expect.requests_per_s is not None:
        took_s = max(watched.bench.now_s() - since_s, 0.001)
        rate = len(seen) / took_s
        if not inside(rate, expect.requests_per_s):
            return f"{bounds_text(expect.requests_per_s)} requests/s to {expect.wire}", f"{rate:.3g} in {took_s:g} s"
        return None
    times = expect.times if expect.times is not None else BoundsForm(min=1)
    wanted = times if isinstance(times, BoundsForm) else BoundsForm(min=times, max=times)
    if not inside(len(seen), wanted):
        window = f" within {seconds(expect.within):g} s" if expect.within is not None else ""
        return f"{bounds_text(wanted)} times{window}", f"{len(seen)}: " + (
            "; ".join(x.text for x in seen[:5]) or "none"
        )
    return None


def wire_matches(form: Expect | WireForm, exchange: DecodedExchange) -> bool:
    """Return whether an exchange has the form's function, access, register and value, if the form specifies them.

    A stray frame is not a request, so it never matches.
    """
    if exchange.is_stray:
        return False
    if form.function is not None and exchange.function != form.function:
        return False
    if form.access is not None and form.access not in exchange.access:
        return False
    if form.register_ is not None and form.register_ not in exchange.tags:
        return False
    return form.value is None or exchange.tags.get(form.register_ or "") == form.value


def inside(number: float, bounds: BoundsForm) -> bool:
    """Return whether a number is within bounds."""
    return (bounds.min is None or number >= bounds.min) and (bounds.max is None or number <= bounds.max)


def bounds_text(bounds: BoundsForm) -> str:
    """Return bounds in words: ``at least 1 and at most 3``."""
    if bounds.min == bounds.max:
        return f"{bounds.min:g}" if bounds.min is not None else "any"
    parts = [f"at least {bounds.min:g}"] if bounds.min is not None else []
    return " and ".join(parts + ([f"at most {bounds.max:g}"] if bounds.max is not None else []))


def said(part: Any) -> str:
    """Return a part of a scenario file as text, in the notation of the file."""
    if hasattr(part, "model_dump"):
        part = part.model_dump(exclude_none=True, exclude_defaults=True, by_alias=True)
    if isinstance(part, dict):
        return ", ".join(f"{key} {said(value)}" for key, value in part.items())
    return str(part)
