"""Signals over time: interpolation, gaps, ends, speed, memory; and their register values."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.emulators.codec import NUMBERS, ORDERS, decode, encode, register_count
from fieldtwin.emulators.context import EndOfRecording, UsedUp
from fieldtwin.emulators.signals import SignalPlayer, SignalTrack
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import Bug, FileInvalid, UsageError
from fieldtwin.gateway.core.files.recording import RecordingHeader, RecordingWriter, SignalInfo, SignalRow

START_NS = 5 * NS_PER_S


def track(*rows: tuple[float, float]) -> SignalTrack:
    return SignalTrack(["x"], [SignalRow(t, (value,)) for t, value in rows])


def at(player: SignalPlayer, t_s: float) -> float:
    return player.at(START_NS + round(t_s * NS_PER_S), "x")


def test_between_rows_it_is_linear_and_on_a_row_exact() -> None:
    ramp = track((0.0, 10.0), (1.0, 20.0), (3.0, 0.1))
    assert [ramp.at(t, "x") for t in (0.0, 0.25, 1.0, 2.0, 3.0)] == [10.0, 12.5, 20.0, 10.05, 0.1]


def test_outside_it_stays_on_the_first_and_the_last_row() -> None:
    ramp = track((2.0, 10.0), (3.0, 20.0))
    assert [ramp.at(t, "x") for t in (-1.0, 0.0, 2.0, 3.0, 99.0)] == [10.0, 10.0, 10.0, 20.0, 20.0]


def test_two_rows_of_one_time_are_a_step() -> None:
    step = track((0.0, 1.0), (1.0, 1.0), (1.0, 2.0), (2.0, 2.0))
    assert [step.at(t, "x") for t in (0.999, 1.0, 1.5)] == [1.0, 2.0, 2.0]


def test_next_to_a_missing_value_there_is_no_interpolation() -> None:
    gap = track((0.0, 1.0), (1.0, math.nan), (2.0, 3.0), (3.0, 5.0))
    assert gap.at(0.0, "x") == 1.0
    assert all(math.isnan(gap.at(t, "x")) for t in (0.001, 0.5, 1.0, 1.5, 1.999))
    assert [gap.at(t, "x") for t in (2.0, 2.5)] == [3.0, 4.0]


@given(st.lists(st.tuples(st.floats(0, 1e6), st.floats(-1e6, 1e6)), min_size=1), st.floats(-10, 1e6 + 10))
def test_a_value_lies_between_its_neighbours(points: list[tuple[float, float]], t: float) -> None:
    rows = sorted(points)
    value = track(*rows).at(t, "x")
    before = [v for time, v in rows if time <= t] or [rows[0][1]]
    after = [v for time, v in rows if time > t] or [rows[-1][1]]
    low, high = sorted((before[-1], after[0]))
    slack = 1e-9 * max(1.0, abs(low), abs(high))
    assert low - slack <= value <= high + slack


def test_hold_loop_and_error_after_the_end() -> None:
    ramp = track((0.0, 0.0), (10.0, 100.0))
    hold, loop, error = (SignalPlayer(ramp, START_NS, at_end=policy) for policy in EndOfRecording)
    assert [at(hold, t) for t in (-1, 5, 10, 11, 1e6)] == [0.0, 50.0, 100.0, 100.0, 100.0]
    assert [at(loop, t) for t in (5, 10, 12, 25, 1003)] == pytest.approx([50.0, 100.0, 20.0, 50.0, 30.0])
    assert at(error, 10) == 100.0
    with pytest.raises(UsedUp, match=r"10\.001 s of 10\.000 s"):
        at(error, 10.001)
    assert [loop.ended(START_NS + t * NS_PER_S) for t in (10, 11)] == [False, True]


def test_a_loop_that_starts_late_repeats_only_recorded_samples() -> None:
    loop = SignalPlayer(track((3.0, 0.0), (10.0, 70.0)), START_NS, at_end=EndOfRecording.LOOP)
    assert [at(loop, t) for t in (0, 3, 5, 12, 19)] == pytest.approx([0.0, 0.0, 20.0, 20.0, 20.0])


def test_speed_plays_it_faster() -> None:
    player = SignalPlayer(track((0.0, 0.0), (100.0, 100.0)), START_NS, speed=10.0)
    assert [at(player, t) for t in (1, 9, 11)] == pytest.approx([10.0, 90.0, 100.0])
    for speed in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(UsageError):
            SignalPlayer(player.track, START_NS, speed=speed)


def test_all_signals_are_of_one_instant() -> None:
    both = SignalTrack(["a", "b"], [SignalRow(0.0, (0.0, 10.0)), SignalRow(1.0, (1.0, 20.0))], units=["m", "s"])
    assert SignalPlayer(both, START_NS).values(START_NS + NS_PER_S // 4) == {"a": 0.25, "b": 12.5}
    with pytest.raises(FileInvalid, match="expected a, b; got c"):
        both.at(0.0, "c")


def test_policies_have_names() -> None:
    assert [EndOfRecording.parse(text) for text in ("hold", "loop", "error")] == list(EndOfRecording)
    with pytest.raises(UsageError, match="hold, loop, error"):
        EndOfRecording.parse("stop")


def test_loading_takes_signals_and_units_and_leaves_a_cut_line_out(tmp_path: Path) -> None:
    path = tmp_path / "r.jsonl"
    signals = {"x": SignalInfo(unit="dbar"), "y": SignalInfo(unit="degC")}
    header = RecordingHeader(version=1, device="d", kind="signals", source="synthetic", signals=signals)
    with RecordingWriter(path, header) as writer:
        with pytest.raises(FileInvalid, match="no rows"):
            SignalTrack.load(path)
        for i in range(65_158):
            writer.row(i / 24, [float(i), -float(i)])
    with path.open("ab") as file:
        file.write(b"[2714.9,1.0")
    loaded = SignalTrack.load(path)
    assert (loaded.names, loaded.units, len(loaded)) == (("x", "y"), ("dbar", "degC"), 65_158)
    assert loaded.nbytes == 65_158 * 3 * 8
    assert loaded.at(100.5, "y") == pytest.approx(-100.5 * 24)


# -- the codec ----------------------------------------------------------------------------------------------------

LAYOUTS = {"ABCD": [0x0102, 0x0304], "CDAB": [0x0304, 0x0102], "BADC": [0x0201, 0x0403], "DCBA": [0x0403, 0x0201]}


@pytest.mark.parametrize("order", ORDERS)
def test_each_order_puts_the_bytes_according_to_its_name(order: str) -> None:
    assert encode(0x01020304, "uint32", order) == LAYOUTS[order]
    assert decode(LAYOUTS[order], "uint32", order) == 0x01020304


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("type_name", NUMBERS)
def test_limits_come_back_as_they_were(type_name: str, order: str) -> None:
    code, count = NUMBERS[type_name]
    for raw in (b"\x00", b"\x01", b"\x7f", b"\x80"):
        value = struct.unpack(f">{code}", raw.ljust(2 * count, b"\x10"))[0]
        words = encode(value, type_name, order)
        assert len(words) == count == register_count(type_name)
        assert decode(words, type_name, order) == value


@given(st.floats(width=32), st.sampled_from(ORDERS))
def test_every_float32_survives(value: float, order: str) -> None:
    back = decode(encode(value, "float32", order), "float32", order)
    assert isinstance(back, float)
    assert back == value or (math.isnan(back) and math.isnan(value))


def test_a_value_that_does_not_fit_is_limited() -> None:
    assert encode(1e300, "float32") == [0x7F80, 0]
    assert encode(3.4028235e38, "float32") == [0x7F7F, 0xFFFF]
    assert (encode(40_000, "int16"), encode(-40_000, "int16")) == ([0x7FFF], [0x8000])
    assert (encode(-1, "uint16"), encode(70_000.4, "uint16")) == ([0], [0xFFFF])
    assert (encode(math.nan, "int16"), encode(math.nan, "uint16")) == ([0x8000], [0xFFFF])
    assert encode(-2.6, "int16") == [0xFFFD]


def test_strings_are_padded_cut_and_never_reversed() -> None:
    assert encode("0042", "string", registers=4) == [0x3030, 0x3432, 0, 0]
    assert encode("0042", "string", "CDAB", registers=2) == [0x3030, 0x3432]
    assert encode("0142", "string", "BADC", registers=2) == [0x3130, 0x3234]
    assert encode("too long", "string", registers=2) == [0x746F, 0x6F20]
    assert decode([0x3030, 0x3432, 0, 0x4141], "string") == "0042"


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: encode(1, "int24"),
        lambda: encode(1, "int16", "ABDC"),
        lambda: encode("1", "int16"),
        lambda: encode("1", "string"),
        lambda: decode([1], "int32"),
        lambda: decode([0x10000], "int16"),
    ],
)
def test_a_request_that_no_profile_can_make_is_a_bug(wrong: object) -> None:
    assert callable(wrong)
    with pytest.raises(Bug):
        wrong()
