"""Checks that test cases share. Each is a function of an `Observation` alone.

The first ones apply to every client in every case: the client continues, does not flood the device, sends only valid
requests, and never publishes the value of a bad frame. The other checks are specific to cases.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from fieldtwin.conformance.core.case import CheckFunction, Finding, failed, inconclusive, passed, skipped
from fieldtwin.conformance.core.observation import (
    Ended,
    Garbled,
    Left,
    Observation,
    ObservedConnection,
    ReplySent,
    RequestSeen,
    ValuePublished,
    Word,
)
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.results.model import Verdict

FLOOD_FACTOR = 5.0
"""A client whose request rate exceeds this many times its usual rate floods the device. A client that sends a request four
times and then continues to poll stays below it.
"""
FLOOD_FLOOR = 30
"""Number of requests in a test case up to which a client does not count as flooding the device, however low its usual rate is."""
NEEDS_PROBE = "only its published values show this: give --probe"
UNSEEN = "its published values were not observed: no --probe"

Rule = Callable[[Observation], Finding | None]


def all_of(*rules: Rule) -> CheckFunction:
    """Return a check that applies `rules`: it gives the first finding that is not a pass, else the first pass with a reason."""

    def check(seen: Observation) -> Finding:
        good: Finding | None = None
        for rule in rules:
            found = rule(seen)
            if found is not None and found.verdict is not Verdict.PASSED:
                return found
            good = good or found
        return good or passed()

    return check


# -- every client -----------------------------------------------------------------------------------------------------


def goes_on(seen: Observation) -> Finding | None:
    """Check that the client still runs, and sends requests after the device has begun to reply correctly again."""
    for ended in seen.of(Ended, seen.begun_ns):
        return failed(
            f"the client ended, exit code {ended.status}, {seen.since_s(ended.t_ns):.2f} s after the first faulty answer"
        )
    asked = next(seen.of(RequestSeen, seen.over_ns + 1), None)
    if asked is None:
        return failed(
            f"no request for {(seen.until_ns - seen.over_ns) / NS_PER_S:.1f} s after the last faulty answer: it has stopped"
        )
    return None


def asks_cleanly(seen: Observation) -> Finding | None:
    """Check that the client sends only valid requests."""
    for bad in seen.of(Garbled, seen.begun_ns):
        return failed(f"sent {len(bad.data)} bytes that do not form a request: {bad.data[:16].hex(' ')}")
    return None


def does_not_flood(seen: Observation) -> Finding | None:
    """Check that the numbers of retries and new connections are bounded."""
    span_s = max((seen.until_ns - seen.begun_ns) / NS_PER_S, 0.001)
    for kind, what in ((RequestSeen, "requests"), (ObservedConnection, "connections")):
        count = sum(isinstance(event, kind) for event in seen.events if event.t_ns >= seen.begun_ns)
        if count > FLOOD_FLOOR and count > FLOOD_FACTOR * seen.habit.rate_per_s * span_s:
            usual = seen.habit.rate_per_s
            return failed(
                f"{count} {what} in {span_s:.1f} s, {usual:.1f} per second are normal for it: it does not slow down"
            )
    return None


def publishes_nothing_bad(seen: Observation) -> Finding | None:
    """Check that every published value was in a correct answer."""
    for shown in seen.of(ValuePublished, seen.begun_ns):
        if shown.word is Word.POISON:
            return failed(f"published {shown.text}, the value of the bad frame, {_when(seen, shown.t_ns)}")
        if shown.word is Word.OTHER:
            return failed(f"published {shown.text}, which no correct answer contained, {_when(seen, shown.t_ns)}")
    return None


def publishes_good_again(seen: Observation) -> Finding | None:
    """Check that the client publishes the device's value again after the device has recovered."""
    if seen.probed and not any(shown.word is seen.last for shown in seen.of(ValuePublished, seen.over_ns)):
        waited = (seen.until_ns - seen.over_ns) / NS_PER_S
        return failed(f"the correct value was not published within {waited:.1f} s after the last faulty answer")
    return None


