"""The gate between a digital twin and its plant: the plant's switch, its limits, its rate, and unique command numbers."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import run

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.statemachine import decode_period, encode_period
from fieldtwin.gateway.core.values import COMMAND
from fieldtwin.gateway.store.event import Event, Kind
from fieldtwin.run.shadow.rules import load_planner
from fieldtwin.run.shadow.twin import Twinning
from fieldtwin.twin.model.mape.execute import CommandLimits
from fieldtwin.twin.model.mape.messages import verdict
from fieldtwin.twin.model.mape.plan import Plan, RulePlanner
from fieldtwin.twin.model.model import DigitalModel
from fieldtwin.twin.plant.command_gate import CommandGate
from fieldtwin.twin.plant.instance import Instance
from fieldtwin.twin.site.system import load_system

OBSERVATORY = Path(__file__).resolve().parents[3] / "profiles" / "systems" / "observatory.yaml"
NOW_MS = 1_790_000_000_000


class Hands:
    now_ms = NOW_MS

    def monotonic_ns(self) -> int:
        return self.now_ms * 1_000_000

    utc_ns = monotonic_ns

    async def sleep_until_ns(self, deadline_ns: int) -> None:
        raise AssertionError("nobody waits here")


def gate(*, remote: bool = True, bounds: CommandLimits = CommandLimits(0, 3600, 5)) -> CommandGate:  # noqa: B008
    return CommandGate(remote=remote, bounds=bounds, clock=Hands())


def number(n: int, period_s: int = 1, t_ms: int = NOW_MS) -> Event:
    return Event(n, t_ms, Kind.COMMAND, "twin", encode_period(period_s).data)


def refusals(made: CommandGate) -> list[str]:
    return [str(e.value) for e in made.collect() if e.kind == Kind.REFUSAL]


def test_an_admitted_command_is_forwarded_bit_by_bit_and_recorded() -> None:
    made = gate()
    command = made.admit("twin:1", number(1, 5))
    assert command is not None
    assert decode_period(command) == 5
    (event,) = made.collect()
    assert (event.kind, event.name, event.value) == (Kind.COMMAND, "twin:1", encode_period(5).data)


def test_a_command_from_before_the_start_of_the_plants_log_is_not_obeyed() -> None:
    """A plant that lost its store does not know its earlier commands; its twin sends everything again."""
    made = CommandGate(remote=True, bounds=CommandLimits(0, 3600, 5), clock=Hands(), since_ms=NOW_MS - 1000)
    assert made.admit("twin:1", number(1, t_ms=NOW_MS - 1001)) is None
    assert refusals(made) == [
        "number 1 of twin:1: it is from before this plant's log began, and may have been obeyed then"
    ]
    assert made.admit("twin:1", number(2, t_ms=NOW_MS - 1000)) is not None


@given(numbers=st.lists(st.integers(1, 8), max_size=30))
def test_each_number_is_taken_once_and_never_after_a_later_one(numbers: list[int]) -> None:
    made = gate(bounds=CommandLimits(per_minute=1000))
    taken = [n for n in numbers if made.admit("twin:1", number(n)) is not None]
    assert taken == sorted(set(taken))
    assert len(refusals(made)) == len(numbers) - len(taken)


@pytest.mark.parametrize(
    ("made", "event", "why"),
    [
        (gate(remote=False), number(1), "the plant is switched to local"),
        (gate(), number(1, -1), "allowed are 0 to 3600 s"),
        (gate(), number(1, t_ms=NOW_MS - 601_000), "601 s old"),
        (gate(), Event(1, NOW_MS, Kind.COMMAND, "twin", "words"), "expected 2 bytes"),
    ],
)
def test_a_refusal_has_its_reason_and_is_kept(made: CommandGate, event: Event, why: str) -> None:
    assert made.admit("twin:1", event) is None
    (said,) = refusals(made)
    assert why in said
    assert said.startswith("number 1 of twin:1")


def test_the_rate_is_bounded_and_recovers() -> None:
    made = gate()
    assert [made.admit("t", number(n)) is not None for n in range(1, 8)] == [True] * 5 + [False] * 2
    Hands.now_ms += 61_000
    try:
        assert made.admit("t", number(9, t_ms=Hands.now_ms)) is not None
    finally:
        Hands.now_ms = NOW_MS


def test_switch_and_limits_may_change_and_earlier_commands_count() -> None:
    made = gate(bounds=CommandLimits(0, 3600, 3))
    assert all(made.admit("t", number(n)) is not None for n in (1, 2))
    made.restate(remote=False, bounds=CommandLimits(0, 3600, 3))
    assert made.admit("t", number(3)) is None
    made.restate(remote=True, bounds=CommandLimits(0, 60, 2))
    assert made.admit("t", number(4, 10)) is None
    assert [why.partition(": ")[2] for why in refusals(made)] == [
        "the plant is switched to local", "more than 2 commands in a minute",
    ]  # fmt: skip
    made.restate(remote=True, bounds=CommandLimits(0, 60, 4))
    assert made.admit("t", number(5, 61)) is None
    assert [made.admit("t", number(n, 10)) is not None for n in (6, 7, 8)] == [True, True, False]


def test_the_gate_ignores_messages_that_are_not_commands() -> None:
    made = gate()
    assert made.admit("twin:1", Event(1, NOW_MS, Kind.VERDICT, "x", "y")) is None
    assert made.collect() == []


def test_a_system_file_declares_permitted_commands(tmp_path: Path) -> None:
    system = load_system(str(OBSERVATORY))
    assert (system.commands.period_s, system.commands.per_minute) == ([-32768, 32767], 60)
    text = OBSERVATORY.read_text()
    mine = tmp_path / "observatory.yaml"
    mine.write_text(text + "commands: {period_s: [0, 60], per_minute: 6}\n")
    (tmp_path / "relay.st").write_text((OBSERVATORY.parent / "relay.st").read_text())
    assert load_system(str(mine)).commands.period_s == [0, 60]
    mine.write_text(text + "commands: {period_s: [60, 0]}\n")
    with pytest.raises(FileInvalid, match="the smallest and the largest"):
        load_system(str(mine))


# -- rules ------------------------------------------------------------------------------------------------------------------


def test_rules_are_read_and_the_first_that_fits_decides(tmp_path: Path) -> None:
    rules = tmp_path / "rules.yaml"
    rules.write_text(
        "limits: {ctd.pressure: [0, 5.5]}\n"
        "rules:\n  - {when: outside, of: ctd.pressure, period_s: 1}\n  - {when: stale, period_s: 0}\n"
    )
    (planner, _, limits), model = load_planner(str(rules), load_system(str(OBSERVATORY))), DigitalModel()
    assert limits["ctd.pressure"] == (0.0, 5.5)
    command = planner.plan(verdict("outside", "ctd.pressure", "", 0), model)
    assert command is not None
    assert decode_period(command) == 1
    assert planner.plan(verdict("outside", "ctd.temperature", "", 0), model) is None
    model.process_event(encode_period(7))
    assert planner.plan(verdict("stale", "anything", "", 0), model) == encode_period(0)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("rules: [{when: ouside, period_s: 1}]", "ouside"),
        ("rules: [{when: outside, of: ctd.presure, period_s: 1}]", "observatory has no 'ctd.presure'"),
        ("rules: [{when: outside, period_s: 99999}]", "32767"),
        ("rules: [{when: outside, of: ctd.pressure, period_s: 1}]", "no limits for the condition"),
        ("{limits: {ctd.presure: [0, 1]}, rules: [{when: outside, period_s: 1}]}", "observatory has no 'ctd.presure'"),
        ("{limits: {ctd.pressure: [1, 0]}, rules: [{when: outside, period_s: 1}]}", "the smallest, then the largest"),
        ("rules: []", "rules"),
    ],
)
def test_errors_in_rules_are_reported_with_their_line(tmp_path: Path, text: str, why: str) -> None:
    rules = tmp_path / "rules.yaml"
    rules.write_text(text)
    with pytest.raises(FileInvalid, match=why) as caught:
        load_planner(str(rules), load_system(str(OBSERVATORY)))
    assert caught.value.line == 1


def test_a_planner_in_python_is_made_or_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    system = load_system(str(OBSERVATORY))
    with pytest.raises(FileInvalid, match="cannot be created: ModuleNotFoundError"):
        load_planner("python: no_such_module:Planner", system)
    with pytest.raises(FileInvalid, match="not a planner"):
        load_planner("python: collections:OrderedDict", system)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "odd_planner.py").write_text("class P:\n    limits = {'x': 5}\n    def plan(self, data, model): ...\n")
    with pytest.raises(FileInvalid, match=r"the limits of .*; got \{'x': 5\}"):
        load_planner("python: odd_planner:P", system)


def test_errors_and_wrong_results_of_a_python_planner_are_refusals_and_the_twin_continues(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "failing_planner.py").write_text(
        "class Planner:\n"
        "    given = 0\n"
        "    def plan(self, data, model):\n"
        "        self.given += 1\n"
        "        return [1 / 0 if data.finding == 'bad' else None, 5][self.given > 1]\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    planner = load_planner("python: failing_planner:Planner", load_system(str(OBSERVATORY))).planner
    plan = Plan(DigitalModel(), planner, Hands())
    for finding in ("bad", "good"):
        plan.consumer.observe(verdict(finding, "ctd.pressure", "", NOW_MS))
    plan.plan()
    assert (plan.planned, plan.failed) == (0, 2)
    raised, gave = [str(e.value) for e in plan.collect() if e.kind == Kind.REFUSAL]
    assert "'python: failing_planner:Planner' failed: ZeroDivisionError: division by zero" in raised
    assert "expected a COMMAND or None; got int" in gave


def test_a_manual_plan_waits_for_the_plants_state_and_is_refused_if_it_never_arrives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FIELDTWIN_RUN", str(tmp_path))
    sent: list[COMMAND] = []
    said: list[str] = []

    async def main(heard: bool) -> None:
        with Instance("twin") as here:
            twinning = Twinning(
                load_system(str(OBSERVATORY)), "tcp://127.0.0.1:1", here, planner=RulePlanner(()),
                on_verdict=lambda verdict: None, on_command=sent.append, on_refusal=said.append,
            )  # fmt: skip
            twinning.plan(encode_period(5))
            if heard:
                await twinning._arrived("plant:1", [Event(1, NOW_MS, Kind.VALUE, "ctd.pressure", 1.0)])
            await twinning.run(asyncio.Event(), 0.2)

    run(main(heard=False))
    assert (sent, said) == ([], ["period 5 s: the twin ended before it received a status of the plant"])
    run(main(heard=True))
    assert sent == [encode_period(5)]


def test_a_refusal_of_the_plant_is_reported_by_its_twin_unless_it_is_history(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FIELDTWIN_RUN", str(tmp_path))
    said: list[str] = []
    with Instance("twin") as here:
        twinning = Twinning(
            load_system(str(OBSERVATORY)), "tcp://127.0.0.1:1", here, planner=RulePlanner(()),
            on_verdict=lambda verdict: None, on_command=lambda command: None, on_refusal=said.append,
        )  # fmt: skip
        now_ms = twinning.clock.utc_ns() // 1_000_000
        told = [
            Event(n, t_ms, Kind.REFUSAL, "command gate", f"no {n}") for n, t_ms in ((1, now_ms - 60_000), (2, now_ms))
        ]
        run(twinning._arrived("plant:1", told))
    assert said == ["by the plant: no 2"]
    assert twinning.describe()["refused_by_plant"] == 2
