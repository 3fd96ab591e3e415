"""A digital twin that queries a prototype before it commands: its initial state, its answer, and that a missing answer counts
as no."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from support import eventually, run

from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.errors import FileInvalid, Unreachable, UsageError
from fieldtwin.gateway.core.statemachine import encode_period
from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.gateway.store.event import Event, Kind
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.run.shadow.rules import load_planner, questions_of
from fieldtwin.run.what_if.asked import objection
from fieldtwin.run.what_if.asking import Asking, ForkSubject, QuestionMessage
from fieldtwin.run.what_if.last_known import LastKnown
from fieldtwin.twin.model.mape.execute import CommandLimits, Execute
from fieldtwin.twin.model.mape.messages import verdict
from fieldtwin.twin.model.mape.what_if import PlannedCommand, Question
from fieldtwin.twin.model.model import DigitalModel
from fieldtwin.twin.model.status import encode_status
from fieldtwin.twin.site.system import load_system

OBSERVATORY = load_system("observatory")
DEEP = (
    Event(1, 1000, Kind.VALUE, "ctd.pressure", 250.0),
    Event(2, 1000, Kind.STATE, "relay", encode_status("ACTIVE", 1).data),
)
STAYS_ACTIVE = Question(6.0, ("relay.state == 'ACTIVE'",), settle_s=3.0)


def asked(period_s: int, **other: object) -> QuestionMessage:
    form = {"horizon_s": 6.0, "require": ("relay.state == 'ACTIVE'",), "finally_": (), "settle_s": 3.0, **other}
    known = {"values": {"ctd.pressure": 250.0}, "programs": {"relay": {"period": 1, "period_s": 1, "state": 1}}}
    return QuestionMessage(system="observatory", period_s=period_s, **known, **form)  # type: ignore[arg-type]


def test_a_command_that_keeps_the_requirements_has_no_objection_and_a_different_one_has() -> None:
    assert objection(asked(2)) == ""
    assert objection(asked(0)) == "\"relay.state == 'ACTIVE'\" does not hold 3 s from now; then relay.state: 'STANDBY'"
    at_the_end = objection(asked(2, require=(), finally_=("value(ctd.pressure) < 5",)))
    assert "does not hold 6 s from now; at the end ctd.pressure: 2" in at_the_end, "it went on from what was known"


def test_an_impossible_query_is_an_objection_too() -> None:
    assert "no tag or variable 'ctd.presure'" in objection(asked(2, require=("ctd.presure > 1",), only_check=True))
    assert "the horizon" in objection(asked(2, horizon_s=0.0, only_check=True))
    assert objection(asked(2, only_check=True)) == ""


def test_the_last_known_is_the_newest_of_each_name_and_nothing_that_turned_bad() -> None:
    known = LastKnown(OBSERVATORY)
    assert known.unknown == "the state of relay"
    known.take(DEEP)
    known.take([Event(9, 900, Kind.VALUE, "ctd.pressure", 1.0), Event(3, 2000, Kind.VALUE, "ctd.temperature", 8.0)])
    known.take([Event(4, 2100, Kind.VALUE, "ctd.temperature", None, Quality.BAD, Reason.TIMEOUT)])
    known.take([Event(5, 2200, Kind.VALUE, "elsewhere.x", 1.0), Event(6, 2300, Kind.STATE, "relay", b"none")])
    found = known.state("")
    assert dict(found.values) == {"ctd.pressure": 250.0}
    assert found.programs["relay"] == {"period": 1, "period_s": 1, "state": 1}
    assert known.unknown == ""


def test_a_state_that_does_not_follow_from_its_period_is_used_as_reported() -> None:
    known = LastKnown(OBSERVATORY)
    known.take([Event(1, 1, Kind.STATE, "relay", encode_status("OFF", 5).data)])
    assert known.state("").programs["relay"] == {"period": 5, "period_s": 5, "state": 2}


@pytest.mark.long
def test_a_twin_queries_in_a_separate_process_and_an_unanswered_command_is_refused() -> None:
    """Real processes: a forbidden command, an allowed one, and one without an answer in time."""

    async def main() -> tuple[list[str], list[bytes], list[int]]:
        told: list[int] = []
        asking = Asking(ForkSubject(OBSERVATORY), WallClock(), 30.0, on_ask=lambda c, q: told.append(c.data[-1]))
        execute = Execute(DigitalModel(), WallClock(), bounds=CommandLimits(), what_if=asking, question=STAYS_ACTIVE)
        sent: list[bytes] = []
        execute.transmitter.emit = lambda command: sent.append(command.data)  # type: ignore[method-assign]
        with pytest.raises(UsageError, match=r"did you mean 'ctd\.pressure'"):
            await asking.check([Question(1.0, ("ctd.presure > 1",))])
        asking.known.take(DEEP)
        for command in (encode_period(0), encode_period(2)):
            execute.plans.observe(command)

        def settled(count: int) -> bool:
            execute.execute()
            return execute.sent + execute.refused == count

        async with Nursery() as nursery:
            nursery.start(asking.run(), "what if")
            await eventually(lambda: settled(2), within_s=30)
            asking._timeout_s = 0.05
            execute.plans.observe(PlannedCommand(encode_period(3).data, "", Question(86_400.0, ("1 < 2",))))
            await eventually(lambda: settled(3), within_s=10)
        return [str(e.value) for e in execute.collect()], sent, told

    refused, sent, told = run(main(), timeout_s=60)
    assert sent == [encode_period(2).data]
    assert refused[0].startswith("period 0 s: simulated: \"relay.state == 'ACTIVE'\" does not hold")
    assert refused[1] == "period 3 s: simulated: no answer within 0.05 s"
    assert told == [0, 2, 3], "one after the other"


def test_nothing_is_forked_from_nothing() -> None:
    class Late:
        """A clock that advances with every reading."""

        now_ns = 0

        def monotonic_ns(self) -> int:
            self.now_ns += 20_000_000_000
            return self.now_ns

        utc_ns = monotonic_ns

        async def sleep_until_ns(self, deadline_ns: int) -> None:
            await asyncio.sleep(0)

    async def main() -> str | None:
        asking = Asking(ForkSubject(OBSERVATORY), Late())
        async with Nursery() as nursery:
            nursery.start(asking.run(), "what if")
            asking.ask(encode_period(1), STAYS_ACTIVE)
            await eventually(lambda: asking.answer() is not None)
        return asking.answer()

    assert "the present state of the plant is not known" in (run(main()) or "")


# -- rules ------------------------------------------------------------------------------------------------------------------


def test_rules_define_the_query(tmp_path: Path) -> None:
    file = tmp_path / "rules.yaml"
    file.write_text(
        "what_if: {horizon: 30min, require: ['ctd.pressure < 900']}\n"
        "rules:\n"
        "  - {when: outside, period_s: 1}\n"
        "  - {when: bad, period_s: 0, what_if: false}\n"
        "  - {when: inside, period_s: 60, what_if: {horizon: 6h, settle: 1min, finally: [\"relay.state == 'ACTIVE'\"]}}\n"
    )
    planner, question, _ = load_planner(str(file), OBSERVATORY)
    assert question == Question(1800.0, ("ctd.pressure < 900",))
    own = Question(21_600.0, (), ("relay.state == 'ACTIVE'",), 60.0)
    assert questions_of(planner) == [own]
    found = [planner.plan(verdict(word, "ctd.pressure", "", 0), DigitalModel()) for word in ("outside", "inside")]
    assert found == [encode_period(1), PlannedCommand(encode_period(60).data, "", own)]
    bad = planner.plan(verdict("bad", "x", "", 0), _at(7))
    assert bad == PlannedCommand(encode_period(0).data, "", None)


def _at(period_s: int) -> DigitalModel:
    model = DigitalModel()
    model.process_event(encode_period(period_s))
    return model


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("{horizon: 30min}", "no requirement is given"),
        ("{horizon: soon, require: [x > 1]}", "a time"),
        ("{require: [x > 1]}", "horizon"),
        ("true", "what_if"),
    ],
)
def test_errors_in_a_query_are_reported_with_their_line(tmp_path: Path, text: str, why: str) -> None:
    file = tmp_path / "rules.yaml"
    file.write_text(f"rules:\n  - {{when: bad, period_s: 0, what_if: {text}}}\n")
    with pytest.raises(FileInvalid, match=why) as caught:
        load_planner(str(file), OBSERVATORY)
    assert ":2" in str(caught.value)


@pytest.mark.long
def test_output_of_control_logic_is_not_an_answer_and_its_crash_is_reported(tmp_path: Path) -> None:
    """A custom system, whose program prints when it is imported, or ends the process."""
    (tmp_path / "loud.py").write_text(
        "import os, sys\nfrom fieldtwin.plc.program import Program\n\nprint('loud' * 100_000)\n"
        "if os.path.exists(os.path.dirname(__file__) + '/dies'):\n    print('no more', file=sys.stderr); os._exit(9)\n\n"
        "class Loud(Program):\n    def execute(self, scan):\n        pass\n"
    )
    (tmp_path / "quiet.yaml").write_text(
        "fieldtwin: 1\nsystem: quiet\nbuses: {lan: {url: 'tcp://there:502'}}\n"
        "devices: {modem: {profile: modem-mailbox, bus: lan, unit: 1}}\n"
        "plc: {programs: {loud: {source: 'python: loud:Loud'}}}\n"
    )
    (tmp_path / "quiet.prototype.yaml").write_text(
        "prototype_of: quiet.yaml\nbuses: {lan: {listen: 'tcp://127.0.0.1:0'}}\n"
        "devices: {modem: {model: mailbox, far: 'tcp://127.0.0.1:0'}}\n"
    )

    async def main() -> str:
        asking = Asking(ForkSubject(load_system(str(tmp_path / "quiet.yaml"))), WallClock())
        await asking.check([Question(1.0, ("modem.link_state == 1",))])
        (tmp_path / "dies").touch()
        with pytest.raises(Unreachable) as caught:
            await asking.check([Question(1.0, ("modem.link_state == 1",))])
        return str(caught.value)

    assert run(main(), timeout_s=60) == "it ended with code 9: no more"
