"""`fieldtwin plc` against a running prototype, and on files alone."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from click.testing import CliRunner
from procs import fieldtwin, wait_for

from fieldtwin.cli.main import cli
from fieldtwin.gateway.core.errors import FieldtwinError, Unreachable, UsageError
from fieldtwin.gateway.core.files.yaml_file import parse


def plc(*args: str) -> str:
    """Return the output of a command on stdout. Its errors are raised."""
    done = CliRunner().invoke(cli, ["plc", *args], catch_exceptions=True, standalone_mode=False)
    if isinstance(done.exception, FieldtwinError):
        raise done.exception
    assert done.exception is None, done.exception
    return done.stdout


@pytest.mark.long
def test_a_running_plc_is_watched_forced_stepped_and_asked_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FIELDTWIN_RUN", str(tmp_path))
    with pytest.raises(Unreachable, match="no PLC is running"):
        plc("status")
    with fieldtwin(
        tmp_path, "run", "observatory", "--prototype", "--commands", "3", "--instance", "p", "--json"
    ) as run:
        run.control("p", "plc")
        wait_for(lambda: json.loads(plc("status", "--json"))["variables"]["relay.state"] == 1, 15, "ACTIVE")
        text = plc("status")
        assert plc("status", "p").splitlines()[0] == text.splitlines()[0], (
            "the instance, as `fieldtwin reload` takes it"
        )
        with pytest.raises(UsageError, match="two instances: 'p' and 'q'"):
            plc("status", "p", "--instance", "q")
        assert "PLC: running" in text
        assert "no tag is forced" in text
        assert "relay.state" in plc("watch", "relay.*")
        wait_for(lambda: "1 (sampling)" in plc("watch", "ctd.status"), 15, "a value with the name of the profile")
        assert "by program relay" in plc("why", "ctd.sample_period_s")
        with pytest.raises(UsageError, match="no terminal for the confirmation"):
            plc("force", "ctd.sample_period_s", "9")
        plc("force", "ctd.sample_period_s", "9", "--yes")
        gateway = run.control("p", "gateway")
        wait_for(
            lambda: gateway("get")["tags"]["ctd.sample_period_s"]["value"] == 9, 5, "the sensor has the forced period"
        )
        assert "FORCED: 1" in plc("status")
        assert json.loads(plc("watch", "ctd.sample_period_s", "--json"))["ctd.sample_period_s"]["forced"]
        plc("unforce", "ctd.sample_period_s")
        with pytest.raises(FieldtwinError, match="not forced"):
            plc("unforce", "ctd.sample_period_s")
        wait_for(lambda: gateway("get")["tags"]["ctd.sample_period_s"]["value"] == 3, 5, "the commanded period again")
        plc("pause", "--yes")
        wait_for(lambda: "paused" in plc("status"), 5, "paused")
        scans = json.loads(plc("status", "--json"))["scans"]
        plc("step", "5")
        wait_for(lambda: json.loads(plc("status", "--json"))["scans"] == scans + 5, 5, "five scans")
        plc("go")
        with pytest.raises(UsageError, match=r"'p' is a running instance, not a tag; expected .*--instance p"):
            plc("watch", "p")
        with pytest.raises(UsageError, match="no tag 'nothing'"):
            plc("watch", "nothing")
        plc("restart", "--cold", "--yes")
        wait_for(
            lambda: json.loads(plc("status", "--json"))["variables"]["relay.state"] == 0, 5, "STANDBY after a restart"
        )


@pytest.mark.long
def test_the_observatorys_relay_is_drawn_and_proved(tmp_path: Path) -> None:
    root = ET.fromstring(plc("diagram", "observatory"))
    texts = {e.text for e in root.iter("{http://www.w3.org/2000/svg}text")}
    assert {"STANDBY", "ACTIVE", "OFF", "command > 0"} <= texts
    plc("diagram", "observatory", "-o", str(tmp_path / "relay.svg"))
    assert (tmp_path / "relay.svg").read_text().startswith("<svg")
    assert "relay: proved for" in plc("prove", "observatory")
    assert json.loads(plc("prove", "observatory", "--json"))["proved"]
    assert "no proof" in plc("prove", "observatory", "--max-states", "5")
    with pytest.raises(UsageError, match="no program 'pump'"):
        plc("prove", "observatory", "--program", "pump")


def test_a_counterexample_is_a_scenario(tmp_path: Path) -> None:
    text = (Path(__file__).parents[3] / "profiles/systems/observatory.yaml").read_text(encoding="utf-8")
    (tmp_path / "site.yaml").write_text(
        text.replace("fieldtwin.plc.relay:Relay", "wrong_relay:Wrong"), encoding="utf-8"
    )
    (tmp_path / "wrong_relay.py").write_text(
        "from fieldtwin.plc.relay_proof import RelayWithHistory\n\n\nclass Wrong(RelayWithHistory):\n"
        "    def execute(self, scan):\n        super().execute(scan)\n"
        "        if self.period_s < 0 and self.commands == 2:\n            self.state = 1\n"
    )
    (tmp_path / "wrong_relay_proof.py").write_text(
        "from dataclasses import replace\n\nfrom fieldtwin.plc.relay_proof import PROOF as RIGHT\n"
        "from wrong_relay import Wrong\n\n"
        "PROOF = replace(RIGHT, make=Wrong, key=lambda r: (r.key, min(r.commands, 2)))\n"
    )
    out = tmp_path / "found.scenario.yaml"
    shown = plc("prove", str(tmp_path / "site.yaml"), "-o", str(out))
    assert "relay: violated after 2 scans: the state follows from the sign of the period" in shown
    assert shown.endswith(out.read_text())  # not wrapped at a terminal's width, because it may be piped into a file
    scenario = parse(out.read_text(), str(out)).data
    assert (scenario["system"], scenario["needs"]) == ("site.yaml", ["send_command"])
    assert [s for s in scenario["steps"] if "send" in s] == [{"send": {"from": "topside", "period_s": -32768}}] * 2
    assert scenario["steps"][-1] == {"pause": "5s"}
    [seen] = scenario["never"]
    assert seen.startswith("relay.state == 'ACTIVE' and relay.period == -32768 and relay.commands == 2 and ")


def test_values_and_bad_inputs_of_a_counterexample_are_steps(tmp_path: Path) -> None:
    text = (Path(__file__).parents[3] / "profiles/systems/observatory.yaml").read_text(encoding="utf-8")
    inputs = "command: {tag: modem.inbox}\n        sample:  {tag: ctd.sample}"
    assert inputs in text
    text = text.replace(inputs, "depth: {tag: ctd.pressure}").replace("fieldtwin.plc.relay:Relay", "winch:Winch")
    text = text.replace("outputs: {period_s: ctd.sample_period_s, response: modem.outbox}", "outputs: {}")
    (tmp_path / "site.yaml").write_text(text, encoding="utf-8")
    (tmp_path / "winch.py").write_text(
        "from fieldtwin.gateway.core.image.image import TagKind\nfrom fieldtwin.plc.program import var_input\n"
        "from fieldtwin.plc.states import StateMachine, StateTable, Transition\n\n\nclass Winch(StateMachine):\n"
        "    depth = var_input(TagKind.REAL)\n    table = StateTable(\n"
        "        Transition('UP', 'DOWN', when='depth is not None and depth < 5'),\n"
        "        Transition('DOWN', 'LOST', when='depth is None', after_ms=30),\n    )\n"
    )
    (tmp_path / "winch_proof.py").write_text(
        "from fieldtwin.plc.prove import Proof, machine_key\nfrom winch import Winch\n\n"
        "PROOF = Proof(Winch, {'depth': [9.0, 2.5, None]},\n"
        "    {'never \"lost\"': lambda w: w.state_name != 'LOST'}, machine_key, requirement={'never \"lost\"': 'REQ-9'})\n"
    )
    out = tmp_path / "found.scenario.yaml"
    plc("prove", str(tmp_path / "site.yaml"), "-o", str(out))
    found = parse(out.read_text(), str(out)).data
    assert found["scenario"] == 'relay: never "lost"'
    assert (found["requirements"], found["needs"]) == (["REQ-9"], ["set_value", "inject_fault"])
    assert found["never"] == ["relay.state == 'LOST'"]
    assert found["steps"] == [
        {"pause": "10ms"},
        {"set": {"tag": "ctd.pressure", "value": 2.5}},
        {"pause": "10ms"},
        {"set": {"tag": "ctd.pressure", "value": 9.0}},
        {"pause": "20ms"},
        {"fault": {"id": "no-ctd", "name": "silence", "device": "ctd"}},
        {"pause": "5s"},
    ]
