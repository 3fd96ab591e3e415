"""The acoustic channel between modems: receivers and delays, losses and their causes, and the accounting of all messages."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.emulators.models.modbus.acoustic_link import AcousticLink
from fieldtwin.emulators.wires.acoustic import MAX_RECEIVED, QUEUE, AcousticMedium, AcousticProperties
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import UsageError

ROW = {"west": (0.0, 0.0), "middle": (3000.0, 0.0), "east": (6000.0, 0.0)}
"""East and west do not reach each other; the middle receives both, 2 s after they send."""
WATER = AcousticProperties(range_m=4000.0, bytes_per_s=20.0, overhead_bytes=8)


def s(seconds: float) -> int:
    return round(seconds * NS_PER_S)


def test_neighbours_receive_it_later_and_others_do_not() -> None:
    sea = AcousticMedium(WATER, ROW, seed=1)
    assert sea.neighbours("west") == ["middle"]
    assert sea.transmit("west", b"ahoy", 0)
    assert sea.take("middle", s(2.59)) is None  # 12 bytes at 20 B/s are 0.6 s, in transit for 2 s
    assert sea.take("middle", s(2.6)) == b"ahoy"
    assert sea.take("middle", s(9)) is None
    assert sea.take("east", s(9)) is None
    assert sea.counters["west"].said == 1
    assert sea.counters["east"].as_dict() == {"said": 0, "heard": 0, "dropped": 0, **dict.fromkeys(
        ("collision", "speaking", "chance", "fault"), 0)}  # fmt: skip


def test_two_simultaneous_messages_collide_where_both_are_received() -> None:
    sea = AcousticMedium(WATER, ROW, seed=1)
    sea.transmit("west", b"one", 0)
    sea.transmit("east", b"two", s(0.3))
    sea.advance(s(10))
    assert sea.take("middle", s(10)) is None
    assert sea.counters["middle"].lost["collision"] == 2


def test_a_sending_modem_receives_nothing() -> None:
    sea = AcousticMedium(WATER, ROW, seed=1)
    sea.transmit("west", b"one", 0)
    sea.transmit("middle", b"two", s(1.9))  # it sends until 2.45 s, and the message from west arrives from 2 s on
    assert sea.take("middle", s(10)) is None
    assert sea.counters["middle"].lost["speaking"] == 1
    assert sea.take("west", s(10)) == b"two"
    assert sea.take("east", s(10)) == b"two"


def test_a_modem_waits_while_it_receives() -> None:
    sea = AcousticMedium(WATER, ROW, seed=1)
    sea.transmit("west", b"one", 0)
    sea.transmit("middle", b"two", s(2.2))  # in the middle of its reception, to 2.55 s
    assert sea.take("middle", s(2.55)) == b"one"
    assert sea.take("west", s(4.55)) is None
    assert sea.take("west", s(6)) == b"two"


def test_a_modem_accepts_a_limited_number_of_bytes() -> None:
    sea = AcousticMedium(WATER, ROW, seed=1)
    taken = sum(sea.transmit("west", bytes([n]), 0) for n in range(10))
    assert taken == QUEUE + 1  # one is in transit
    assert [sea.take("middle", s(60)) for _ in range(taken + 1)] == [*(bytes([n]) for n in range(taken)), None]


def test_a_listener_that_takes_nothing_loses_the_oldest() -> None:
    sea = AcousticMedium(WATER, ROW, seed=1)
    for n in range(MAX_RECEIVED + 3):
        assert sea.transmit("west", bytes([n]), s(n))
    assert sea.take("middle", s(500)) == bytes([3])
    assert sea.counters["middle"].dropped == 3


def test_a_ship_repeats_its_message() -> None:
    sea = AcousticMedium(WATER, ROW, seed=1)
    ship = AcousticLink(sea, "west", times=3, every_ns=s(5))
    middle = AcousticLink(sea, "middle")
    assert ship.submit(b"\x00\x0a", 0)
    assert [middle.arrived(s(4)), middle.arrived(s(4)), middle.arrived(s(9)), middle.arrived(s(14))] == [
        b"\x00\x0a", None, b"\x00\x0a", b"\x00\x0a",
    ]  # fmt: skip
    assert (ship.sent, ship.resent, middle.delivered) == (1, 2, 3)


def test_faults_drop_messages() -> None:
    struck: list[tuple[int, int, bytes]] = []

    def spoils(t_ns: int, listener: int, payload: bytes) -> bool:
        struck.append((t_ns, listener, payload))
        return listener == 3

    sea = AcousticMedium(WATER, ROW, seed=1, spoils=spoils)
    sea.transmit("middle", b"one", 0)
    assert sea.take("west", s(5)) == b"one"
    assert sea.take("east", s(5)) is None
    assert sea.counters["east"].lost["fault"] == 1
    assert struck == [(s(2.55), 1, b"one"), (s(2.55), 3, b"one")]


def test_no_such_modem() -> None:
    with pytest.raises(UsageError, match="no modem 'north'"):
        AcousticMedium(WATER, ROW, seed=1).transmit("north", b"x", 0)


@settings(max_examples=60, deadline=None)
@given(
    said=st.lists(st.tuples(st.sampled_from(sorted(ROW)), st.integers(0, 3000), st.binary(min_size=1, max_size=64)), max_size=40),
    loss=st.floats(0.0, 0.9),
    seed=st.integers(0, 99),
    looks=st.integers(1, 50),
)  # fmt: skip
def test_every_message_is_received_once_or_lost_for_a_reason_independent_of_polls(
    said: list[tuple[str, int, bytes]], loss: float, seed: int, looks: int
) -> None:
    said = sorted(said, key=lambda one: one[1])
    water = AcousticProperties(range_m=4000.0, bytes_per_s=80.0, loss=loss)

    def played(every_s: float) -> tuple[dict[str, list[bytes]], dict[str, dict[str, int]]]:
        sea, heard, t_s = AcousticMedium(water, ROW, seed), {name: list[bytes]() for name in ROW}, 0.0
        for name, at_s, payload in said:
            while t_s + every_s < at_s:
                t_s += every_s
                sea.advance(s(t_s))
            sea.transmit(name, payload, s(at_s))
        for name in ROW:
            while (payload_heard := sea.take(name, s(10_000))) is not None:
                heard[name].append(payload_heard)
        return heard, {name: counters.as_dict() for name, counters in sea.counters.items()}

    heard, counters = played(every_s=float(looks))
    assert (heard, counters) == played(every_s=1000.0)
    reached = sum(counters[name]["said"] * (2 if name == "middle" else 1) for name in ROW)
    assert reached == sum(c["heard"] + c["collision"] + c["speaking"] + c["chance"] for c in counters.values())
    payloads = [payload for _, _, payload in said]
    assert all(payload in payloads for one in heard.values() for payload in one)
    assert all(c["heard"] == len(heard[name]) + c["dropped"] for name, c in counters.items())
