"""Schemas Plan, Execute, DigitalTwin."""

from __future__ import annotations

from collections import deque

import pytest
from hypothesis import given
from hypothesis import strategies as st
from shadow_rig import DECLARED, NOW_MS, Hands, status, value

from fieldtwin.gateway.core.concurrency.events import Consumer, Producer
from fieldtwin.gateway.core.statemachine import decode_period, delta, encode_period
from fieldtwin.gateway.core.values import COMMAND, DATA, Quality, Reason
from fieldtwin.gateway.store.event import Kind
from fieldtwin.twin.model.mape.execute import CommandLimits, Execute
from fieldtwin.twin.model.mape.messages import verdict
from fieldtwin.twin.model.mape.plan import Plan, Planner, PlanRule, RulePlanner
from fieldtwin.twin.model.mape.what_if import Question
from fieldtwin.twin.model.model import DigitalModel
from fieldtwin.twin.model.shadow import DigitalShadow
from fieldtwin.twin.model.thread_process import DTDigitalThreadProcess, ReceivingEnd
from fieldtwin.twin.model.twin import DigitalTwin
from fieldtwin.twin.thread.thread import Operator

PERIODS = st.integers(-32768, 32767)
RULES = (PlanRule("outside", "ctd.pressure", 1), PlanRule("inside", "ctd.pressure", 10), PlanRule("bad", "", -1))


class Always:
    """A planner in Python: for every finding, the next of its periods."""

    def __init__(self, *periods: int) -> None:
        self._periods = deque(periods)

    def plan(self, data: DATA, model: DigitalModel) -> COMMAND | None:
        return encode_period(self._periods.popleft()) if self._periods else None


class Prototype:
    """A what-if query whose answer the test sets: None for a while, then the objection to the command, or nothing."""

    def __init__(self) -> None:
        self.asked: list[tuple[int, Question]] = []
        self.says: str | None = None

    def ask(self, command: COMMAND, question: Question) -> None:
        self.asked.append((decode_period(command), question))

    def answer(self) -> str | None:
        return self.says


EMPTY = Question(3600.0, ("battery.charge > 0.1",))


class Rig:
    def __init__(
        self,
        *,
        bounds: CommandLimits = CommandLimits(),  # noqa: B008
        what_if: Prototype | None = None,
        rules: tuple[PlanRule, ...] = RULES,
        planner: Planner | None = None,
    ) -> None:
        self.clock = Hands()
        self.receiving = ReceivingEnd("from the plant")
        self.twin = DigitalTwin(
            self.receiving, self.clock, planner or RulePlanner(rules), declared=DECLARED, bounds=bounds,
            what_if=what_if, question=EMPTY if what_if else None,
        )  # fmt: skip
        self.sent: Consumer[COMMAND] = Consumer(self.twin.execute.transmitter.event)
        self.twin.execute.transmitter.subscribe(self.sent)

    def give(self, *events: object) -> list[int]:
        """Return the periods that were commanded because of these events."""
        for event in events:
            self.receiving.observe("plant:1", event)  # type: ignore[arg-type]
        self.twin.step()
        return [decode_period(command) for command in self.sent.drain()]


def test_Plan_and_Execute_are_processes_of_the_digital_twin_that_share_its_model() -> None:
    twin = Rig().twin
    for process in (twin.plan, twin.execute):
        assert isinstance(process, DTDigitalThreadProcess)
        assert process.digital_model is twin.digital_model
    assert type(twin.plan.consumer) is type(twin.execute.plans) is Consumer
    assert type(twin.plan.emitter) is type(twin.execute.transmitter) is Producer
    assert not twin.plan.consumer.queue, "empty after Init"
    assert not twin.execute.plans.queue


@given(periods=st.lists(PERIODS, max_size=10))
def test_Plan_consumes_plans_and_emits_each(periods: list[int]) -> None:
    plan = Plan(DigitalModel(), Always(*periods), Hands())
    emitted: Consumer[COMMAND] = Consumer(plan.emitter.event)
    plan.emitter.subscribe(emitted)
    for _ in periods:
        plan.consumer.observe(verdict("outside", "x", "", NOW_MS))
    plan.plan()
    assert [decode_period(c) for c in emitted.drain()] == periods
    assert not plan.consumer.queue


def test_Plan_is_rules_over_the_analysis_of_which_the_first_that_fits_decides() -> None:
    rig = Rig()
    assert rig.give(value(150.0)) == [1]
    assert rig.give(value(151.0)) == [], "what is known already is no news"
    assert rig.give(value(50.0)) == [10]
    planner = RulePlanner((PlanRule("stale", "", 5),))
    assert planner.plan(DATA(b"no verdict"), DigitalModel()) is None


def test_Plan_does_nothing_about_history() -> None:
    """Events delayed by an outage arrive late: an hour-old state must not cause a command."""
    rig = Rig()
    assert rig.give(value(150.0, NOW_MS - 3_600_000)) == []
    assert rig.twin.plan.too_old == 1