def sees_all_values(seen: Observation) -> Finding | None:
    """Check that every number that may be a published value was classified. This check comes last, because a failure of
    another check is more important.
    """
    if not seen.probed:
        return passed(UNSEEN)
    for shown in seen.of(ValuePublished, seen.begun_ns):
        if shown.word is Word.UNCLEAR:
            return inconclusive(
                f"printed {shown.text!r} {_when(seen, shown.t_ns)}, which may or may not be a published value: give a "
                "tcp:// probe, or --probe output:TEXT with the text that stands before each value"
            )
    return None


DUTIES: tuple[Rule, ...] = (goes_on, asks_cleanly, publishes_nothing_bad, does_not_flood, publishes_good_again)


def needs_probe(seen: Observation) -> Finding | None:
    return None if seen.probed else skipped(NEEDS_PROBE)


def owes(*rules: Rule) -> CheckFunction:
    """Return a check that applies `DUTIES`, which every client has to fulfil, and then `rules`.

    It passes only if the probe has classified all published values.
    """
    return all_of(*DUTIES, *rules, sees_all_values)


rejects = owes(needs_probe)
"""Check a client after a bad frame whose acceptance shows only in the published values."""
survives = owes()
"""Check a client after an answer without values, so that only its frames are examined."""


# -- single cases -----------------------------------------------------------------------------------------------------


def took_odd_answer(seen: Observation) -> Finding | None:
    """Check that the client published the value of the unusual but permitted answers before it received ordinary answers
    again.
    """
    if not seen.probed:
        return skipped(NEEDS_PROBE)
    first = next((s for s in seen.of(ValuePublished, seen.begun_ns) if s.word is seen.after), None)
    plain = next((t.t_ns for t in seen.of(ReplySent, seen.over_ns + 1) if t.good), seen.until_ns)
    if first is None or first.t_ns >= plain:
        return failed(
            "the unusual answers were not accepted, although they contain the value: it was published only after the normal ones"
        )
    return None


def keeps_waiting(seen: Observation) -> Finding | None:
    """Check that the client waits long enough for a reply.

    On a serial line a client has one open request at a time. If a reply arrives only after the client's next request, the
    client gave up waiting for this reply.
    """
    for told in seen.of(ReplySent, seen.begun_ns):
        if told.good or not told.asked_ns:
            continue
        asked = seen.of(RequestSeen, told.asked_ns + 1, told.t_ns - 1)
        again = next((a for a in asked if a.client == told.client), None)
        if again is None:
            continue
        after_s, due_s = (again.t_ns - told.asked_ns) / NS_PER_S, (told.t_ns - told.asked_ns) / NS_PER_S
        said = f"asked again {after_s:.3f} s after a request whose answer came after {due_s:.3f} s"
        if due_s >= 0.8 * (seen.timeout_s or seen.habit.silent_gap_s or 1.0):
            return inconclusive(f"{said}, which is about its timeout")
        return failed(f"{said}: it did not wait for it")
    return None


_TAKES: tuple[Rule, ...] = (took_odd_answer, publishes_good_again, sees_all_values)
accepts = all_of(goes_on, asks_cleanly, publishes_nothing_bad, does_not_flood, *_TAKES)
accepts_on_line = all_of(goes_on, asks_cleanly, publishes_nothing_bad, does_not_flood, keeps_waiting, *_TAKES)
"""Apply the check `accepts`, for a client that sends one request at a time."""
either = owes(needs_probe)
"""Check a reply that the client may either use or discard. Only a wrong value fails."""


