"""The pytest plugin from the user's view: runs of pytest in a user's folder."""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

pytest_plugins = ["pytester"]
HERE = Path(__file__).parents[2]
LOADED = ("-p", "fieldtwin.pytest_plugin", "-p", "no:randomly", "-p", "no:hypothesispytest")

FAKE = """
import json, sys
verdict = sys.argv[2].rpartition("-")[2].removesuffix(".scenario.yaml")
if verdict == "invalid":
    print("fieldtwin: x.scenario.yaml:3:5: unknown key 'wiat'", file=sys.stderr)
    sys.exit(3)
check = {"number": "2", "text": "expect", "verdict": verdict, "expected": "level 3", "got": "level 2"}
seed = int(sys.argv[sys.argv.index("--seed") + 1]) if "--seed" in sys.argv else 7
target = sys.argv[sys.argv.index("--target") + 1] if "--target" in sys.argv else "virtual"
print(json.dumps([{"name": "A scenario", "verdict": verdict, "reason": "because", "seed": seed, "target": target,
    "requirements": ["REQ-1"], "case": "a-case", "role": "controller", "impact": "disrupt", "checks": [check],
    "reproduce": f"fieldtwin test {sys.argv[2]} --seed {seed}"}]))
sys.exit(verdict != "passed")
"""
"""A replacement for `fieldtwin test`: the file name contains the verdict."""


@pytest.fixture
def fake(pytester: pytest.Pytester) -> str:
    """The command to run instead of fieldtwin; the folder has a scenario for each verdict."""
    script = pytester.makepyfile(fake_command=FAKE)
    for verdict in ("passed", "failed", "error", "inconclusive", "skipped", "invalid"):
        (pytester.path / f"a-{verdict}.scenario.yaml").write_text("scenario: x\n")
    return f"{sys.executable} {script}"


def test_scenarios_are_tests_and_only_passed_is_a_pass(pytester: pytest.Pytester, fake: str) -> None:
    result = pytester.runpytest_inprocess(*LOADED, "--fieldtwin-command", fake, "-rs", "--junit-xml=out.xml")
    result.assert_outcomes(passed=1, failed=4, skipped=1)
    result.stdout.fnmatch_lines(
        [
            "*INCONCLUSIVE: A scenario: because",
            "*expected level 3",
            "*got      level 2",
            "*again: fieldtwin test *--seed 7",
        ]
    )
    result.stdout.fnmatch_lines(["fieldtwin: x.scenario.yaml:3:5: unknown key 'wiat'", "SKIPPED*because"])
    cases = ElementTree.parse(pytester.path / "out.xml").iter("testcase")
    passed = next(case for case in cases if case.get("name") == "a-passed")
    properties = {p.get("name"): p.get("value") for p in passed.iter("property")}
    about = {"case": "a-case", "role": "controller", "impact": "disrupt"}
    assert properties == {"requirement": "REQ-1", "fieldtwin verdict": "passed", "seed": "7", **about}


def test_seed_and_target_go_to_the_scenario(pytester: pytest.Pytester, fake: str) -> None:
    pytester.makepyfile(
        test_one="""
        def test_it(scenario):
            outcome = scenario("a-failed.scenario.yaml")
            assert (outcome.seed, outcome.target, bool(outcome)) == (11, "local", False)
            assert scenario("a-passed.scenario.yaml", seed=12).seed == 12
        """
    )
    options = ("--fieldtwin-command", fake, "--fieldtwin-seed", "11", "--fieldtwin-target", "local")
    pytester.runpytest_inprocess(*LOADED, *options, "test_one.py").assert_outcomes(passed=1)


def test_scenarios_can_be_excluded(pytester: pytest.Pytester, fake: str) -> None:
    pytester.makeini("[pytest]\nfieldtwin_scenarios = false\n")
    result = pytester.runpytest_inprocess(*LOADED)
    assert result.ret == pytest.ExitCode.NO_TESTS_COLLECTED


