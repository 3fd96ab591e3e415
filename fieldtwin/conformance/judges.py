"""Judges that cases share: pure functions of an `Observation`.

What every master owes, whatever was done to it, comes first: it goes on, it does not flood, it sends nothing that is no
request, and no value of a bad frame is ever published. Then what the case is about.
"""

from __future__ import annotations

from collections.abc import Callable

from fieldtwin.conformance.case import Finding, Judge, failed, inconclusive, passed, skipped
from fieldtwin.conformance.observation import Asked, Came, Ended, Garbled, Left, Observation, Shown, Told, Word
from gateway.core.clock import NS_PER_S

FLOOD_FACTOR = 5.0
"""So many times the usual rate is a flood: a master that tries four times and polls on stays below."""
FLOOD_FLOOR = 30
"""Requests within the case that are no flood, however rare they usually are."""
NEEDS_PROBE = "only its values can tell: give --probe"

Rule = Callable[[Observation], Finding | None]


def all_of(*rules: Rule) -> Judge:
    """The first rule that has something to say decides; passed when none has."""

    def judge(seen: Observation) -> Finding:
        for rule in rules:
            found = rule(seen)
            if found is not None:
                return found
        return passed()

    return judge


# -- what every master owes -------------------------------------------------------------------------------------------


def goes_on(seen: Observation) -> Finding | None:
    """It still runs, and asks again once the device is well."""
    for ended in seen.of(Ended, seen.begun_ns):
        return failed(
            f"the master ended, exit code {ended.status}, {seen.since_s(ended.t_ns):.2f} s after the first odd answer"
        )
    asked = next(seen.of(Asked, seen.over_ns + 1), None)
    if asked is None:
        return failed(
            f"no request for {(seen.until_ns - seen.over_ns) / NS_PER_S:.1f} s after the last odd answer: it is wedged"
        )
    return None


def asks_cleanly(seen: Observation) -> Finding | None:
    """What it sends are requests."""
    for bad in seen.of(Garbled, seen.begun_ns):
        return failed(f"sent {len(bad.data)} bytes that are no request: {bad.data[:16].hex(' ')}")
    return None


def does_not_flood(seen: Observation) -> Finding | None:
    """Retries and new connections are bounded."""
    span_s = max((seen.until_ns - seen.begun_ns) / NS_PER_S, 0.001)
    for kind, what in ((Asked, "requests"), (Came, "connections")):
        count = sum(isinstance(event, kind) for event in seen.events if event.t_ns >= seen.begun_ns)
        if count > FLOOD_FLOOR and count > FLOOD_FACTOR * seen.habit.rate_per_s * span_s:
            usual = seen.habit.rate_per_s
            return failed(
                f"{count} {what} in {span_s:.1f} s, {usual:.1f} a second are its habit: nothing holds it back"
            )
    return None


def publishes_nothing_bad(seen: Observation) -> Finding | None:
    """No published value that no honest answer held."""
    for shown in seen.of(Shown, seen.begun_ns):
        if shown.word is Word.POISON:
            return failed(f"published {shown.text}, the value of the bad frame, {_when(seen, shown.t_ns)}")
        if shown.word is Word.OTHER:
            return failed(f"published {shown.text}, which no honest answer held, {_when(seen, shown.t_ns)}")
    return None


def publishes_good_again(seen: Observation) -> Finding | None:
    """Once the device is well, its value is seen again."""
    if seen.probed and not any(shown.word is seen.last for shown in seen.of(Shown, seen.over_ns)):
        waited = (seen.until_ns - seen.over_ns) / NS_PER_S
        return failed(f"the honest value was not published within {waited:.1f} s after the last odd answer")
    return None


DUTIES: tuple[Rule, ...] = (goes_on, asks_cleanly, publishes_nothing_bad, does_not_flood, publishes_good_again)


def needs_probe(seen: Observation) -> Finding | None:
    return None if seen.probed else skipped(NEEDS_PROBE)


rejects = all_of(*DUTIES, needs_probe)
"""A bad frame that only the values betray."""
survives = all_of(*DUTIES)
"""An answer that holds no value, so that the wire shows all."""


# -- what a case is about ---------------------------------------------------------------------------------------------


def took_odd_answer(seen: Observation) -> Finding | None:
    """The odd answers held the honest value: it was to be taken from them, before the plain ones came again."""
    if not seen.probed:
        return skipped(NEEDS_PROBE)
    first = next((s for s in seen.of(Shown, seen.begun_ns) if s.word is seen.after), None)
    plain = next((t.t_ns for t in seen.of(Told, seen.over_ns + 1) if t.good), seen.until_ns)
    if first is None or first.t_ns >= plain:
        return failed("answers that it has to accept were not taken: the value came only with the plain ones")
    return None


accepts = all_of(goes_on, asks_cleanly, publishes_nothing_bad, does_not_flood, took_odd_answer, publishes_good_again)
either = all_of(*DUTIES, needs_probe)
"""Taken or discarded, both are right; a wrong value is not."""


def answers_at_once(seen: Observation) -> Finding | None:
    """A short frame is seen when it is there: the next request comes sooner than after silence."""
    told = next(seen.of(Told, seen.begun_ns), None)
    asked = next(seen.of(Asked, told.t_ns + 1), None) if told else None
    if told is None or asked is None:
        return inconclusive("no request after the short frame")
    gap_s = (asked.t_ns - told.t_ns) / NS_PER_S
    silence_s = seen.timeout_s or seen.habit.silent_gap_s
    if not silence_s or silence_s <= 1.25 * seen.habit.longest_gap_s:
        return inconclusive("it polls no sooner than its timeout: when it saw the frame does not show on the wire")
    if gap_s >= 0.9 * silence_s:
        return failed(
            f"the next request came {gap_s:.2f} s after a whole exception frame, as after silence ({silence_s:.2f} s)"
        )
    return None


