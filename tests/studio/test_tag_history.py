"""The history of tags keeps what a diagram must show, however much it is thinned out."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.studio.live.tag_history import LEAST_OF_A_TAG, MOST_OF_A_TAG, Point, TagHistory

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
