"""The histogram of durations: against the sorted list of the same durations."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.histogram import RESPONSE_MS, Histogram, response_times

DURATIONS = st.lists(st.integers(-5, 2**43), min_size=1, max_size=200)
LIMITS = st.lists(st.integers(0, 2**43), unique=True, min_size=1, max_size=30).map(sorted)


def filled(histogram: Histogram, durations_ns: list[int]) -> list[int]:
    """Record the durations, and return them sorted, negative ones as 0."""
    for ns in durations_ns:
        histogram.record(ns)
    return sorted(max(0, ns) for ns in durations_ns)


def at_percent(ordered: list[int], percent: float) -> int:
    return ordered[max(1, int(-(-len(ordered) * percent // 100))) - 1]


@given(DURATIONS, LIMITS)
def test_each_duration_is_in_the_first_bucket_that_holds_it(durations_ns: list[int], limits_ns: list[int]) -> None:
    histogram = Histogram(limits_ns)
    ordered = filled(histogram, durations_ns)
    cumulative = [sum(histogram.counts[: i + 1]) for i in range(len(limits_ns))]
    assert cumulative == [sum(ns <= limit for ns in ordered) for limit in limits_ns]
    assert sum(histogram.counts) == histogram.count == len(ordered)
    assert (histogram.min_ns, histogram.max_ns, histogram.total_ns) == (ordered[0], ordered[-1], sum(ordered))
    for limit in limits_ns:
        assert histogram.share_above(limit) == sum(ns > limit for ns in ordered) / len(ordered)


@given(DURATIONS, LIMITS, st.sampled_from([0, 10, 50, 99, 100]))
def test_a_percentile_is_the_first_limit_above_the_truth(
    durations_ns: list[int], limits_ns: list[int], percent: float
) -> None:
    histogram = Histogram(limits_ns)
    truth = at_percent(filled(histogram, durations_ns), percent)
    expected = next((limit for limit in limits_ns if limit >= truth), histogram.max_ns)
    assert histogram.percentile_ns(percent) == min(expected, histogram.max_ns)


@given(st.lists(st.integers(-5, 2**42 - 1), min_size=1, max_size=200), st.sampled_from([0, 10, 50, 99, 100]))
def test_percentiles_are_within_a_32nd_above_the_truth(durations_ns: list[int], percent: float) -> None:
    histogram = Histogram()
    truth = at_percent(filled(histogram, durations_ns), percent)
    assert truth <= histogram.percentile_ns(percent) <= truth + truth / 32 + 1
    assert histogram.summary_us()["count"] == len(durations_ns)


def test_an_empty_histogram_has_zeros() -> None:
    histogram = Histogram()
    assert set(histogram.summary_us().values()) == {0}
    assert histogram.recent_longest_ns == 0


def test_response_times_have_few_buckets_and_the_longest_of_the_last_64() -> None:
    times = response_times()
    filled(times, [-5, 0, 1_000_000, 1_000_001, 10**15])
    assert list(times.limits_ns) == [ms * 1_000_000 for ms in RESPONSE_MS]
    assert list(times.counts) == [3, 1, *[0] * (len(RESPONSE_MS) - 2), 1]
    assert times.total_ns == 2_000_001 + 10**15
    assert times.recent_longest_ns == 10**15
    filled(times, [7] * 63)
    assert times.recent_longest_ns == 10**15
    filled(times, [6])
    assert times.recent_longest_ns == 7
