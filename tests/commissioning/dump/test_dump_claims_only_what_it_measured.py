"""Silence, refusal, an invalid reply and "not asked" are four states of a register, in every output of a dump.

Defects: a device that is silent at unknown addresses was reported as "refused 20..28, ~29..2000" although nothing after 28 had
been asked; its block at 1000 was missed; the exit code was 0. Replies of the wrong size were reported as refusals, and 32
registers at 352 that the device returns only together were called unreadable.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from dump_device_rig import device
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.cli.main import cli
from fieldtwin.commissioning.dump.beyond import beyond_silence, other_lengths
from fieldtwin.commissioning.dump.coverage import INVALID, NOT_ASKED, READABLE, REFUSED, SILENT, Coverage, describe
from fieldtwin.commissioning.dump.file import load_dump
from fieldtwin.commissioning.dump.sweep import Invalid, Outcome, RefusedRead, Silent, Sweep, Taken
from fieldtwin.gateway.core.files.profile import RegisterRange

BLOCKS = (range(20), range(1000, 1032))


def registers(address: int, count: int) -> list[int] | None:
    """The words of a device with registers `BLOCKS`; None if one of the addresses is not among them."""
    return list(range(address, address + count)) if any(
        address in block and address + count - 1 in block for block in BLOCKS
    ) else None  # fmt: skip


def silent_elsewhere(function: int, address: int, count: int) -> list[int] | int | None:
    return registers(address, count) if function == 3 else 1


def wrong_size_elsewhere(function: int, address: int, count: int) -> list[int] | int | None:
    """Holding registers 0..19 one by one; 352..383 only as a block: any other read in it is answered with all 32."""
    if function != 3:
        return 1
    if 352 <= address < 384:
        return list(range(32)) if address == 352 else 2
    return registers(address, count) or 2


def run_dump(url: str, out: Path, *arguments: str) -> Result:
    return CliRunner().invoke(
        cli,
        ["dump", url, *arguments, "-o", str(out), "--timeout", "20ms", "--retries", "0", "--rate", "0"],
        standalone_mode=False,
    )


@pytest.fixture(scope="module")
def silent_dump(tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, Path]:
    out = tmp_path_factory.mktemp("dump") / "silent.jsonl"
    with device(silent_elsewhere) as url:
        return run_dump(url, out, "holding:0..2000", "--json"), out


@pytest.mark.long
def test_silence_is_not_reported_as_a_refusal(silent_dump: tuple[Result, Path]) -> None:
    result, _ = silent_dump
    found = json.loads(result.stdout)["maps"][0]
    assert found["refused"] == []
    assert found["counts"]["refused"] == 0
    assert found["codes"] == {}
    assert "holding:20..28" in found["silent"]
    assert found["counts"]["not_asked"] > 0


def test_a_block_after_a_silent_region_is_found(silent_dump: tuple[Result, Path]) -> None:
    _, out = silent_dump
    held = {address for _, address in load_dump(out).passes[0].cells}
    assert held == {*BLOCKS[0], *BLOCKS[1]}


def test_the_states_in_the_file_are_those_of_the_requests_that_were_sent(silent_dump: tuple[Result, Path]) -> None:
    _, out = silent_dump
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    singles = {int(x["read"].split(":")[1]): x for x in lines if "read" in x and ".." not in x["read"]}
    dump = load_dump(out)
    for address in range(2001):
        state = dump.state_of(("holding", address))
        if state == SILENT:
            assert "silent" in singles.get(address, {}) or any("silent" in x for x in lines if covers(x, address))
        if state == NOT_ASKED:
            assert address not in singles


def covers(line: dict[str, object], address: int) -> bool:
    first, _, last = str(line.get("read", "holding:0")).partition(":")[2].partition("..")
    return int(first) <= address <= int(last or first)


def test_a_dump_that_leaves_most_unknown_ends_with_exit_code_4(silent_dump: tuple[Result, Path]) -> None:
    result, _ = silent_dump
    assert result.return_value == 4
    told = json.loads(result.stdout)
    assert told["mostly_unknown"]
    assert told["unknown"]["of"] == 2001
    assert "no reply" in result.stderr


def test_the_table_on_the_terminal_names_all_states(tmp_path: Path) -> None:
    with device(silent_elsewhere) as url:
        shown = run_dump(url, tmp_path / "d.jsonl", "holding:0..200").stdout
    lines = {line.split("  ")[0].strip(): line for line in shown.splitlines()}
    assert "no reply" in shown
    assert "not asked" in shown
    assert "refused" not in shown.partition("function")[0]
    assert lines


def test_a_report_of_a_dump_with_unknown_registers_is_not_called_whole(
    silent_dump: tuple[Result, Path], tmp_path: Path
) -> None:
    _, out = silent_dump
    page = tmp_path / "site.html"
    CliRunner().invoke(cli, ["report", str(out), "-o", str(page)])
    text = page.read_text()
    assert "mostly unknown" in text
    assert ">whole<" not in text
    assert "no reply" in text
    assert "not asked" in text


def test_the_budget_ends_the_search_and_is_named_as_the_reason(tmp_path: Path) -> None:
    with device(silent_elsewhere) as url:
        result = run_dump(url, tmp_path / "d.jsonl", "holding", "--budget", "1s", "--json")
    found = json.loads(result.stdout)["maps"][0]
    assert "time budget of 1 s" in found["stopped"]
    assert found["counts"]["not_asked"] > 60_000


def test_registers_that_come_only_together_are_found_by_the_size_of_the_reply(tmp_path: Path) -> None:
    with device(wrong_size_elsewhere) as url:
        result = run_dump(url, tmp_path / "d.jsonl", "holding:0..511", "--passes", "2", "--every", "10ms", "--json")
    found = json.loads(result.stdout)["maps"][0]
    assert "holding:352..383" in found["readable"]
    dump = load_dump(tmp_path / "d.jsonl")
    assert dump.passes[0].cells[("holding", 383)] == b"\0\x1f"
    assert dump.passes[1].cells.keys() == dump.passes[0].cells.keys()


def test_a_reply_of_the_wrong_size_is_an_invalid_reply(tmp_path: Path) -> None:
    def one_short(function: int, address: int, count: int) -> list[int] | int | None:
        if function == 3 and 40 <= address < 60:
            return [7] * (count + 1)
        return registers(address, count) or 2 if function == 3 else 1

    with device(one_short) as url:
        result = run_dump(url, tmp_path / "d.jsonl", "holding:0..99", "--thorough", "--json")
    found = json.loads(result.stdout)["maps"][0]
    assert "holding:40..59" in found["invalid"]
    assert "holding:60..99" in found["refused"]


def test_a_dump_of_version_1_is_read_without_its_claims(tmp_path: Path) -> None:
    old = tmp_path / "old.jsonl"
    lines: list[dict[str, object]] = [
        {"fieldtwin_dump": 1, "protocol": "modbus", "address": 1, "ranges": ["holding:0..99"]},
        {"pass": 0, "at": "2026-01-01T00:00:00+00:00"},
        {"read": "holding:0", "hex": "0001", "us": 5},
        {"read": "holding:1", "silent": "no reply within 1 s"},
        {"read": "holding:2", "code": 2, "us": 5},
        {"map": "holding", "readable": ["holding:0"], "holes": ["holding:1..2"], "voids": ["holding:3..99"], "max_read": 1,
         "limit_proved": False, "codes": {"02": 1}, "given_up": "no reply 10 times in a row"},
        {"ended": "x"},
    ]  # fmt: skip
    old.write_text("".join(json.dumps(line) + "\n" for line in lines))
    found = load_dump(old).maps["holding"]
    assert (found["silent"], found["refused"], found["not_asked"]) == (["holding:1"], ["holding:2"], ["holding:3..99"])
    assert "holes" not in found


# -- generated maps -----------------------------------------------------------------------------------------------------------

SPAN = 640


def ask(sweep: Sweep, answer: dict[str, object], *, limit: int = 125) -> dict[tuple[int, int], Outcome]:
    """Run the three parts of a sweep against a device. `answer`: how each address may be read, and how it refuses the others."""
    asked: dict[tuple[int, int], Outcome] = {}

    def outcome(at: RegisterRange) -> Outcome:
        modes = [answer.get(str(a)) for a in range(at.address, at.end)]
        if all(m is not None for m in modes) and at.count <= limit:
            edges = [(m, a) for a, m in zip(range(at.address, at.end), modes, strict=True) if isinstance(m, tuple)]
            whole = all(at.address <= a - place and a - place + size <= at.end for (size, place), a in edges)
            if whole:
                return Taken(bytes(2 * at.count), 1000)
        return Silent("no reply", 1_000_000) if answer.get("else") == "silent" else RefusedRead(2, 1000)

    for part in (sweep.asking(), beyond_silence(sweep), other_lengths(sweep)):
        try:
            at = next(part)
            while True:
                asked[at.address, at.count] = outcome(at)
                at = part.send(asked[at.address, at.count])
        except StopIteration:
            pass
    return asked


block = st.tuples(st.integers(0, SPAN - 40), st.integers(8, 40), st.sampled_from(["single", "pairs"]))


STATES = st.sampled_from([READABLE, REFUSED, SILENT, INVALID])


@settings(max_examples=80, deadline=None)
@given(st.lists(block, min_size=1, max_size=5), st.integers(8, 125))
def test_blocks_of_eight_that_give_single_registers_or_pairs_are_found(
    blocks: list[tuple[int, int, str]], limit: int
) -> None:
    """The promise of docs/explanation/dumping.md, on devices that refuse everything else, mixed kinds of blocks included."""
    answer: dict[str, object] = {}
    for start, count, kind in blocks:
        count -= count % 2 if kind == "pairs" else 0
        if any(str(a) in answer for a in range(start - 1, start + count + 1)):
            continue
        for place in range(count):
            answer[str(start + place)] = (2, place % 2) if kind == "pairs" else (1, 0)
    sweep = Sweep(RegisterRange("holding", 0, SPAN))
    ask(sweep, answer, limit=limit)
    readable = {a for a in range(SPAN) if sweep.coverage.states[a] == READABLE}
    assert {1, 2} <= set(sweep.found.lengths)
    assert readable == {int(a) for a in answer}


@pytest.mark.long
@settings(max_examples=60, deadline=None)
@given(st.lists(block, max_size=4), st.sampled_from(["silent", "refuse"]), st.integers(1, 400))
def test_reported_addresses_are_the_requested_ones(
    blocks: list[tuple[int, int, str]], other: str, budget_s: int
) -> None:
    answer: dict[str, object] = {"else": other}
    for start, count, _ in blocks:
        answer |= {str(a): (1, 0) for a in range(start, start + count)}
    sweep = Sweep(RegisterRange("holding", 0, SPAN), budget_us=budget_s * 1_000_000)
    asked = ask(sweep, answer)
    for address in range(SPAN):
        outcomes = [out for (at, count), out in asked.items() if at <= address < at + count]
        short = [out for (at, count), out in asked.items() if at <= address < at + count and count <= 2]
        state = sweep.coverage.states[address]
        assert (state == READABLE) == any(isinstance(out, Taken) for out in outcomes)
        assert (state == NOT_ASKED) == (state != READABLE and not short)
        if state in (REFUSED, SILENT):
            assert any(isinstance(out, RefusedRead if state == REFUSED else Silent) for out in short)
    told = describe("holding", sweep.coverage, [(0, SPAN)])
    assert sum(n for key, n in told["counts"].items() if key != "unknown") == SPAN
    if other == "refuse" and not sweep.found.stopped:
        assert not told["unknown"]


@given(
    st.lists(
        st.tuples(st.integers(0, 90), st.integers(1, 3), STATES),
        max_size=30,
    )
)
def test_each_address_is_in_exactly_one_state(notes: list[tuple[int, int, int]]) -> None:
    coverage = Coverage()
    for at, count, state in notes:
        coverage.note(RegisterRange("input", at, count), state)
    told = describe("input", coverage, [(0, 100)])
    assert sum(n for key, n in told["counts"].items() if key != "unknown") == 100
    listed = sum(size(text) for key in ("readable", "refused", "silent", "invalid", "not_asked") for text in told[key])
    assert listed + sum(s["addresses"] for s in told["sampled"]) == 100


def size(text: str) -> int:
    first, _, last = text.partition(":")[2].partition("..")
    return int(last or first) - int(first) + 1


def test_a_wrong_size_is_only_a_hint() -> None:
    sweep = Sweep(RegisterRange("holding", 0, 16))
    part = sweep.asking()
    next(part)
    questions = []
    try:
        while True:
            questions.append(part.send(Invalid("a reply of the wrong size", 1000, 5)))
    except StopIteration:
        pass
    assert any(q.count == 5 for q in questions)
    assert not sweep.found.readable


def test_a_dry_run_prints_the_first_100_frames_and_says_how_to_get_all() -> None:
    words = ["dump", "tcp://192.0.2.1", "--dry-run"]
    done = CliRunner().invoke(cli, words, standalone_mode=False, catch_exceptions=False)
    shown = done.stdout.splitlines()
    every = CliRunner().invoke(cli, [*words, "--json"], standalone_mode=False, catch_exceptions=False)
    frames = json.loads(every.stdout)["frames"]
    assert len(frames) > 1000
    assert shown == frames[:100]
    assert f"100 of {len(frames):,} frames; --dry-run --json prints all" in done.stderr
    assert every.stderr == ""


def test_a_dry_run_of_a_short_range_prints_every_frame() -> None:
    words = ["dump", "tcp://192.0.2.1", "holding:0..300", "--dry-run"]
    done = CliRunner().invoke(cli, words, standalone_mode=False, catch_exceptions=False)
    assert len(done.stdout.splitlines()) == 3
    assert done.stderr == ""