def answers_at_once(seen: Observation) -> Finding | None:
    """Check that the client notices a short frame on arrival: its next request comes sooner than after no reply.

    A client may also notice the frame at once and then pause for about as long as its timeout. Therefore the second short
    frame is sent later than the first: a client that waits for its timeout sends its next request at the same time after
    both requests.
    """
    gaps_s = [
        (delay_s, gap_s) for told in seen.of(ReplySent, seen.begun_ns) for delay_s, gap_s in _gap_after(seen, told)
    ]
    if not gaps_s:
        return inconclusive("no request after the short frame")
    silence_s = seen.habit.silent_gap_s
    if not silence_s or silence_s <= 1.25 * seen.habit.longest_gap_s:
        return inconclusive(
            "its poll period is not shorter than its timeout, so the traffic does not show when it detected the frame"
        )
    (at_once_s, gap_s), (later_s, later_gap_s) = gaps_s[0], gaps_s[-1]
    if gap_s < 0.9 * silence_s:
        return None
    said = f"the next request came {gap_s:.2f} s after a whole exception frame; after silence it comes after {silence_s:.2f} s"
    delay_s = later_s - at_once_s
    if len(gaps_s) < 2 or not seen.timeout_s or not 0 < delay_s < seen.timeout_s:
        return inconclusive(
            f"{said}: it waits for silence or backs off" + ("" if seen.timeout_s else "; give --timeout")
        )
    if later_s + later_gap_s - at_once_s - gap_s < 0.25 * delay_s:
        return failed(f"{said}, and equally soon when the frame came {delay_s:.2f} s later: it waits out its timeout")
    return inconclusive(f"{said}, and later when the frame came later: it backs off, or its timeout starts again")


def _gap_after(seen: Observation, told: ReplySent) -> Iterator[tuple[float, float]]:
    """For a faulty answer, yield its delay after the request and the time from it to the next request, both in seconds.

    Yield nothing for a correct answer, or if the next request was sent before the answer.
    """
    if told.good:
        return
    after = next(seen.of(RequestSeen, told.t_ns + 1), None)
    asked = next((a for a in reversed(list(seen.of(RequestSeen, 0, told.t_ns))) if a.client == told.client), None)
    if after is not None and asked is not None and told.asked_ns in (0, asked.t_ns):
        yield (told.t_ns - asked.t_ns) / NS_PER_S, (after.t_ns - told.t_ns) / NS_PER_S


def backs_off(seen: Observation) -> Finding | None:
    """Check that the client does not ask a busy device more often than usual."""
    busy = list(seen.of(RequestSeen, seen.begun_ns, seen.over_ns))
    span_s = (seen.over_ns - seen.begun_ns) / NS_PER_S
    if len(busy) < 3 or span_s <= 0:
        return None
    rate = (len(busy) - 1) / span_s
    if rate > 2 * seen.habit.rate_per_s:
        usual = seen.habit.rate_per_s
        return failed(
            f"asked a busy device {rate:.1f} times per second, {usual:.1f} are normal for it: it does not back off"
        )
    return None


def quarantines(seen: Observation) -> Finding | None:
    """Check that the client waits before it repeats a request that timed out.

    After a timeout, a late reply cannot be distinguished from a prompt reply to the repeated request. With a probe, the
    check of the published values decides, and this check finds nothing; without a probe, a repetition before the late reply
    is inconclusive.
    """
    late = next((t for t in seen.of(ReplySent, seen.begun_ns) if not t.good), None)
    first = next(seen.of(RequestSeen, seen.begun_ns), None)
    if late is None and any(not left.by_us for left in seen.of(Left, seen.begun_ns)):
        return None  # the connection was closed, so a late reply cannot arrive
    if late is None or first is None:
        return inconclusive("the late answer was never sent")
    again = next((a for a in seen.of(RequestSeen, first.t_ns + 1, late.t_ns) if a.target == first.target), None)
    if again is None or seen.probed:
        return None
    gap_s = (again.t_ns - first.t_ns) / NS_PER_S
    return inconclusive(f"asked the same again {gap_s:.2f} s later, before the late answer came: {NEEDS_PROBE}")


