"""A scenario and the user's own control program in one command, and `with` and `test --target compose` that find each other.

Defect: to test a controller other than fieldtwin's, a user had to start the simulated devices by hand, copy their port into
the controller's settings and into the scenario, and end everything by hand; `test --target compose` inside `fieldtwin with`
looked for a host named `field`.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest
from procs import Asking, fieldtwin, no_tracebacks, run_to_end, wait_for
from shed_site import write_shed

pytestmark = pytest.mark.long

CONTROLLER = """
import os, socket, sys, time

host, port = os.environ["FIELDTWIN_LAN_HOST"], int(os.environ["FIELDTWIN_LAN_PORT"])
unit = int(os.environ["FIELDTWIN_TANK_UNIT"])
limit = int(sys.argv[1])
print("controller", os.getpid(), flush=True)


def ask(line, pdu):
    line.sendall(b"\\0\\1\\0\\0" + (len(pdu) + 1).to_bytes(2, "big") + bytes([unit]) + pdu)
    head = b""
    while len(head) < 7:
        head += line.recv(7 - len(head))
    body = b""
    while len(body) < head[5] - 1:
        body += line.recv(head[5] - 1 - len(body))
    return body


while True:
    try:
        with socket.create_connection((host, port), timeout=5) as line:
            while True:
                level = int.from_bytes(ask(line, bytes([4, 0, 0, 0, 1]))[2:4], "big")
                ask(line, bytes([6, 0, 0, 0, int(level > limit)]))
                time.sleep(0.05)
    except OSError:
        time.sleep(0.05)
"""
SCENARIO = """scenario: the valve opens above 100
system: shed.yaml
{start}probes:
  device: {{endpoint: "${{FIELDTWIN_LAN_URL}}", every: 50ms, registers: {{level: {{at: 30001}}, valve: {{at: 40001}}}}}}
steps:
  - expect: {{that: "device.level == 20 and device.valve == 0", within: 60s}}
  - set: {{tag: tank.level, value: 120}}
  - expect: {{that: "device.level == 120", within: 60s}}
  - expect: {{tag: device.valve, value: 1, within: 60s}}
