"""Recorded Modbus devices that are replayed (paper.md, ruling 3), against a device simulated in a few lines here."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.emulators.context import EndOfRecording
from fieldtwin.emulators.replay.counters import CounterSpan
from fieldtwin.emulators.replay.replay import ExchangeReplay, NeverRecorded, ReplayedReply
from fieldtwin.emulators.replay.situation import Situations
from fieldtwin.emulators.replay.unit import ReplayUnit
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.recording import RecordedExchange, RecordingHeader, RecordingWriter


def read(address: int, count: int = 1, function: int = 4) -> bytes:
    return struct.pack(">BHH", function, address, count)


def write(address: int, *values: int) -> bytes:
    return struct.pack(f">BHHB{len(values)}H", 16, address, len(values), 2 * len(values), *values)


def reply(*values: int, function: int = 4) -> bytes:
    return struct.pack(f">BB{len(values)}H", function, 2 * len(values), *values)


def ok(request: bytes, answer: bytes | None, unit: int = 1, latency_s: float = 0.01) -> RecordedExchange:
    return RecordedExchange(0.0, unit, request, answer, latency_s, None if answer is not None else "timeout")


def words(replay: ExchangeReplay, address: int, count: int = 1, function: int = 4, unit: int = 1) -> tuple[int, ...]:
    answer = replay.respond(unit, read(address, count, function)).reply
    assert answer is not None
    assert answer[0] == function, f"exception {answer.hex()}"
    return struct.unpack(f">{count}H", answer[2:])


def replies(replay: ExchangeReplay, request: bytes, times: int) -> list[bytes | None]:
    return [replay.respond(1, request).reply for _ in range(times)]


# -- values -------------------------------------------------------------------------------------------------------

SIZE = 8


@st.composite
def splits(draw: st.DrawFn) -> list[tuple[int, int]]:
    """Ranges (address, count) that cover SIZE registers, in any order."""
    borders = [*sorted(draw(st.sets(st.integers(1, SIZE - 1)))), SIZE]
    ranges, start = [], 0
    for border in borders:
        ranges.append((start, border - start))
        start = border
    return draw(st.permutations(ranges))


@given(st.lists(splits(), min_size=1, max_size=5), st.data())
def test_any_split_or_merge_of_the_recorded_ranges_gives_the_same_answers(
    polls: list[list[tuple[int, int]]], data: st.DataObject
) -> None:
    recorded = [
        ok(read(address, count), reply(*(100 * poll + a for a in range(address, address + count))))
        for poll, ranges in enumerate(polls)
        for address, count in ranges
    ]
    replay = ExchangeReplay(recorded)
    for poll in range(len(polls) + 1):  # one more than recorded: hold
        ranges = data.draw(splits())
        got = {
            a: v for start, n in ranges for a, v in zip(range(start, start + n), words(replay, start, n), strict=True)
        }
        assert got == {a: 100 * min(poll, len(polls) - 1) + a for a in range(SIZE)}


def test_bits_are_resolved_one_by_one_too() -> None:
    replay = ExchangeReplay([ok(read(10, 10, 1), bytes((1, 2, 0b10100101, 0b11))), ok(read(20, 1, 1), b"\x01\x01\x00")])
    assert replay.respond(1, read(12, 9, 1)).reply == bytes((1, 2, 0b11101001, 0b0))
    assert replay.respond(1, read(12, 1, 2)).reply == b"\x82\x01"


def test_loop_starts_over_and_error_is_a_device_failure() -> None:
    recorded = [ok(read(0), reply(n)) for n in (5, 6)]
    loop = ExchangeReplay(recorded, when_used_up=EndOfRecording.LOOP)
    assert [words(loop, 0)[0] for _ in range(5)] == [5, 6, 5, 6, 5]
    error = ExchangeReplay(recorded, when_used_up=EndOfRecording.ERROR)
    assert replies(error, read(0), 3) == [reply(5), reply(6), b"\x84\x04"]
    assert error.counters.used_up == 1


def test_tables_and_units_are_separate() -> None:
    replay = ExchangeReplay(
        [ok(read(0), reply(1)), ok(read(0, 1, 3), reply(2, function=3)), ok(read(0), reply(3), unit=2)]
    )
    assert (words(replay, 0), words(replay, 0, 1, 3), words(replay, 0, unit=2)) == ((1,), (2,), (3,))
    assert replay.units == (1, 2)
    assert replay.respond(3, read(0)) == ReplayedReply(None)


# -- what was written before --------------------------------------------------------------------------------------


def session(*steps: tuple[bytes, bytes]) -> ExchangeReplay:
    return ExchangeReplay([ok(request, answer) for request, answer in steps])


STATUS, PERIOD = 0, 1
OBSERVED = (
    (read(STATUS, 2, 3), reply(0, 0, function=3)),
    (write(PERIOD, 1), write(PERIOD, 1)[:5]),
    (read(STATUS, 2, 3), reply(1, 1, function=3)),
    (read(STATUS, 2, 3), reply(1, 1, function=3)),
    (write(PERIOD, 0), write(PERIOD, 0)[:5]),
    (read(STATUS, 2, 3), reply(0, 0, function=3)),
    (write(PERIOD, 0xFFFF), write(PERIOD, 0xFFFF)[:5]),
    (read(STATUS, 2, 3), reply(2, 0xFFFF, function=3)),
)


def test_a_recorded_session_replayed_is_the_same_session() -> None:
    replay = session(*OBSERVED)
    for request, answer in OBSERVED:
        assert replay.respond(1, request).reply == answer
    assert (replay.counters.answered, replay.counters.misfits, len(replay.context)) == (len(OBSERVED), 0, 0)


def test_a_read_depends_on_earlier_writes_and_not_on_the_number_of_reads() -> None:
    replay = session(*OBSERVED)
    assert [words(replay, STATUS, 2, 3) for _ in range(9)] == [(0, 0)] * 9
    replay.respond(1, write(PERIOD, 0xFFFF))
    assert [words(replay, STATUS, 2, 3) for _ in range(3)] == [(2, 0xFFFF)] * 3
    replay.respond(1, write(PERIOD, 1))
    assert [words(replay, STATUS, 1, 3) for _ in range(3)] == [(1,)] * 3


def test_another_value_is_accepted_and_read_back() -> None:
    replay = session(*OBSERVED)
    assert replay.respond(1, write(PERIOD, 7)).reply == write(PERIOD, 7)[:5]
    assert words(replay, PERIOD, 1, 3) == (7,)
    status = words(replay, STATUS, 1, 3)[0]
    assert status in (0, 1, 2)


def accepted(address: int, value: int) -> tuple[bytes, bytes]:
    return write(address, value), write(address, value)[:5]


def test_a_register_reads_back_its_own_value_whatever_was_written_elsewhere() -> None:
    read_back = [(read(5, 1, 3), reply(value, function=3)) for value in (1, 2)]
    replay = session(accepted(5, 1), read_back[0], accepted(6, 1), accepted(5, 2), read_back[1])
    replay.respond(1, write(5, 1))
    replay.respond(1, write(6, 1))
    assert words(replay, 5, 1, 3) == (1,)


def test_in_a_new_situation_the_recorded_one_most_like_it_answers() -> None:
    statuses = [(read(STATUS, 1, 3), reply(value, function=3)) for value in (10, 20)]
    replay = session(accepted(5, 1), statuses[0], accepted(5, 2), statuses[1], accepted(6, 1))
    replay.respond(1, write(6, 9))
    replay.respond(1, write(5, 2))
    assert words(replay, STATUS, 1, 3) == (20,)
    replay.respond(1, write(5, 1))
    assert words(replay, STATUS, 1, 3) == (10,)


def test_a_register_that_was_only_written_reads_the_written_value() -> None:
    replay = session((write(9, 4), write(9, 4)[:5]), (read(0, 1, 3), reply(0, function=3)))
    assert replay.respond(1, read(9, 1, 3)).reply == b"\x83\x02"
    replay.respond(1, write(9, 5))
    assert words(replay, 9, 1, 3) == (5,)


def test_writes_may_be_split_and_merged() -> None:
    replay = session((write(0, 1, 2), write(0, 1, 2)[:5]), (write(2, 3), write(2, 3)[:5]))
    assert replay.respond(1, write(1, 8, 9)).reply == write(1, 8, 9)[:5]
    assert replay.respond(1, write(2, 8, 9)).reply == b"\x90\x02"
    assert replay.respond(1, b"\x06\x00\x01\x00\x05").reply == b"\x86\x01"


def test_single_writes_are_echoed() -> None:
    coil, register = b"\x05\x00\x03\xff\x00", b"\x06\x00\x04\x00\x07"
    replay = session((coil, coil), (register, register))
    assert replay.respond(1, b"\x05\x00\x03\x00\x00").reply == b"\x05\x00\x03\x00\x00"
    assert replay.respond(1, b"\x06\x00\x04\x01\x01").reply == b"\x06\x00\x04\x01\x01"


def test_a_broadcast_write_counts_for_every_unit_and_is_not_answered() -> None:
    recorded = [
        ok(read(0, 1, 3), reply(0, function=3)),
        ok(write(1, 5), b"", unit=0),
        ok(read(0, 1, 3), reply(9, function=3)),
        ok(read(0, 1, 3), reply(7, function=3), unit=2),
    ]
    replay = ExchangeReplay(recorded)
    assert (words(replay, 0, 1, 3), words(replay, 0, 1, 3)) == ((0,), (0,))
    replay.broadcast(write(1, 5))
    assert (words(replay, 0, 1, 3), words(replay, 0, 1, 3, unit=2)) == ((9,), (7,))


def test_endlessly_new_writes_cost_no_memory() -> None:
    situations = Situations(max_situations=3)
    for value in range(5):
        situations.write("holding", 0, [value])
    assert situations.folded == 3
    situations.rewind()
    for value in range(1000):
        situations.write("holding", 0, [value])
    assert situations.now is None
    assert situations.written(("holding", 0)) == 999
    assert situations.most_similar([0, 1, 2]) == 1  # the earliest in which that register was written at all


# -- shapes -------------------------------------------------------------------------------------------------------


def test_exceptions_come_at_their_recorded_place() -> None:
    replay = ExchangeReplay(
        [ok(read(0), reply(1)), ok(read(0), b"\x84\x06"), ok(read(0), reply(2)), ok(read(90), b"\x84\x02")]
    )
    assert replies(replay, read(0), 4) == [reply(1), b"\x84\x06", reply(2), reply(2)]
    assert replies(replay, read(90), 2) == [b"\x84\x02"] * 2
    assert replay.counters.exceptions == 3


def test_a_write_that_was_refused_is_refused_and_changes_nothing() -> None:
    replay = session(
        (write(1, 5), write(1, 5)[:5]),
        (write(1, 999), b"\x90\x03"),
        (read(1, 1, 3), reply(5, function=3)),
        (write(7, 1), b"\x90\x02"),
    )
    replay.respond(1, write(1, 5))
    assert replay.respond(1, write(1, 999)).reply == b"\x90\x03"
    assert words(replay, 1, 1, 3) == (5,)
    assert replay.respond(1, write(7, 2)).reply == b"\x90\x02"


def test_a_limit_on_the_count_holds_for_longer_reads() -> None:
    recorded = [ok(read(0, 80), reply(*range(80))), ok(read(80, 80), reply(*range(80))), ok(read(0, 81), b"\x84\x03")]
    replay = ExchangeReplay(recorded)
    assert replay.respond(1, read(10, 90)).reply == b"\x84\x03"
    assert words(replay, 40, 80) == (*range(40, 80), *range(40))


def test_silence_is_an_event_and_not_held() -> None:
    replay = ExchangeReplay([ok(read(0), reply(1)), ok(read(0), None), ok(read(5), None)])
    assert replies(replay, read(0), 4) == [reply(1), None, reply(1), reply(1)]
    assert replies(replay, read(5), 3) == [None] * 3
    assert replay.counters.silences == 4


def test_latency_is_that_of_the_shape_or_the_usual_one() -> None:
    recorded = [ok(read(0, 2), reply(1, 2), latency_s=0.02), ok(read(2, 2), reply(3, 4), latency_s=0.04)]
    replay = ExchangeReplay(recorded)
    assert replay.respond(1, read(2, 2)).latency_s == 0.04
    assert replay.respond(1, read(0, 4)).latency_s == pytest.approx(0.03)


def test_other_functions_are_answered_as_a_whole() -> None:
    identify = b"\x2b\x0e\x01\x00"
    replay = ExchangeReplay([ok(identify, b"\x2b\x0e\x01\x01\x00\x00\x00"), ok(b"\x11", b"\x11\x02\x42\xff")])
    assert replay.respond(1, identify).reply == b"\x2b\x0e\x01\x01\x00\x00\x00"
    assert replay.respond(1, b"\x11").reply == b"\x11\x02\x42\xff"
    assert replay.respond(1, b"\x2b\x0e\x02\x00").reply == b"\xab\x03"
    assert replay.respond(1, b"\x07").reply == b"\x87\x01"


def test_a_devices_own_mistake_is_repeated_to_the_letter() -> None:
    replay = ExchangeReplay([ok(read(0, 2), reply(1)), ok(read(0, 2), reply(1, 2))])
    assert replies(replay, read(0, 2), 2) == [reply(1), reply(1, 2)]
    assert replay.counters.misfits == 1


@pytest.mark.parametrize(
    "request_pdu", [read(1), read(0, 2), read(0, 1, 3), b"\x2b\x0e\x01\x00", write(0, 1), b"\x04\x00"]
)
def test_an_unrecorded_request_is_refused_or_not_answered(request_pdu: bytes) -> None:
    refusing = ExchangeReplay([ok(read(0), reply(1))])
    answer = refusing.respond(1, request_pdu).reply
    assert answer is not None
    assert (answer[0], len(answer)) == (request_pdu[0] | 0x80, 2)
    assert refusing.counters.never_recorded == 1
    silent = ExchangeReplay([ok(read(0), reply(1))], never_recorded=NeverRecorded.SILENCE)
    assert silent.respond(1, request_pdu) == ReplayedReply(None)


@given(
    st.lists(st.tuples(st.binary(min_size=1, max_size=12), st.binary(max_size=12))), st.lists(st.binary(max_size=12))
)
def test_no_recording_and_no_request_breaks_it(recorded: list[tuple[bytes, bytes]], asked: list[bytes]) -> None:
    replay = ExchangeReplay([ok(request, answer) for request, answer in recorded])
    for request in [*(request for request, _ in recorded), *asked]:
        replay.respond(1, request)
    if recorded:
        assert ExchangeReplay([ok(*recorded[0])]).respond(1, recorded[0][0]).reply == (recorded[0][1] or None)


# -- counters -----------------------------------------------------------------------------------------------------

ENERGY = CounterSpan(1, "input", 0, 2)


def energy(replay: ExchangeReplay, split: bool = False) -> int:
    high, low = (words(replay, 0)[0], words(replay, 1)[0]) if split else words(replay, 0, 2)
    return high << 16 | low


@given(
    st.lists(st.integers(0, 0xFFFFFFFF), min_size=1, max_size=6),
    st.lists(st.sampled_from(["whole", "high", "low", "write"]), max_size=20),
    st.sampled_from([EndOfRecording.HOLD, EndOfRecording.LOOP]),
)
def test_a_counter_never_runs_backwards_and_is_never_torn(
    values: list[int], reads: list[str], policy: EndOfRecording
) -> None:
    values.sort()
    recorded = [ok(read(0, 2), reply(v >> 16, v & 0xFFFF)) for v in values]
    recorded[1:1] = [ok(write(5, 1), write(5, 1)[:5])]
    replay = ExchangeReplay(recorded, when_used_up=policy, counters=[ENERGY])
    last = 0
    for kind in reads:
        if kind == "write":
            replay.respond(1, write(5, 1))
        elif kind in ("high", "low"):
            words(replay, 0 if kind == "high" else 1)
        else:
            got = energy(replay)
            assert got in values
            assert got >= last
            last = got


def test_a_counter_read_in_parts_is_the_counter_read_whole() -> None:
    values = [0x0001_FFFF, 0x0002_0000, 0x0002_0001]
    recorded = [ok(read(0, 2), reply(v >> 16, v & 0xFFFF)) for v in values]
    for split in (False, True):
        replay = ExchangeReplay(recorded, when_used_up=EndOfRecording.LOOP, counters=[ENERGY])
        assert [energy(replay, split) for _ in range(5)] == [*values, values[-1], values[-1]]


def test_a_counter_recorded_in_parts_is_put_together() -> None:
    replay = ExchangeReplay(
        [ok(read(0), reply(1)), ok(read(1), reply(0xFFFF)), ok(read(0), reply(2)), ok(read(1), reply(0))],
        counters=[ENERGY],
    )
    assert [energy(replay) for _ in range(2)] == [0x0001_FFFF, 0x0002_0000]


def test_half_a_counter_is_repeated_as_it_was_recorded() -> None:
    replay = ExchangeReplay([ok(read(0), reply(1)), ok(read(0), reply(2))], counters=[ENERGY])
    assert replies(replay, read(0), 3) == [reply(1), reply(2), reply(2)]
    assert replay.respond(1, read(0, 2)).reply == b"\x84\x02"


# -- as a unit, and from a file -----------------------------------------------------------------------------------


def test_a_recorded_unit_replaces_a_computed_one(tmp_path: Path) -> None:
    path = tmp_path / "r.jsonl"
    header = RecordingHeader(version=1, device="d", kind="exchanges", source="measured")
    with RecordingWriter(path, header) as writer:
        writer.exchange(ok(read(0), reply(7), latency_s=0.05))
        writer.exchange(ok(read(1), b"\x84\x02"))
        writer.exchange(ok(read(2), None))
    with path.open("ab") as file:
        file.write(b'{"t":1.0,"un')
    replay = ExchangeReplay.load(path)
    assert replay.truncated
    unit = ReplayUnit(replay, 1, name="ctd")
    assert [unit.respond(read(address), 0) for address in range(3)] == [reply(7), b"\x84\x02", None]
    counters = unit.counters
    assert (counters.requests, counters.replies, counters.exceptions, counters.unanswered) == (3, 2, 1, 1)
    unit.respond(read(0), 0)
    assert unit.latency_s == 0.05
    with pytest.raises(UsageError, match="expected 1; got 2"):
        ReplayUnit(replay, 2)


def test_copies_answer_like_the_first_whatever_another_was_asked() -> None:
    """Devices of one recording: each starts at its beginning, with separate writes and counters."""
    recorded = [
        ok(read(0), reply(1)),
        ok(read(0), reply(2)),
        ok(bytes.fromhex("0600010007"), bytes.fromhex("0600010007")),
        ok(read(0), reply(3)),
    ]
    first = ExchangeReplay(recorded)
    asked, other = first.copy(), first.copy()
    assert replies(asked, read(0), 2) == [reply(1), reply(2)]
    asked.respond(1, bytes.fromhex("0600010007"))
    assert replies(asked, read(0), 1) == [reply(3)]
    asked.put(1, "input", 0, [99])
    for replay in (other, first):
        assert replies(replay, read(0), 2) == [reply(1), reply(2)]
        assert replay.counters.answered == 2
    assert replies(asked, read(0), 1) == [reply(99)]


def test_copies_have_their_own_counters() -> None:
    first = ExchangeReplay([ok(read(0, 2), reply(0, n)) for n in (1, 2, 3)], counters=[ENERGY])
    copies = [first.copy() for _ in range(2)]
    assert [words(copies[0], 0, 2) for _ in range(3)] == [(0, 1), (0, 2), (0, 3)]
    assert words(copies[1], 0, 2) == (0, 1)
