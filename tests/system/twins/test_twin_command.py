"""`fieldtwin twin` with a prototype: commands reach the control logic, once, and only while the plant allows it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from procs import CHECKOUT, fieldtwin, free_port, no_tracebacks, wait_for


@pytest.mark.long
def test_a_twin_commands_a_prototype_and_a_restarted_one_repeats_nothing(tmp_path: Path) -> None:
    root, place = tmp_path / "r", f"tcp://127.0.0.1:{free_port()}"
    shutil.copytree(CHECKOUT / "profiles", tmp_path / "profiles")
    system = tmp_path / "profiles" / "systems" / "observatory.yaml"
    system.write_text(system.read_text() + "commands: {period_s: [-1, 60], per_minute: 60}\n")
    rules = tmp_path / "rules.yaml"
    rules.write_text("rules: [{when: good, of: ctd.pressure, period_s: 3}]\n")
    twin = ("twin", str(system), "--from", place, "--for", "60s", "--json")
    with fieldtwin(
        root, "run", str(system), "--prototype", "--commands", "none", "--for", "60s", "--thread", place
    ) as run:
        plant = run.control("observatory", "thread")
        with fieldtwin(root, *twin, "--command", "1", "--plan", str(rules), name="first") as first:
            wait_for(lambda: plant("get")["commands_taken"] == 2, 30, f"period 1, and by the rule 3; {first.err}")
            first.process.kill()
        with fieldtwin(root, *twin, name="second") as second:
            wait_for(
                lambda: plant("get")["links"] >= 2 and plant("get")["waiting"] == 0, 30, f"caught up; {second.err}"
            )
            health = second.control("observatory-twin", "twin")
            wait_for(lambda: health("ready")["ready"], 20, "the twin says that it hears the plant")
            wait_for(lambda: health("get")["period_s"] == 3, 20, f"it knows what the first one commanded; {second.err}")
            second.signal(2)
            assert second.wait(20) == 0, second.err
        assert plant("get")["commands_taken"] == 2, "nothing is repeated"
        run.signal(2)
        run.wait(20)
    seen = second.summary
    assert (seen["state"], seen["period_s"], seen["sent"]) == ("ACTIVE", 3, 0)
    audit = [json.loads(line) for line in (root / "observatory" / "audit.jsonl").read_text().splitlines()]
    assert [a["payload"] for a in audit if a["action"] == "command"] == ["0001", "0003"]
    no_tracebacks(root)


@pytest.mark.long
def test_a_twin_that_asks_first_sends_only_what_its_prototype_allows(tmp_path: Path) -> None:
    root, place = tmp_path / "r", f"tcp://127.0.0.1:{free_port()}"
    question = ("--what-if", "20s", "--finally", "relay.state == 'ACTIVE'")
    with fieldtwin(
        root, "run", "observatory", "--prototype", "--commands", "none", "--for", "90s", "--thread", place
    ) as run:
        plant = run.control("observatory", "thread")
        commands = ("--command", "2", "--command", "0")
        with fieldtwin(
            root, "twin", "observatory", "--from", place, "--for", "90s", *question, *commands, name="twin"
        ) as twin:
            wait_for(lambda: "refused    period 0 s" in twin.err, 60, f"both were asked about; {twin.err}")
            assert plant("get")["commands_taken"] == 1
            twin.signal(2)
            assert twin.wait(20) == 0, twin.err
        run.signal(2)
        run.wait(20)
    assert "command    period 2 s" in twin.err
    assert "simulated: \"relay.state == 'ACTIVE'\" does not hold 20 s from now" in twin.err
    assert "0 planned, 2 simulated, 1 sent, 1 refused" in twin.err
    audit = [json.loads(line) for line in (root / "observatory" / "audit.jsonl").read_text().splitlines()]
    assert [a["payload"] for a in audit if a["action"] == "command"] == ["0002"]
    no_tracebacks(root)
