"""A field side that was started by hand: run after run against it, and a run that notices that it is gone."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from procs import fieldtwin, free_port, no_tracebacks, run_to_end, wait_for

pytestmark = pytest.mark.slow

RUN = ("run", "observatory", "--prototype", "--json", "--instance", "r")


@pytest.mark.long
def test_one_field_side_serves_run_after_run(tmp_path: Path) -> None:
    port = free_port()
    with fieldtwin(tmp_path, "emulate", "observatory", "--control", f"127.0.0.1:{port}", name="field") as side:
        wait_for(
            lambda: f"fieldtwin run observatory --prototype --field localhost:{port}" in side.err, 10, "its advice"
        )
        field = ("--field", f"localhost:{port}")
        for name in ("first", "second"):  # the second finds counters, mailboxes and journals as the first left them
            ended = run_to_end(tmp_path, *RUN, *field, "--commands", "1", "--for", "3s", name=name)
            assert ended.process.returncode == 0, ended.out + ended.err
            summary = ended.summary
            assert summary["states"]["relay"] == ["STANDBY", "ACTIVE"]
            assert summary["published"]["wrong"] == 0
            assert summary["published"]["checked"] > 20
            for bus, row in summary["exchanges"].items():
                assert {k: row["gateway"][k] for k in ("requests", "replies")} == row["emulators"], bus
        other = run_to_end(
            tmp_path, *RUN, "--field", f"localhost:{port + 1 if port < 65535 else port - 1}", name="wrong"
        )
        assert other.process.returncode == 4
        with fieldtwin(tmp_path, *RUN, *field, "--commands", "none", name="lost") as run:
            gateway = run.control("r", "gateway")
            wait_for(lambda: all(d["online"] for d in gateway("get")["devices"].values()), 10, "all online")
            side.signal(signal.SIGKILL)
            wait_for(lambda: not any(d["online"] for d in gateway("get")["devices"].values()), 10, "all lost")
            run.signal(signal.SIGINT)
            assert run.wait(5) == 1
        assert any("the field side at localhost" in error for error in run.summary["errors"])
    no_tracebacks(tmp_path)
