"""Processes that are killed mid-run, and a field simulator that disappears: the outputs must be safe, and the run must report
it.

The test acts as the remote client, so that each test decides when the observatory is ACTIVE.
"""

from __future__ import annotations

import json
import os
import signal
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from procs import (
    Asking,
    Fieldtwin,
    alive,
    command_from_far,
    every_device_online,
    fieldtwin,
    free_port,
    held_by,
    no_tracebacks,
    wait_for,
)
from stores import log_of, own

PROTOTYPE = ("run", "observatory", "--prototype", "--commands", "none", "--json")


def state_of(plc: Asking) -> str:
    return {0: "STANDBY", 1: "ACTIVE", 2: "OFF"}[plc("get")["variables"]["relay.state"]]


def make_active(run: Fieldtwin, instance: str, field: Asking, sequence: int = 1) -> None:
    """Command a period of 1 s from the remote client and wait until the sensor samples."""
    plc = run.control(instance, "plc")
    gateway = run.control(instance, "gateway")
    every_device_online(gateway)
    command_from_far(field("get")["far"]["modem"], sequence, 1)
    wait_for(lambda: state_of(plc) == "ACTIVE", 10, "ACTIVE")
    wait_for(lambda: held_by(field, "ctd", "sample_period_s")[-1] == "0001", 10, "the sensor samples")


@pytest.mark.long
def test_a_killed_plc_leaves_the_sensor_safe_and_the_run_names_the_dead_process(tmp_path: Path) -> None:
    with fieldtwin(tmp_path, *PROTOTYPE, "--instance", "p") as run:
        field = run.control("p", "field")
        make_active(run, "p", field)
        gateway = run.control("p", "gateway")
        os.kill(run.pid_of("p", "plc"), signal.SIGKILL)
        wait_for(lambda: held_by(field, "ctd", "sample_period_s")[-1] == "0000", 5, "the safe period")
        status = gateway("get")
        assert status["plc"]["alive"] is False
        assert status["writes"]["safe"] is True
        assert [o["by"] for o in status["outputs"]] == ["safe: the PLC's heartbeat was lost"]
        assert status["tags"]["inclinometer.slope_long"]["quality"] == "good"  # the others continue
        run.signal(signal.SIGINT)
        assert run.wait(4) == 1
        assert held_by_file(tmp_path / "p" / "audit.jsonl")[-1] == 0
    summary = run.summary
    assert summary["ok"] is False
    assert any(error.startswith("plc: ended with signal 9") for error in summary["errors"]), summary["errors"]
    no_tracebacks(tmp_path)


def held_by_file(audit: Path) -> list[float]:
    """Return the values of the confirmed writes in the audit log."""
    entries = [json.loads(line) for line in audit.read_text(encoding="utf-8").splitlines()]
    return [e["new"] for e in entries if e["action"] == "write" and e["result"] == "done"]


@pytest.mark.long
def test_a_killed_thread_process_is_restarted_and_its_twin_misses_nothing(tmp_path: Path) -> None:
    """The thread process is restarted, because a plant loses events every second without it. It blocks no other process."""
    args = (*PROTOTYPE, "--instance", "t", "--thread", "tcp://127.0.0.1:0")
    with fieldtwin(tmp_path, *args) as run:
        thread = run.control("t", "thread")
        place, first = thread("get")["place"], run.pid_of("t", "thread")
        twin = ("twin", "observatory", "--from", place, "--instance", "tt", "--json")
        with fieldtwin(tmp_path, *twin, "--command", "1", name="twin") as its:
            wait_for(lambda: answered(thread, "sent_through") > 20, 20, its.err)
            os.kill(first, signal.SIGKILL)
            wait_for(lambda: not alive(first), 5, "it is gone")
            wait_for(lambda: answered(thread, "place") == place, 10, "another one, at the same place")
            assert run.pid_of("t", "thread") != first
            wait_for(lambda: answered(thread, "sent_through") > 60, 20, "and the twin has found it")
            its.signal(signal.SIGINT)
            assert its.wait(10) == 0, its.err
        run.signal(signal.SIGINT)
        assert run.wait(6) == 1
    assert [error.partition(" (")[0] for error in run.summary["errors"]] == ["thread: ended with signal 9"]
    here, there = (tmp_path / name / "knowledge.sqlite" for name in ("t", "tt"))
    known = log_of(there, own(here, "plant"))
    assert len(known) > 60
    assert known == log_of(here, own(here, "plant"))[: len(known)]


