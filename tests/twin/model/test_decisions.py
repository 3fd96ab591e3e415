"""The decisions of a twin: each finding with the plan that follows from it, and why it was sent or refused."""

from __future__ import annotations

from itertools import count

from fieldtwin.gateway.core.statemachine import encode_period
from fieldtwin.gateway.core.values import COMMAND
from fieldtwin.twin.model.mape.decisions import MOST, DecisionLog
from fieldtwin.twin.model.mape.messages import AnalysisFinding, verdict
from fieldtwin.twin.model.mape.what_if import Question

NUMBERS = count(1)


def outside() -> AnalysisFinding:
    return verdict("outside", "ctd.pressure", f"ctd.pressure is {next(NUMBERS)}", 1000)


def test_a_finding_without_a_plan_is_kept_as_observed() -> None:
    log = DecisionLog()
    log.observed(outside(), "too old")
    [decision] = log.newest(10)
    assert (decision.finding, decision.subject, decision.t_ms) == ("outside", "ctd.pressure", 1000)
    assert (decision.plan, decision.outcome, decision.reason) == ("", "observed", "too old")


def test_an_agreement_is_kept_once_for_each_state() -> None:
    log = DecisionLog()
    for text in ("STANDBY, period 0 s", "STANDBY, period 0 s", "ACTIVE, period 2 s", "ACTIVE, period 2 s"):
        log.observed(verdict("agree", "relay", text, 1))
    log.observed(verdict("mismatch", "relay", "the plant reports OFF", 2))
    log.observed(verdict("agree", "relay", "ACTIVE, period 2 s", 3))
    assert [d.observed for d in log.newest(10)] == [
        "STANDBY, period 0 s",
        "ACTIVE, period 2 s",
        "the plant reports OFF",
        "ACTIVE, period 2 s",
    ]


def test_a_plan_belongs_to_its_finding_and_is_sent() -> None:
    log, finding, command = DecisionLog(), outside(), encode_period(5)
    log.observed(outside())
    log.observed(finding)
    log.planned(command, 1100, finding)
    assert [d.outcome for d in log.newest(10)] == ["observed", "waiting"]
    log.settled(command, "", 1200)
    _, sent = log.newest(10)
    assert (sent.observed, sent.plan, sent.outcome) == (finding.text, "period 5 s", "sent")
    assert (sent.reason, sent.settled_ms) == ("the model accepts it", 1200)


def test_a_simulated_command_is_refused_with_the_objection() -> None:
    log, command = DecisionLog(), encode_period(60)
    log.planned(command, 1000, None)
    log.asked(command, Question(300.0, ("relay.dropped == 0",)))
    [asked] = log.newest(1)
    assert (asked.finding, asked.outcome, asked.reason) == ("by hand", "simulating", "a prototype runs 300 s ahead")
    log.settled(command, "not met: relay.dropped == 0", 2000)
    assert (asked.outcome, asked.reason) == ("refused", "not met: relay.dropped == 0")


def test_equal_commands_are_told_apart_and_settled_in_order() -> None:
    log, first, second = DecisionLog(), COMMAND(b"\x00\x02"), COMMAND(b"\x00\x02")
    for command in (first, second):
        log.planned(command, 1, None)
    log.settled(first, "refused", 2)
    log.settled(second, "", 3)
    assert [d.outcome for d in log.newest(10)] == ["refused", "sent"]


def test_a_planner_that_fails_and_a_plant_that_refuses_are_refusals() -> None:
    log, finding = DecisionLog(), outside()
    log.observed(finding)
    log.failed(finding, "the planner failed", 5)
    log.refused_by_plant("the plant is switched to local", 6)
    assert [(d.outcome, d.reason) for d in log.newest(10)] == [
        ("refused", "the planner failed"),
        ("refused", "the plant is switched to local"),
    ]


def test_the_log_is_bounded_and_counts_what_it_forgets() -> None:
    log = DecisionLog()
    for _ in range(MOST + 10):
        log.observed(outside())
    assert log.count == MOST + 10
    assert len(log.newest(10_000)) == MOST
    assert [d.number for d in log.newest(2)] == [MOST + 9, MOST + 10]
