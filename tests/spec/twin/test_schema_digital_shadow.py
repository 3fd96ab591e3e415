"""Schemas Monitor, Analyze, DigitalShadow."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from shadow_rig import DECLARED, NOW_MS, Hands, status, value

from fieldtwin.cli.twin.shadow_command import variables_text
from fieldtwin.gateway.core.concurrency.events import Consumer, Producer
from fieldtwin.gateway.core.statemachine import STATE_CODES, delta
from fieldtwin.gateway.core.values import DATA, STATUS, Quality, Reason
from fieldtwin.gateway.store.event import Event, Kind
from fieldtwin.twin.model.mape.messages import AnalysisFinding, SeenMeasurement, SeenStatus
from fieldtwin.twin.model.mape.monitor import Monitor
from fieldtwin.twin.model.model import DigitalModel
from fieldtwin.twin.model.shadow import DigitalShadow
from fieldtwin.twin.model.status import decode_status, encode_status
from fieldtwin.twin.model.thread_process import DTDigitalThreadProcess, ReceivingEnd

PERIODS = st.integers(-32768, 32767)


class Rig:
    """A shadow, its inputs, and its output."""

    def __init__(self) -> None:
        self.clock = Hands()
        self.receiving = ReceivingEnd("from the plant")
        self.shadow = DigitalShadow(self.receiving, self.clock, declared=DECLARED, stale_after_ms=30_000)

    def give(self, *events: Event) -> list[AnalysisFinding]:
        for event in events:
            self.receiving.observe("plant:1", event)
        self.shadow.step()
        return list(self.shadow.verdicts.drain())


def test_Monitor_is_a_process_with_two_consumers_and_a_producer() -> None:
    model = DigitalModel()
    monitor = Monitor(model, Hands())
    assert isinstance(monitor, DTDigitalThreadProcess)
    assert type(monitor.statuses) is type(monitor.measurements) is Consumer
    assert monitor.statuses is not monitor.measurements
    assert type(monitor.emitter) is Producer
    assert monitor.digital_model is model
    assert not monitor.statuses.queue, "empty after Init"
    assert not monitor.measurements.queue


@given(periods=st.lists(PERIODS, min_size=1, max_size=20))
def test_Monitor_handleState_consumes_lets_the_model_process_and_emits_each(periods: list[int]) -> None:
    monitor = Monitor(DigitalModel(), Hands())
    seen: Consumer[DATA] = Consumer(monitor.emitter.event)
    monitor.emitter.subscribe(seen)
    for period_s in periods:
        monitor.arrived(status(period_s), NOW_MS)
    monitor.handle_state()
    assert [decode_status(s.data)[1] for s in seen.drain()] == periods
    assert (monitor.digital_model.period_s, monitor.digital_model.state) == (periods[-1], delta(periods[-1]))
    assert not monitor.statuses.queue


@given(numbers=st.lists(st.floats(allow_nan=False), max_size=20), before=PERIODS)
def test_Monitor_handleMeasurements_emits_each_and_leaves_the_model(numbers: list[float], before: int) -> None:
    monitor = Monitor(DigitalModel(DECLARED), Hands())
    monitor.arrived(status(before), NOW_MS)
    monitor.handle_state()
    seen: Consumer[DATA] = Consumer(monitor.emitter.event)
    monitor.emitter.subscribe(seen)
    for number in numbers:
        monitor.arrived(value(number), NOW_MS)
    monitor.handle_measurements()
    emitted = list(seen.drain())
    assert [m.event.value for m in emitted if isinstance(m, SeenMeasurement)] == numbers
    assert len(emitted) == len(numbers)
    assert monitor.digital_model.period_s == before
    assert not monitor.digital_model.variables["ctd.pressure"].heard, (
        "its variables listen; Monitor does not touch them"
    )


@pytest.mark.parametrize("data", [b"", b"\7\0\1", b"\0\0\1\0"])
def test_Monitor_reports_an_invalid_status_that_changes_nothing(data: bytes) -> None:
    rig = Rig()
    rig.give(status(5))
    (told,) = rig.give(Event(2, NOW_MS, Kind.STATE, "relay", data))
    assert told.finding == "unreadable"
    assert rig.shadow.digital_model.period_s == 5


@given(reported=st.sampled_from(sorted(STATE_CODES)), period_s=PERIODS)
def test_Analyze_compares_the_reported_state_with_the_models_and_emits_the_verdict(
    reported: str, period_s: int
) -> None:
    """Ruling 7: a STATUS carries state and period; a mismatch between them is itself a finding."""
    rig = Rig()
    (told,) = rig.give(status(period_s, reported))
    assert told.finding == ("agree" if delta(period_s).name == reported else "mismatch")
    assert rig.shadow.analyze.check_statuses(SeenStatus(encode_status(reported, period_s).data)) is told.fine
    assert rig.shadow.describe()["agreement"] == (1.0 if told.fine else 0.0)


def test_Analyze_every_status_has_its_own_verdict_against_the_model_as_it_was_then() -> None:
    told = Rig().give(status(5), status(0), status(3, "OFF"), status(-1))
    assert [v.finding for v in told] == ["agree", "agree", "mismatch", "agree"]


def test_Analyze_reports_once_each_that_a_value_is_outside_of_the_model_bad_or_stale_and_that_it_recovered() -> None:
    rig = Rig()
    assert rig.give(value(50.0)) == []
    assert [v.finding for v in rig.give(value(150.0), value(151.0))] == ["outside"]
    assert [v.finding for v in rig.give(value(99.0))] == ["inside"]
    assert [v.finding for v in rig.give(value(None, quality=Quality.BAD, reason=Reason.TIMEOUT))] == ["bad"]
    assert [v.finding for v in rig.give(value(99.0))] == ["good"]
    rig.clock.now_ms += 31_000
    assert [v.finding for v in rig.give()] == ["stale"]
    assert rig.give() == []
    assert [v.finding for v in rig.give(value(99.0, rig.clock.now_ms))] == ["fresh"]
    assert rig.shadow.describe()["wrong"] == {}
    verdicts = [e.value for e in rig.shadow.analyze.collect()]
    assert [str(v).partition(":")[0] for v in verdicts] == ["outside", "bad", "stale"], (
        "what is wrong becomes knowledge"
    )


def test_Analyze_measures_rate_and_lag_of_twinning_and_leaves_out_what_was_backfilled() -> None:
    """Prose, row 10."""
    rig = Rig()
    rig.give(value(1.0, NOW_MS - 1))
    for n in range(1, 12):
        rig.clock.now_ms = NOW_MS + 100 * n
        rig.give(value(1.0, rig.clock.now_ms - 40))
    rig.give(value(1.0, NOW_MS - 3_600_000))
    figures = rig.shadow.describe()
    assert figures["twinning_rate_hz"] == pytest.approx(10.0)
    assert figures["lag_ms"] == {"median": 40, "p95": 40, "max": 40}
    assert figures["backfilled"] == 2, "of an hour ago, and of before the shadow began"


def test_DigitalShadow_has_a_model_of_its_own_processes_and_a_connection_that_only_receives() -> None:
    """Rulings 8 and 16: it is given a queue."""
    rig, other = Rig(), Rig()
    assert type(rig.shadow.digital_model) is DigitalModel
    assert rig.shadow.digital_model is not other.shadow.digital_model
    assert all(isinstance(process, DTDigitalThreadProcess) for process in rig.shadow.processes)
    assert type(rig.shadow.receiving) is ReceivingEnd
    assert rig.shadow.monitor.digital_model is rig.shadow.analyze.digital_model is rig.shadow.digital_model


def test_DigitalShadow_can_reach_nothing_that_sends() -> None:
    """Prose, row 4, by construction: from the shadow, through every attribute, no object leads to a thread's end, a link, a
    driver or a command. The import contract in pyproject.toml requires the same of its modules."""
    seen: set[int] = set()
    kinds: set[str] = set()

    def walk(thing: object) -> None:
        if id(thing) in seen or isinstance(thing, type | str | bytes | int | float | None):
            return
        seen.add(id(thing))
        kinds.add(type(thing).__name__)
        if isinstance(thing, dict):
            parts = [*thing.keys(), *thing.values()]
        elif isinstance(thing, list | tuple | set | frozenset) or hasattr(thing, "popleft"):
            parts = list(thing)  # type: ignore[call-overload]
        else:
            names = [*getattr(thing, "__dict__", {}), *getattr(type(thing), "__slots__", ())]
            parts = [getattr(thing, name) for name in names if isinstance(name, str) and hasattr(thing, name)]
        for part in parts:
            walk(part)

    rig = Rig()
    rig.receiving.observe("plant:1", status(5))
    walk(rig.shadow)
    assert {"Monitor", "Analyze", "DigitalModel", "ReceivingEnd"} <= kinds
    assert not kinds & {
        "ThreadEnd",
        "Outgoing",
        "Link",
        "TransmitterDriver",
        "Operator",
        "COMMAND",
        "function",
        "method",
    }
    source = Path(__file__).resolve().parents[3] / "twin" / "model"
    for module in ("shadow.py", "mape/monitor.py", "mape/analyze.py"):
        names = {n.id for n in ast.walk(ast.parse((source / module).read_text())) if isinstance(n, ast.Name)}
        assert "COMMAND" not in names


def test_DigitalShadow_updates_its_model_from_everything_that_it_receives() -> None:
    """Prose, row 5."""
    rig = Rig()
    for period_s in (1, 2, 0, -1):
        rig.give(status(period_s), value(float(period_s)))
        assert rig.shadow.digital_model.period_s == period_s
        assert rig.shadow.digital_model.variables["ctd.pressure"].value == period_s
    rig.give(Event(9, NOW_MS, Kind.PAYLOAD, "ctd.sample", b"\1\2"))
    assert rig.shadow.digital_model.variables["ctd.sample"].value == b"\1\2"
    assert issubclass(SeenStatus, STATUS), "it reuses the physical twin's message types"


def test_DigitalShadow_holds_each_declared_variable_with_quality_and_time_as_it_was_reported_last() -> None:
    rig = Rig()
    variables = rig.shadow.digital_model.variables
    never = {"value": None, "unit": "dbar", "quality": "bad", "reason": "never read", "t_ms": None}
    assert rig.shadow.describe()["variables"]["ctd.pressure"] == never
    rig.give(value(50.0, NOW_MS - 7))
    assert rig.shadow.describe()["variables"]["ctd.pressure"] == {
        "value": 50.0, "unit": "dbar", "quality": "good", "reason": "none", "t_ms": NOW_MS - 7,
    }  # fmt: skip
    rig.give(value(50.0, quality=Quality.BAD, reason=Reason.TIMEOUT))
    assert (variables["ctd.pressure"].value, variables["ctd.pressure"].reason) == (50.0, Reason.TIMEOUT)
    rig.give(value(51.0))
    assert variables["ctd.pressure"].good
    rig.clock.now_ms += 31_000
    rig.give()
    assert (variables["ctd.pressure"].value, variables["ctd.pressure"].reason) == (51.0, Reason.STALE), (
        "never good: old"
    )
    assert not variables["ctd.sample_count"].heard


def test_DigitalShadow_has_its_variables_kept_up_before_a_verdict_on_them_is_reached() -> None:
    rig, seen = Rig(), []

    class Looks(Consumer[AnalysisFinding]):
        def observe(self, item: AnalysisFinding) -> None:
            seen.append((item.finding, rig.shadow.digital_model.variables["ctd.pressure"].value))

    rig.shadow.analyze.emitter.subscribe(Looks(rig.shadow.analyze.emitter.event))
    rig.give(value(150.0), value(50.0))
    assert seen == [("outside", 150.0), ("inside", 50.0)]


def test_DigitalShadow_what_the_system_does_not_declare_is_no_part_of_its_model_and_is_counted() -> None:
    rig = Rig()
    rig.give(value(1.0)._replace(name="somebody.else"))
    assert list(rig.shadow.digital_model.variables) == [variable.name for variable in DECLARED]
    assert rig.shadow.describe()["undeclared"] == 1
    seen = rig.shadow.describe()
    assert variables_text(seen["variables"], seen["undeclared"]) == (
        "3, 0 of them received, 0 good; 1 values of tags that it does not declare"
    )


def test_Analyze_a_quality_and_a_reason_that_a_newer_plant_knows_are_bad_and_unnamed() -> None:
    """Both are numbers on the wire, whose range exceeds the known values."""
    rig = Rig()
    (told,) = rig.give(value(1.0)._replace(quality=7, reason=31))
    assert (told.finding, told.text) == ("bad", "ctd.pressure is bad: none")
    assert rig.shadow.digital_model.variables["ctd.pressure"].quality is Quality.BAD


def test_DigitalShadow_is_bounded_and_counts_what_it_drops() -> None:
    receiving = ReceivingEnd("from the plant", capacity=3)
    for n in range(5):
        receiving.observe("plant:1", value(n))
    assert ([e.value for _, e in receiving.queue], receiving.dropped) == ([2, 3, 4], 2)