def answered(asking: Asking, key: str) -> Any:
    """Return the value of that key; 0 if the channel does not answer."""
    with suppress(OSError):
        return asking("get")[key] or 0
    return 0


def test_a_killed_gateway_turns_the_plcs_inputs_bad(tmp_path: Path) -> None:
    with fieldtwin(tmp_path, *PROTOTYPE, "--instance", "g") as run:
        plc = run.control("g", "plc")
        field = run.control("g", "field")
        make_active(run, "g", field)
        wait_for(lambda: plc("get")["inputs"]["inclinometer.slope_long"]["quality"] == "good", 10, "a good input")
        os.kill(run.pid_of("g", "gateway"), signal.SIGKILL)

        def all_bad() -> bool:
            inputs = plc("get")["inputs"]
            measured = {n: v for n, v in inputs.items() if n.startswith(("ctd.", "inclinometer."))}
            return all((v["quality"], v["reason"]) == ("bad", "gateway dead") for v in measured.values())

        wait_for(all_bad, 5, "inputs bad")
        scans = plc("get")["scans"]
        wait_for(lambda: plc("get")["scans"] > scans + 20, 5, "the PLC scans on")
        assert plc("get")["gateway_alive"] is False
        run.signal(signal.SIGTERM)
        assert run.wait(4) == 1
    assert any(error.startswith("gateway: ended with signal 9") for error in run.summary["errors"])
    no_tracebacks(tmp_path)


@pytest.mark.long
def test_a_field_simulator_that_dies_and_returns_and_a_parent_that_is_killed(tmp_path: Path) -> None:
    """One system through all stages: lost, returned, written again; then the parent dies and the gateway leaves safe outputs."""
    ports = {name: free_port() for name in ("control", "lan", "can", "far")}
    prototype = tmp_path / "fixed.prototype.yaml"
    shipped = Path(__file__).resolve().parents[3] / "profiles" / "systems" / "observatory.prototype.yaml"
    prototype.write_text(
        shipped.read_text(encoding="utf-8").replace(
            'far: "tcp://127.0.0.1:0"', f'far: "tcp://127.0.0.1:{ports["far"]}"'
        ),
        encoding="utf-8",
    )
    emulate = (
        "emulate", "observatory", "--prototype-file", str(prototype), "--control", f"127.0.0.1:{ports['control']}",
        "--listen", f"lan=tcp://127.0.0.1:{ports['lan']}", "--listen", f"can0=can:fieldtwin/127.0.0.1:{ports['can']}",
    )  # fmt: skip
    watched = ("ctd.pressure", "inclinometer.slope_long", "modem.link_state")
    with fieldtwin(tmp_path, *emulate, name="field1") as first:
        field = first.control("observatory-field", "field")
        field_address = ("--field", f"127.0.0.1:{ports['control']}")
        with fieldtwin(tmp_path, *PROTOTYPE, *field_address, "--instance", "r") as run:
            make_active(run, "r", field)
            gateway = run.control("r", "gateway")
            wait_for(lambda: gateway("get")["tags"]["ctd.pressure"]["quality"] == "good", 5, "good samples")

            first.signal(signal.SIGKILL)
            first.wait(5)
            wait_for(lambda: not any(d["online"] for d in gateway("get")["devices"].values()), 10, "all devices lost")
            tags = gateway("get")["tags"]
            for name in watched:
                assert tags[name]["quality"] == "bad", name
                assert tags[name]["reason"] in ("timeout", "unreachable", "heartbeat lost"), (name, tags[name])

            with fieldtwin(tmp_path, *emulate, name="field2") as second:
                field = second.control("observatory-field", "field")
                wait_for(lambda: all(d["online"] for d in gateway("get")["devices"].values()), 15, "all devices back")
                wait_for(lambda: held_by(field, "ctd", "sample_period_s")[-1:] == ["0001"], 15, "the period again")

                def good_again() -> bool:
                    tags = gateway("get")["tags"]
                    return all(tags[name]["quality"] == "good" for name in watched)

                wait_for(good_again, 15, "values good again")
                command_from_far(field("get")["far"]["modem"], 1, 2)
                wait_for(
                    lambda: held_by(field, "ctd", "sample_period_s")[-1] == "0002", 10, "a new command gets through"
                )

                children = [run.pid_of("r", name) for name in ("plc", "gateway")]
                run.signal(signal.SIGKILL)
                run.wait(5)
                wait_for(lambda: held_by(field, "ctd", "sample_period_s")[-1] == "0000", 3, "safe outputs")
                wait_for(lambda: not any(alive(pid) for pid in children), 3, "the children end by themselves")
    no_tracebacks(tmp_path)
