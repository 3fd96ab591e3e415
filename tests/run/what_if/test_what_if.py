"""Forks: they start from the known state, execute a plan, and report the effects."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from click.testing import CliRunner
from support import run

from fieldtwin.cli.twin.what_if_command import command
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.gateway.store.event import Event, Kind
from fieldtwin.gateway.store.sqlite_knowledge import SqliteKnowledge, in_place
from fieldtwin.run.processes.topside import Scripted
from fieldtwin.run.what_if.fork import Fork, answer
from fieldtwin.run.what_if.known import known_state
from fieldtwin.run.what_if.last_known import of_period
from fieldtwin.run.what_if.many import answers
from fieldtwin.run.what_if.outcome import MOST_POINTS, Series, VariableOutcome
from fieldtwin.run.what_if.plan import WhatIfPlan, load_plans
from fieldtwin.run.what_if.plan import command as parsed
from fieldtwin.run.what_if.state import KnownState, read_state
from fieldtwin.twin.model.status import encode_status
from fieldtwin.twin.site.system import load_system

ROOT = Path(__file__).resolve().parents[3]
OBSERVATORY = load_system("observatory")
DEEP = KnownState({"ctd.pressure": 250.0, "ctd.temperature": 8.0}, {"relay": of_period(1)})


def test_a_fork_continues_from_the_known_state() -> None:
    """The relay is ACTIVE with its earlier period, and the sensor continues at its position in the cast."""
    outcome = answer(
        Fork("observatory", DEEP, 6.0, settle_s=3.0), WhatIfPlan("go on", require=("relay.state == 'ACTIVE'",))
    )
    assert outcome.error == ""
    assert outcome.met
    assert [state for _, state in outcome.states["relay"]] == ["ACTIVE"]
    pressure = outcome.variables["ctd.pressure"]
    assert pressure.first == pytest.approx(
        250.0, abs=15.0
    )  # the nearest row by both signals, and some seconds of the cast
    assert pressure.lowest > 200
    assert outcome.variables["ctd.sample_period_s"].last == 1
    assert outcome.not_taken == []


def test_a_mean_is_over_time_and_independent_of_the_number_of_reads() -> None:
    """10 for ten seconds, reported each second; 20 for thirty, reported once; then bad for a minute; then 40 for ten."""
    seen = VariableOutcome()
    for second in range(10):
        seen.saw(10, True, second * NS_PER_S)
    seen.saw(20.0, True, 10 * NS_PER_S)
    seen.saw(20.0, False, 40 * NS_PER_S)
    seen.saw(None, False, 0)
    seen.saw(40, True, 100 * NS_PER_S)
    seen.ends(110 * NS_PER_S)
    told = seen.described()
    assert told["mean"] == pytest.approx((10 * 10 + 20 * 30 + 40 * 10) / 50)
    assert (told["updates"], told["good"], told["min"], told["max"]) == (14, 12, 10, 40)
    once, words = VariableOutcome(), VariableOutcome()
    once.saw(7, True, 0)
    words.saw("0042", True, 0)
    assert once.described()["mean"] == 7
    assert "mean" not in words.described()


def test_a_program_that_does_not_publish_its_period_gets_the_known_command() -> None:
    """For `adapt.st`, a store knows state and period, but not the period that it was ordered."""
    known = KnownState({}, {"adapt": of_period(10)})
    outcome = answer(Fork("ocean_west", known, 30.0), WhatIfPlan("go on", require=("adapt.state == 'ACTIVE'",)))
    assert (outcome.error, outcome.met, outcome.not_taken) == ("", True, [])
    assert outcome.variables["ctd.sample_period_s"].last == 10


@pytest.mark.parametrize(("system", "program"), [("ocean_west", "adapt"), ("observatory", "relay")])
def test_a_state_that_a_fork_could_not_begin_with_is_named_unless_a_command_came_first(
    system: str, program: str
) -> None:
    # OFF with a period of 10 s: the state follows from the period
    known = KnownState({}, {program: {**of_period(10), "state": 2}})
    told = [
        answer(Fork(system, known, 3.0), plan).not_taken
        for plan in (WhatIfPlan("go on"), WhatIfPlan("", (Scripted(0, 5),)))
    ]
    assert told == [[program], []]


def test_a_simulation_that_follows_the_time_is_named_because_its_curve_begins_again() -> None:
    known = KnownState({"optode.temperature": 7.4})
    assert answer(Fork("ocean_middle", known, 3.0), WhatIfPlan("go on")).not_taken == ["optode"]


def test_without_knowledge_it_begins_as_any_prototype() -> None:
    outcome = answer(
        Fork("observatory", KnownState(), 2.0, settle_s=1.0),
        WhatIfPlan("nothing", require=("relay.state == 'ACTIVE'",)),
    )
    assert not outcome.met
    [broken] = outcome.requirements
    assert broken.broken_s == pytest.approx(1.0)
    assert broken.seen == "relay.state: 'STANDBY'"


def test_commands_and_faults_of_a_plan_and_the_same_again() -> None:
    fork = Fork("observatory", DEEP, 12.0, settle_s=3.0)
    silent = ({"name": "silence", "device": "ctd", "from": "4s"},)
    plans = [
        WhatIfPlan("off", (Scripted(0.5, -1),), finally_=("relay.state == 'OFF'",)),
        WhatIfPlan("dead", (), silent, require=("quality(ctd.pressure) == 'good'",)),
    ]
    off, dead = answers(fork, plans, jobs=1)
    assert off.met
    assert [state for _, state in off.states["relay"]] == ["ACTIVE", "OFF"]
    assert not dead.met
    assert 4.0 < (dead.requirements[0].broken_s or 0) < 9.0
    again = answer(fork, plans[0])
    assert {**again.described(), "took_s": 0} == {**off.described(), "took_s": 0}


def test_messages_are_taken_at_the_remote_end() -> None:
    """Modems whose messages are not taken would become full, and the fork would predict losses that do not occur."""
    outcome = answer(Fork("observatory", DEEP, 40.0), WhatIfPlan("go on", finally_=("relay.waiting < 3",)))
    assert outcome.met, outcome.described()
    assert outcome.variables["modem.link_sent"].last > 30


def test_a_simulation_continues_from_its_values() -> None:
    known = KnownState({"localiser.x": 5.0, "localiser.heading": 0.0, "console.enable": 1, "console.speed": 1.0})
    outcome = answer(Fork("lab_vehicle", known, 4.0), WhatIfPlan("drive", finally_=("localiser.x > 6",)))
    assert outcome.met, outcome.described()
    assert outcome.variables["localiser.x"].lowest >= 5.0


def test_impossible_plans_are_refused() -> None:
    with pytest.raises(UsageError, match="the horizon"):
        answer(Fork("observatory", DEEP, 0.0), WhatIfPlan("x"))
    with pytest.raises(UsageError, match="no tag or variable"):
        answer(Fork("observatory", DEEP, 1.0), WhatIfPlan("x", require=("ctd.presure > 1",)))
    with pytest.raises(UsageError, match="a command"):
        parsed("fast")
    assert parsed("60@10min") == Scripted(600.0, 60)
    nobody = answer(Fork("lab_vehicle", KnownState(), 1.0), WhatIfPlan("x", (Scripted(0, 1),)))
    assert "this system cannot be commanded" in nobody.error
    assert not nobody.met


# -- where a state comes from ---------------------------------------------------------------------------------------------


def test_a_state_file_reports_its_contents(tmp_path: Path) -> None:
    path = tmp_path / "now.json"
    path.write_text(DEEP.dump(OBSERVATORY), encoding="utf-8")
    again = read_state(path, OBSERVATORY)
    assert (again.values, again.programs) == (DEEP.values, DEEP.programs)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"fieldtwin_state": 1', '"fieldtwin_state": 9', "a different format version.*expected 1; got 9"),
        ('"system": "observatory"', '"system": "pump"', "the state of a different system"),
        ("ctd.pressure", "ctd.presure", "no tag 'ctd.presure'"),
        ('"relay"', '"rely"', "no program 'rely'"),
        ('"values"', '"valeus"', "not a state of a system"),
        ("{", "", "not a state of a system"),
    ],
)
def test_a_wrong_state_file(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "now.json"
    path.write_text(DEEP.dump(OBSERVATORY).replace(old, new, 1), encoding="utf-8")
    with pytest.raises(FileInvalid, match=message):
        read_state(path, OBSERVATORY)


def test_the_last_known_state_is_read_from_a_store(tmp_path: Path) -> None:
    async def main() -> KnownState:
        store = await SqliteKnowledge.open(tmp_path / "k.db", offload=in_place)
        try:
            mine = await store.own("plant", system="observatory", prototype=True, log="1")
            await store.append(
                mine,
                [
                    Event(0, 1000, Kind.VALUE, "ctd.pressure", 100.0, Quality.GOOD, 0),
                    Event(0, 2000, Kind.VALUE, "ctd.pressure", 101.5, Quality.GOOD, 0),
                    Event(0, 2000, Kind.VALUE, "ctd.temperature", 8.0, Quality.GOOD, 0),
                    Event(0, 2500, Kind.STATE, "relay", encode_status("ACTIVE", 2).data),
                    Event(0, 2600, Kind.STATE, "relay", b"none"),
                    Event(0, 3000, Kind.VALUE, "ctd.temperature", None, Quality.BAD, Reason.TIMEOUT),
                ],
            )
        finally:
            await store.aclose()
        return await known_state(str(tmp_path / "k.db"), OBSERVATORY)

    known = run(main())
    assert dict(known.values) == {"ctd.pressure": 101.5}  # a value that turned bad is unknown
    assert known.programs == {"relay": {"period": 2, "period_s": 2, "state": 1}}
    assert known.utc_ms == 3000


# -- plans in a file, and the command --------------------------------------------------------------------------------------

PLANS = """\
what_if: observatory
require: ["quality(inclinometer.slope_long) == 'good'"]
plans:
  - name: keep
    finally: ["relay.state == 'ACTIVE'"]
  - name: stop
    commands: [{at: 500ms, period_s: 0}]
    finally: ["relay.state == 'ACTIVE'"]