def late_is_not_data(seen: Observation) -> Finding | None:
    """Apply the check `publishes_nothing_bad`. A failure becomes inconclusive if the user has not stated the client's
    timeout, because the client may still have been waiting for the late reply.
    """
    bad = publishes_nothing_bad(seen)
    if bad is not None and not seen.timeout_s:
        return inconclusive(
            f"{bad.reason}; a failure if its timeout is {seen.habit.silent_gap_s:.2f} s: give --timeout"
        )
    return bad


late_same_shape = all_of(
    goes_on, asks_cleanly, late_is_not_data, does_not_flood, quarantines, publishes_good_again, sees_all_values
)


def another_shape_came(seen: Observation) -> Finding | None:
    if not any(not told.good for told in seen.of(ReplySent, seen.begun_ns)):
        return skipped("all its requests have one shape: see MB-013")
    return None


late_other = all_of(another_shape_came, *DUTIES, needs_probe, sees_all_values)


def checks_echo_of_write(seen: Observation) -> Finding | None:
    """Check that the client notices an echo that differs from its write: it repeats the write or reads the value back.

    The result is inconclusive otherwise, because the client may have reported the error in a way that the test does not
    see.
    """
    first = next(seen.of(RequestSeen, seen.begun_ns), None)
    if first is None:
        return inconclusive("no write was seen")
    for asked in seen.of(RequestSeen, first.t_ns + 1):
        if asked.target == first.target:
            return passed("it wrote again")
        if (
            asked.target[:1] == first.target[:1]
            and asked.target[1] in (3, 1)
            and asked.target[2:4] == first.target[2:4]
        ):
            return passed("it read back what it wrote")
    return inconclusive("it neither wrote again nor read back, so it is not known whether it noticed")


write_echo = all_of(goes_on, asks_cleanly, does_not_flood, checks_echo_of_write)


def reconnects(seen: Observation) -> Finding | None:
    if next(seen.of(ObservedConnection, seen.begun_ns), None) is None:
        return failed("no new connection after the old one was cut")
    return None


def asked_once(seen: Observation) -> Finding | None:
    """Check that the client does not repeat a broadcast for lack of an answer, because no device answers a broadcast."""
    first = next(seen.of(RequestSeen, seen.begun_ns), None)
    again = next((a for a in seen.of(RequestSeen, first.t_ns + 1) if a.target == first.target), None) if first else None
    if first is None or again is None:
        return None
    gap_s, usual_s = (again.t_ns - first.t_ns) / NS_PER_S, seen.habit.period_s.get(first.target, 0.0)
    if not usual_s:
        return inconclusive(f"the same request came again {gap_s:.2f} s later, which may be its period")
    if gap_s < 0.7 * usual_s:
        return failed(f"sent again {gap_s:.2f} s later, {usual_s:.2f} s is its period: it waited for an answer")
    return None


def _when(seen: Observation, t_ns: int) -> str:
    return f"{seen.since_s(t_ns):.2f} s after the first faulty answer"


def asks_for_less(seen: Observation) -> Finding | None:
    """Check that the client repeats a refused read in parts."""
    first = next(seen.of(RequestSeen, seen.begun_ns), None)
    if first is None:
        return inconclusive("no such read was seen")
    asked_for = int.from_bytes(first.target[4:6], "big")
    parts = [
        a
        for a in seen.of(RequestSeen, seen.begun_ns)
        if a.target[:2] == first.target[:2] and int.from_bytes(a.target[4:6], "big") < asked_for
    ]
    if not parts:
        return inconclusive(f"it went on to ask for all {asked_for}: correct only for a client that merges no reads")
    return None


bisects = owes(asks_for_less)
short_frame = owes(answers_at_once)
busy = owes(backs_off, needs_probe)
not_our_exception = owes(needs_probe)
cut_off = owes(reconnects)
unit_0 = all_of(goes_on, asks_cleanly, does_not_flood, asked_once)
