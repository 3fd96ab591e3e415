"""A late host proves nothing; an accepted failure with an owner is skipped until its expiry date."""

from __future__ import annotations

from datetime import date
from pathlib import Path

import pytest
from click.testing import CliRunner
from late_host_rig import HEAD, judged_on

from fieldtwin.cli.test.test_command import command
from fieldtwin.conformance.core.waivers import Waiver, Waivers
from fieldtwin.results.model import ScenarioResult, Verdict
from fieldtwin.run.benches.virtual_bench import VirtualBench
from fieldtwin.scenarios.bench import Can
from fieldtwin.scenarios.judging.waiving import all_well, waive


class LateBench(VirtualBench):
    """A bench whose host was 300 ms late just now, with scans of 7 ms."""

    can = VirtualBench.can - {Can.EXACT_TIME}

    def host_late_s(self, since_s: float) -> float:
        return 0.3

    def host_late_total_s(self, since_s: float) -> tuple[float, float]:
        return 0.3, 0.3

    def late_ms(self) -> float:
        return 7.0


@pytest.mark.parametrize(
    ("text", "verdict"),
    [
        ("steps:\n  - expect: {tag: relay.state, value: ACTIVE, within: 2s}\n", Verdict.FAILED),
        ("steps:\n  - expect: {tag: relay.state, value: ACTIVE, within: 100ms}\n", Verdict.INCONCLUSIVE),
        ("steps:\n  - expect: {tag: relay.state, value: ACTIVE, within: 20s}\n", Verdict.FAILED),
        ("steps:\n  - wait: {until: \"relay.state == 'ACTIVE'\", within: 2s}\n", Verdict.FAILED),
        ("steps:\n  - pause: 1s\n  - expect: {that: \"relay.state == 'STANDBY'\", during: 1s}\n", Verdict.INCONCLUSIVE),
        ("steps:\n  - pause: 1s\n  - expect: {that: \"relay.state == 'STANDBY'\", during: 4s}\n", Verdict.PASSED),
        ("always: ['plc.late < 5 ms']\nsteps:\n  - pause: 1s\n", Verdict.INCONCLUSIVE),
        ("never: ['plc.late > 5 ms']\nsteps:\n  - pause: 1s\n", Verdict.INCONCLUSIVE),
        ("cycle: [{late: 5ms}]\nsteps:\n  - pause: 1s\n", Verdict.INCONCLUSIVE),
        ("cycle: [{late: 10ms}]\nsteps:\n  - pause: 1s\n", Verdict.PASSED),
        ("always: [\"relay.state == 'OFF'\"]\nsteps:\n  - pause: 1s\n", Verdict.FAILED),
    ],
)
def test_a_late_host_proves_nothing_about_short_times(tmp_path: Path, text: str, verdict: Verdict) -> None:
    result = judged_on(LateBench, tmp_path, text)
    assert result.verdict is verdict, result.checks
    if verdict is Verdict.INCONCLUSIVE:
        assert "late" in result.checks[-1].got


TODAY = date(2027, 1, 10)


@pytest.mark.parametrize(
    ("found", "expires", "verdict", "well"),
    [
        (Verdict.FAILED, TODAY, Verdict.SKIPPED, True),
        (Verdict.FAILED, date(2027, 1, 9), Verdict.FAILED, False),
        (Verdict.PASSED, TODAY, Verdict.PASSED, True),
        (Verdict.PASSED, date(2027, 1, 9), Verdict.FAILED, False),
        (Verdict.INCONCLUSIVE, TODAY, Verdict.INCONCLUSIVE, False),
        (Verdict.SKIPPED, TODAY, Verdict.SKIPPED, False),
    ],
)
def test_a_waiver_holds_until_its_expiry(found: Verdict, expires: date, verdict: Verdict, well: bool) -> None:
    passed = ScenarioResult("good", Verdict.PASSED, file="good.scenario.yaml")
    result = ScenarioResult("a test", found, file="/x/ctd-silent.scenario.yaml", reason="step 3")
    waived = waive(result, Waivers((Waiver("ctd-silent", "A. Berg", "ticket 4711", expires),)), TODAY)
    assert waived.verdict is verdict
    assert all_well([passed, waived]) is well
    assert not all_well([] if verdict is Verdict.PASSED else [waived])


def test_waivers_are_read_and_reported(tmp_path: Path) -> None:
    path = tmp_path / "x.scenario.yaml"
    path.write_text(HEAD + "steps:\n  - expect: {tag: relay.state, value: ACTIVE, within: 1s}\n")
    waivers = tmp_path / "waivers.yaml"
    waivers.write_text("waivers:\n  - {id: x, owner: A. Berg, reason: ticket 4711, expires: 2999-01-01}\n")
    ended = CliRunner().invoke(command, [str(path), "--waivers", str(waivers)], standalone_mode=False)
    assert "waived: ticket 4711; owner A. Berg, until 2999-01-01 (failed: step 1" in " ".join(ended.output.split())
    assert ended.return_value == 1, "nothing passed"
    waivers.write_text("waivers:\n  - {id: y, owner: A. Berg, reason: ticket 4711, expires: 2999-01-01}\n")
    wrong = CliRunner().invoke(command, [str(path), "--waivers", str(waivers)], standalone_mode=False)
    assert "no case 'y'" in str(wrong.exception)
