"""Errors on the modelled CAN bus: cost of each in bits, the counters, error-passive, bus-off and recovery.

125 kbit/s: a bit is 8 us. Identifier 000h without data takes 53 bits (test_can_timing, by hand), 40 of them stuffed.
"""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.emulators.wires.can_bus import CanBus
from fieldtwin.emulators.wires.can_events import Delivery, Notice
from fieldtwin.emulators.wires.can_faults import Disturbance, spoil
from fieldtwin.emulators.wires.can_timing import (
    bits_on_wire,
    bits_to_end,
    error_flag_bits,
    plain_bits,
    stuff,
    wire_bits,
)
from fieldtwin.gateway.core.can_error import CanErrorState
from fieldtwin.gateway.core.canframe import CanFrame

US = 1000
BIT_NS = 8 * US
END = 10**12
ZERO, ONE = CanFrame(0x000), CanFrame(0x001)
ACTIVE, WARNING, PASSIVE, BUS_OFF = CanErrorState


def make(nodes: int, **options: bool) -> tuple[CanBus, list[int]]:
    bus = CanBus(125_000, **options)
    return bus, [bus.join(0) for _ in range(nodes)]


def counters(bus: CanBus, node: int) -> tuple[int, int]:
    _, tec, rec = bus.error_state(node)
    return tec, rec


def changes(bus: CanBus, node: int) -> list[CanErrorState]:
    return [n.state for n in bus.take_notices() if n.node == node]


# -- one error ------------------------------------------------------------------------------------------------------


def test_an_error_frame_and_the_frame_again() -> None:
    bus, (a, b, c) = make(3)
    # Bit 3 of "00000 1 00000 1..." is read as 1 by all nodes. The sender's flag begins at bit 4; the receivers have seen
    # 0001 and after six dominant bits a broken stuffing, so they add six: 12 of flags, 8 of delimiter, 3 of interframe space.
    bus.disturb(spoil(Disturbance(at_bit=3)))
    bus.submit(a, ZERO, 0)
    (done,) = bus.advance(END)
    (fault,) = bus.take_faults()
    assert (fault.kind, fault.t_ns, fault.bits, fault.senders) == ("bit", 4 * BIT_NS, 4 + 12 + 8 + 3, (a,))
    assert (done.start_ns, done.frame.t_ns) == (27 * BIT_NS, (27 + 50) * BIT_NS)
    # +8 and then -1 for the successful frame; +1 and -1.
    assert fault.counters == ((a, 8, 0), (b, 0, 1), (c, 0, 1))
    assert [counters(bus, n) for n in (a, b, c)] == [(7, 0), (0, 0), (0, 0)]
    assert (bus.frames, bus.error_frames, bus.bits) == (1, 1, 27 + 53)


def test_a_receiver_that_objects_alone_counts_nine() -> None:
    bus, (a, b, c) = make(3)
    bus.disturb(spoil(Disturbance(seen_by=frozenset({b}))))
    bus.submit(a, ZERO, 0)
    bus.advance(43 * BIT_NS)
    assert bus.take_faults() == []  # not yet: an attempt is evaluated after its regular end
    assert len(bus.advance(END)) == 1
    (fault,) = bus.take_faults()
    # A wrong check sum: b's flag follows the acknowledge delimiter, at bit 40 + 3; the others see it at once: 7 bits of flags.
    assert (fault.kind, fault.t_ns, fault.bits) == ("crc", 43 * BIT_NS, 43 + 7 + 8 + 3)
    assert fault.counters == ((a, 8, 0), (b, 0, 9), (c, 0, 1))


def test_a_corrupted_frame_arbitrates_again() -> None:
    bus, (a, b, _) = make(3)
    bus.disturb(spoil(Disturbance(at_bit=0)))
    bus.submit(a, ONE, 0)
    bus.submit(b, ZERO, 1)  # 000h came too late for the first attempt and wins the second
    assert [d.frame.can_id for d in bus.advance(END)] == [0, 1]


