"""Whether one expectation holds now: of a tag, or of what was seen on a device's wire. Answers with (expected, got), or None."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from emulators.faults.schema import seconds
from fieldtwin.decoding.exchange import SECRET, Exchange
from fieldtwin.scenarios.bench import Bench, Reading
from fieldtwin.scenarios.words import Bounds, Expect
from gateway.devices.codec import decode, decode_little
from twin.system import System

_NS = 1_000_000_000
Said = tuple[str, str] | None
LIKE_S = 0.5
"""How long before a value's own time its device may have held it: a reply takes its time on the wire."""


@dataclass
class Watched:
    """What an expectation can look at: the bench, since when, and the exchanges that were seen. `stimulus_s`: when the system
    was last told something; exchanges count from then."""

    bench: Bench
    system: System
    since_s: float
    stimulus_s: float
    exchanges: Iterable[Exchange]
    updates: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in self.bench.names():
            reading = self.bench.reading(name)
            self.updates[name] = reading.updates if reading is not None else 0


async def judge_tag(expect: Expect, watched: Watched) -> Said:
    """Value, quality, likeness and rate of a tag now."""
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
    said = await _judge_value(expect, watched, reading)
    return said if said is None or not is_secret(watched.system, expect.tag) else (f"{expect.tag}", SECRET)


def is_secret(system: System, name: str) -> bool:
    """Whether nobody is to see the value of DEVICE.TAG."""
    device, _, tag = name.rpartition(".")
    found = system.devices[device].profile.tags.get(tag) if device in system.devices else None
    return found is not None and found.secret


async def _judge_value(expect: Expect, watched: Watched, reading: Reading) -> Said:
    assert expect.tag is not None
    if expect.quality is not None and reading.quality != expect.quality:
        return f"{expect.tag} {expect.quality}", f"{reading.quality} ({reading.reason})"
    if expect.value is not None and not _near(reading.value, expect.value, expect.tolerance):
        within = f" ± {expect.tolerance:g}" if expect.tolerance else ""
        return f"{expect.tag} {expect.value}{within}", str(reading.value)
    if expect.like is not None:
        return await _like_held(expect, watched, reading.value, reading.age_s)
    return None


async def _like_held(expect: Expect, watched: Watched, value: object, reading_age_s: float) -> Said:
    """The tag against what its device holds, or held when the tag was read."""
    assert expect.tag is not None
    device, _, name = expect.tag.rpartition(".")
    tag = watched.system.devices[device].profile.tags[name]
    held = await watched.bench.held(expect.tag)
    can = watched.system.buses[watched.system.devices[device].bus].endpoint.is_can
    since_s = watched.bench.now_s() - reading_age_s - LIKE_S
    newest = [raw for t_s, raw in held if t_s >= since_s]
    recent = newest or [raw for _, raw in held[-1:]]
    truths = [(decode_little if can else decode)(tag, raw, 0).value for raw in recent]
    if any(_near(value, truth, expect.tolerance) for truth in truths if truth is not None):
        return None
    last = truths[-1] if truths else "nothing"
    return f"{expect.tag} as the device holds it, ± {expect.tolerance:g}", f"{value!r}; the device holds {last!r}"


def _near(value: object, truth: object, tolerance: float) -> bool:
    if isinstance(value, int | float) and isinstance(truth, int | float) and not isinstance(value, bool):
        return abs(value - truth) <= tolerance
    return value == truth


def judge_wire(expect: Expect, watched: Watched) -> Said:
    """How often something was asked on a device's wire since the last stimulus; or how often a second, since the step began."""
    assert expect.wire is not None
    since_s = watched.since_s if expect.requests_per_s is not None else watched.stimulus_s
    seen = [x for x in watched.exchanges if x.device == expect.wire and x.t_ns >= since_s * _NS and _matches(expect, x)]
    if expect.requests_per_s is not None:
        took_s = max(watched.bench.now_s() - since_s, 0.001)
        rate = len(seen) / took_s
        if not inside(rate, expect.requests_per_s):
            return f"{bounds_text(expect.requests_per_s)} requests/s to {expect.wire}", f"{rate:.3g} in {took_s:g} s"
        return None
    times = expect.times if expect.times is not None else Bounds(min=1)
    wanted = times if isinstance(times, Bounds) else Bounds(min=times, max=times)
    if not inside(len(seen), wanted):
        window = f" within {seconds(expect.within):g} s" if expect.within is not None else ""
        return f"{bounds_text(wanted)} times{window}", f"{len(seen)}: " + (
            "; ".join(x.text for x in seen[:5]) or "none"
        )
    return None


def _matches(expect: Expect, exchange: Exchange) -> bool:
    if expect.function is not None and exchange.function != expect.function:
        return False
    if expect.access is not None and expect.access not in exchange.access:
        return False
    if expect.register_ is not None and expect.register_ not in exchange.tags:
        return False
    return expect.value is None or exchange.tags.get(expect.register_ or "") == expect.value


def inside(number: float, bounds: Bounds) -> bool:
    """Whether a number is within bounds."""
    return (bounds.min is None or number >= bounds.min) and (bounds.max is None or number <= bounds.max)


def bounds_text(bounds: Bounds) -> str:
    """Bounds in words: ``at least 1 and at most 3``."""
    if bounds.min == bounds.max:
        return f"{bounds.min:g}" if bounds.min is not None else "any"
    parts = [f"at least {bounds.min:g}"] if bounds.min is not None else []
    return " and ".join(parts + ([f"at most {bounds.max:g}"] if bounds.max is not None else []))
