"""Contradictions to a node's data sheet are reported before the node starts, with the option that overrides it.

Defects: a DCF of node 32 was applied to node 17 without a message, so that two nodes shared COB-IDs; 1006h = 1 us put a drive
into a fault that never ended; a drive whose 1000h has no value got no state machine, without a message.
"""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from canopen_slave_rig import record, var
from support import eventually, run

from fieldtwin.commissioning.access.connection import canopen_at
from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.eds.remarks import remarks
from fieldtwin.emulators.canopen.node import CanopenNode
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.site.system import load_system

CHECKOUT = Path(__file__).parents[4]
DRIVE = (CHECKOUT / "profiles" / "devices" / "drive-cia402.eds").read_text("ascii")
HEAD = "[DeviceInfo]\nVendorName=x\n" + var("1000", 7, "ro", "0x00020192")


def tpdo(cob_id: str, parameter: str = "") -> str:
    sub = var("1800sub1", 7, "rw", cob_id) + (f"ParameterValue={parameter}\n" if parameter else "")
    return record("1800", [var("1800sub0", 5, "const", 1), sub])


def texts(sheet: str, node: int, *, has_model: bool = True) -> list[str]:
    return [remark.text for remark in remarks(parse_eds(sheet), node, has_model=has_model)]


def test_cob_ids_of_another_node_are_named() -> None:
    sheet = HEAD + tpdo("$NODEID+0x180", "0x1A0")
    (remark,) = remarks(parse_eds(sheet), 17, has_model=True)
    assert remark.by_parameter_value
    assert remark.text == "these ParameterValues are COB-IDs of node 32, and this is node 17: 1800h:01 = 1A0h"
    assert texts(sheet, 32) == []
    (remark,) = remarks(parse_eds(HEAD + tpdo("0x1A0")), 17, has_model=True)
    assert not remark.by_parameter_value
    assert remark.text.startswith("these DefaultValues are COB-IDs of node 32")


def test_a_file_that_commissions_another_node_is_reported_without_any_cob_id() -> None:
    sheet = HEAD + var("1017", 6, "rw", 0) + "ParameterValue=500\n[DeviceComissioning]\nNodeID=32\n"
    assert texts(sheet, 32) == []
    (text,) = texts(sheet, 17)
    assert text == "the file commissions node 32, and this is node 17: its 1 ParameterValues are applied as they stand"


@pytest.mark.parametrize("cob_id", ["0x800001A0", "0x3A0", "0x180", "$NODEID+0x180", "0x191"])
def test_cob_ids_that_no_other_node_has_are_not_reported(cob_id: str) -> None:
    assert texts(HEAD + tpdo(cob_id), 17) == []


def test_a_sync_period_that_no_bus_can_keep_is_reported() -> None:
    sheet = HEAD + var("1006", 7, "rw", 0) + "ParameterValue=1\n"
    (remark,) = remarks(parse_eds(sheet), 17, has_model=True)
    assert remark.by_parameter_value
    assert "1006h (communication cycle period) is 1 us" in remark.text
    assert texts(HEAD + var("1006", 7, "rw", 1000), 17) == []


@pytest.mark.parametrize(
    ("device_type", "said"), [("", "1000h (device type) has no value"), ("0x198", "names the device profile 408")]
)
def test_a_missing_model_is_reported(device_type: str, said: str) -> None:
    sheet = var("1000", 7, "ro", device_type) + var("6040", 6, "rw", 0) + var("6041", 6, "ro", 0)
    (text,) = texts("[DeviceInfo]\nVendorName=x\n" + sheet, 17, has_model=False)
    assert said in text
    assert "no state machine implements them" in text


def test_the_factory_settings_hold_without_parameter_values() -> None:
    sheet = HEAD + tpdo("$NODEID+0x180", "0x1A0")
    assert CanopenNode(parse_eds(sheet), 17).data.number(0x1800, 1) == 0x1A0
    assert CanopenNode(parse_eds(sheet, parameter_values=False), 17).data.number(0x1800, 1) == 0x191