def test_an_error_costs_between_17_and_31_bits() -> None:
    costs = set()
    frame = CanFrame(0x123, bytes(range(8)))
    for at in range(bits_to_end(frame)):
        bus, (a, _) = make(2)
        bus.disturb(spoil(Disturbance(at_bit=at)))
        bus.submit(a, frame, 0)
        bus.advance(END)
        (fault,) = bus.take_faults()
        costs.add(fault.bits - fault.t_ns // BIT_NS)
    assert min(costs) >= 17
    assert max(costs) <= 23
    assert {17, 18, 23} <= costs
    # An error-passive sender waits 8 bits more: 31 at most.
    bus, (a, _) = make(2)
    bus.disturb(spoil(Disturbance(at_bit=3), times=17))
    bus.submit(a, ZERO, 0)
    (done,) = bus.advance(END)
    assert (done.start_ns - bus.take_faults()[-1].t_ns) // BIT_NS == 31


def flags_by_brute_force(frame: CanFrame, seen: str) -> int:
    """Step a receiver that knows only the stuffing rule and the fixed form over the dominant bits of the first flag."""
    fixed = bits_to_end(frame) - 10
    wire = list(seen)

    def objects() -> bool:
        at = len(wire) - 1
        if at < fixed:
            return len(wire) >= 6 and len(set(wire[-6:])) == 1
        return at != fixed + 1 and wire[at] == "0"

    if objects() and len(seen) <= fixed:
        return 6
    for sent in itertools.count(1):
        wire.append("0")
        if objects():
            return sent + 6
    raise AssertionError


@given(st.integers(0, 0x7FF), st.binary(max_size=8), st.floats(0, 1), st.booleans())
def test_flags_overlap_as_bits_do(can_id: int, data: bytes, where: float, flipped: bool) -> None:
    frame = CanFrame(can_id, data)
    wire = wire_bits(frame)
    at = int(where * (len(wire) - 3))
    last = wire[at] if not flipped else "10"[int(wire[at])]
    if at >= bits_to_end(frame) - 10:
        last = wire[at]  # in the fixed form an error is detected at once; the test is about the flag after it
    seen = wire[:at] + last
    assert error_flag_bits(frame, seen) == flags_by_brute_force(frame, seen)
    assert 6 <= error_flag_bits(frame, seen) <= 12
    assert wire.startswith(stuff(plain_bits(frame)))


# -- error-passive, bus-off, recovery -------------------------------------------------------------------------------


def test_from_active_to_bus_off_and_back() -> None:
    bus, (a, b) = make(2)
    bus.disturb(spoil(Disturbance(at_bit=3), times=32))
    bus.submit(a, ZERO, 0)
    bus.submit(a, ONE, 0)
    assert [d.senders for d in bus.advance(END)] == [(a,), (a,)]  # both, once it is back
    notices = [n for n in bus.take_notices() if n.node == a]
    assert [(n.before, n.state, n.tec) for n in notices] == [
        (ACTIVE, WARNING, 96), (WARNING, PASSIVE, 128), (PASSIVE, BUS_OFF, 256), (BUS_OFF, ACTIVE, 0)
    ]  # fmt: skip
    # 32 errors at 27 bits each; the suspension before the tries 17 to 32 is 8 more. Then 128 times 11 recessive bits.
    off = 32 * 27 + 16 * 8
    assert notices[2].t_ns == (off - 23) * BIT_NS
    assert notices[3].t_ns == (off + 128 * 11) * BIT_NS
    assert counters(bus, a) == (0, 0)
    assert counters(bus, b) == (0, 30)  # 32 errors, two good frames


def test_in_bus_off_a_node_neither_receives_nor_acknowledges_nor_sends() -> None:
    bus, (a, b) = make(2, monitored=False)
    bus.disturb(spoil(Disturbance(at_bit=3), match=lambda f: f.can_id == 0, times=32))
    bus.submit(a, ZERO, 0)
    bus.submit(a, CanFrame(0x10), 0)
    bus.advance((32 * 27 + 16 * 8 + 50) * BIT_NS)
    assert bus.error_state(a)[0] is BUS_OFF
    bus.submit(b, ONE, 1000 * BIT_NS)
    assert bus.advance(2000 * BIT_NS) == []  # no node acknowledges it
    assert {f.kind for f in bus.take_faults()[32:]} == {"ack"}
    done = bus.advance(END)
    assert [d.frame.can_id for d in done] == [0x000, 0x001, 0x010]
    assert done[1].receivers == (a,)


def test_recovery_counts_the_ends_of_foreign_frames() -> None:
    bus, (a, b, _) = make(3)
    bus.disturb(spoil(Disturbance(at_bit=3), match=lambda f: f.can_id == 0x7FF, times=32))
    bus.submit(a, CanFrame(0x7FF), 0)
    bus.advance(10_000 * US)
    assert bus.error_state(a)[0] is BUS_OFF
    bus.take_notices()
    start = 10_000 * US
    for _ in range(60):
        assert bus.submit(b, ONE, start)
    bus.advance(END)
    back = next(n for n in bus.take_notices() if n.node == a)
    # Idle since the last error frame, then 60 frames of 50 bits with one sequence each, then idle again.
    off_bit = 32 * bits_of_error() + 16 * 8
    idle = (start // BIT_NS - off_bit) // 11
    assert back.t_ns == start + 60 * 50 * BIT_NS + (128 - 60 - idle) * 11 * BIT_NS


def bits_of_error() -> int:
    """Return the cost of one error at bit 3 of 7FFh."""
    bus, (a, _) = make(2)
    bus.disturb(spoil(Disturbance(at_bit=3)))
    bus.submit(a, CanFrame(0x7FF), 0)
    bus.advance(END)
    return bus.take_faults()[0].bits


def test_an_error_passive_node_waits_eight_bits_and_others_do_not() -> None:
    bus, (a, b) = make(2)
    bus.disturb(spoil(Disturbance(at_bit=3), times=16))
    bus.submit(a, ZERO, 0)
    bus.submit(a, ZERO, 0)
    bus.submit(b, ONE, (16 * 27 + 1) * BIT_NS)  # within the suspension: it may start at once, although 000h waits
    done = bus.advance(END)
    assert [d.frame.can_id for d in done] == [1, 0, 0]
    assert done[0].start_ns == (16 * 27 + 1) * BIT_NS
    assert changes(bus, a) == [WARNING, PASSIVE, WARNING]  # 127 after the first that came through


def test_a_passive_receiver_goes_without_and_spoils_nothing() -> None:
    bus, (a, b, c) = make(3)
    bus.disturb(spoil(Disturbance(seen_by=frozenset({b})), times=None))
    bus.submit(a, ZERO, 0)
    (done,) = bus.advance(END)
    # 15 rejections at 9 make 135: passive. The next attempt succeeds, c receives it and b does not.
    assert (done.receivers, bus.error_frames) == ((c,), 15)
    assert counters(bus, b) == (0, 136)
    assert bus.error_state(b)[0] is PASSIVE


def test_a_good_frame_brings_a_passive_receiver_back() -> None:
    bus, (a, b, _) = make(3)
    rule = spoil(Disturbance(seen_by=frozenset({b})), times=15)
    bus.disturb(rule)
    bus.submit(a, ZERO, 0)
    bus.advance(END)
    assert counters(bus, b) == (0, 119)
    assert changes(bus, b) == [WARNING, PASSIVE, WARNING]
    bus.undisturb(rule)
    bus.undisturb(rule)


# -- without acknowledgement ----------------------------------------------------------------------------------------


def test_without_acknowledgement_a_node_gets_passive_and_never_bus_off() -> None:
    bus, (a,) = make(1, monitored=False)
    bus.submit(a, ZERO, 0)
    assert bus.advance(3600 * 10**9) == []  # an hour at once: attempts that change nothing are counted, not simulated
    assert bus.error_state(a) == (PASSIVE, 128, 0)
    assert changes(bus, a) == [WARNING, PASSIVE]
    # 42 bits to the acknowledge slot, a flag of 6, 8 and 3: 59 bits, and 8 more once it is passive.
    assert bus.error_frames == pytest.approx(3600 * 125_000 / 67, rel=1e-4)
    assert bus.next_event_ns() is None  # and no node is woken
    b = bus.join(3600 * 10**9)
    (done,) = bus.advance(3601 * 10**9)
    assert (done.receivers, done.senders) == ((b,), (a,))
    assert done.start_ns - 3600 * 10**9 <= 67 * BIT_NS
    assert (done.start_ns // BIT_NS - 16 * 59 - 8) % 67 == 0  # in its usual rhythm
    assert bus.error_state(a) == (WARNING, 127, 0)


def test_a_listener_of_the_bus_acknowledges() -> None:
    bus, (a,) = make(1)
    bus.submit(a, ZERO, 0)
    assert len(bus.advance(END)) == 1


def test_a_node_that_left_does_not_retry_for_ever() -> None:
    bus, (a,) = make(1, monitored=False)
    bus.submit(a, ZERO, 0)
    bus.leave(a, 1)
    bus.advance(END)
    assert bus.stats(END)["nodes"] == []


# -- two nodes with one identifier ----------------------------------------------------------------------------------


def test_a_collision_lasts_until_the_recessive_one_is_passive() -> None:
    bus, (a, b, c) = make(3)
    bus.submit(a, CanFrame(0x181, b"\xff"), 0)
    bus.submit(b, CanFrame(0x181, b"\x7f"), 0)
    first, second = bus.advance(END)
    # 16 collisions at the data's first bit, TEC + 8 each: 128, error-passive. Then a's flag is recessive: b's frame succeeds,
    # a counts that too and sends alone after its suspension.
    assert (bus.conflicts, bus.error_frames) == (17, 16)
    assert (first.senders, first.frame.data, first.receivers) == ((b,), b"\x7f", (c,))
    assert (second.senders, second.frame.data, second.receivers) == ((a,), b"\xff", (b, c))
    assert second.start_ns == first.start_ns + (first.bits + 8) * BIT_NS
    assert (counters(bus, a)[0], counters(bus, b)[0]) == (128 + 8 - 1, 128 - 1)
    faults = bus.take_faults()
    # SOF, 11 of identifier, 3, 4 of length: the first bit of the data is bit 19, and one stuff bit stands before it.
    wire = wire_bits(CanFrame(0x181, b"\xff"))
    at = next(i for i, (x, y) in enumerate(zip(wire, wire_bits(CanFrame(0x181, b"\x7f")), strict=False)) if x != y)
    assert {f.t_ns - f.start_ns for f in faults} == {(at + 1) * BIT_NS}
    assert {f.kind for f in faults} == {"bit"}


def test_collisions_of_three_and_the_same_frame_twice() -> None:
    bus, (a, b, c, d) = make(4)
    for node, data in ((a, b"\xff"), (b, b"\x00"), (c, b"\x00"), (d, b"\x0f")):
        bus.submit(node, CanFrame(0x181, data), 0)
    done = bus.advance(END)
    assert [x.senders for x in done] == [(b, c), (d,), (a,)]


def test_a_node_that_always_yields_goes_to_bus_off_too() -> None:
    bus, (a, b, _) = make(3)
    # 16 collisions; then a, error-passive, yields to b, whose frame is corrupted each time: + 8 for both until they are off.
    bus.disturb(spoil(match=lambda frame: frame.data == b"\x7f", times=16))
    bus.submit(a, CanFrame(0x181, b"\xff"), 0)
    bus.submit(b, CanFrame(0x181, b"\x7f"), 0)
    assert [d.frame.data for d in bus.advance(END)] == [b"\x7f", b"\xff"]
    notices = bus.take_notices()
    states = [WARNING, PASSIVE, BUS_OFF, ACTIVE]
    assert [n.state for n in notices if n.node == a][:4] == states
    assert [n.state for n in notices if n.node == b][:4] == states
    off, back = (next(n.t_ns for n in notices if n.node == a and n.state is state) for state in (BUS_OFF, ACTIVE))
    assert back - off > 128 * 11 * BIT_NS


def test_repeated_collisions_lead_to_bus_off() -> None:
    bus, (a, b) = make(2)
    for _ in range(40):
        assert bus.submit(a, CanFrame(0x181, b"\xff"), 0)
        assert bus.submit(b, CanFrame(0x181, b"\x7f"), 0)
    assert len(bus.advance(END)) == 80  # late, and complete
    assert BUS_OFF in changes(bus, a)


# -- arbitrary sequences --------------------------------------------------------------------------------------------

frames = st.builds(CanFrame, st.integers(0, 6), st.sampled_from([b"", b"\x00", b"\x7f", b"\xff", bytes(8)]))
troubles = st.lists(
    st.tuples(
        st.none() | st.integers(0, 130), st.frozensets(st.integers(1, 4)), st.integers(0, 30), st.integers(1, 40)
    ),
    max_size=3,
)
submitted = st.lists(st.tuples(st.integers(0, 3), frames, st.integers(0, 3_000_000)), max_size=20)


@settings(max_examples=60)
@given(submitted, troubles, st.lists(st.integers(0, 6_000_000), max_size=6), st.booleans())
def test_no_frame_is_lost_and_looking_changes_nothing(
    items: list[tuple[int, CanFrame, int]],
    trouble: list[tuple[int | None, frozenset[int], int, int]],
    looks: list[int],
    monitored: bool,
) -> None:
    def run(looks: list[int]) -> tuple[list[Delivery], list[Notice], CanBus]:
        bus = CanBus(1_000_000, monitored=monitored)
        nodes = [bus.join(0) for _ in range(4)]
        for at_bit, seen_by, skip, times in trouble:
            bus.disturb(spoil(Disturbance(at_bit, seen_by), skip=skip, times=times))
        events = [(at, 1, -1, ZERO) for at in looks] + [(at, 0, node, frame) for node, frame, at in items]
        out: list[Delivery] = []
        notices: list[Notice] = []
        for at, look, node, frame in sorted(events, key=lambda e: e[:2]):
            if look:
                out += bus.advance(at)
                notices += bus.take_notices()
            else:
                assert bus.submit(nodes[node], frame, at)
        out += bus.advance(END)
        return out, notices + bus.take_notices(), bus

    done, notices, bus = run([])
    assert run(looks)[:2] == (done, notices)
    # Conservation: each submitted frame is sent by its node once, in order.
    for node in range(4):
        sent = [d.frame.key() for d in done if node + 1 in d.senders]
        assert sent == [f.key() for n, f, _ in sorted(items, key=lambda i: i[2]) if n == node]
    for delivery in done:
        assert not set(delivery.senders) & set(delivery.receivers)
        assert delivery.bits == bits_on_wire(delivery.frame)
        assert delivery.start_ns == delivery.frame.t_ns - bits_to_end(delivery.frame) * 1000
    for before, after in itertools.pairwise(done):
        assert after.start_ns >= before.start_ns + before.bits * 1000
    stats = bus.stats(END)
    assert stats["frames"] == len(done) == sum(stats["by_id"].values())
    errors = [f.bits for f in bus.take_faults()]
    assert stats["bits"] == sum(d.bits for d in done) + sum(errors)
    assert all(0 <= n["tec"] < 256 and 0 <= n["rec"] <= 255 and n["queued"] == 0 for n in stats["nodes"])
    assert sum(n["sent"] for n in stats["nodes"]) == len(items)
    # States change one step at a time, and only bus-off ends automatically.
    for node in range(1, 5):
        own = [n for n in notices if n.node == node]
        assert all(a.state is b.before and a.t_ns <= b.t_ns for a, b in itertools.pairwise(own))
    assert bus.next_event_ns() is None


@pytest.mark.parametrize("monitored", [True, False])
def test_a_frame_that_begins_before_a_recovery_postpones_it(monitored: bool) -> None:
    """The next event was the recovery, at which nothing happened: virtual time stood still."""
    bus, (a, b, _) = make(3, monitored=monitored)
    bus.disturb(spoil(times=32))
    bus.submit(a, ONE, 0)
    while bus.error_state(a)[0] is not BUS_OFF:
        event_ns = bus.next_event_ns()
        assert event_ns is not None
        bus.advance(event_ns)
    bus.take_notices(), bus.take_faults()
    recovery_ns = bus.next_event_ns()
    assert recovery_ns is not None
    bus.submit(b, ZERO, recovery_ns - 5 * BIT_NS)
    assert bus.next_event_ns() == recovery_ns + (50 - 5) * BIT_NS
    events = []
    while (event_ns := bus.next_event_ns()) is not None:
        bus.advance(event_ns)
        assert len(events) < 10
        events.append(event_ns)
    assert bus.error_state(a)[0] is ACTIVE
