"""`--plant`: without devices, with devices and without permission to write, and with permission; also ports in use.

The plant's devices are a separately started field simulator; the run knows only the URLs in its system file.
"""

from __future__ import annotations

import json
import signal
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from procs import (
    CHECKOUT,
    Asking,
    command_from_far,
    every_device_online,
    fieldtwin,
    free_port,
    held_by,
    no_tracebacks,
    run_to_end,
    wait_for,
)
from stores import Row, log_of, own

SYSTEMS = CHECKOUT / "profiles" / "systems"


@pytest.mark.long
def test_without_devices_it_reports_retries_and_keeps_scanning(tmp_path: Path) -> None:
    (tmp_path / "systems").mkdir()
    system = (SYSTEMS / "observatory.yaml").read_text(encoding="utf-8")
    system = system.replace("rtu:/dev/ttyS0", f"rtu:{tmp_path}/ttyNONE").replace(
        "modem:502", f"127.0.0.1:{free_port()}"
    )
    system = system.replace("socketcan/can0", "socketcan/nocan0")
    (tmp_path / "systems" / "observatory.yaml").write_text(system, encoding="utf-8")
    path = str(tmp_path / "systems" / "observatory.yaml")
    ended = run_to_end(tmp_path, "run", path, "--plant", "--for", "4s", "--instance", "n")
    assert ended.process.returncode == 1, ended.err
    for bus, endpoint in (("line1", "ttyNONE"), ("can0", "nocan0"), ("lan", "tcp://127.0.0.1:")):
        told = [line for line in ended.err.splitlines() if line.startswith(f"! {bus}: ")]
        assert len(told) == 1, ended.err  # once, and not with every attempt
        assert endpoint in told[0]
        assert endpoint in ended.out
    as_json = run_to_end(tmp_path, "run", path, "--plant", "--for", "3s", "--instance", "n", "--json", name="json")
    assert as_json.process.returncode == 1
    summary = as_json.summary
    assert summary["ok"] is False
    assert len(summary["errors"]) == 3
    assert {d["state"] for d in summary["devices"].values()} == {"bad"}
    tags = summary["tags"]
    assert {t["quality"] for t in tags.values()} == {"bad"}
    assert {t["reason"] for t in tags.values()} == {"unreachable"}
    assert summary["plc"]["state"] == "running"
    assert summary["plc"]["scans"] > 150
    assert summary["mapping"] == {}
    no_tracebacks(tmp_path)


class Plant:
    """A field simulator on fixed endpoints, and the system file that has them as its plant."""

    def __init__(self, folder: Path, field: Asking, system: Path, line: Path) -> None:
        self.folder, self.field, self.system, self.line = folder, field, system, line

    def held(self) -> list[str]:
        return held_by(self.field, "ctd", "sample_period_s")

    def counters(self, device: str) -> dict[str, int]:
        found: dict[str, int] = self.field("get")["devices"][device]["counters"]
        return found


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Plant]:
    can, lan = free_port(), free_port()
    with fieldtwin(
        tmp_path, "emulate", "observatory", "--control", "127.0.0.1:0", "--instance", "f", "--listen",
        f"can0=can:fieldtwin/127.0.0.1:{can}", "--listen", f"lan=tcp://127.0.0.1:{lan}", name="field",
    ) as side:  # fmt: skip
        field = side.control("f", "field")
        line = tmp_path / "f" / "line1"
        text = (SYSTEMS / "observatory.yaml").read_text(encoding="utf-8")
        for old, new in (
            ("/dev/ttyS0", str(line)),
            ("socketcan/can0", f"fieldtwin/127.0.0.1:{can}"),
            ("modem:502", f"127.0.0.1:{lan}"),
        ):
            assert old in text
            text = text.replace(old, new)
        system = tmp_path / "site.yaml"
        system.write_text(text, encoding="utf-8")
        yield Plant(tmp_path, field, system, line)
        side.signal(signal.SIGINT)
        assert side.wait(4) == 0
    no_tracebacks(tmp_path)


