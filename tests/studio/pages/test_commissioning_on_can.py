"""The commissioning guide for a CANopen node on a software CAN bus, in a real Chromium, up to its emulation and comparison."""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from studio_rig import studio, until

pytest.importorskip("selenium", reason="needs selenium, which is in the extra dev")
from browser import MISSING, browser
from test_commissioning_page import go_to, opened, play

pytestmark = [pytest.mark.long, pytest.mark.skipif(bool(MISSING), reason=MISSING), pytest.mark.timeout(600)]

DEVICES = Path(__file__).parents[3] / "profiles" / "devices"
DEVICE = "inclinometer-cia410"


def free_bus() -> str:
    """Return a software CAN bus on a port that is free now."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return f"can:fieldtwin/127.0.0.1:{listener.getsockname()[1]}"


@contextmanager
def inclinometer(log: Path) -> Iterator[str]:
    """Emulate the inclinometer as node 5 in a separate process, and yield its bus."""
    bus = free_bus()
    command = [sys.executable, "-m", "fieldtwin", "emulate", DEVICE, "--on", bus, "--node", "5"]
    with log.open("wb") as out:
        node = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT)
    try:
        until(lambda: "node 5 on" in log.read_text(), "the node answers")
        yield bus
    finally:
        node.terminate()
        node.wait()


def test_a_canopen_node_is_identified_recorded_emulated_and_compared(tmp_path: Path) -> None:
    with inclinometer(tmp_path / "emulate.log") as bus, studio(folder=tmp_path) as running, browser() as page:
        opened(page, running)
        page.type("#field-endpoint", bus)
        page.type("#field-name", "incl")
        play(page, "Scan", "done", listen_s="0.5", units="3-6")
        page.sees(".outcome td", "in use")
        play(page, "Identify", "done")
        page.sees(".outcome", "fieldtwin/inclinometer-cia410: likely")
        go_to(page, "Dump")
        page.sees("#command-line", f"--node 5 --profile {DEVICE} -o incl-dump.jsonl")
        play(page, "Dump", "done")
        page.sees(".outcome", "51 values in 1 pass.")
        go_to(page, "Edit")
        page.sees("main", f"The known profile {DEVICE} fits")

        go_to(page, "Record")
        page.type("[name=sheet]", "none")  # the node has no heartbeat
        page.sees("#command-line", f"fieldtwin record {bus} --for 10s -o incl.log")
        play(page, "Record", "findings", for_s="1")
        page.sees(".outcome", f"Nothing was recorded: no frame arrived at {bus} in 1.")
        page.sees(".outcome", "check the bit rate")
        assert not (tmp_path / "incl.log").exists()
        page.type("[name=sheet]", DEVICE)
        play(page, "Record", "done", rounds="3", every_s="0.2")
        page.sees(".outcome", "18 frames in 3 rounds")

        copy = free_bus()
        go_to(page, "Emulate")
        page.sees("#command-line", "fieldtwin emulate incl.log --on can:fieldtwin/127.0.0.1:29536 --node 5")
        page.type("[name=on]", copy)
        page.sees("#command-line", copy)
        page.click("form button", "Emulate")
        page.sees(".messages", f"node 5 on {copy}")
        play(page, "Compare", "done", listen_s="0.5")
        page.sees(".outcome", "9 of 9 exchanges are equal")
        play(page, "Compare", "findings", listen_s="0.5")
        page.sees(".outcome", "An emulator gives each recorded value once.")
        go_to(page, "Emulate")
        page.click("form button", "Stop")
        page.sees(".outcome .chip", "stopped")

        play(page, "Check", "done")
        page.sees(".outcome", "No case failed.")
        play(page, "Report", "done")
        page.sees(".finish", f"The known profile {DEVICE} fits.")
        page.sees(".finish pre", f"fieldtwin new mysite --device incl={DEVICE}@{bus}#5 --yes")
        page.sees(".finish", "recording: ../incl.log")
        assert page.complaints() == []


def test_a_profile_of_a_canopen_node_begins_with_its_eds(tmp_path: Path) -> None:
    with inclinometer(tmp_path / "emulate.log") as bus, studio(folder=tmp_path) as running, browser() as page:
        opened(page, running)
        page.type("#field-endpoint", bus)
        page.type("#field-name", "incl")
        go_to(page, "Edit")
        page.sees("main", f"copy it into {tmp_path}")
        shutil.copy(DEVICES / f"{DEVICE}.eds", tmp_path / "incl.eds")
        page.driver.refresh()
        page.click("button", "Begin a profile")
        page.sees("#draft-errors", "mysite/incl, 1 tag")
        page.sees(".steps [data-step=edit]", "done")

        go_to(page, "Record")
        page.type("[name=address]", "5")
        page.sees("#command-line", f"fieldtwin record {bus} --eds incl.eds --node 5 --rounds 10 -o incl.log")
        play(page, "Record", "done", rounds="1")
        page.sees(".outcome dl", "refused\n4")
        go_to(page, "Check")
        page.sees("#command-line", "--node 5 --eds incl.eds")
        page.click(".steps a", "Report")
        page.sees(".finish pre", "cp incl.yaml incl.eds profiles/devices/")
        assert page.complaints() == []


def test_the_dump_of_a_canopen_node_counts_its_objects_and_names_their_indexes(tmp_path: Path) -> None:
    with inclinometer(tmp_path / "emulate.log") as bus, studio(folder=tmp_path) as running, browser() as page:
        opened(page, running)
        page.type("#field-endpoint", bus)
        page.sees(".top", bus)
        go_to(page, "Dump")
        page.type("[name=address]", "5")
        play(page, "Dump", "done", ranges="1000..1018")
        page.sees(".outcome td", "21: 1000h..1001h, ")
        assert page.complaints() == []
