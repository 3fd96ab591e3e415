"""A system of a PLC that only clients of its servers use: no buses, no devices, and no prototype file."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.site.system import load_system

PROGRAM = "PROGRAM Main VAR scans AT %QW0 : INT; END_VAR scans := scans + 1; END_PROGRAM"
SYSTEM = """fieldtwin: 1
system: line
plc:
  programs:
    main: {source: main.st}
serve:
  hmi: {url: "tcp://127.0.0.1:1502", addresses: openplc, write: true}
"""


def written(folder: Path, text: str) -> Path:
    (folder / "main.st").write_text(PROGRAM)
    path = folder / "line.yaml"
    path.write_text(text)
    return path


def test_a_system_needs_no_devices_and_no_prototype_file(tmp_path: Path) -> None:
    system = load_system(str(written(tmp_path, SYSTEM)))
    assert (system.buses, system.devices) == ({}, {})
    prototype = load_prototype(system)
    assert (prototype.buses, prototype.devices) == ({}, {})


def test_its_virtual_run_is_ok_without_published_values(tmp_path: Path) -> None:
    run = VirtualRun(VirtualOptions(str(written(tmp_path, SYSTEM)), 5.0, seed=1))
    run.run()
    summary = run.summary()
    assert summary["ok"], summary


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("fieldtwin: 1\nsystem: x\n", 1, "a system without devices and programs"),
        ('fieldtwin: 1\nsystem: x\nbuses:\n  b: {url: "tcp://127.0.0.1:502"}\n', 3, "no device is on the buses"),
        (SYSTEM + "devices:\n  d: {profile: modbus, bus: b}\n", 0, "no bus 'b'"),
    ],
)
def test_half_a_plant_is_refused(tmp_path: Path, text: str, line: int, message: str) -> None:
    with pytest.raises(FileInvalid, match=message) as caught:
        load_system(str(written(tmp_path, text)))
    assert caught.value.line == line or not line
