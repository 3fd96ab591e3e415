"""Dumps of hidden maps find everything readable, in a counted number of requests, despite any interruption."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path

import pytest
from canopen_slave_rig import RICH
from commissioning_rig import CAN_URL, URL, Wired, bank, can_bus, loop, run_virtually, unit
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.cli.device.dump_view import estimate_text, object_indexes
from fieldtwin.commissioning.access.reading import DeviceTarget
from fieldtwin.commissioning.dump.coverage import NOT_ASKED, READABLE, REFUSED
from fieldtwin.commissioning.dump.dump import DumpJob
from fieldtwin.commissioning.dump.file import LATENCY_LIMITS_NS, describe_latency, load_dump
from fieldtwin.commissioning.dump.objects import ListedObjects
from fieldtwin.commissioning.dump.session import dump, estimate, frames, log_path, object_ranges, register_spans
from fieldtwin.commissioning.dump.sweep import RefusedRead, Silent, Sweep, Taken
from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.node import CanopenNode, NodeContext
from fieldtwin.emulators.modbus.bank import CellSpan
from fieldtwin.gateway.core.errors import FileInvalid, Unreachable, UsageError
from fieldtwin.gateway.core.files.profile import RegisterRange
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.histogram import Histogram
from fieldtwin.gateway.protocols.canopen.eds.dictionary import parse_dictionary

ROOT = Path(__file__).parents[3]


def sweep(readable: set[int], limit: int, *, pairs: bool = False, end: int = 400, **how: int) -> tuple[Sweep, int]:
    """Sweep a device given as a set of addresses; return the number of requests."""
    made = Sweep(RegisterRange("holding", 0, end), **how)
    asking, requests = made.asking(), 0
    try:
        asked = next(asking)
        while True:
            requests += 1
            cells = set(range(asked.address, asked.end))
            whole = not pairs or (asked.address % 2 == 0 and asked.count % 2 == 0)
            taken = cells <= readable and asked.count <= limit and whole
            asked = asking.send(
                Taken(bytes(2 * asked.count)) if taken else RefusedRead(3 if asked.count > limit else 2)
            )
    except StopIteration:
        return made, requests


def in_state(made: Sweep, state: int) -> set[int]:
    return {a for a in range(made.span.address, made.span.end) if made.coverage.states[a] == state}


def cells(spans: list[tuple[int, int]]) -> set[int]:
    return {a for start, end in spans for a in range(start, end)}


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 399), st.integers(1, 90)), max_size=6), st.integers(1, 125))
def test_asking_every_address_finds_exactly_the_existing_ones(islands: list[tuple[int, int]], limit: int) -> None:
    readable = {a for start, count in islands for a in range(start, min(400, start + count))}
    made, _ = sweep(readable, limit, stride=1)
    assert cells(made.found.readable) == readable
    assert in_state(made, REFUSED) == set(range(400)) - readable
    assert not in_state(made, NOT_ASKED)
    assert made.found.max_read <= limit
    planned = made.found.reads()
    assert [a for r in planned for a in range(r.address, r.end)] == sorted(readable)
    assert all(r.count <= limit for r in planned)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 49), st.integers(1, 20)), max_size=5), st.integers(4, 125), st.booleans())
def test_striding_finds_every_island_of_its_stride_and_invents_none(
    islands: list[tuple[int, int]], limit: int, pairs: bool
) -> None:
    readable = {a for start, count in islands for a in range(8 * start, min(400, 8 * start + 8 * count))}
    made, requests = sweep(readable, limit, pairs=pairs)
    assert cells(made.found.readable) == readable
    assert in_state(made, READABLE) == readable
    assert requests < 200


def test_the_fewest_requests_that_the_limits_allow() -> None:
    made, requests = sweep(set(range(1000)), 125, end=1000)
    assert (requests, made.found.limit_proved) == (8, True)
    made, requests = sweep(set(range(1000)), 50, end=1000)
    assert (made.found.max_read, made.found.limit_proved, len(made.found.reads())) == (50, True, 20)
    assert requests <= 20 + 11  # halving 125 down to 50, and proving that it is not a gap
    made, requests = sweep(set(range(1000)), 50, end=1000, most=50)
    assert requests == 20
    made, _ = sweep(set(range(80)), 40, pairs=True, end=80)
    assert (made.found.grain, made.found.max_read) == (2, 40)


def test_a_table_without_its_function_or_in_silence_is_left_soon() -> None:
    for outcome, most in ((RefusedRead(1), 2), (Silent("no reply"), 10)):
        made = Sweep(RegisterRange("coil", 0, 65536))
        asking, requests = made.asking(), 1
        next(asking)
        with suppress(StopIteration):
            while requests <= most:
                asking.send(outcome)
                requests += 1
        assert requests <= most
        assert made.halted
        assert ("refuses the function" in made.found.stopped) == isinstance(outcome, RefusedRead)


def test_a_value_of_two_registers_that_may_not_be_cut_is_a_border_and_no_hole() -> None:
    made = Sweep(RegisterRange("holding", 0, 130))
    asking = made.asking()
    asked = next(asking)
    try:  # registers 0 to 129; 124 and 125 are one value
        while True:
            cut = asked.address == 125 or asked.end == 125
            asked = asking.send(RefusedRead(2) if cut else Taken(bytes(2 * asked.count)))
    except StopIteration:
        pass
    assert cells(made.found.readable) == set(range(130))
    assert made.found.borders == [124]


MAP = [CellSpan("holding", 0, 30), CellSpan("holding", 40, 60), CellSpan("input", 8, 16), CellSpan("coil", 0, 20)]


def job(**how: object) -> DumpJob:
    target = DeviceTarget(URL, 1)
    return DumpJob(target, register_spans(["holding:0..127", "input:0..63", "coil:0..63"]), **how)  # type: ignore[arg-type]


def wired(**how: object) -> Wired:
    made = bank(MAP, {"holding": {0: range(100, 130), 40: range(60)}, "coil": {3: [1]}})
    return Wired(unit(made, read_registers=32), **how)  # type: ignore[arg-type]


def test_a_dump_holds_values_holes_limits_functions_and_latencies(tmp_path: Path) -> None:
    async def main() -> None:
        wire = wired()
        result = await dump(job(), tmp_path / "d.jsonl", words="w", connector=wire, clock=loop())
        assert result.requests == len(wire.requests)

    run_virtually(main())
    found = load_dump(tmp_path / "d.jsonl")
    assert found.ended
    values = found.passes[0].cells
    assert values[("holding", 41)] == b"\0\1"
    assert values[("coil", 3)] == b"\1"
    assert {a for t, a in values if t == "holding"} == {*range(30), *range(40, 100)}
    assert {a for t, a in values if t == "input"} == set(range(8, 24))
    assert found.maps["holding"]["max_read"] == 32
    assert found.maps["holding"]["limit_proved"]
    assert found.functions[0x08]["hex"].endswith("a537")
    assert found.functions[0x11]["code"] == 1
    assert found.latency["03"]["p50_us"] >= 10_000
    log = [json.loads(line) for line in log_path(tmp_path / "d.jsonl").read_text("ascii").splitlines()]
    assert (
        len([line for line in log if line.get("direction") == "sent"]) == len(found.lines) or log[0]["command"] == "w"
    )


def test_later_passes_read_the_found_registers_in_the_fewest_requests(tmp_path: Path) -> None:
    async def main() -> None:
        wire = wired()
        await dump(job(functions=False), tmp_path / "a.jsonl", words="", connector=wire, clock=loop())
        first = len(wire.requests)
        wire = wired()
        passes = job(functions=False, passes=3, every_s=60.0)
        began_s = loop().time()
        await dump(passes, tmp_path / "b.jsonl", words="", connector=wire, clock=loop())
        assert 120 <= loop().time() - began_s < 125
        each = -(-30 // 32) + -(-60 // 32) + 1 + 1
        assert len(wire.requests) == first + 2 * each

    run_virtually(main())
    assert len(load_dump(tmp_path / "b.jsonl").passes) == 3


@settings(max_examples=12, deadline=None)
@given(st.integers(1, 4000))
def test_a_killed_dump_continues_and_repeats_no_request(tmp_path_factory: pytest.TempPathFactory, cut: int) -> None:
    folder = tmp_path_factory.mktemp("killed")
    whole, part = folder / "whole.jsonl", folder / "part.jsonl"

    async def main() -> None:
        wire = wired()
        await dump(job(passes=2), whole, words="", connector=wire, clock=loop())
        asked = len(wire.requests)
        kept = whole.read_bytes()[: min(cut, whole.stat().st_size - 1)]
        part.write_bytes(kept)
        if b"\n" not in kept:  # not even a header
            with pytest.raises(FileInvalid):
                await dump(job(passes=2), part, words="", resume=True, connector=wired(), clock=loop())
            return
        wire = wired()
        result = await dump(job(passes=2), part, words="", resume=True, connector=wire, clock=loop())
        answers = kept.count(b'"us"')
        assert asked - answers <= len(wire.requests) <= asked - answers + 1
        assert result.replayed >= answers
        one, other = load_dump(whole), load_dump(part)
        assert [p.cells for p in one.passes] == [p.cells for p in other.passes]
        assert one.maps == other.maps

    run_virtually(main())


def test_a_different_job_an_existing_file_and_a_missing_device_are_refused(tmp_path: Path) -> None:
    async def main() -> None:
        out = tmp_path / "d.jsonl"
        await dump(job(), out, words="", connector=wired(), clock=loop())
        with pytest.raises(FileInvalid, match="--resume"):
            await dump(job(), out, words="", connector=wired(), clock=loop())
        with pytest.raises(FileInvalid, match="different device or range"):
            await dump(job(stride=1), out, words="", resume=True, connector=wired(), clock=loop())
        with pytest.raises(UsageError, match="broadcast"):
            await dump(DumpJob(DeviceTarget("rtu:/dev/ttyS99", 0)), tmp_path / "n.jsonl", words="")
        deaf = wired(mute=lambda adu, before: True)
        with pytest.raises(Unreachable, match="nobody answers"):
            await dump(job(), tmp_path / "n.jsonl", words="", connector=deaf, clock=loop())

    run_virtually(main())


def test_a_lost_reply_is_asked_for_again_and_a_hole_is_not_invented(tmp_path: Path) -> None:
    async def main() -> None:
        noisy = wired(mute=lambda adu, before: before % 3 == 2)
        await dump(job(functions=False), tmp_path / "d.jsonl", words="", connector=noisy, clock=loop())
        first = load_dump(tmp_path / "d.jsonl").passes[0]
        assert not first.silent
        found = first.cells
        assert {a for t, a in found if t == "holding"} == {*range(30), *range(40, 100)}

    run_virtually(main())


def test_a_profile_is_dumped_by_its_tags_and_limits_and_secrets_stay_out(tmp_path: Path) -> None:
    async def main() -> None:
        sdm = load_profile(ROOT / "profiles/devices/eastron-sdm630.yaml")
        made = bank([CellSpan("input", 0, 80), CellSpan("holding", 0, 30)])
        wire = Wired(unit(made))
        what = DumpJob(DeviceTarget(URL, 1, sdm), functions=False)
        await dump(what, tmp_path / "d.jsonl", words="", connector=wire, clock=loop())
        assert len(wire.requests) == estimate(what, 0).least_requests == len(frames(what))
        found = load_dump(tmp_path / "d.jsonl").passes[0].cells
        assert ("input", 70) in found
        assert ("holding", 14) not in found  # the password

    run_virtually(main())


def test_a_nodes_objects_by_its_data_sheet_and_by_sweeping(tmp_path: Path) -> None:
    async def main() -> None:
        node = CanopenNode(parse_eds(RICH, "x"), 5, NodeContext())
        sheet = parse_dictionary(RICH, 5)
        async with can_bus(node) as connector:
            how = {"words": "", "connector": connector, "clock": loop()}
            eds = DumpJob(DeviceTarget(CAN_URL, 5, dictionary=sheet), passes=2)
            await dump(eds, tmp_path / "eds.jsonl", **how)  # type: ignore[arg-type]
            raw = DumpJob(DeviceTarget(CAN_URL, 5), objects=object_ranges(["1000..1020"]))
            await dump(raw, tmp_path / "raw.jsonl", **how)  # type: ignore[arg-type]

    run_virtually(main())
    eds, raw = load_dump(tmp_path / "eds.jsonl"), load_dump(tmp_path / "raw.jsonl")
    assert eds.passes[0].cells[(0x1008, 0)] == b"a node for tests"
    assert eds.passes[0].cells.keys() == eds.passes[1].cells.keys()
    low = {key: value for key, value in eds.passes[0].cells.items() if key[0] <= 0x1020}
    assert {key: raw.passes[0].cells.get(key) for key in low} == low
    assert raw.passes[0].refused[(0x1002, 0)] == 0x06020000


def test_invalid_ranges_and_invalid_dumps(tmp_path: Path) -> None:
    for text in ("holding:9..3", "nothing", "holding:0..70000"):
        with pytest.raises(UsageError):
            register_spans([text])
    with pytest.raises(UsageError):
        object_ranges(["7000..6000"])
    assert isinstance(ListedObjects([]), ListedObjects)
    for text in (
        '{"a":1}\n',
        "x\n",
        "",
        "[]\n",
        '{"fieldtwin_dump":1,"protocol":"modbus","ranges":[]}\n{"read":"x"}\n',
    ):
        (tmp_path / "x").write_text(text)
        with pytest.raises(FileInvalid):
            load_dump(tmp_path / "x")


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 10_000), st.binary(max_size=6))
def test_a_damaged_dump_is_invalid_or_a_dump(tmp_path_factory: pytest.TempPathFactory, at: int, junk: bytes) -> None:
    good = (
        b'{"fieldtwin_dump":1,"protocol":"modbus","ranges":["holding:0..9"]}\n{"pass":0,"at":"2026-01-01T00:00:00+00:00"}\n'
        b'{"read":"holding:0..3","hex":"0001000200030004","us":5}\n{"map":"holding","holes":["holding:4"]}\n{"ended":"x"}\n'
    )
    path = tmp_path_factory.getbasetemp() / "damaged.jsonl"
    path.write_bytes(good[: at % len(good)] + junk + good[at % len(good) :])
    with suppress(FileInvalid):
        load_dump(path)


@given(st.lists(st.integers(0, 10**9), min_size=1, max_size=40))
def test_response_times_in_the_file_are_in_microseconds_and_complete(us: list[int]) -> None:
    times = Histogram(LATENCY_LIMITS_NS)
    for value in us:
        times.record(value * 1000)
    line = describe_latency(times)
    assert sum(value <= line["p50_us"] for value in us) >= len(us) / 2
    assert line["p50_us"] <= line["p95_us"] <= line["most_us"] == max(us)
    assert (line["count"], line["least_us"]) == (len(us), min(us))
    assert sum(n for _, n in line["buckets"]) == len(us)
    assert [limit for limit, _ in line["buckets"]] == sorted(
        {next((b // 1000 for b in LATENCY_LIMITS_NS if v * 1000 <= b), None) for v in us}, key=lambda b: b or 10**9
    )


def test_the_estimate_of_a_long_dump_names_what_shortens_it() -> None:
    everything = estimate(DumpJob(DeviceTarget("tcp://192.0.2.1", 1)), 0.02)
    text = estimate_text(everything, 1, 50.0)
    assert everything.most_s > 1000
    assert "shorter with ranges, such as holding:0..999, with --profile, or with a higher --rate" in text
    few = DumpJob(DeviceTarget("tcp://192.0.2.1", 1), register_spans(["holding:0..99"]))
    assert "shorter" not in estimate_text(estimate(few, 0.02), 1, 50.0)
    wide = DumpJob(DeviceTarget("tcp://192.0.2.1", 1), register_spans(["holding"]))
    assert "shorter with fewer ranges, or with a higher --rate" in estimate_text(estimate(wide, 0.02), 1, 50.0)
    line = DumpJob(DeviceTarget("rtu:/dev/ttyS0", 1), register_spans(["holding:0..20"]))
    shortest = estimate(line, 0.02)  # its one long reply takes longer than short ones
    assert shortest.least_s < shortest.most_s
    drive = DumpJob(DeviceTarget("can:socketcan/can0", 5))
    assert "such as 6000..6FFF, with --eds" in estimate_text(estimate(drive, 0.02), 1, 50.0)


def test_the_objects_of_a_dump_are_listed_by_their_indexes(tmp_path: Path) -> None:
    found = ("1000h:00", "1008h:00", "1009h:00", "100Ah:00", "2400h:00", "2400h:01")
    lines = [
        '{"fieldtwin_dump":2,"protocol":"canopen","address":41,"ranges":["1000h..24FFh"]}',
        '{"pass":0,"at":"2026-11-28T05:32:19.326+00:00"}',
        *(f'{{"read":"{name}","hex":"01","us":9}}' for name in found),
        '{"read":"1001h:00","code":100794368,"us":9}',
    ]
    (tmp_path / "node.jsonl").write_text("\n".join(lines) + "\n")
    assert object_indexes(load_dump(tmp_path / "node.jsonl")) == ["1000h", "1008h..100Ah", "2400h"]
