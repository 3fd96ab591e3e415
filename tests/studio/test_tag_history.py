"""The history of tags keeps what a diagram must show, however much it is thinned out."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.studio.live.tag_history import (
    LEAST_OF_A_TAG,
    MOST_OF_A_TAG,
    MOST_RECENT_OF_ALL,
    RECENT_NS,
    Point,
    TagHistory,
    recent,
)

points_of_a_tag = st.lists(
    st.tuples(st.integers(1, 50), st.floats(-1e6, 1e6), st.sampled_from(["good", "bad", "uncertain"])),
    min_size=1,
    max_size=400,
)


def filled(changes: list[tuple[int, float, str]]) -> tuple[TagHistory, list[Point]]:
    history, t_ns, added = TagHistory(["a.b"]), 0, []
    for step, value, quality in changes:
        t_ns += step
        point = Point(t_ns, value if quality != "bad" else None, quality, "none" if quality == "good" else "timeout")
        history.add("a.b", point)
        added.append(point)
    return history, added


@given(points_of_a_tag, st.integers(8, 100))
def test_thinning_keeps_extremes_and_every_change_of_quality(changes: list[tuple[int, float, str]], most: int) -> None:
    history, added = filled(changes)
    found, thinned = history.between("a.b", 0, added[-1].t_ns, most)
    assert thinned == (len(added) > most)
    assert set(found) <= set(added)
    assert [p.t_ns for p in found] == sorted(p.t_ns for p in found)
    numbers = [p.value for p in added if p.value is not None]
    if numbers:
        shown = [p.value for p in found if p.value is not None]
        assert (min(shown), max(shown)) == (min(numbers), max(numbers))
    assert changes_of_quality(found) == changes_of_quality(added)


def changes_of_quality(points: list[Point]) -> list[tuple[int, str]]:
    return [(p.t_ns, p.quality) for n, p in enumerate(points) if n == 0 or points[n - 1].quality != p.quality]


@given(points_of_a_tag, st.integers(0, 30_000))
def test_the_value_at_an_instant_is_the_latest_before_it(changes: list[tuple[int, float, str]], t_ns: int) -> None:
    history, added = filled(changes)
    before = [p for p in added if p.t_ns <= t_ns]
    assert history.at("a.b", t_ns) == (before[-1] if before else None)


def test_memory_is_bounded_and_the_oldest_changes_are_dropped() -> None:
    history = TagHistory(f"a.t{n}" for n in range(10_000))
    for n in range(LEAST_OF_A_TAG + 5):
        history.add("a.t0", Point(n, n, "good", "none"))
    found, _ = history.between("a.t0", 0, 10**9, 10_000)
    assert len(found) == LEAST_OF_A_TAG
    assert found[0].t_ns == 5
    assert LEAST_OF_A_TAG < MOST_OF_A_TAG


def test_changes_of_an_interval_have_the_point_before_each() -> None:
    history = TagHistory(["a.b"])
    points = [Point(t, v, "good", "none") for t, v in ((10, 1), (20, 2), (30, 3), (40, 4))]
    for point in points:
        history.add("a.b", point)
    assert history.changes("a.b", 20, 35) == [(points[0], points[1]), (points[1], points[2])]
    assert history.changes("a.b", 0, 10) == [(None, points[0])]
    assert history.changes("a.b", 41, 99) == []
    assert history.changes("no.tag", 0, 99) == []


def test_the_last_minute_of_all_tags_has_a_limited_number_of_points_and_none_for_a_text() -> None:
    names = [f"a.t{n}" for n in range(1000)]
    history = TagHistory([*names, "a.text"])
    for n in range(LEAST_OF_A_TAG):
        for name in names[:2]:
            history.add(name, Point(n * NS_PER_S, float(n), "good", "none"))
    history.add(names[2], Point(NS_PER_S, 7, "bad", "timeout"))
    history.add("a.text", Point(1, "0042", "good", "none"))
    now_ns = LEAST_OF_A_TAG * NS_PER_S
    found = recent(history, history.names(), now_ns)
    assert sum(len(points) for points in found.values()) <= MOST_RECENT_OF_ALL
    assert 4 <= len(found["a.t0"]) <= MOST_RECENT_OF_ALL // 1001 + 4
    assert found["a.t0"][0][0] <= now_ns - RECENT_NS
    assert found["a.t0"][-1] == (now_ns - NS_PER_S, LEAST_OF_A_TAG - 1)
    assert found["a.t2"] == [(NS_PER_S, None)]
    assert found["a.text"] == []


def test_the_last_minute_of_few_tags_is_complete() -> None:
    history = TagHistory(["a.b"])
    for n in range(100):
        history.add("a.b", Point(n * NS_PER_S, n, "good", "none"))
    assert recent(history, ["a.b"], 99 * NS_PER_S)["a.b"] == [(n * NS_PER_S, n) for n in range(39, 100)]
