"""Long recordings in columns: each cell in recorded order for any read, memory bounds, and unrecorded cells between others."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from packets import read, values

from fieldtwin.emulators.context import EndOfRecording
from fieldtwin.emulators.replay import learning
from fieldtwin.emulators.replay.replay import ExchangeReplay, NeverRecorded
from fieldtwin.gateway.core.files.recording import RecordedExchange


def asked(request: bytes, reply: bytes | None, t_s: float = 0.0, unit: int = 1) -> RecordedExchange:
    return RecordedExchange(t_s, unit, request, reply, 0.01, None if reply is not None else "timeout")


def words(replay: ExchangeReplay, address: int, count: int = 1) -> tuple[int, ...]:
    reply = replay.respond(1, read(address, count)).reply
    assert reply is not None
    assert reply[0] == 3, reply.hex()
    return struct.unpack(f">{count}H", reply[2:])


spans = st.tuples(st.integers(0, 5), st.integers(1, 3))
outcomes = st.sampled_from(["values", "values", "values", "02", "03", "silence", "nonsense"])


@settings(max_examples=80)
@given(st.lists(st.tuples(spans, outcomes, st.booleans()), min_size=1, max_size=25))
def test_every_cell_continues_in_recorded_order_whatever_it_was_read_with(
    steps: list[tuple[tuple[int, int], str, bool]],
) -> None:
    """Compare with a handwritten list per cell; some writes occur between reads, to a register that is never read."""
    model: dict[int, list[int]] = {}
    recorded = []
    for n, ((address, count), outcome, bits) in enumerate(steps):
        if bits:  # another table, whose values must not appear here
            recorded.append(asked(read(address, count, 1), bytes((1, 1, n & 7))))
        reply: bytes | None = None
        if outcome == "values":
            reply = values(*(100 * n + a for a in range(address, address + count)))
            for a in range(address, address + count):
                model.setdefault(a, []).append(100 * n + a)
        elif outcome == "nonsense":
            reply = values(1)[:-1]
        elif outcome != "silence":
            reply = bytes((0x83, int(outcome)))
        recorded.append(asked(read(address, count), reply, float(n)))
    replay = ExchangeReplay(recorded)
    shapes = {step[0] for step in steps}
    for address, wanted in model.items():
        if (address, 1) in shapes:  # answered as before, errors included
            continue
        got = [words(replay, address)[0] for _ in range(len(wanted) + 2)]
        assert got == [*wanted, wanted[-1], wanted[-1]]


def test_outcomes_of_a_read_keep_their_order_and_latency() -> None:
    replies = [values(1), b"\x83\x06", None, values(2)]
    replay = ExchangeReplay(
        RecordedExchange(n, 1, read(0), r, n / 100, None if r else "timeout") for n, r in enumerate(replies)
    )
    assert [(replay.respond(1, read(0)).reply) for _ in range(5)] == [*replies, values(2)]
    assert replay.respond(1, read(0)).latency_s == 0.03
    assert replay.counters.silences == 1


def test_copies_share_the_recording_and_each_starts_at_its_beginning() -> None:
    replay = ExchangeReplay([asked(read(0, 2), values(n, n + 50)) for n in range(3)], when_used_up=EndOfRecording.LOOP)
    one, two = replay.copy(), replay.copy()
    assert [words(one, 0)[0] for _ in range(5)] == [0, 1, 2, 0, 1]
    assert [words(two, 1)[0] for _ in range(2)] == [50, 51]
    assert (len(one.context), len(two.context)) == (9 - 5 + 3, 9 - 2)


def test_a_recording_that_is_too_long_keeps_its_newer_half(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learning, "MAX_BYTES", 100 * (4 + 32))
    replay = ExchangeReplay(asked(read(0), values(n)) for n in range(1000))
    first = words(replay, 0)[0]
    assert 900 <= first < 1000
    assert replay.context.dropped == first
    assert words(replay, 0)[0] == first + 1


def test_cells_between_recorded_registers_are_interpolated_on_request() -> None:
    recorded = [asked(read(10, 2), values(0, 100)), asked(read(15), values(500)), asked(read(10, 2), values(0, 200)),
                asked(read(3, 1, 1), b"\x01\x01\x01"), asked(read(8, 1, 1), b"\x01\x01\x00")]  # fmt: skip
    replay = ExchangeReplay(recorded, never_recorded=NeverRecorded.INTERPOLATE)
    assert words(replay, 11, 5) == (100, 200, 300, 400, 500)
    assert words(replay, 13) == (300,)
    assert words(replay, 11) == (200,), "asking between takes nothing"
    assert words(replay, 13) == (350,)
    assert replay.respond(1, read(5, 4, 1)).reply == b"\x01\x01\x07"
    assert replay.respond(1, read(9, 2)).reply == b"\x83\x02"
    assert replay.respond(1, read(15, 2)).reply == b"\x83\x02"
    assert ExchangeReplay(recorded).respond(1, read(13)).reply == b"\x83\x02"


def test_a_broadcast_before_the_first_request_to_a_unit_is_part_of_its_past() -> None:
    write = struct.pack(">BHH", 6, 0, 7)
    replay = ExchangeReplay([asked(write, b"", unit=0), asked(read(0), values(7)), asked(read(1), values(1))])
    replay.broadcast(write)
    assert words(replay, 0) == (7,)
