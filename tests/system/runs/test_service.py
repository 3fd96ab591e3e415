"""`fieldtwin run` under systemd: READY, the watchdog only while the gateway answers, STOPPING; events and metrics."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
from itertools import pairwise
from pathlib import Path

import pytest
from procs import CHECKOUT, Asking, wait_for
from prometheus_client.parser import text_string_to_metric_families

VALUES = "010400000"  # unit 1, function 04 from the first input register on
"""The first bytes of a read of the sensor's values, in hex."""


def ctd_polls(capture: Path) -> list[float]:
    """Return when the gateway polled the sensor's values, in seconds, by its own clock."""
    lines = [json.loads(line) for line in capture.read_text(encoding="ascii").splitlines() if line.endswith("}")]
    return [x["t_ns"] / 1e9 for x in lines if x.get("direction") == "sent" and x["hex"].startswith(VALUES)]


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")


@pytest.mark.long
def test_a_run_under_systemd(tmp_path: Path) -> None:
    run_dir = tmp_path / "r"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd, (tmp_path / "err").open("w+") as said:
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(20)
        told: list[str] = []

        def hear(start: str) -> str:
            """Return the next message that begins with this text."""
            while not (text := systemd.recv(4096).decode()).startswith(start):
                told.append(text)
            return text

        environment = {
            **os.environ,
            "FIELDTWIN_RUN": str(run_dir),
            "NOTIFY_SOCKET": str(tmp_path / "notify"),
            "WATCHDOG_USEC": "2000000",
        }
        fieldtwin = [sys.executable, "-m", "fieldtwin"]
        for name in ("observatory.yaml", "observatory.prototype.yaml"):
            shutil.copy(CHECKOUT / "profiles" / "systems" / name, tmp_path)
        system, capture = tmp_path / "observatory.yaml", tmp_path / "wires.jsonl"
        command = [*fieldtwin, "run", str(system), "--prototype", "--log", "json", "--capture", str(capture)]
        process = subprocess.Popen(
            [*command, "--metrics", "0"], cwd=CHECKOUT, env=environment, stdout=subprocess.DEVNULL, stderr=said
        )
        try:
            assert hear("READY=1")
            assert "devices answer" in hear("WATCHDOG=1")
            url = re.search(r'"metrics": "(\S+)"', Path(said.name).read_text())
            assert url is not None
            with urllib.request.urlopen(url[1], timeout=5) as answer:
                samples = [s for f in text_string_to_metric_families(answer.read().decode()) for s in f.samples]
            assert {s.labels["process"] for s in samples if s.name == "fieldtwin_up"} == {"gateway", "plc", "field"}

            # Three seconds of polls before and after a reload, from the capture.
            gateway_socket = Asking(str(run_dir / "observatory" / "gateway.sock"))
            wait_for(lambda: len(ctd_polls(capture)) > 3)
            edit(system, "values: {every_ms: 500}", "values: {every_ms: 1000}")
            process.send_signal(signal.SIGHUP)
            assert hear("RELOADING=1")
            assert hear("READY=1")
            before = len(ctd_polls(capture))
            wait_for(lambda: '"reloaded"' in Path(said.name).read_text())
            edit(system, "values: {every_ms: 1000}", "values: {every_ms: -1}")
            process.send_signal(signal.SIGHUP)
            wait_for(lambda: "not_reloaded" in Path(said.name).read_text(), what="a file that is not right is refused")
            edit(system, "values: {every_ms: -1}", "values: {every_ms: 300}")
            edit(system, "baudrate=19200", "baudrate=9600")
            asked = subprocess.run(
                [*fieldtwin, "reload", "observatory"], env=environment, cwd=CHECKOUT, capture_output=True, text=True
            )
            assert asked.returncode == 1
            assert f"{system}:7:11: buses.line1.url" in asked.stdout
            assert "Nothing was changed" in asked.stderr
            wait_for(lambda: len(ctd_polls(capture)) >= before + 3)
            slow = [b - a > 0.75 for a, b in pairwise(ctd_polls(capture)[1:])]
            assert slow == sorted(slow), "first every 500 ms, and then every 1000"
            assert 3 <= sum(slow) < len(slow)
            status = gateway_socket("get")
            assert status["config"]["reloads"] == 1
            assert status["buses"]["line1"]["counters"]["missed_polls"] == 0

            gateway = gateway_socket("ready")["pid"]
            os.kill(gateway, signal.SIGSTOP)
            try:
                hear("STATUS=")  # a status line that does not feed the watchdog
            finally:
                os.kill(gateway, signal.SIGCONT)
            assert hear("WATCHDOG=1")  # and it is fed again
            process.terminate()
            assert hear("STOPPING=1")
            process.wait(20)
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
        events = [json.loads(line)["event"] for line in Path(said.name).read_text().splitlines()]
    assert events[0] == "started"
    assert {"bus_open", "device_online", "plc_state"} <= set(events)
    assert [e for e in events if "reloaded" in e] == ["reloaded", "not_reloaded"]
    assert events[-1] == "stopping"