def test_Plan_does_something_about_history_as_soon_as_it_is_the_present_too() -> None:
    """An outage of the thread for an hour: a finding that began in it and persists is planned for, and one that ended in it."""
    rig = Rig(rules=(*RULES, PlanRule("stale", "", 0), PlanRule("fresh", "", 10)))
    hour_ago = NOW_MS - 3_600_000
    assert rig.give(status(60, t_ms=hour_ago), value(200.0, hour_ago)) == []
    assert rig.give(value(201.0)) == [1], "outside, still"
    assert rig.give(value(202.0)) == []
    rig.clock.now_ms += 3_600_000
    assert rig.give() == [0], "nothing was heard of it"
    assert rig.give(value(5.0, NOW_MS + 60_000)) == [10], "it is heard of again; inside, an hour ago"
    rig.twin.digital_model.process_event(encode_period(1))
    assert rig.give(value(5.0, rig.clock.now_ms)) == [10], "inside"


def test_DigitalTwin_begins_again_where_it_ended() -> None:
    """The twin's knowledge of the plant is its model; a deviation is planned for when the plant reports its current state."""
    rig = Rig()
    rig.twin.recall([status(1, t_ms=NOW_MS - 60_000), value(200.0, NOW_MS - 60_000)])
    seen = rig.twin.describe()
    assert (seen["state"], seen["period_s"], seen["wrong"]) == ("ACTIVE", 1, {"ctd.pressure": ["outside"]})
    assert (seen["measurements"], seen["statuses"], seen["backfilled"]) == (0, 0, 0), "nothing has come yet"
    assert rig.give() == []
    assert rig.give(value(5.0)) == [10], "it came back while nobody looked"
    rig.twin.recall([status(1), value(200.0)])
    assert rig.give(value(201.0)) == [], "the model has that period"
    assert rig.twin.digital_model.variables["ctd.pressure"].value == 201.0
    rig.twin.recall([status(60), value(200.0)])
    assert rig.give(value(201.0)) == [1], "it died between what it found and what it would have commanded"
    assert [(v.finding, v.again) for v in rig.twin.verdicts.drain()][-1] == ("outside", True)


@given(x=PERIODS, before=PERIODS)
def test_Execute_asks_the_model_first_and_emits_the_command_if_and_only_if_it_accepts(x: int, before: int) -> None:
    """Ruling 9, and prose, row 7: no user intervenes."""
    model = DigitalModel()
    model.process_event(encode_period(before))
    execute = Execute(model, Hands(), bounds=CommandLimits(0, 3600))
    emitted: Consumer[COMMAND] = Consumer(execute.transmitter.event)
    execute.transmitter.subscribe(emitted)
    execute.plans.observe(encode_period(x))
    execute.execute()
    sent = [decode_period(c) for c in emitted.drain()]
    accepted = 0 <= x <= 3600
    assert sent == ([x] if accepted else []), "the command, not the state"
    assert model.period_s == (x if accepted else before)
    assert model.state is delta(model.period_s)
    refusals = [e for e in execute.collect() if e.kind == Kind.REFUSAL]
    assert len(refusals) == (not accepted)


@pytest.mark.parametrize(
    ("command", "why"), [(COMMAND(b"\0"), "expected 2 bytes"), (encode_period(9999), "allowed are -1 to 3600 s")]
)
def test_Execute_keeps_a_refusal_with_its_reason(command: COMMAND, why: str) -> None:
    execute = Execute(DigitalModel(), Hands(), bounds=CommandLimits(-1, 3600))
    execute.plans.observe(command)
    execute.execute()
    (refusal,) = execute.collect()
    assert why in str(refusal.value)
    assert (execute.sent, execute.refused) == (0, 1)


def test_Execute_is_bounded_in_rate() -> None:
    clock = Hands()
    execute = Execute(DigitalModel(), clock, bounds=CommandLimits(per_minute=2))
    for n in range(3):
        execute.plans.observe(encode_period(n))
    execute.execute()
    assert (execute.sent, execute.refused) == (2, 1)
    clock.now_ms += 60_001
    execute.plans.observe(encode_period(7))
    execute.execute()
    assert execute.sent == 3


def test_Execute_asks_a_prototype_if_configured_and_sends_nothing_without_its_answer() -> None:
    rig = Rig(what_if=(prototype := Prototype()))
    assert rig.give(value(150.0)) == []
    assert rig.give() == [], "no answer yet"
    assert rig.twin.digital_model.period_s == 0, "nor does the model change"
    assert prototype.asked == [(1, EMPTY)], "once"
    prototype.says = ""
    assert rig.give() == [1]
    prototype.says = "the battery would be empty"
    assert rig.give(value(50.0)) == []
    assert rig.twin.digital_model.period_s == 1
    assert [e.value for e in rig.twin.execute.collect()] == ["period 10 s: the battery would be empty"]
    assert rig.twin.describe() | {"asked": 2, "sent": 1, "refused": 1} == rig.twin.describe()


