"""The alarm list of a gateway: the quality of an alarm, the actions of users, and when conditions are evaluated."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.gateway.core.conditions.expression import Expression
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.gateway.runtime.alarms.alarm_list import AlarmConfig, AlarmList
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.tags import TagTable

NAMES = ("tank.level", "tank.backup", "pump.full")


class StepClock:
    """A clock that the test sets."""

    now_ns = NS_PER_S

    def monotonic_ns(self) -> int:
        return self.now_ns

    def utc_ns(self) -> int:
        return self.now_ns

    async def sleep_until_ns(self, t_ns: int) -> None:
        raise NotImplementedError


class Bench:
    """An alarm list with one alarm on values that the test stores. `put` and `after` let the gateway's next cycle follow."""

    def __init__(self, folder: Path, condition: str, stale_after_ms: int | None = None, **more: int) -> None:
        self.clock = StepClock()
        self.tags = TagTable(self.clock)
        self.tags.declare(["tank.level", "tank.backup"], stale_after_ms)
        self.audit = folder / "audit.jsonl"
        config = AlarmConfig("a", Expression(condition, NAMES), "high", **more)
        self.log = AuditLog(self.audit, self.clock)
        self.alarms = AlarmList([config], self.tags, self.log)
        self.outputs: dict[str, TagValue] = {}
        self.plc_alive = True
        self.after(0)

    def put(self, tag: str, value: float | None, quality: Quality = Quality.GOOD) -> None:
        self.clock.now_ns += 1  # two samples of a device have different times
        reason = Reason.NONE if quality is Quality.GOOD else Reason.TIMEOUT
        self.tags.put(tag, TagValue(value, quality, reason, self.clock.now_ns))
        self.after(0)

    def after(self, s: float) -> None:
        self.clock.now_ns += int(s * NS_PER_S)
        self.alarms.tick(self.clock.now_ns, self.outputs, plc_alive=self.plc_alive)

    @property
    def now(self) -> tuple[str, str, str]:
        event = self.alarms.present("a")
        return event.state, event.quality, event.reason


Made = Callable[..., Bench]


@pytest.fixture
def made(tmp_path: Path) -> Iterator[Made]:
    """Return a function that makes a bench, whose audit log is closed after the test."""
    with ExitStack() as stack:

        def make(condition: str, **more: int) -> Bench:
            bench = Bench(tmp_path, condition, **more)
            stack.callback(bench.log.close)
            return bench

        yield make


def test_an_alarm_on_a_value_that_was_never_read_is_not_good(made: Made) -> None:
    assert made("tank.level > 5").now == ("normal", "bad", "never_read")


def test_a_bad_value_keeps_the_state_of_the_alarm_with_bad_quality(made: Made) -> None:
    bench = made("tank.level > 5")
    bench.put("tank.level", 9)
    bench.put("tank.level", 1, Quality.BAD)
    assert bench.now == ("active_unacknowledged", "bad", "timeout")
    bench.put("tank.level", 1)
    assert bench.now == ("returned_unacknowledged", "good", "none")


def test_a_stale_value_makes_the_quality_bad_without_a_new_value(made: Made) -> None:
    bench = made("tank.level > 5", stale_after_ms=1000)
    bench.put("tank.level", 9)
    bench.after(1.0)
    assert bench.now[1] == "good"
    bench.after(0.001)
    assert bench.now == ("active_unacknowledged", "bad", "stale")


def test_the_same_sample_read_again_makes_a_stale_alarm_good(made: Made) -> None:
    bench = made("tank.level > 5", stale_after_ms=1000)
    sample = TagValue(9, Quality.GOOD, Reason.NONE, NS_PER_S)
    bench.tags.put("tank.level", sample)
    bench.after(3)
    assert bench.now[1] == "bad"
    bench.tags.put("tank.level", sample)  # the tag table reports no change, because it is the same sample
    bench.after(0)
    assert bench.now == ("active_unacknowledged", "good", "none")


def test_a_shorter_age_limit_after_a_reload_counts_at_once(made: Made) -> None:
    bench = made("tank.level > 5", stale_after_ms=600_000)
    bench.put("tank.level", 9)
    bench.tags.restate("tank.level", 1000)
    bench.alarms.look_again()
    bench.after(0)
    bench.after(1.001)
    assert bench.now == ("active_unacknowledged", "bad", "stale")