"""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    (tmp_path / "controller.py").write_text(CONTROLLER)
    write_shed(tmp_path)
    (tmp_path / "valve.scenario.yaml").write_text(SCENARIO.format(start="start: fresh\n"))
    (tmp_path / "as_is.scenario.yaml").write_text(SCENARIO.format(start=""))
    return tmp_path


def controller(site: Path, limit: int = 100) -> list[str]:
    return [sys.executable, str(site / "controller.py"), str(limit)]


def judged(site: Path, *words: str, name: str = "test") -> tuple[int, list[dict[str, Any]], str]:
    ended = run_to_end(site, "test", *words, name=name, within_s=200)
    return ended.process.returncode, json.loads(ended.out), ended.err


def test_one_command_tests_the_users_controller(site: Path) -> None:
    scenario = str(site / "valve.scenario.yaml")
    words = (scenario, str(site / "as_is.scenario.yaml"), "--json", "--with", "--", *controller(site))
    code, results, told = judged(site, *words)
    assert code == 0, results
    assert {result["target"] for result in results} == {"local"}
    assert results[0]["reproduce"].endswith(f"--with -- {' '.join(controller(site))}")
    pids = [int(line.split()[1]) for line in told.splitlines() if line.startswith("controller ")]
    assert len(set(pids)) == 2, "a controller of its own for each scenario"
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids), "and none is left"
    assert not list(site.glob("test-*")), "the run directories are gone"
    no_tracebacks(site)


def test_a_controller_that_decides_wrongly_fails(site: Path) -> None:
    text = SCENARIO.format(start="").replace("value: 1, within: 60s", "value: 1, within: 4s")
    (site / "valve.scenario.yaml").write_text(text)
    code, (result,), _ = judged(
        site, str(site / "valve.scenario.yaml"), "--json", "--with", "--", *controller(site, 300)
    )
    assert code == 1
    assert result["verdict"] in ("failed", "inconclusive"), result
    assert result["checks"][-1]["number"] == "4"


def test_a_controller_that_ends_is_an_error(site: Path) -> None:
    words = (str(site / "valve.scenario.yaml"), "--json", "--with", "--", "sh", "-c", "echo gone >&2; exit 3")
    code, (result,), told = judged(site, *words)
    assert code == 1
    assert result["verdict"] == "error"
    assert "the controller ended early with exit status 3" in result["reason"]
    assert "gone" in told


def test_a_scenario_about_our_gateway_is_skipped_with_the_reason(site: Path) -> None:
    (site / "ours.scenario.yaml").write_text(
        "scenario: ours\nsystem: shed.yaml\nsteps:\n  - expect: {that: 'tank.level == 20 and not idle.high', within: 9s}\n"
    )
    code, (result,), _ = judged(site, str(site / "ours.scenario.yaml"), "--json", "--with", "--", *controller(site))
    assert code == 1
    assert result["verdict"] == "skipped"
    assert "the scenario reads idle.high, tank.level, which fieldtwin's own gateway and PLC publish" in result["reason"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--target", "virtual", "--with", "--", "true"], "cannot run in virtual time"),
        (["--target", "compose", "--with", "--", "true"], "tests a running system"),
        (["--with"], "--with needs a command"),
        (["--with", "--", "no-such-program"], "no such program"),
    ],
)
def test_inconsistent_options_are_a_usage_error(site: Path, words: list[str], told: str) -> None:
    ended = run_to_end(site, "test", str(site / "valve.scenario.yaml"), *words)
    assert ended.process.returncode == 2
    assert told in " ".join(ended.err.split())


def test_inside_of_with_the_test_finds_the_field_simulator(site: Path) -> None:
    """The shell starts a controller and then tests it: FIELDTWIN_CONTROL gives the address of the simulated devices."""
    fieldtwin_test = f"{sys.executable} -m fieldtwin test {site / 'as_is.scenario.yaml'} --target compose --json"
    script = f"{' '.join(controller(site))} >&2 & {fieldtwin_test}; status=$?; kill $!; exit $status"
    ended = run_to_end(site, "with", str(site / "shed.yaml"), "--", "sh", "-c", script, within_s=200)
    assert ended.process.returncode == 0, ended.out + ended.err
    assert json.loads(ended.out)[0]["verdict"] == "passed"


def test_from_another_terminal_the_test_finds_the_only_field_simulator_of_the_system(site: Path) -> None:
    with fieldtwin(site, "with", str(site / "shed.yaml"), "--", *controller(site), name="with") as running:
        wait_for(lambda: "controller " in running.out, 30, running.err)
        words = (str(site / "as_is.scenario.yaml"), "--target", "compose", "--json")
        code, results, _ = judged(site, *words)
        assert code == 0, results
        (home,) = site.glob("with-*")
        assert Asking(str(home / "field.sock"))("get")["set"] == {}, "nothing is left in the devices"
        with fieldtwin(site, "with", "--instance", "second", str(site / "shed.yaml"), "--", "sleep", "600", name="two"):
            wait_for(lambda: (site / "second" / "field.sock").exists(), 30, "the second field simulator")
            several = run_to_end(site, "test", *words, name="several")
            assert several.process.returncode == 1
            assert (
                f"several field simulators of 'shed' run on this host; expected --instance with one of second, {home.name}"
                in (json.loads(several.out)[0]["reason"])
            )
            code, results, _ = judged(site, *words, "--instance", home.name, name="named")
            assert code == 0, results


def test_a_killed_scenario_leaves_no_controller(site: Path) -> None:
    (site / "long.scenario.yaml").write_text(SCENARIO.format(start="") + "  - pause: 600s\n")
    words = ("test", str(site / "long.scenario.yaml"), "--with", "--", *controller(site))
    with fieldtwin(site, *words, name="killed") as judge:
        wait_for(lambda: "controller " in judge.err, 30, judge.err)
        pid = int(judge.err.split("controller ")[1].split()[0])
        judge.process.kill()
        judge.process.wait()
    wait_for(lambda: not os.path.exists(f"/proc/{pid}"), 20, "the controller ends with its judge")
