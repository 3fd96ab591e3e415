"""`fieldtwin run` as systemd sees it: READY, the watchdog only while the gateway answers, STOPPING; events and metrics."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest
from procs import CHECKOUT, Asking, wait_for
from prometheus_client.parser import text_string_to_metric_families


@pytest.mark.slow
def test_a_run_under_systemd(tmp_path: Path) -> None:
    run_dir = tmp_path / "r"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd, (tmp_path / "err").open("w+") as said:
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(20)
        told: list[str] = []

        def hear(start: str) -> str:
            """The next message that begins so."""
            while not (text := systemd.recv(4096).decode()).startswith(start):
                told.append(text)
            return text

        environment = {
            **os.environ,
            "FIELDTWIN_RUN": str(run_dir),
            "NOTIFY_SOCKET": str(tmp_path / "notify"),
            "WATCHDOG_USEC": "2000000",
        }
        command = [sys.executable, "-m", "fieldtwin", "run", "observatory", "--prototype", "--log", "json"]
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

            process.send_signal(signal.SIGHUP)
            wait_for(lambda: "not_reloaded" in Path(said.name).read_text(), what="SIGHUP is answered")

            gateway = Asking(str(run_dir / "observatory" / "gateway.sock"))("ready")["pid"]
            os.kill(gateway, signal.SIGSTOP)
            try:
                hear("STATUS=")  # a line of status that feeds no watchdog
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
    assert events[-1] == "stopping"