def test_a_bad_value_on_which_the_result_does_not_depend_leaves_it_good(made: Made) -> None:
    bench = made("tank.level > 5 or tank.backup > 5")
    bench.put("tank.backup", 9)
    assert bench.now == ("active_unacknowledged", "good", "none")
    bench.put("tank.backup", 1)
    assert bench.now == ("active_unacknowledged", "bad", "never_read")


def test_an_uncertain_value_makes_the_alarm_uncertain(made: Made) -> None:
    bench = made("tank.level > 5")
    bench.put("tank.level", 9, Quality.UNCERTAIN)
    assert bench.now == ("active_unacknowledged", "uncertain", "none")


def test_variables_of_a_program_are_unknown_while_the_plc_does_not_run(made: Made) -> None:
    bench = made("pump.full")
    bench.outputs = {"pump.full": TagValue(True, Quality.GOOD, Reason.NONE, NS_PER_S)}
    bench.after(0)
    assert bench.now == ("active_unacknowledged", "good", "none")
    bench.plc_alive = False
    bench.after(0)
    assert bench.now == ("active_unacknowledged", "bad", "not_operational")


def test_the_quality_of_a_value_is_always_known(made: Made) -> None:
    assert made("quality(tank.level) == 'bad'").now == ("active_unacknowledged", "good", "none")


def test_a_shelved_alarm_returns_when_its_time_is_over(made: Made) -> None:
    bench = made("tank.level > 5")
    bench.alarms.shelve("a", 60, "operator", bench.clock.now_ns)
    bench.put("tank.level", 9)
    bench.after(59.999)
    assert bench.now[0] == "shelved"
    assert bench.alarms.statuses(bench.clock.now_ns)["a"].shelved_for_s == pytest.approx(0.001, abs=1e-6)
    bench.after(0.001)
    assert bench.now[0] == "active_unacknowledged"


def test_actions_of_users_are_in_the_audit_log(made: Made) -> None:
    bench = made("tank.level > 5")
    bench.put("tank.level", 9)
    bench.alarms.acknowledge("a", "jo", bench.clock.now_ns)
    bench.alarms.shelve("a", 5, "jo", bench.clock.now_ns)
    bench.alarms.unshelve("a", "jo", bench.clock.now_ns)
    entries = [json.loads(line) for line in bench.audit.read_text().splitlines()]
    assert [(e["action"], e["device"], e["by"]) for e in entries] == [
        ("acknowledge", "alarm.a", "jo"),
        ("shelve", "alarm.a", "jo"),
        ("unshelve", "alarm.a", "jo"),
    ]


def test_actions_that_make_no_sense_are_refused_and_change_nothing(made: Made) -> None:
    bench = made("tank.level > 5")
    now_ns = bench.clock.now_ns
    with pytest.raises(UsageError, match="nothing to acknowledge"):
        bench.alarms.acknowledge("a", "jo", now_ns)
    with pytest.raises(UsageError, match="no alarm 'b'"):
        bench.alarms.acknowledge("b", "jo", now_ns)
    with pytest.raises(UsageError, match="is not shelved"):
        bench.alarms.unshelve("a", "jo", now_ns)
    for for_s in (0, -1, 86_401, float("nan"), float("inf")):
        with pytest.raises(UsageError, match="the time for which alarm 'a' is shelved"):
            bench.alarms.shelve("a", for_s, "jo", now_ns)
    assert bench.now[0] == "normal"
    assert not bench.audit.read_text()


def test_cycles_before_the_end_of_a_delay_may_be_skipped_and_the_one_at_its_end_not(made: Made) -> None:
    bench = made("tank.level > 5", on_delay_ms=100)
    bench.put("tank.level", 9)
    due_ns = bench.clock.now_ns + 100 * NS_PER_MS
    assert bench.alarms.repeats_until(due_ns)
    assert not bench.alarms.repeats_until(due_ns + 1)
    bench.after(0.1)
    assert bench.now[0] == "active_unacknowledged"
    assert bench.alarms.repeats_until(due_ns + NS_PER_S)


def test_changes_of_an_alarm_are_numbered(made: Made) -> None:
    bench = made("tank.level > 5")
    bench.put("tank.level", 1)
    bench.put("tank.level", 9)
    assert [(e.number, e.state, e.quality) for e in bench.alarms.events_since(0)] == [
        (1, "normal", "good"),
        (2, "active_unacknowledged", "good"),
    ]
    assert [e.number for e in bench.alarms.events_since(1)] == [2]
