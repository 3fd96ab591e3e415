"""State tables: their behaviour scan by scan, their diagrams, and their provable properties."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import Bug
from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.gateway.core.statemachine import PERIOD_MAX, PERIOD_MIN, STATES, delta
from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.plc.diagram import svg
from fieldtwin.plc.program import ScanInfo, var_input, var_local, var_output
from fieldtwin.plc.prove import Proof, machine_key, prove
from fieldtwin.plc.relay import Relay
from fieldtwin.plc.relay_proof import PROOF, RelayWithHistory
from fieldtwin.plc.states import ANY, StateMachine, StateTable, Transition

MS = 1_000_000


class Pump(StateMachine):
    start: bool = var_input(TagKind.BOOL)
    level: float = var_input(TagKind.REAL)
    stop: bool = var_input(TagKind.BOOL)
    valve: bool = var_output(TagKind.BOOL, initial=False)
    scans_filling: int = var_local(TagKind.INT, initial=0)

    table = StateTable(
        Transition(ANY, "IDLE", when="stop", do="close"),
        Transition("IDLE", "FILLING", when="start and level is not None and level < 20", do="open"),
        Transition("FILLING", "IDLE", when="level is not None and level >= 80", do="close"),
        Transition("FILLING", "FAULT", after_ms=50, do="close"),
        states=("IDLE", "FILLING", "FAULT"),
    )

    def open(self) -> None:
        self.valve = True

    def close(self) -> None:
        self.valve = False

    def during_FILLING(self, scan: ScanInfo) -> None:
        self.scans_filling += 1


def scan(pump: Pump, number: int, start: bool = False, level: float | None = 10.0, stop: bool = False) -> str:
    pump.start, pump.level, pump.stop = start, level, stop  # type: ignore[assignment]
    pump.execute(ScanInfo(number * 10 * MS, number, number == 1))
    return pump.state_name


def test_a_machine_takes_the_first_enabled_transition_one_per_scan() -> None:
    pump = Pump()
    assert [scan(pump, 1), scan(pump, 2, start=True), scan(pump, 3)] == ["IDLE", "FILLING", "FILLING"]
    assert pump.valve
    assert scan(pump, 4, level=85.0) == "IDLE"
    assert not pump.valve
    assert scan(pump, 5, start=True, stop=True) == "FILLING"  # from IDLE `stop` leads nowhere
    assert scan(pump, 6, start=True, stop=True) == "IDLE"
    assert pump.scans_filling == 3
    assert scan(pump, 7, start=True) == "FILLING"
    # full just when it takes too long: only the first of the two transitions
    assert scan(pump, 20, level=85.0) == "IDLE"


def test_time_in_a_state_counts_from_the_scan_that_entered_it() -> None:
    pump = Pump()
    scan(pump, 1)
    states = [scan(pump, n, start=True) for n in range(2, 10)]
    assert states == ["FILLING"] * 5 + ["FAULT"] * 3
    assert not pump.valve


@pytest.mark.parametrize(
    ("table", "told"),
    [
        (lambda: StateTable(), "without transitions"),
        (lambda: StateTable(Transition("A", "B"), states=("A",)), "not declared: B"),
        (lambda: StateTable(Transition("A", "B"), Transition("C", "A")), "cannot be reached"),
    ],
)
def test_tables_that_make_no_sense_are_refused(table: object, told: str) -> None:
    with pytest.raises(Bug, match=told):
        table()  # type: ignore[operator]


@pytest.mark.parametrize(
    ("transition", "told"),
    [
        (Transition("A", "B", when="nothing > 1"), "without a variable"),
        (Transition("A", "B", when="x >"), "not an expression"),
        (Transition("A", "B", when="open('f')"), "without a variable"),
        (Transition("A", "B", do="missing"), "no method missing"),
    ],
)
def test_guards_and_actions_are_checked_when_the_program_is_declared(transition: Transition, told: str) -> None:
    with pytest.raises(Bug, match=told):
        type("Broken", (StateMachine,), {"table": StateTable(transition), "x": var_local(TagKind.INT, initial=0)})


def test_a_diagram_shows_every_state_and_every_way_out_of_it() -> None:
    drawn = svg(Pump.table, "pump", current="FILLING")
    root = ET.fromstring(drawn)
    texts = [e.text for e in root.iter("{http://www.w3.org/2000/svg}text")]
    assert {"IDLE", "FILLING", "FAULT"} <= set(texts)
    assert "after 50 ms / close" in texts
    arrows = [e for e in root.iter("{http://www.w3.org/2000/svg}path") if e.get("class") == "arrow"]
    assert len(arrows) == 1 + 4  # the initial one, IDLE-FILLING and back, FILLING-FAULT, FAULT-IDLE
    assert "http" not in drawn.replace("http://www.w3.org/2000/svg", "")  # no external resource is loaded


SEQUENCE = StateTable(
    *(Transition(f"STEP{i}", f"STEP{i + 1}", f"sensor_{i} and not alarm", 100 * i) for i in range(7)),
    Transition("STEP7", "STEP0", when="restart"),
    Transition(ANY, "STEP0", when="estop", do="safe"),
    Transition("STEP3", "STEP3", when="again", do="count"),
)


@pytest.mark.parametrize("table", [Pump.table, Relay.table, SEQUENCE], ids=["pump", "relay", "sequence"])
def test_in_a_diagram_no_label_hides_a_state_or_another_label(table: StateTable) -> None:
    root = ET.fromstring(svg(table))
    width, height = float(root.attrib["width"]), float(root.attrib["height"])
    frames = [
        (float(e.attrib["x"]), float(e.attrib["y"]), float(e.attrib["width"]), float(e.attrib["height"]))
        for e in root.iter("{http://www.w3.org/2000/svg}rect")
        if e.attrib["class"] in ("paper", "box")
    ]
    assert len(frames) > len(table.states)
    for n, (x, y, w, h) in enumerate(frames):
        assert x >= 0
        assert y >= 0
        assert x + w <= width
        assert y + h <= height
        for ox, oy, ow, oh in frames[:n]:
            assert x >= ox + ow or ox >= x + w or y >= oy + oh or oy >= y + h


def test_the_relays_diagram_matches_its_machine() -> None:
    for period_s in (PERIOD_MIN, -1, 0, 1, PERIOD_MAX):
        for state in STATES:
            held = [
                t.target
                for t in Relay.table.leaving(state)
                if eval(t.when.replace("= 0", "== 0"), {"command": period_s})
            ]
            assert (held or [state]) == [delta(period_s).name]


# -- proofs ----------------------------------------------------------------------------------------------------------------

PUMP_PROOF = Proof(
    make=Pump,
    domain={"start": [False, True], "level": [10.0, 85.0, None], "stop": [False, True]},
    steps_ms=(10.0, 60.0),
    key=lambda p: (machine_key(p)[0], p.state, p.valve),
    invariants={"the valve is open only while filling": lambda p: p.valve == (p.state_name == "FILLING")},
)


def test_true_properties_are_proved_over_states_inputs_quality_and_timer_phase() -> None:
    result = prove(PUMP_PROOF)
    assert result.proved
    assert result.states >= 8
    assert result.transitions == result.states * 24  # every state with every possible input, and the initial one


def test_a_false_property_has_a_shortest_counterexample() -> None:
    wrong = replace(PUMP_PROOF, invariants={"never a fault": lambda p: p.state_name != "FAULT"})
    result = prove(wrong)
    assert (result.proved, result.broken) == (False, "never a fault")
    assert [g.ms for g in result.way] == [10.0, 60.0]
    assert result.way[0].describe()["inputs"] == {"start": True, "level": 10.0, "stop": False}
    slow = prove(replace(wrong, steps_ms=(10.0, 20.0)))  # filling, then three scans are the fewest that make 50 ms
    assert [g.ms for g in slow.way][1:] == [10.0, 20.0, 20.0]


class Wary(Pump):
    """Starts filling only on a good value."""

    trusts = (Quality.GOOD,)

    def execute(self, scan: ScanInfo) -> None:
        self.quality = self.tag("level").quality
        if self.state_name == "IDLE" and self.quality not in self.trusts:
            self.level = None  # type: ignore[assignment]
        super().execute(scan)


class Gullible(Wary):
    trusts = (Quality.GOOD, Quality.UNCERTAIN)


def test_the_quality_of_an_input_is_part_of_the_proof() -> None:
    old = TagValue(15.0, Quality.UNCERTAIN, Reason.TIMEOUT)
    proof = replace(
        PUMP_PROOF,
        make=Wary,
        domain={**PUMP_PROOF.domain, "level": [10.0, None, old]},
        invariants={
            "begins on what is good": lambda p: p.state_name != "FILLING" or p.in_state_ms or p.quality is Quality.GOOD,
            "a value that is not there is bad": lambda p: (p.level is None) <= (p.quality is not Quality.GOOD),
        },
    )
    assert prove(proof).proved
    found = prove(replace(proof, make=Gullible))
    assert (found.broken, len(found.way)) == ("begins on what is good", 1)
    assert found.way[0].describe()["inputs"]["level"] == {"value": 15.0, "quality": "uncertain", "reason": "timeout"}


def test_logic_that_raises_is_a_counterexample_too() -> None:
    class Naive(Pump):
        table = StateTable(Transition("IDLE", "FILLING", when="level < 20"))

    result = prove(replace(PUMP_PROOF, make=Naive, invariants={}))
    assert result.broken.startswith("a scan raised TypeError")
    assert len(result.way) == 1


def test_bounds_make_no_proof() -> None:
    assert not prove(PUMP_PROOF, max_states=3).proved
    assert not prove(PUMP_PROOF, max_depth=1).proved


def test_the_relay_is_proved() -> None:
    assert prove(PROOF).proved


class LogsTooMuch(RelayWithHistory):
    def execute(self, scan: ScanInfo) -> None:
        super().execute(scan)
        self.logged += 1


class Forgets(RelayWithHistory):
    def execute(self, scan: ScanInfo) -> None:
        super().execute(scan)
        if len(self._outgoing.queue) == 2:
            self._outgoing.consume()


@pytest.mark.parametrize(
    ("broken", "invariant"),
    [
        (LogsTooMuch, "nothing is logged while the period is 0 or below"),
        (Forgets, "every response leaves, waits or is"),
    ],
)
def test_a_wrong_relay_is_detected(broken: type[RelayWithHistory], invariant: str) -> None:
    result = prove(replace(PROOF, make=broken))
    assert result.broken.startswith(invariant)
    assert result.way


def test_the_drawing_in_the_docs_is_that_of_the_table() -> None:
    drawn = (Path(__file__).parents[2] / "docs/pictures/relay.svg").read_text(encoding="utf-8")
    assert drawn == svg(Relay.table, "observatory: relay"), (
        "fieldtwin plc diagram observatory -o docs/pictures/relay.svg"
    )