def test_a_plant_is_only_read_until_it_may_be_written(plant: Plant) -> None:
    far = plant.field("get")["far"]["modem"]
    command_from_far(far, 1, 1)
    before = {"inclinometer": plant.counters("inclinometer")}
    with fieldtwin(plant.folder, "run", str(plant.system), "--plant", "--instance", "ro", "--json") as run:
        gateway, plc = run.control("ro", "gateway"), run.control("ro", "plc")
        wait_for(lambda: all(d["online"] for d in gateway("get")["devices"].values()), 15, "every device read")
        wait_for(lambda: gateway("get")["mailboxes"]["modem"]["received"] == 1, 5, "the command was read")
        wait_for(lambda: plc("get")["variables"]["relay.state"] == 1, 5, "and the control logic obeys it")
        refused = lambda: any(o["wanted"] == 1 and o["refused"] for o in gateway("get")["outputs"])  # noqa: E731
        wait_for(refused, 5, "its output is refused")
        polls = plant.counters("ctd")["requests"]
        wait_for(lambda: plant.counters("ctd")["requests"] > polls + 4, 10, "it goes on reading")
        run.signal(signal.SIGINT)
        assert run.wait(4) == 0, run.err
    assert "read-only" in run.err
    assert plant.held() == ["0000"]  # its factory setting
    node = plant.counters("inclinometer")
    assert node["requests"] > before["inclinometer"]["requests"]
    assert node["nmt_commands"] == before["inclinometer"]["nmt_commands"] == 0
    assert node["tpdos"] == 0  # no program started it
    assert node["frames_in"] == node["requests"]  # only its serial number and its mapping were requested
    entries = [json.loads(line) for line in (plant.folder / "ro" / "audit.jsonl").read_text().splitlines()]
    assert {e["action"] for e in entries} == {"refuse"}
    # the 0 of the first scan is refused too, unless the device was connected after the command had arrived
    assert [e["new"] for e in entries if e["by"] == "plc"] in ([1], [0, 1])
    assert "read-only" in entries[0]["result"]

    allowed = ("--allow-writes", "--instance", "rw", "--json")
    with fieldtwin(plant.folder, "run", str(plant.system), "--plant", *allowed, name="rw") as run:
        gateway = run.control("rw", "gateway")
        wait_for(lambda: plant.held()[-1] == "0001", 15, "the waiting command is carried out")
        wait_for(lambda: gateway("get")["tags"]["inclinometer.slope_long"]["quality"] == "good", 5, "the node runs")
        wait_for(lambda: gateway("get")["tags"]["ctd.pressure"]["quality"] == "good", 5, "samples come")
        run.signal(signal.SIGTERM)
        assert run.wait(4) == 0, run.err
    assert plant.held()[-1] == "0000"
    assert run.summary["outputs_safe"] is True


