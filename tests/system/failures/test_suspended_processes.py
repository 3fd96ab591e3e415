"""SIGSTOP of each process for 10 s: nothing stale is published as good, the run reports it, and it recovers after SIGCONT."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from procs import (
    Asking,
    command_from_far,
    every_device_online,
    fieldtwin,
    held_by,
    no_tracebacks,
    wait_for,
)

pytestmark = [pytest.mark.long, pytest.mark.timeout(240)]
STOPPED_S = 10
PROCESSES = ("field", "gateway", "plc", "thread", "twin", "run")
WATCHED = ("ctd.pressure", "inclinometer.slope_long", "modem.link_state")
LATEST_S = 6.0
"""Maximum age of a good value: the slowest poll of the system, and the misses that a device may have."""


def good(status: dict[str, Any]) -> list[str]:
    return [name for name in WATCHED if status[name]["quality"] == "good"]


def test_each_process_is_stopped_for_ten_seconds(tmp_path: Path) -> None:
    words = ("run", "observatory", "--prototype", "--commands", "none", "--instance", "s", "--json")
    with fieldtwin(tmp_path, *words, "--thread", "tcp://127.0.0.1:0") as run:
        ask = {name: run.control("s", name) for name in PROCESSES if name not in ("run", "twin")}
        follow = ("twin", "observatory", "--from", ask["thread"]("get")["place"], "--instance", "tt", "--json")
        with fieldtwin(tmp_path, *follow, name="twin") as twin:
            ask["twin"] = twin.control("tt", "twin")
            pids = {name: run.pid_of("s", name) for name in ask if name != "twin"}
            pids |= {"run": run.process.pid, "twin": twin.process.pid}
            every_device_online(ask["gateway"])
            command_from_far(ask["field"]("get")["far"]["modem"], 1, 1)
            wait_for(lambda: well(ask), 30, "all is well")
            for name in PROCESSES:
                os.kill(pids[name], signal.SIGSTOP)
                try:
                    stood_still(name, ask)
                finally:
                    os.kill(pids[name], signal.SIGCONT)
                wait_for(lambda: well(ask), 30, f"all is well again after {name}")
            last = ask["thread"]("get")["sent_through"]
            wait_for(lambda: ask["thread"]("get")["sent_through"] > last, 20, "the twin goes on")
            twin.signal(signal.SIGINT)
            assert twin.wait(20) == 0, twin.err
        run.signal(signal.SIGINT)
        assert run.wait(20) == 1
    told = run.summary["errors"]
    for name in ("field", "gateway", "plc", "thread"):
        assert f"{name}: the process did not answer within 5 s" in told, told
    own = [text for text in told if text.startswith("run: this process was not scheduled for ")]
    assert own, told
    others = [text for text in told if text not in own and not text.endswith("the process did not answer within 5 s")]
    assert others == [], "and nothing that is not so"
    no_tracebacks(tmp_path)


def well(ask: dict[str, Asking]) -> bool:
    status, plc, field = ask["gateway"]("get"), ask["plc"]("get"), ask["field"]
    return bool(
        len(good(status["tags"])) == len(WATCHED)
        and all(device["online"] for device in status["devices"].values())
        and status["plc"]["alive"]
        and plc["gateway_alive"]
        and held_by(field, "ctd", "sample_period_s")[-1:] == ["0001"]
        and plc["inputs"]["inclinometer.slope_long"]["quality"] == "good"
        and ask["thread"]("get")["connected"]
    )


def stood_still(name: str, ask: dict[str, Asking]) -> None:
    """For ten seconds with that process stopped, check continuously the values published by the others."""
    began = time.monotonic()
    expected: dict[str, Callable[[], None]] = {
        "field": lambda: nothing_is_good(ask["gateway"], "tags"),
        "gateway": lambda: nothing_is_good(ask["plc"], "inputs"),
        "plc": lambda: outputs_are_safe(ask),
    }
    while (since_s := time.monotonic() - began) < STOPPED_S:
        if since_s > LATEST_S and name in expected:
            expected[name]()
        if name in ("thread", "twin", "run"):
            status = ask["gateway"]("get")
            assert good(status["tags"]) == list(WATCHED), "what only watches holds nothing up"
            assert status["plc"]["alive"]
        time.sleep(0.1)  # checked ten times a second


def nothing_is_good(asking: Asking, where: str) -> None:
    status = asking("get")[where]
    held = {name: value for name, value in status.items() if name in WATCHED}
    assert held
    assert [name for name, value in held.items() if value["quality"] == "good"] == []


def outputs_are_safe(ask: dict[str, Asking]) -> None:
    assert not ask["gateway"]("get")["plc"]["alive"]
    assert held_by(ask["field"], "ctd", "sample_period_s")[-1] == "0000"
