"""Two prototypes and their two digital twins on one host, from one system file and with the same options."""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path

import pytest
from procs import Fieldtwin, fieldtwin, no_tracebacks, run_to_end, wait_for


def what_if(root: Path, system: str, instance: str) -> tuple[int, str, int]:
    """Return exit code, state and period of a fork of a running instance, a few seconds ahead; or the error."""
    ended = run_to_end(
        root, "what-if", system, "--from", f"instance:{instance}", "--horizon", "5s", "--json", name=f"if-{instance}"
    )
    if ended.process.returncode > 1:
        return ended.process.returncode, ended.err.removeprefix("fieldtwin: ").partition(";")[0], 0
    [outcome] = ended.summary["outcomes"]
    [(_, state)] = outcome["states"]["relay"]
    return ended.process.returncode, state, outcome["variables"]["ctd.sample_period_s"]["last"]


@pytest.mark.long
def test_two_twins_of_one_system_run_side_by_side_and_each_has_its_own_plant(tmp_path: Path) -> None:
    root = tmp_path / "r"
    with ExitStack() as stack:

        def start(*args: str, name: str) -> Fieldtwin:
            return stack.enter_context(fieldtwin(root, *args, "--instance", name, name=name))

        names = ("one", "two")
        same = ("run", "observatory", "--prototype", "--commands", "none", "--thread", "tcp://127.0.0.1:0")
        runs = [start(*same, name=name) for name in names]
        plants = [run.control(name, "thread") for run, name in zip(runs, names, strict=True)]
        places = [str(plant("get")["place"]) for plant in plants]
        assert len(set(places)) == 2
        twins = [
            start("twin", "observatory", "--from", place, "--json", "--command", str(period), name=f"{name}-twin")
            for place, period, name in zip(places, (3, 7), names, strict=True)
        ]
        twins[0].control("one-twin", "twin")("get")  # it exists, so the name is in use
        again = run_to_end(root, "twin", "observatory", "--from", places[0], "--instance", "one-twin", name="again")
        assert again.process.returncode == 4
        assert "is running already" in again.err
        for plant, twin in zip(plants, twins, strict=True):
            wait_for(lambda p=plant: p("get")["commands_taken"] == 1 and p("get")["sent_through"] > 20, 40, twin.err)
        assert what_if(root, "observatory", "two") == (0, "ACTIVE", 7)
        assert what_if(root, "ocean_west", "two") == (2, "the instance 'two' runs a different system", 0)
        assert what_if(root, "observatory", "three") == (4, "no instance 'three' is running here", 0)
        for twin in twins:
            twin.signal(2)
            assert twin.wait(20) == 0, twin.err
        for run in runs:
            run.signal(2)
            run.wait(20)
    assert [twin.summary["period_s"] for twin in twins] == [3, 7]
    assert len({tuple(twin.summary["origins"]) for twin in twins}) == 2, "each heard of its own plant only"
    for name, payload in zip(names, ("0003", "0007"), strict=True):
        audit = [json.loads(line) for line in (root / name / "audit.jsonl").read_text().splitlines()]
        assert [a["payload"] for a in audit if a["action"] == "command"] == [payload]
    no_tracebacks(root)