def test_an_impossible_run_is_explained_in_a_line(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import pytest

        @pytest.mark.fieldtwin(device="ctd-reference")
        def test_it(device): ...

        def test_which(device): ...
        """
    )
    result = pytester.runpytest_inprocess(*LOADED, "--fieldtwin-command", "/nowhere/fieldtwin")
    result.assert_outcomes(errors=2)
    result.stdout.fnmatch_lines(["fieldtwin: cannot start '/nowhere/fieldtwin': No such file or directory; *"])
    result.stdout.fnmatch_lines(["which device? *"])


HIDDEN = """
import sys

HIDDEN = (
    "pymodbus", "canopen", "can", "serial", "msgspec", "pydantic", "yaml", "click", "rich"
)

class Hide:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in HIDDEN:
            raise ModuleNotFoundError(f"No module named {name!r} here", name=name)

for name in [name for name in sys.modules if name.partition(".")[0] in HIDDEN]:
    del sys.modules[name]
sys.meta_path.insert(0, Hide())

def pytest_collection_finish():
    ours = {name for name in sys.modules if name.startswith("fieldtwin")}
    assert ours == {"fieldtwin", "fieldtwin.__about__", "fieldtwin.pytest_plugin"}, ours
"""
"""A user's environment with pytest and fieldtwin without its dependencies; nothing is imported before a test runs."""


@pytest.mark.long
def test_the_docs_examples_run_with_nothing_but_pytest_installed(pytester: pytest.Pytester) -> None:
    blocks = re.findall(r"```python\n(.*?)```", (HERE / "docs/how-to/pytest.md").read_text(), re.DOTALL)
    for block in blocks:
        assert len([line for line in block.splitlines() if line]) <= 10, block
    for example in ("meter/meter.py", "pump/pump.st"):
        shutil.copy(HERE / "examples" / example, pytester.path)
    docs = blocks[0] + "from meter import MeterError\n" + "".join(blocks[1:])
    fails = """
import pytest
from meter import Meter

@pytest.mark.fieldtwin(device="eastron-sdm630", on="tcp", values={"voltage_l1": 1.5})
def test_fails(device):
    with Meter(device.host, device.port, device.unit) as meter:
        assert meter.voltage() == 2.0

@pytest.mark.fieldtwin(device="eastron-sdm360")
def test_no_such_device(device): ...

@pytest.mark.fieldtwin(device="inclinometer-cia410", unit=9)
def test_a_node_on_can(device, wire):
    assert (device.interface, device.node) == ("fieldtwin", 9)
    assert device.held("slope_long") is not None

@pytest.mark.fieldtwin(system="observatory")
def test_a_running_plc_is_steered(prototype, plc):
    with pytest.raises(KeyError, match="relay.state"):
        plc["relay.stat"]
    with pytest.raises(AssertionError, match="'ACTIVE' within 0.1 s; it is 'STANDBY', good"):
        plc.wait("relay.state", "ACTIVE", within_s=0.1)
    plc.pause()
    plc.step(2)
    plc.go()
    with plc.force("ctd.pressure", 3.0):
        assert plc.tag("ctd.pressure")["forced"]["by"] == "test"
        assert plc.quality("ctd.pressure") == "simulated"
    assert plc.tag("ctd.pressure")["forced"] is None
    plc.send(1)
    plc.wait("relay.state", "ACTIVE")
    assert plc.why("relay.state")[0]["program"] == "relay"
    plc.restart(cold=True)
    plc.wait("relay.state", "STANDBY")
"""
    pytester.makeconftest(HIDDEN)
    pytester.makepyfile(test_docs=docs, test_more=fails)
    result = pytester.runpytest_subprocess(*LOADED, "--junit-xml=out.xml", "-ra")
    result.assert_outcomes(passed=len(re.findall(r"def test_", docs)) + 2, failed=1, errors=1)
    result.stdout.fnmatch_lines(["*on the wire*", "*read input registers 30001*voltage_l1 1.5*"])
    result.stdout.fnmatch_lines(["*no device*eastron-sdm360*"])
    properties = [p.get("value") for p in ElementTree.parse(pytester.path / "out.xml").iter("property")]
    assert properties == ["METER-3", "METER-7"]


@pytest.mark.long
def test_workers_of_xdist_do_not_meet(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import pytest
        from pathlib import Path

        @pytest.mark.requirement("REQ-9")
        @pytest.mark.parametrize("n", range(2))
        @pytest.mark.fieldtwin(system="observatory", device="ctd-reference")
        def test_it(prototype, device, emulate, n):
            other = emulate("ctd-reference", unit=n + 1)
            assert Path(device.path).resolve() != Path(other.path).resolve() != Path(prototype.buses["line1"].path).resolve()
            assert other.unit == n + 1

        def test_no():
            assert 1 == 2, "one and\\ntwo"
        """
    )
    result = pytester.runpytest_subprocess(*LOADED, "-n", "2", "--fieldtwin-html", "out.html")
    result.assert_outcomes(passed=2, failed=1)
    page = (pytester.path / "out.html").read_text()
    assert page.count("test_it[1]") >= 1
    assert "REQ-9" in page
    assert '<td class="long check">AssertionError: one and</td>' in page
    assert "[gw" not in page