"""


def test_several_plans_by_command(tmp_path: Path) -> None:
    (tmp_path / "plans.yaml").write_text(PLANS, encoding="utf-8")
    (tmp_path / "now.json").write_text(DEEP.dump(OBSERVATORY), encoding="utf-8")
    words = [
        "--plans",
        str(tmp_path / "plans.yaml"),
        "--from",
        str(tmp_path / "now.json"),
        "--horizon",
        "8s",
        "--jobs",
        "1",
    ]
    said = CliRunner().invoke(command, [*words, "--json"], standalone_mode=False)
    assert said.exception is None
    found = json.loads(said.stdout)
    assert [(o["plan"], o["met"]) for o in found["outcomes"]] == [("keep", True), ("stop", False)]
    assert said.return_value == 0  # one of them is sufficient
    assert found["outcomes"][1]["requirements"][1]["seen"] == "relay.state: 'STANDBY'"
    shown = CliRunner().invoke(command, words, standalone_mode=False).stdout
    assert "keep: met" in shown
    assert re.search(r"ctd\.pressure +dbar +2[45]\d", shown)


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["--command", "60@10min", "--command", "2@5s"], "command 2 s at 5 s, command 60 s at 10 min"),
        (["--command", "0"], "command 0 s at 0 s"),
        (["--faults", "silent.yaml"], "fault silence on ctd, fault drop on line1"),
        (
            [f"--command={n}@{n}s" for n in range(1, 10)],
            ", ".join(f"command {n} s at {n} s" for n in range(1, 7)) + " and 3 more",
        ),
        ([], "no commands"),
    ],
)  # fmt: skip
def test_a_plan_of_the_command_line_is_named_after_its_actions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("silent.yaml").write_text("faults: [{name: silence, device: ctd}, {name: drop, bus: line1}]\n")
    line = ["observatory", *words, "--require", "relay.dropped == 0", "--horizon", "2s", "--jobs", "1"]
    shown = CliRunner().invoke(command, line, standalone_mode=False)
    assert f"\n{name}: " in shown.stdout


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("name: stop", "name: keep", r"two plans with the same name"),
        ("period_s: 0", "period_s: 99999", r"plans.yaml:7:\d+: a command"),
        ("finally:", "finaly:", r"finaly.*did you mean"),
    ],
)
def test_a_wrong_file_of_plans(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "plans.yaml"
    path.write_text(PLANS.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(FileInvalid, match=message):
        load_plans(path)


def test_a_series_has_each_change_once_and_none_where_there_is_no_good_value() -> None:
    series = Series(100.0)
    for t_s, value, good in (
        (0, 1, True),
        (1, 1, True),
        (2, 2.5, True),
        (3, 2.5, False),
        (4, "text", True),
        (5, 3, True),
    ):
        series.saw(float(t_s), value, good)
    assert series.described() == [[0.0, 1.0], [2.0, 2.5], [3.0, None], [5.0, 3.0]]


def test_a_long_series_is_bounded_and_keeps_its_newest_value() -> None:
    series = Series(1000.0)
    for n in range(100_000):
        series.saw(n / 100, n, True)
    points = series.described()
    assert 500 < len(points) < MOST_POINTS
    assert points[-1][1] == 99_999
    assert [t for t, _ in points] == sorted(t for t, _ in points)


def test_a_fork_returns_the_values_of_a_tag_and_a_variable_over_time() -> None:
    fork = Fork("observatory", KnownState(), 12.0, series=("ctd.sample_period_s", "relay.period"))
    outcome = answer(fork, WhatIfPlan("go", (Scripted(1.0, 2),)))
    described = outcome.described()["series"]
    assert [value for _, value in described["relay.period"]] == [0.0, 2.0]
    assert described["ctd.sample_period_s"][-1][1] == 2.0
    assert all(0 <= t <= 12 for t, _ in described["relay.period"])
    assert "series" not in answer(Fork("observatory", KnownState(), 1.0), WhatIfPlan("go")).described()


def test_a_series_of_an_unknown_name_is_refused() -> None:
    with pytest.raises(UsageError, match=r"no tag or variable 'ctd\.depth'"):
        answer(Fork("observatory", KnownState(), 1.0, series=("ctd.depth",)), WhatIfPlan("go"))