def test_Execute_asks_the_model_before_the_prototype() -> None:
    rig = Rig(bounds=CommandLimits(5, 60), what_if=(prototype := Prototype()))
    assert rig.give(value(150.0)) == []
    assert prototype.asked == []
    assert [e.value for e in rig.twin.execute.collect()] == ["a period of 1 s; allowed are 5 to 60 s"]


def test_Plan_says_what_is_asked_and_of_which_commands_nothing_is() -> None:
    own = Question(60.0, finally_=("relay.state == 'STANDBY'",))
    rules = (PlanRule("bad", "", 0, ask=False), PlanRule("outside", "", 1, ask=own), PlanRule("inside", "", 10))
    rig = Rig(what_if=(prototype := Prototype()), rules=rules)
    prototype.says = ""
    bad = value(None, quality=Quality.BAD, reason=Reason.TIMEOUT)
    assert rig.give(value(150.0), value(50.0), bad) == [1, 10, 0]
    assert prototype.asked == [(1, own), (10, EMPTY)]
    nobody = Rig(rules=rules)
    assert nobody.give(value(150.0), value(50.0)) == [10], "a question that nobody can ask is not left out"
    assert "this process cannot run one" in str(nobody.twin.execute.collect()[0].value)


def test_Plan_what_is_found_while_a_prototype_is_asked_waits_and_of_one_subject_the_newest_counts() -> None:
    rig = Rig(what_if=(prototype := Prototype()))
    rig.give(value(150.0))
    for number in (50.0, 150.0) * 20 + (50.0,):
        assert rig.give(value(number, rig.clock.now_ms)) == []
        rig.clock.now_ms += 1000  # 41 s old, but not history: it was new when it arrived
    prototype.says = ""
    assert rig.give() == [1, 10]
    assert [period_s for period_s, _ in prototype.asked] == [1, 10]
    assert rig.twin.plan.overtaken == 40


def test_Execute_of_a_twin_that_ends_sends_nothing_of_what_it_still_asks_about() -> None:
    rig = Rig(what_if=Prototype())
    rig.give(value(150.0))
    rig.twin.execute.plans.observe(encode_period(7))
    rig.twin.execute.give_up("the twin ended")
    assert [e.value for e in rig.twin.execute.collect()] == [
        "period 1 s: the twin ended",
        "period 7 s: the twin ended",
    ]
    assert not rig.twin.execute.asking
    assert not rig.sent.queue


def test_DigitalTwin_is_the_shadow_plus_plan_and_execute_and_the_way_back() -> None:
    rig, shadow = Rig(), DigitalShadow(ReceivingEnd("x"), Hands(), declared=())
    twin = rig.twin
    assert isinstance(twin, DigitalShadow)
    assert [p.name for p in twin.processes] == ["monitor", "analyze", "plan", "execute"]
    assert [p.name for p in shadow.processes] == ["monitor", "analyze"]
    assert not any(hasattr(shadow, name) for name in ("plan", "execute")), "a shadow has no way back"
    twin.plan.emitter.emit(encode_period(7))
    twin.execute.execute()
    (command,) = rig.sent.drain()
    operator = Operator("operator", Hands())
    assert isinstance(operator, DTDigitalThreadProcess)
    operator.command(command)
    (event,) = operator.collect()
    assert (event.kind, event.value) == (Kind.COMMAND, encode_period(7).data), (
        "what Plan emits is what the thread is given"
    )


def test_DigitalTwin_changes_of_the_model_reach_the_plant_and_those_of_the_plant_the_model_without_a_user() -> None:
    """Prose, rows 5 to 7: Monitor, Analyze, Plan and Execute run one after another in one step."""
    rig = Rig()
    assert rig.give(status(5), value(150.0)) == [1]
    assert rig.twin.digital_model.period_s == 1, "the model has what was commanded"
    assert rig.give(status(1)) == []
    assert rig.give(status(3)) == [], "somebody at the plant: the model follows"
    assert rig.twin.digital_model.period_s == 3


class Deep:
    """A planner in Python that reads the model's variables: sample each second while the pressure is below 80 dbar."""

    def plan(self, data: DATA, model: DigitalModel) -> COMMAND | None:
        pressure = model.variables["ctd.pressure"]
        deep = pressure.good and isinstance(pressure.value, float) and pressure.value > 80.0
        return encode_period(1) if deep and model.period_s != 1 else None


def test_DigitalTwin_a_planner_is_given_the_variables_as_they_were_reported_and_may_rely_on_their_quality() -> None:
    rig = Rig(planner=Deep())
    assert rig.give(value(120.0, quality=Quality.BAD, reason=Reason.TIMEOUT), status(60)) == [], (
        "bad: nobody relies on it"
    )
    assert rig.give(value(50.0), status(60)) == []
    assert rig.give(value(90.0), status(60)) == [1], "not outside of its limits: no rule would have seen it"
