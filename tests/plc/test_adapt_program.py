"""The network's control logic on the acoustic channel alone: with any losses and restarts, all reach the same state in the
end."""

from __future__ import annotations

from pathlib import Path
from random import Random
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fieldtwin.emulators.wires.acoustic import AcousticMedium, AcousticProperties
from fieldtwin.gateway.core.image.image import Message
from fieldtwin.gateway.core.statemachine import encode_period
from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.plc.binding import load_program
from fieldtwin.plc.program import Program, ScanInfo

SYSTEMS = Path(__file__).resolve().parents[2] / "profiles" / "systems"
NAMES = ("west", "middle", "east")
PLACES = {"west": (0.0, 0.0), "middle": (3000.0, 0.0), "east": (6000.0, 0.0), "ship": (-2000.0, 0.0)}
SCAN_S = 0.5


class Station:
    """The program, its modem's mailboxes and a sensor that samples when due."""

    def __init__(self, sea: AcousticMedium, name: str) -> None:
        self.name, self.sea = name, sea
        self.number = NAMES.index(name) + 1
        self.temperature = 8.0
        self.kept: dict[str, Any] = {}
        self.count, self.due_s, self.period_s = 0, 0.0, 0
        self.log: list[bytes] = []
        self.begin()

    def begin(self) -> None:
        """Restart, warm."""
        self.program: Program = load_program("adapt.st", [str(SYSTEMS)])
        self.program.restore(self.kept)
        self.program._lookup = lambda name: TagValue(getattr(self.program, name), Quality.GOOD, Reason.NONE, 0)
        self.scans = 0
        self.before = self.count

    def scan(self, now_s: float) -> None:
        p, now_ns = self.program, round(now_s * 1e9)
        heard: list[Message] = []
        while (payload := self.sea.take(self.name, now_ns)) is not None:
            heard.append(Message(len(heard) + 1, now_ns, payload))
        if self.period_s > 0 and now_s >= self.due_s:
            self.count += 1
            self.due_s += self.period_s
        self.scans += 1
        p.heard, p.address, p.link = tuple(heard), self.number, 1  # type: ignore[attr-defined]
        p.value, p.count, p.sample = self.temperature, self.count, ()  # type: ignore[attr-defined]
        p.execute(ScanInfo(now_ns, self.scans, self.scans == 1))
        for _, data in p.said.pending:  # type: ignore[attr-defined]
            self.sea.transmit(self.name, data, now_ns)
        self.log += [data for _, data in p.log.pending]  # type: ignore[attr-defined]
        p.said.pending, p.log.pending = [], []  # type: ignore[attr-defined]
        self.kept = p.retained()
        if (period_s := p.period_s) != self.period_s:  # type: ignore[attr-defined]
            self.period_s, self.due_s = period_s, now_s

    def __getattr__(self, name: str) -> Any:
        return getattr(self.program, name)


class Ocean:
    def __init__(self, loss: float, seed: int) -> None:
        self.deaf: set[int] = set()
        self.sea = AcousticMedium(
            AcousticProperties(4000.0, loss=loss), PLACES, seed, lambda t_ns, listener, payload: listener in self.deaf
        )
        self.stations = {name: Station(self.sea, name) for name in NAMES}
        self.now_s = 0.0

    def run(self, for_s: float) -> None:
        until_s = self.now_s + for_s
        while self.now_s < until_s:
            self.now_s += SCAN_S
            for station in self.stations.values():
                station.scan(self.now_s)

    def order(self, period_s: int) -> None:
        self.sea.transmit(
            "ship", encode_period(period_s).data, round(self.now_s * 1e9), times=3, every_ns=15_000_000_000
        )

    def periods(self) -> list[int]:
        return [station.period_s for station in self.stations.values()]


def front(ocean: Ocean, name: str, for_s: float) -> None:
    """The temperature there falls by 0.2 K a second."""
    for _ in range(round(for_s)):
        ocean.stations[name].temperature -= 0.2
        ocean.run(1)


def test_an_order_and_a_front_go_from_one_end_to_the_other_and_are_over_everywhere() -> None:
    ocean = Ocean(0.0, 1)
    ocean.order(10)
    ocean.run(30)
    assert ocean.periods() == [10, 10, 10]
    assert [ocean.stations[n].hops for n in NAMES] == [0, 1, 2]
    front(ocean, "east", 25)
    assert ocean.stations["east"].front
    assert ocean.periods() == [2, 2, 2]
    ocean.run(60)
    assert not ocean.stations["east"].front
    assert ocean.periods() == [10, 10, 10]
    ocean.run(60)
    spoken = [ocean.stations[n].spoken for n in NAMES]
    ocean.run(3600)
    assert [ocean.stations[n].spoken for n in NAMES] == spoken  # when all have it, no member repeats it
    assert any(b'"command"' in entry for entry in ocean.stations["west"].log)


