"""How a poll group is read: every value once, none split, limits observed; gaps are learned (MB-025)."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.profile import DeviceProfile, RegisterRange, Table, gap_text, resolve_gap
from fieldtwin.gateway.core.files.profile_file import resolve
from fieldtwin.gateway.core.files.yaml_file import parse
from fieldtwin.gateway.devices.read_plan import GroupPlan, Learnt, Read, plan_reads, split

TYPES = {"uint16": 1, "float32": 2, "float64": 4}


def span(at: RegisterRange) -> range:
    return range(at.address, at.end)


def profile_of(
    layout: list[tuple[int, str]], *, read_registers: int = 20, max_gap: int = 4, gaps: Sequence[str] = ()
) -> DeviceProfile:
    """Holding registers: gaps before each value, and its type."""
    lines = [
        "device: test/planned",
        'source: "a test"',
        "protocol: modbus",
        f"limits: {{read_registers: {read_registers}, max_gap: {max_gap}}}",
        f"gaps: {json.dumps(list(gaps))}",
        "tags:",
    ]
    address = 0
    for i, (gap, kind) in enumerate(layout):
        address += gap
        lines.append(f'  t{i}: {{at: "holding:{address}", type: {kind}}}')
        address += TYPES[kind]
    return resolve(parse("\n".join(lines), "test.yaml"))


layouts = st.lists(st.tuples(st.integers(0, 9), st.sampled_from(sorted(TYPES))), min_size=1, max_size=30)


@given(layout=layouts, most=st.integers(4, 125), gap=st.integers(0, 12))
def test_every_value_is_read_once_and_whole_within_the_limits(
    layout: list[tuple[int, str]], most: int, gap: int
) -> None:
    profile = profile_of(layout, read_registers=most, max_gap=gap)
    reads = plan_reads(profile, "values")
    assert sorted(t.name for r in reads for t in r.tags) == sorted(profile.tags)
    for read in reads:
        assert read.range.count <= most
        end = read.range.address
        for at, _ in read.members:
            assert read.range.address <= at.address
            assert at.end <= read.range.end
            assert at.address - end <= gap
            end = max(end, at.end)


def taught(plan: GroupPlan, refuses: Callable[[Read], int]) -> list[int]:
    """Read the group until nothing more is learned, as a driver does; return the number of requests of each pass."""
    passes: list[int] = []
    changes = -1
    while changes != plan.learnt.changes:
        todo, changes = deque(plan.reads), plan.learnt.changes
        passes.append(0)
        while todo:
            read = todo.popleft()
            passes[-1] += 1
            code = refuses(read)
            if code:
                todo.extendleft(reversed(plan.refused(read, code)))
            else:
                plan.taken(read)
        plan.pass_ended()
        assert len(passes) < 100, "never settles"
    return passes


def without(holes: set[int]) -> Callable[[Read], int]:
    """A device without these registers."""
    return lambda read: 2 if any(read.range.address <= h < read.range.end for h in holes) else 0


@given(layout=layouts, holes=st.sets(st.integers(0, 200), max_size=12), gap=st.integers(0, 30))
def test_a_device_with_holes_is_read_whole_with_the_fewest_requests(
    layout: list[tuple[int, str]], holes: set[int], gap: int
) -> None:
    """A temporary split is undone: the final plan is one that a profile could state."""
    profile = profile_of(layout, read_registers=60, max_gap=gap)
    plan = GroupPlan(profile, "values")
    refuses = without(holes)
    taught(plan, refuses)
    there = {t.name for t in profile.tags.values() if not any(h in span(t.registers) for h in holes)}
    if there:
        assert {t.name for r in plan.reads for t in r.tags} == there
    else:
        assert len(plan.reads) == 1  # one is still requested
    assert set(plan.learnt.missing) == set(profile.tags) - there
    assert all(any(h in span(g) for h in holes) for g in plan.learnt.profile_gaps)
    assert plan.learnt.gaps == [g for g in plan.learnt.gaps if g.count]
    stated = profile_of(layout, read_registers=60, max_gap=gap, gaps=[gap_text(g) for g in plan.learnt.profile_gaps])
    told = GroupPlan(stated, "values", Learnt(missing=list(plan.learnt.missing)))
    assert [r.range for r in told.reads if {t.name for t in r.tags} & there] == [
        r.range for r in plan.reads if {t.name for t in r.tags} & there
    ]


@given(layout=layouts, most=st.integers(4, 60))
def test_a_device_that_accepts_less_than_its_profile_states_has_limits_and_no_gaps(
    layout: list[tuple[int, str]], most: int
) -> None:
    profile = profile_of(layout, read_registers=125, max_gap=4)
    plan = GroupPlan(profile, "values")
    taught(plan, lambda read: 3 if read.range.count > most else 0)
    assert {t.name for r in plan.reads for t in r.tags} == set(profile.tags)
    assert plan.learnt.profile_gaps == ()
    assert plan.learnt.missing == []


def test_mb_025_the_gap_between_two_values_is_learned() -> None:
    plan = GroupPlan(profile_of([(0, "float32"), (3, "float32"), (2, "uint16")]), "values")
    assert [str(r.range) for r in plan.reads] == ["40001 (holding:0) x 10"]
    assert taught(plan, without({8})) == [5, 2]  # whole, its halves, the halves of one half; then two
    assert [str(r.range) for r in plan.reads] == ["40001 (holding:0) x 7", "40010 (holding:9)"]
    assert [gap_text(g) for g in plan.learnt.profile_gaps] == ["holding:7..8"]


def test_mb_025_a_profile_that_states_its_gap_is_never_asked_for_it() -> None:
    profile = profile_of([(0, "float32"), (3, "float32")], gaps=["40003..40005"])
    assert [str(r.range) for r in GroupPlan(profile, "values").reads] == [
        "40001 (holding:0) x 2",
        "40006 (holding:5) x 2",
    ]


def test_a_missing_value_that_appears_is_read_with_the_others_again() -> None:
    plan = GroupPlan(profile_of([(0, "uint16"), (0, "uint16"), (0, "uint16")]), "values")
    taught(plan, without({1}))
    assert plan.learnt.missing == ["t1"]
    assert [r.range.address for r in plan.reads] == [0, 2]
    plan.plan_again()  # the device was disconnected
    assert [r.range.address for r in plan.reads] == [0, 1, 2]
    taught(plan, without(set()))
    assert plan.learnt.missing == []
    assert [(r.range.address, r.range.count) for r in plan.reads] == [(0, 3)]


def test_a_device_that_has_nothing_yet_is_asked_for_one_value_until_it_has_all() -> None:
    """Some devices answer 02 to everything while they start."""
    plan = GroupPlan(profile_of([(0, "uint16")] * 8), "values")
    assert taught(plan, lambda read: 2) == [15, 1]
    assert taught(plan, lambda read: 0) == [1, 8, 1]  # one exists, each exists, all at once
    assert plan.learnt.missing == []
    assert [(r.range.address, r.range.count) for r in plan.reads] == [(0, 8)]


def test_pairs_are_requested_whole_if_the_device_knows_nothing_else() -> None:
    """Eastron: an odd count is refused with 03, an odd address with 02."""
    text = 'device: test/pairs\nsource: "a test"\nprotocol: modbus\nlimits: {even_only: true, max_gap: 0, read_registers: 6}\n'
    tags = 'tags: {a: {at: "holding:1"}, b: {at: "holding:2"}, c: {at: "holding:4"}, d: {at: "holding:7"}}\n'
    reads = plan_reads(resolve(parse(text + tags, "test.yaml")), "values")
    assert [(r.range.address, r.range.count) for r in reads] == [(0, 4), (4, 2), (6, 2)]


def test_a_single_value_cannot_be_split() -> None:
    profile = profile_of([(0, "float64")])
    (read,) = plan_reads(profile, "values")
    assert split(profile, read) is None


@given(
    table=st.sampled_from(["coil", "discrete", "input", "holding"]),
    first=st.integers(0, 65535),
    more=st.integers(0, 99),
)
def test_a_gap_is_written_as_it_is_read(table: Table, first: int, more: int) -> None:
    gap = RegisterRange(table, first, min(more, 65535 - first) + 1)
    assert resolve_gap(gap_text(gap), "sent") == gap


@pytest.mark.parametrize("text", ["holding:9..5", "30001..40001", "holding:5..", "..5", "30001..", "coil:1..65536", ""])
def test_an_invalid_range_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        resolve_gap(text, "printed")


def test_a_gap_at_the_place_of_a_value_is_refused() -> None:
    with pytest.raises(FileInvalid, match=r"holding:2\.\.5.*overlaps the tag 't1'"):
        profile_of([(0, "uint16"), (4, "uint16")], gaps=["holding:1", "holding:2..5"])


@pytest.mark.parametrize(
    ("functions", "tag", "why"),
    [
        ("[3]", '{at: "input:0"}', "read with a function.*expected 4"),
        ("[3]", '{at: "holding:0", access: rw}', "written with a function.*expected 6 or 16"),
        ("[3, 6]", '{at: "holding:0", type: float32, access: rw}', "written with a function.*expected 16"),
        ("[1]", '{at: "coil:0", type: bool, access: rw}', "expected 5 or 15"),
        ("[4]", '{at: "input:0", access: rw}', "cannot be written"),
    ],
)
def test_a_value_that_the_device_has_no_function_for_is_refused(functions: str, tag: str, why: str) -> None:
    head = 'device: test/functions\nsource: "a test"\nprotocol: modbus\n'
    with pytest.raises(FileInvalid, match=why):
        resolve(parse(f"{head}limits: {{functions: {functions}}}\ntags: {{x: {tag}}}\n", "test.yaml"))