def backs_off(seen: Observation) -> Finding | None:
    """While the device is busy it is not asked more often than when it is well."""
    busy = list(seen.of(Asked, seen.begun_ns, seen.over_ns))
    span_s = (seen.over_ns - seen.begun_ns) / NS_PER_S
    if len(busy) < 3 or span_s <= 0:
        return None
    rate = (len(busy) - 1) / span_s
    if rate > 2 * seen.habit.rate_per_s:
        usual = seen.habit.rate_per_s
        return failed(f"asked a busy device {rate:.1f} times a second, {usual:.1f} are its habit: it does not back off")
    return None


def quarantines(seen: Observation) -> Finding | None:
    """After a timeout the same question, answered by a late reply of the same shape, is not to be told from a prompt one.

    Where a probe saw the late value this was decided already, but only a timeout that somebody named makes it a failure.
    """
    late = next((t for t in seen.of(Told, seen.begun_ns) if not t.good), None)
    first = next(seen.of(Asked, seen.begun_ns), None)
    if late is None and any(not left.by_us for left in seen.of(Left, seen.begun_ns)):
        return None  # it gave up the connection: on that nothing comes late
    if late is None or first is None:
        return inconclusive("the late answer was never sent")
    again = next((a for a in seen.of(Asked, first.t_ns + 1, late.t_ns) if a.target == first.target), None)
    if again is None or seen.probed:
        return None
    gap_s = (again.t_ns - first.t_ns) / NS_PER_S
    return inconclusive(f"asked the same again {gap_s:.2f} s later, before the late answer came: {NEEDS_PROBE}")


def late_is_not_data(seen: Observation) -> Finding | None:
    """As `publishes_nothing_bad`; without the master's timeout nobody knows whether it could have waited for this."""
    bad = publishes_nothing_bad(seen)
    if bad is not None and not seen.timeout_s:
        return inconclusive(f"{bad.reason}; a failure if its timeout is {seen.habit.silent_gap_s:.2f} s: say --timeout")
    return bad


late_same_shape = all_of(goes_on, asks_cleanly, late_is_not_data, does_not_flood, quarantines, publishes_good_again)


def another_shape_came(seen: Observation) -> Finding | None:
    if not any(not told.good for told in seen.of(Told, seen.begun_ns)):
        return skipped("all its requests have one shape: see MB-013")
    return None


late_other = all_of(another_shape_came, *DUTIES, needs_probe)


def checks_echo_of_write(seen: Observation) -> Finding | None:
    """A write whose echo differs did not happen as asked: it is repeated, read back, or made known."""
    first = next(seen.of(Asked, seen.begun_ns), None)
    if first is None:
        return inconclusive("no write was seen")
    for asked in seen.of(Asked, first.t_ns + 1):
        if asked.target == first.target:
            return passed("it wrote again")
        if (
            asked.target[:1] == first.target[:1]
            and asked.target[1] in (3, 1)
            and asked.target[2:4] == first.target[2:4]
        ):
            return passed("it read back what it wrote")
    return inconclusive("it neither wrote again nor read back: whether it noticed does not show")


write_echo = all_of(goes_on, asks_cleanly, does_not_flood, checks_echo_of_write)


def reconnects(seen: Observation) -> Finding | None:
    if next(seen.of(Came, seen.begun_ns), None) is None:
        return failed("no new connection after the old one was cut")
    return None


def asked_once(seen: Observation) -> Finding | None:
    """What nobody answers, because it is for all, is not repeated because nobody answered."""
    first = next(seen.of(Asked, seen.begun_ns), None)
    again = next((a for a in seen.of(Asked, first.t_ns + 1) if a.target == first.target), None) if first else None
    if first is None or again is None:
        return None
    gap_s, usual_s = (again.t_ns - first.t_ns) / NS_PER_S, seen.habit.period_s.get(first.target, 0.0)
    if not usual_s:
        return inconclusive(f"the same came again {gap_s:.2f} s later: whether that is its period does not show")
    if gap_s < 0.7 * usual_s:
        return failed(f"sent again {gap_s:.2f} s later, {usual_s:.2f} s is its period: it waited for an answer")
    return None


def _when(seen: Observation, t_ns: int) -> str:
    return f"{seen.since_s(t_ns):.2f} s after the first odd answer"


def asks_for_less(seen: Observation) -> Finding | None:
    """A read that was refused as a whole is asked for in parts."""
    first = next(seen.of(Asked, seen.begun_ns), None)
    if first is None:
        return inconclusive("no such read was seen")
    asked_for = int.from_bytes(first.target[4:6], "big")
    parts = [
        a
        for a in seen.of(Asked, seen.begun_ns)
        if a.target[:2] == first.target[:2] and int.from_bytes(a.target[4:6], "big") < asked_for
    ]
    if not parts:
        return inconclusive(f"it went on to ask for all {asked_for}: right only for a master that merges no reads")
    return None


bisects = all_of(*DUTIES, asks_for_less)
short_frame = all_of(*DUTIES, answers_at_once)
busy = all_of(*DUTIES, backs_off)
cut_off = all_of(*DUTIES, reconnects)
unit_0 = all_of(goes_on, asks_cleanly, does_not_flood, asked_once)