def emulated(tmp_path: Path, sheet: str, *options: str) -> tuple[list[str], int, int]:
    """Run `emulate` on a file; return its output, the COB-ID of TPDO 1, and the statusword."""
    path, said = tmp_path / "drive.dcf", tmp_path / "said"
    path.write_text(sheet)
    command = [sys.executable, "-m", "fieldtwin", "emulate", str(path), "--node", "17", *options]

    async def ask(url: str) -> tuple[int, int]:
        async with canopen_at(url, sdo_timeout_s=5.0) as master:

            async def number(index: int, subindex: int) -> int:
                return int.from_bytes(await master.sdo_upload(17, index, subindex), "little")

            async def tested() -> bool:
                return await number(0x6041, 0) & 0x6F == 0x40

            if "--model" in options:  # its self-test takes a moment; then it is in "switch on disabled"
                await eventually(tested)
            return await number(0x1800, 1), await number(0x6041, 0)

    with (
        said.open("w") as file,
        subprocess.Popen([*command, "--on", "can:fieldtwin/127.0.0.1:0"], stderr=file, cwd=CHECKOUT) as process,
    ):
        try:
            run(eventually(lambda: "a new bus with" in said.read_text() or process.poll() is not None, within_s=60))
            found = re.search(r"can:fieldtwin/[0-9.:]+[0-9]", said.read_text())
            assert found is not None, said.read_text()
            cob_id, status = run(ask(found[0]))
        finally:
            process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0, said.read_text()
    return said.read_text().splitlines(), cob_id, status


def test_emulate_reports_a_file_of_a_different_node_and_the_override(tmp_path: Path) -> None:
    sheet = DRIVE.replace("DefaultValue=$NODEID+0x180\n", "DefaultValue=$NODEID+0x180\nParameterValue=0x1A0\n")
    lines, cob_id, _ = emulated(tmp_path, sheet)
    assert cob_id == 0x1A0
    assert any("COB-IDs of node 32, and this is node 17" in line and "--defaults" in line for line in lines), lines
    lines, cob_id, _ = emulated(tmp_path, sheet, "--defaults")
    assert cob_id == 0x191
    assert not any("COB-IDs" in line for line in lines), lines


@pytest.mark.long
def test_emulate_reports_a_drive_without_a_model_and_how_to_choose_one(tmp_path: Path) -> None:
    sheet = DRIVE.replace("DefaultValue=0x00020192\n", "")
    lines, _, status = emulated(tmp_path, sheet)
    assert status == 0
    assert any("no state machine implements them" in line and "--model 402" in line for line in lines), lines
    lines, _, status = emulated(tmp_path, sheet, "--model", "402")
    assert status & 0x6F == 0x40, "switch on disabled"
    assert not any("no state machine" in line for line in lines), lines


def prototype_file(folder: Path, **devices: str) -> Path:
    """The lab vehicle's prototype file, with its drive's data sheet configured for node 32 and more keys for some devices."""
    sheet = DRIVE.replace("DefaultValue=$NODEID+0x180\n", "DefaultValue=$NODEID+0x180\nParameterValue=0x1A0\n")
    (folder / "odd.eds").write_text(sheet)
    profile = (CHECKOUT / "profiles" / "devices" / "drive-cia402.yaml").read_text()
    (folder / "odd.yaml").write_text(profile.replace("eds: drive-cia402.eds", "eds: odd.eds"))
    text = (CHECKOUT / "profiles" / "systems" / "lab_vehicle.prototype.yaml").read_text()
    for name, more in devices.items():
        text = re.sub(rf"( {name}: +{{model: profile)", rf"\1, {more}", text)
    path = folder / "odd.prototype.yaml"
    path.write_text(text)
    return path


@pytest.mark.long
def test_a_run_reports_contradictions_to_a_node_at_its_start(tmp_path: Path) -> None:
    path = prototype_file(tmp_path, drive="profile: odd.yaml", steering="cia: none")
    command = [sys.executable, "-m", "fieldtwin", "run", "lab_vehicle", "--prototype", "--prototype-file", str(path)]
    done = subprocess.run(
        [*command, "--for", "1s"], capture_output=True, text=True, cwd=CHECKOUT, timeout=120, check=False
    )
    assert re.search(
        r"drive: these ParameterValues are COB-IDs of node 32, .*`parameter_values: false`", done.stderr
    ), done.stderr


@pytest.mark.parametrize("key", ["cia: none", "parameter_values: false"])
def test_a_modbus_device_has_no_data_sheet_to_speak_of(tmp_path: Path, key: str) -> None:
    with pytest.raises(FileInvalid, match=key.partition(":")[0]) as caught:
        load_prototype(load_system("lab_vehicle"), prototype_file(tmp_path, console=key))
    assert caught.value.expected == "a CANopen device"
