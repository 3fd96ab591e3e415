"""Unfounded claims of the terminal and the audit log.

Defects: "ok" for a run whose sensor was silent to the end, without a note that a run with faults does not check devices; an
audit entry that a heartbeat had been written to a node whose heartbeat is only monitored; and an emulator that refused the
draft of a profile because the dump in the same folder is not a recording.
"""

from __future__ import annotations

import json
import socket
import tempfile
from pathlib import Path

import pytest
from click.testing import CliRunner
from gateway_canopen_rig import rig
from rich.console import Console
from rich.table import Table
from support import eventually, run

from fieldtwin.cli.run.simulate_command import command as simulate
from fieldtwin.cli.twin.shadow_command import exit_code, print_shadow
from fieldtwin.console import stderr, stdout
from fieldtwin.gateway.core.files.recording import looks_like_another_file
from fieldtwin.gateway.devices.config import Heartbeat
from fieldtwin.run.processes import plc_client
from fieldtwin.run.shadow.shadow import Shadowing
from fieldtwin.twin.plant.instance import Instance
from fieldtwin.twin.site.system import load_system

SILENT = "faults: [{name: silence, device: ctd}]\n"
VIRTUAL = ["observatory", "--for", "5s"]


def test_a_run_with_faults_reports_that_it_did_not_check_devices(tmp_path: Path) -> None:
    (tmp_path / "faults.yaml").write_text(SILENT)
    done = CliRunner().invoke(simulate, [*VIRTUAL, "--faults", str(tmp_path / "faults.yaml")], standalone_mode=False)
    assert (
        "not checked    whether devices and outputs were good at the end, because faults were injected" in done.stdout
    )
    assert "not checked" not in CliRunner().invoke(simulate, VIRTUAL, standalone_mode=False).stdout


def test_the_audit_log_names_only_writes_of_the_start_up(tmp_path: Path) -> None:
    async def main() -> None:
        for number, heartbeat in enumerate((Heartbeat(None, 150), Heartbeat(50, 150))):
            folder = tmp_path / str(number)
            folder.mkdir()
            async with rig(folder, heartbeat=heartbeat) as r:
                r.plug_node()
                await eventually(lambda r=r: r.status.online)
            lines = [json.loads(line) for line in (folder / "audit").read_text().splitlines()]
            assert [line["what"] for line in lines if line["action"] == "sdo"] == [
                ("heartbeat, " if heartbeat.producer_ms else "") + "TPDO1 as in the system file"
            ]

    run(main())


def test_a_dump_is_not_taken_for_the_recording_of_the_profile_in_its_folder(tmp_path: Path) -> None:
    dump, recording = tmp_path / "dump.jsonl", tmp_path / "recording.jsonl"
    dump.write_text('{"fieldtwin_dump":2,"protocol":"modbus"}\n')
    recording.write_text('{"fieldtwin_recording": 1, "device": "x", "kind": "exchanges", "source": "measured"}\n')
    assert looks_like_another_file(dump)
    assert not looks_like_another_file(recording)


@pytest.mark.parametrize("console", [stderr, stdout])
def test_a_name_between_colons_stays_a_name(console: Console) -> None:
    """Defect: `boom.py💥 step() failed` for the class `Boom` of a model."""
    with console.capture() as seen:
        console.print("boom.py:Boom: step() failed", soft_wrap=True)
    assert seen.get() == "boom.py:Boom: step() failed\n"


@pytest.mark.parametrize("console", [stderr, stdout])
def test_control_characters_of_a_name_are_shown_and_not_sent(console: Console) -> None:
    """Defect: the name of a scenario with ESC [31m made the rest of the terminal red."""
    table = Table("name")
    table.add_row("\x1b[31mred\x07")
    with console.capture() as seen:
        console.print("\x1b]0;title\x07 and so on", markup=False)
        console.print(table)
        console.print("two\nlines")
    assert "\x1b" not in seen.get()
    assert "\x07" not in seen.get()
    assert "two\nlines\n" in seen.get()


def test_the_socket_of_a_killed_plc_is_not_an_instance(monkeypatch: pytest.MonkeyPatch) -> None:
    """Defect: "several instances are running" after the PLC of an earlier one had been killed."""
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:  # short, because of the socket's path
        monkeypatch.setattr(plc_client, "runtime_root", lambda: Path(folder))
        for name in ("killed", "running"):
            (Path(folder) / name).mkdir()
            server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            server.bind(str(Path(folder) / name / "plc.sock"))
            if name == "killed":
                server.close()
        server.listen()
        with server:
            assert plc_client.running_instances() == ["running"]


def test_a_shadow_compares_no_states_with_a_plant_that_reports_none(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    # Defect: it printed "STANDBY" and ended with 1, "the states differed", because such a plant never reports a state.
    shadow = Shadowing(load_system("lab_vehicle"), "tcp://127.0.0.1:1", Instance("hall", tmp_path), on_verdict=print)
    seen = {**shadow.describe(), "origins": ["plant:1"], "thread": {"links": 1, "duplicates": 0, "trouble": ""}}
    print_shadow(seen)
    told = capsys.readouterr().err
    assert "states     not compared: no device of this system reports one" in told
    assert "STANDBY" not in told
    assert exit_code(seen) == 0
    reports = Shadowing(load_system("observatory"), "tcp://127.0.0.1:1", Instance("sea", tmp_path), on_verdict=print)
    assert exit_code(reports.describe()) == 1, "without a status there is no result"
