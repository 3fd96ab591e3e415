"""The bus model: arbitration, exact times, receivers, bounds and counts. 125 kbit/s: a bit is 8 us."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.emulators.wires.can_bus import CanBus
from fieldtwin.emulators.wires.can_events import Delivery
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.errors import Bug, EndpointBusy, UsageError

US = 1000
END = 10**12

# From test_can_timing, by hand: identifier 0 takes 50 bits to its end of frame and 53 of the bus, identifier 1 takes 47
# and 50. At 8 us a bit: 400 and 424 us, 376 and 400 us.
ZERO, ONE = CanFrame(0x000), CanFrame(0x001)


def keys(deliveries: list[Delivery]) -> list[int]:
    return [d.frame.can_id for d in deliveries]


def test_exact_times_and_arbitration() -> None:
    bus = CanBus(125_000)
    a, b, c = (bus.join(0) for _ in range(3))
    assert bus.next_event_ns() is None
    assert bus.submit(a, ONE, 0)
    assert bus.submit(b, ZERO, 0)
    assert bus.next_event_ns() == 400 * US
    assert bus.advance(400 * US - 1) == []
    (first,) = bus.advance(400 * US)
    # 000h wins, 0 to 400 us, received by all others at its end.
    assert (first.frame.can_id, first.start_ns, first.frame.t_ns) == (0x000, 0, 400 * US)
    assert (first.bits, first.senders, first.receivers) == (53, (b,), (a, c))
    # 001h starts when the interframe space ends at 424 us, and ends 376 us later.
    assert bus.next_event_ns() == 800 * US
    (second,) = bus.advance(800 * US)
    assert (second.start_ns, second.frame.t_ns, second.bits) == (424 * US, 800 * US, 50)
    assert bus.next_event_ns() is None


def test_a_frame_on_the_wire_is_not_interrupted() -> None:
    bus = CanBus(125_000)
    a, b = bus.join(0), bus.join(0)
    bus.submit(a, ONE, 0)
    bus.submit(b, ZERO, 8 * US)  # a higher priority, one bit late
    done = bus.advance(END)
    assert keys(done) == [0x001, 0x000]
    assert done[1].start_ns == 400 * US


def test_a_waiting_frame_can_be_withdrawn_and_a_frame_on_the_wire_cannot() -> None:
    bus = CanBus(125_000)
    a, b = bus.join(0), bus.join(0)
    again, other = CanFrame(0x001, b"\x01"), CanFrame(0x002)
    for frame in (ONE, again, other):
        assert bus.submit(a, frame, 0)
    assert bus.submit(b, CanFrame(0x003), 0)
    assert bus.withdraw(a, {0x001}, 100 * US) == [again], "001h has been on the wire since 0"
    assert bus.withdraw(b, {0x003}, 100 * US) == [CanFrame(0x003)], "it lost the arbitration and waits"
    assert bus.withdraw(b, {0x003}, 100 * US) == []
    assert keys(bus.advance(END)) == [0x001, 0x002]
    assert (bus.queued(a), bus.queued(b)) == (0, 0)


def test_a_frame_withdrawn_in_time_takes_no_part_in_the_arbitration() -> None:
    bus = CanBus(125_000)
    a, b = bus.join(0), bus.join(0)
    bus.submit(a, ZERO, 0)
    bus.submit(b, ONE, 0)
    assert bus.next_event_ns() == 400 * US
    assert bus.withdraw(a, {0x000}, 0) == [ZERO]
    assert bus.next_event_ns() == 376 * US
    assert keys(bus.advance(END)) == [0x001]


def test_a_frame_queued_before_the_start_takes_part_independent_of_polls() -> None:
    bus = CanBus(125_000)
    a, b = bus.join(0), bus.join(0)
    bus.submit(a, ONE, 0)
    bus.submit(a, CanFrame(0x300), 0)
    assert keys(bus.advance(380 * US)) == [0x001]
    assert bus.next_event_ns() is not None  # 300h, from 400 us on, in the present state
    bus.submit(b, ZERO, 400 * US)
    assert keys(bus.advance(END)) == [0x000, 0x300]


def test_a_frame_waits_no_longer_than_it_must() -> None:
    bus = CanBus(125_000)
    a = bus.join(0)
    bus.submit(a, ZERO, 0)
    bus.submit(a, ONE, 10_000 * US)  # the bus is long idle by then
    first, second = bus.advance(END)
    assert first.frame.t_ns == 400 * US
    assert second.start_ns == 10_000 * US


def test_only_the_head_of_a_queue_takes_part_so_each_sender_keeps_its_order() -> None:
    bus = CanBus(125_000)
    a, b = bus.join(0), bus.join(0)
    for can_id in (0x300, 0x000):
        bus.submit(a, CanFrame(can_id), 0)
    bus.submit(b, CanFrame(0x200), 0)
    assert keys(bus.advance(END)) == [0x200, 0x300, 0x000]


def test_identical_frames_overlap_and_are_one_on_the_wire() -> None:
    bus = CanBus(125_000)
    a, b, c = (bus.join(0) for _ in range(3))
    answer = CanFrame(0x7E4, b"\x4f" + bytes(7))
    bus.submit(a, answer, 0)
    bus.submit(b, answer, 0)
    (only,) = bus.advance(END)
    assert (only.senders, only.receivers) == ((a, b), (c,))
    assert bus.conflicts == 0


def test_late_joiner_receives_only_frames_that_start_after_it_joined() -> None:
    bus = CanBus(125_000)
    a = bus.join(0)
    bus.submit(a, ZERO, 0)
    bus.submit(a, ONE, 0)
    late = bus.join(200 * US)  # in the middle of the first
    first, second = bus.advance(END)
    assert late not in first.receivers
    assert late in second.receivers


def test_a_node_that_left_still_sends_what_it_queued_and_receives_nothing() -> None:
    bus = CanBus(125_000)
    a, b = bus.join(0), bus.join(0)
    bus.submit(a, ZERO, 0)
    bus.submit(a, ONE, 0)
    bus.submit(b, CanFrame(0x700), 0)
    bus.leave(a, 100 * US)
    done = bus.advance(END)
    assert [(d.frame.can_id, d.receivers) for d in done] == [(0x000, (b,)), (0x001, (b,)), (0x700, ())]
    assert [n["node"] for n in bus.stats(END)["nodes"]] == [b]
    with pytest.raises(Bug):
        bus.submit(a, ZERO, END)


def test_leaving_loses_nothing_that_had_ended() -> None:
    bus = CanBus(125_000)
    a, b = bus.join(0), bus.join(0)
    bus.submit(a, ZERO, 0)
    bus.leave(b, 500 * US)
    (delivery,) = bus.advance(500 * US)
    assert delivery.receivers == (b,)


def test_a_full_queue_refuses_and_accepts_again_when_a_frame_was_sent() -> None:
    bus = CanBus(125_000, queue_frames=2)
    a, b = bus.join(0), bus.join(0)
    assert [bus.submit(a, ZERO, 0) for _ in range(3)] == [True, True, False]
    assert bus.submit(b, ONE, 0)  # only the sender itself is delayed
    assert not bus.submit(a, ZERO, 400 * US - 1)
    assert bus.submit(a, ZERO, 400 * US)
    assert len(bus.advance(END)) == 4
    assert bus.stats(END)["nodes"][0]["refused"] == 2


def test_bounds_and_refusals() -> None:
    bus = CanBus(500_000, max_nodes=1)
    a = bus.join(0)
    with pytest.raises(EndpointBusy):
        bus.join(0)
    with pytest.raises(UsageError):
        bus.submit(a, CanFrame(0x20, bytes(8), error=True), 0)
    for bitrate in (0, 1_000_001):
        with pytest.raises(UsageError):
            CanBus(bitrate)


def test_counts_and_load() -> None:
    bus = CanBus(125_000)
    a, b = bus.join(0, "plc"), bus.join(0, "tilt")
    for i in range(20):
        bus.submit(a, ONE, i * 1000 * US)  # 50 bits each millisecond
    bus.submit(b, CanFrame(0x1, b"", extended=True), 20_000 * US)
    bus.count_overrun(b)
    bus.advance(END)
    stats = bus.stats(999_000 * US)
    assert stats["frames"] == 21
    assert stats["by_id"] == {"001": 20, "00000001": 1}
    extended_bits = stats["bits"] - 20 * 50
    assert 67 <= extended_bits <= 80
    assert stats["load"] == pytest.approx(stats["bits"] / 125_000)
    assert bus.load(2_000_000 * US) == 0
    assert stats["overruns"] == 1
    assert stats["load_by_id"] == {"001": 20 * 50 / 125_000, "00000001": extended_bits / 125_000}
    assert stats["nodes"][0] == {
        "node": a, "name": "plc", "sent": 20, "received": 1, "overruns": 0, "refused": 0, "queued": 0,
        "load": 20 * 50 / 125_000, "errors": 0, "state": "error-active", "tec": 0, "rec": 0,
    }  # fmt: skip
    assert (stats["nodes"][1]["received"], stats["nodes"][1]["overruns"]) == (20, 1)


def test_frames_without_duration_do_not_collide_and_are_counted() -> None:
    bus = CanBus(125_000, instant=True)
    a, b = bus.join(0), bus.join(0)
    bus.submit(b, CanFrame(0x181, b"b"), 0)
    bus.submit(a, CanFrame(0x181, b"a"), 0)
    assert [d.frame.data for d in bus.advance(END)] == [b"b", b"a"]
    assert (bus.conflicts, bus.error_frames) == (1, 0)


def test_instant_frames_take_no_time_and_are_still_arbitrated() -> None:
    bus = CanBus(125_000, instant=True)
    a, b = bus.join(0), bus.join(0)
    bus.submit(a, ONE, 5)
    bus.submit(b, ZERO, 5)
    done = bus.advance(5)
    assert [(d.frame.can_id, d.frame.t_ns) for d in done] == [(0, 5), (1, 5)]


submissions = st.lists(
    st.tuples(st.integers(0, 2), st.integers(0, 0x7FF), st.binary(max_size=8), st.integers(0, 900_000)), max_size=25
)


@given(submissions, st.lists(st.integers(0, 1_000_000), max_size=10))
def test_the_number_of_polls_changes_nothing(items: list[tuple[int, int, bytes, int]], looks: list[int]) -> None:
    def run(looks: list[int]) -> tuple[list[Delivery], CanBus]:
        bus = CanBus(1_000_000)
        nodes = [bus.join(0) for _ in range(3)]
        out: list[Delivery] = []
        now = 0
        events = [("look", gap, -1, CanFrame(0)) for gap in looks]
        for node, can_id, data, gap in items:
            events.append(("send", gap, node, CanFrame(can_id, data)))
        for kind, at, node, frame in sorted(events, key=lambda e: (e[1], e[0] != "send")):
            now = at
            if kind == "look":
                out += bus.advance(now)
            else:
                assert bus.submit(nodes[node], frame, now)
        return out + bus.advance(END), bus

    often, bus = run(looks)
    once, _ = run([])
    assert often == once
    # Nothing lost, nothing invented, no two frames at once, each sender's order kept.
    assert sum(len(d.senders) for d in once) == len(items)
    for before, after in itertools.pairwise(once):
        assert after.start_ns >= before.start_ns + before.bits * 1000
    for node in (1, 2, 3):
        sent = [d.frame.key() for d in once if node in d.senders]
        wanted = [CanFrame(i[1], i[2]).key() for i in sorted(items, key=lambda i: i[3]) if i[0] + 1 == node]
        assert sent == wanted
    assert bus.next_event_ns() is None