@settings(max_examples=12, deadline=None)
@given(
    loss=st.sampled_from([0.0, 0.1, 0.3, 0.5]),
    seed=st.integers(0, 10_000),
    told=st.lists(st.tuples(st.sampled_from(["order", "front", "deaf", "restart"]), st.integers(1, 60)), max_size=6),
)
@example(0.0, 0, [("order", 1)])  # so fast that a period cannot be written between two samples
def test_in_the_end_all_know_the_same(loss: float, seed: int, told: list[tuple[str, int]]) -> None:
    ocean, random = Ocean(loss, seed), Random(seed)
    ocean.order(20)
    ocean.run(30)
    last = 20
    for what, n in told:
        if what == "order":
            last = n
            ocean.order(n)
        elif what == "front":
            front(ocean, random.choice(NAMES), 20)
        elif what == "deaf":
            ocean.deaf = {random.randint(1, 3)}
        elif ocean.stations["middle"].base_s:
            ocean.stations["middle"].begin()
        ocean.run(n)
    ocean.deaf.clear()
    ocean.order(last + 1)
    ocean.run(100)
    while ocean.stations["west"].base_s != last + 1:  # the ship's three were lost, or came too early: it repeats them
        assert ocean.now_s < 3000
        ocean.order(last + 1)
        ocean.run(60)
    until_s = ocean.now_s + 1500
    while ocean.now_s < until_s and not (
        ocean.periods() == [last + 1] * 3 and all(s.pending == 0 and not s.alert for s in ocean.stations.values())
    ):
        ocean.run(10)
    assert ocean.periods() == [last + 1] * 3
    assert [s.alert for s in ocean.stations.values()] == [False] * 3
    assert [s.pending for s in ocean.stations.values()] == [0] * 3
    assert [s.missed for s in ocean.stations.values()] == [0] * 3
    assert [s.unknown for s in ocean.stations.values()] == [0] * 3


def test_a_restarted_observatory_receives_the_ships_order() -> None:
    ocean = Ocean(0.0, 3)
    ocean.order(10)
    ocean.run(60)
    ocean.stations["east"].begin()
    ocean.run(1)
    assert ocean.stations["east"].base_s == 0
    ocean.run(30)
    assert ocean.periods() == [10, 10, 10]


def test_a_front_of_a_restarted_observatory_is_news() -> None:
    ocean = Ocean(0.0, 3)
    ocean.order(10)
    ocean.run(60)
    front(ocean, "east", 25)
    ocean.run(120)
    ocean.stations["east"].begin()
    ocean.run(60)
    front(ocean, "east", 25)
    assert ocean.periods() == [2, 2, 2]


def test_an_observatory_that_forgot_its_numbers_learns_them_from_the_others() -> None:
    ocean = Ocean(0.0, 3)
    ocean.order(10)
    ocean.run(60)
    for _ in range(4):
        front(ocean, "east", 25)
        ocean.run(60)
    number = ocean.stations["east"].kept["kept"]
    ocean.stations["east"].kept = {}
    ocean.stations["east"].begin()
    ocean.run(60)
    front(ocean, "east", 15)  # an outdated period, until it is informed
    ocean.run(20)
    assert ocean.stations["east"].kept["kept"] > number
    assert ocean.periods() == [2, 2, 2]


def test_without_an_order_they_stop_to_ask_for_one() -> None:
    ocean = Ocean(0.0, 3)
    ocean.run(600)
    spoken = [s.spoken for s in ocean.stations.values()]
    assert max(spoken) <= 5
    ocean.run(3600)
    assert [s.spoken for s in ocean.stations.values()] == spoken
    assert ocean.periods() == [0, 0, 0]


def test_a_front_without_further_records_is_over_after_a_while() -> None:
    ocean = Ocean(0.0, 1)
    ocean.order(10)
    ocean.run(60)
    front(ocean, "west", 25)
    assert ocean.stations["east"].alert
    ocean.deaf = {1, 2, 3}
    ocean.run(880)
    assert ocean.stations["east"].alert
    ocean.run(40)
    assert not ocean.stations["east"].alert
    assert ocean.stations["east"].period_s == 10


@pytest.mark.parametrize(
    "nonsense",
    [b"", b"\x00", b"\x6f" * 11, b"\x6e" + bytes(11), b"\x6f\x09" + bytes(10), b"\x6f\x01\x00" + bytes(9), bytes(64), b"abc"],
)  # fmt: skip
def test_an_invalid_message_changes_nothing(nonsense: bytes) -> None:
    ocean = Ocean(0.0, 1)
    ocean.order(10)
    ocean.run(60)
    ocean.sea.transmit("ship", nonsense, round(ocean.now_s * 1e9))
    ocean.run(30)
    assert ocean.stations["west"].unknown == 1
    assert ocean.periods() == [10, 10, 10]
    assert [s.alert for s in ocean.stations.values()] == [False] * 3