@pytest.mark.long
def test_a_plant_obeys_its_twin_while_its_switch_is_remote_and_both_know_the_same_in_the_end(plant: Plant) -> None:
    """No emulated connection anywhere: the plant's own file on both sides, the switch changed while the plant runs."""
    place = f"tcp://127.0.0.1:{free_port()}"
    with plant.system.open("a", encoding="utf-8") as file:
        file.write("commands: {period_s: [0, 60], per_minute: 60}\n")
    stores = [plant.folder / instance / "knowledge.sqlite" for instance in ("pt", "dt")]
    wanted: list[Row] = []
    args = ("run", str(plant.system), "--plant", "--allow-writes", "--instance", "pt", "--thread", place)
    with fieldtwin(plant.folder, *args) as run:
        every_device_online(run.control("pt", "gateway"))
        thread = run.control("pt", "thread")

        def twin(period_s: int, counts: str, model_s: int, name: str, *, dies: bool = False) -> None:
            n = thread("get")[counts]
            command = ("--command", str(period_s), "--instance", "dt")
            with fieldtwin(plant.folder, "twin", str(plant.system), "--from", place, *command, name=name) as its:
                wait_for(lambda: thread("get")[counts] == n + 1, 20, f"{counts}; {its.err}")
                mine, own_log = its.control("dt", "twin"), own(stores[0], "plant")
                wait_for(lambda: mine("get")["period_s"] == model_s, 5, "its model is as the plant is")
                wanted[:] = log_of(stores[0], own_log)
                wait_for(lambda: len(log_of(stores[1], own_log)) >= len(wanted), 20, "it knows what the plant knows")
                its.signal(signal.SIGKILL if dies else signal.SIGINT)
                its.process.wait(10)

        def switch(old: str, new: str) -> None:
            text = plant.system.read_text(encoding="utf-8")
            assert old in text
            plant.system.write_text(text.replace(old, new), encoding="utf-8")
            done = run_to_end(plant.folder, "reload", "pt", name="reload")
            assert done.process.returncode == 0, done.err
            assert f"{old} -> {new.partition(': ')[2]}" in done.out

        twin(2, "commands_taken", 2, "first", dies=True)
        switch("remote: remote", "remote: local")
        twin(3, "commands_refused", 2, "second")
        switch("remote: local", "remote: remote")
        twin(4, "commands_taken", 4, "third")
        assert plant.held()[-1] == "0004"
        assert "refused    by the plant: number 2 of twin:" in (plant.folder / "second.err").read_text()
        assert (thread("get")["commands_taken"], thread("get")["commands_refused"]) == (2, 1), "nothing is repeated"
        run.signal(signal.SIGINT)
        assert run.wait(6) == 0, run.err
    audit = [json.loads(line) for line in (plant.folder / "pt" / "audit.jsonl").read_text().splitlines()]
    assert [(e["action"], e.get("payload", "")) for e in audit if e["action"] in ("command", "reload")] == [
        ("command", "0002"), ("reload", ""), ("reload", ""), ("command", "0004"),
    ]  # fmt: skip
    plants, twins = own(stores[0], "plant"), own(stores[1], "twin")
    assert log_of(stores[1], plants)[: len(wanted)] == wanted, "no gap, none twice, row by row"
    assert log_of(stores[0], twins) == log_of(stores[1], twins)
    assert [row[5] for row in log_of(stores[0], twins)] == [b"\0\2", b"\0\3", b"\0\4"]


@pytest.mark.long
def test_another_device_than_expected_is_never_written(plant: Plant) -> None:
    plant.system.write_text(plant.system.read_text(encoding="utf-8").replace('"0042"', '"0815"'), encoding="utf-8")
    command_from_far(plant.field("get")["far"]["modem"], 1, 1)
    with fieldtwin(
        plant.folder, "run", str(plant.system), "--plant", "--allow-writes", "--instance", "w", "--json"
    ) as run:
        gateway = run.control("w", "gateway")
        wait_for(lambda: run.control("w", "plc")("get")["variables"]["relay.state"] == 1, 15, "ACTIVE")
        wait_for(lambda: gateway("get")["devices"]["ctd"]["polls"] > 3, 10, "the stranger was asked again")
        status = gateway("get")
        assert status["devices"]["ctd"]["identity_error"] == "serial is '0042'"
        assert status["tags"]["ctd.pressure"]["reason"] == "wrong device"
        run.signal(signal.SIGINT)
        assert run.wait(4) == 1
    assert plant.held() == ["0000"]
    assert any("a different device answers" in error for error in run.summary["errors"])


@pytest.mark.long
def test_ports_that_are_taken_are_named(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        for i, args in enumerate((
            ("emulate", "observatory", "--control", "127.0.0.1:0", "--listen", f"lan=tcp://127.0.0.1:{port}"),
            ("emulate", "observatory", "--control", "127.0.0.1:0", "--listen", f"can0=can:fieldtwin/127.0.0.1:{port}"),
            ("emulate", "observatory", "--control", f"127.0.0.1:{port}"),
            ("emulate", "ctd-reference", "--on", f"tcp://127.0.0.1:{port}"),
            ("run", "observatory", "--prototype", "--listen", f"lan=tcp://127.0.0.1:{port}", "--for", "3s"),
        )):  # fmt: skip
            ended = run_to_end(tmp_path, *args, name=f"try{i}")
            assert ended.process.returncode == 4, (args, ended.err)
            assert str(port) in ended.err, args
            assert ended.out == ""
    no_tracebacks(tmp_path)
