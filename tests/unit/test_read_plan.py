"""How a poll group is read: every value once, none cut, limits kept; holes are learnt (MB-025)."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from gateway.core.profile import DeviceProfile, resolve
from gateway.core.yaml_file import parse
from gateway.devices.read_plan import GroupPlan, plan_reads, split

TYPES = {"uint16": 1, "float32": 2, "float64": 4}


def profile_of(layout: list[tuple[int, str]], *, read_registers: int = 20, max_gap: int = 4) -> DeviceProfile:
    """Holding registers: gaps before each value, and its type."""
    lines = [
        "device: test/planned",
        'source: "a test"',
        "protocol: modbus",
        f"limits: {{read_registers: {read_registers}, max_gap: {max_gap}}}",
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


@given(layout=layouts, holes=st.sets(st.integers(0, 200)))
def test_a_device_with_holes_is_read_whole_but_for_what_it_does_not_have(
    layout: list[tuple[int, str]], holes: set[int]
) -> None:
    profile = profile_of(layout, read_registers=125, max_gap=125)
    plan = GroupPlan(profile, "values")

    def accepts(first: int, count: int) -> bool:
        return not any(first <= h < first + count for h in holes)

    for _ in range(200):
        refused = [r for r in plan.reads if not accepts(r.range.address, r.range.count)]
        if not refused:
            break
        plan.refused(refused[0])
    got = {t.name for r in plan.reads for t in r.tags}
    there = {t.name for t in profile.tags.values() if accepts(t.registers.address, t.registers.count)}
    assert got == there
    assert set(plan.missing) == set(profile.tags) - there


def test_mb_025_the_hole_between_two_values_is_learnt() -> None:
    plan = GroupPlan(profile_of([(0, "float32"), (3, "float32")]), "values")
    assert [str(r.range) for r in plan.reads] == ["40001 (holding:0) x 7"]
    assert len(plan.refused(plan.reads[0])) == 2
    assert [str(r.range) for r in plan.reads] == ["40001 (holding:0) x 2", "40006 (holding:5) x 2"]
    assert [str(h) for h in plan.holes] == ["40003 (holding:2) x 3"]


def test_a_single_value_cannot_be_split() -> None:
    (read,) = plan_reads(profile_of([(0, "float64")]), "values")
    assert split(read) is None
