"""A field simulator started by hand: several runs against it, and a run that detects its loss."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from procs import CHECKOUT, every_device_online, fieldtwin, free_port, no_tracebacks, run_to_end, wait_for

RUN = ("run", "observatory", "--prototype", "--json", "--instance", "r")


@pytest.mark.long
def test_the_printed_command_finds_a_system_of_the_user(tmp_path: Path) -> None:
    """The bare name of a system finds only shipped ones and those in ./profiles."""
    site = tmp_path / "hall"
    assert run_to_end(tmp_path, "new", str(site), "--yes", "--control", "none", name="new").process.returncode == 0
    with fieldtwin(tmp_path, "emulate", str(site / "hall.yaml"), name="field") as side:
        wait_for(lambda: f"now: fieldtwin run {site}/hall.yaml --prototype" in side.err, 20, "its advice")


@pytest.mark.long
def test_one_field_simulator_serves_several_runs(tmp_path: Path) -> None:
    port = free_port()
    with fieldtwin(tmp_path, "emulate", "observatory", "--control", f"127.0.0.1:{port}", name="field") as side:
        wait_for(
            lambda: f"fieldtwin run observatory --prototype --field localhost:{port}" in side.err, 10, "its advice"
        )
        field = ("--field", f"localhost:{port}")
        for name in ("first", "second"):  # the second run finds counters, mailboxes and journals as the first left them
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
        assert any("the field simulator at localhost" in error for error in run.summary["errors"])
    no_tracebacks(tmp_path)


@pytest.mark.long
def test_a_field_simulator_that_returns_is_found_again(tmp_path: Path) -> None:
    """On the same ports, as in a container: a process that was killed and started again has no state of the first one."""
    port, can, lan, far = free_port(), free_port(), free_port(), free_port()
    there = tmp_path / "there"
    there.mkdir()
    shipped = CHECKOUT / "profiles/systems/observatory.prototype.yaml"
    text = shipped.read_text().replace('far: "tcp://127.0.0.1:0"', f'far: "tcp://127.0.0.1:{far}"')
    (there / "p.yaml").write_text(
        text.replace("prototype_of: observatory.yaml", f"prototype_of: {shipped.parent}/observatory.yaml")
    )
    emulate = ("emulate", "observatory", "--control", f"127.0.0.1:{port}", "--prototype-file", str(there / "p.yaml"),
               "--listen", f"can0=can:fieldtwin/127.0.0.1:{can}", "--listen", f"lan=tcp://127.0.0.1:{lan}")  # fmt: skip
    plain = tuple(word for word in RUN if word != "--json")
    with fieldtwin(tmp_path, *emulate, name="field") as side:
        wait_for(lambda: "now: fieldtwin run" in side.err, 10, "its advice")
        with fieldtwin(tmp_path, *plain, "--field", f"localhost:{port}", "--commands", "none") as run:
            gateway = run.control("r", "gateway")
            every_device_online(gateway)
            side.signal(signal.SIGKILL)
            side.wait(5)
            wait_for(lambda: not any(d["online"] for d in gateway("get")["devices"].values()), 10, "all lost")
            wait_for(lambda: run.err.count("was lost: the values") == 1, 10, "that it says so")
            assert all(tag["quality"] != "good" for tag in gateway("get")["tags"].values())
            with fieldtwin(tmp_path, *emulate, name="again"):
                wait_for(lambda: "is back after" in run.err, 15, "that it says so")
                every_device_online(gateway)
                run.signal(signal.SIGINT)
                assert run.wait(5) == 0, run.out
        assert run.err.count("was lost") == run.err.count("is back after") == 1
        assert "simulator      lost once" in run.out
    no_tracebacks(tmp_path)
    no_tracebacks(tmp_path)
