"""A test names an EDS, or a profile with an EDS, as its CANopen node.

Defects: `device="node.eds"` was read as YAML and refused, and a CANopen node with a profile needed a recording.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import canopen
import pytest
from device_rig import emulated, started_runner

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.testing.handles import DeviceHandle
from fieldtwin.testing.runner import FieldtwinRefused, WorkerProcess
from fieldtwin.testing.worker.sheet_profile import write_profile

SHEET = Path(__file__).parents[2] / "profiles" / "devices" / "inclinometer-cia410.eds"
PROFILE = """\
device: acme/tilt
source: "its manual"
protocol: canopen
factory: {node: 5}
eds: SHEET
tags:
  slope: {object: "6010:00", type: int16}
"""


@pytest.fixture(scope="module")
def runner() -> Iterator[WorkerProcess]:
    with started_runner() as runner:
        yield runner


def test_an_eds_is_a_device_whose_tags_are_its_objects(runner: WorkerProcess, tmp_path: Path) -> None:
    sheet = tmp_path / "tilt.eds"
    sheet.write_bytes(SHEET.read_bytes())
    with emulated(runner, "tilt.eds", unit=9, beside=str(tmp_path)) as device:
        assert _uploaded(device, sheet, 0x6010, "slope_long16", 123) == 123
        assert device.node == 9


def test_a_profile_with_an_eds_needs_no_recording(runner: WorkerProcess, tmp_path: Path) -> None:
    (tmp_path / "tilt.yaml").write_text(PROFILE.replace("SHEET", str(SHEET)), encoding="utf-8")
    with emulated(runner, "tilt.yaml", beside=str(tmp_path)) as device:
        assert device.node == 5
        assert _uploaded(device, SHEET, 0x6010, "slope", -77) == -77


def test_values_of_a_node_are_refused(runner: WorkerProcess, tmp_path: Path) -> None:
    (tmp_path / "tilt.eds").write_bytes(SHEET.read_bytes())
    with (
        pytest.raises(FieldtwinRefused, match=r"values for a CANopen node; expected .* device\.set"),
        emulated(runner, "tilt.eds", values={"slope_long16": 1}, beside=str(tmp_path)),
    ):
        pass


def test_a_damaged_data_sheet_is_named_with_its_line(runner: WorkerProcess, tmp_path: Path) -> None:
    (tmp_path / "tilt.eds").write_text("[FileInfo\n", encoding="utf-8")
    with pytest.raises(FieldtwinRefused, match=r"tilt\.eds"), emulated(runner, "tilt.eds", beside=str(tmp_path)):
        pass


def test_a_data_sheet_without_numbers_is_refused(tmp_path: Path) -> None:
    sheet = tmp_path / "text.eds"
    sheet.write_text(
        "[OptionalObjects]\nSupportedObjects=1\n1=0x1008\n"
        "[1008]\nParameterName=Device name\nObjectType=0x7\nDataType=0x0009\nAccessType=const\nPDOMapping=0\n",
        encoding="utf-8",
    )
    with pytest.raises(FileInvalid, match="no object that holds a number"):
        write_profile(sheet, tmp_path)


def test_objects_of_equal_names_have_index_and_subindex_in_their_tags(tmp_path: Path) -> None:
    sheet = tmp_path / "two.eds"
    sheet.write_text(
        "[OptionalObjects]\nSupportedObjects=3\n1=0x2000\n2=0x2001\n3=0x2002\n"
        + "".join(
            f"[{index}]\nParameterName={name}\nObjectType=0x7\nDataType=0x0006\nAccessType=rw\nPDOMapping=0\n"
            for index, name in (("2000", "Level"), ("2001", "level "), ("2002", "24 V supply"))
        ),
        encoding="utf-8",
    )
    text = write_profile(sheet, tmp_path).read_text(encoding="utf-8")
    assert [name for name in ("level_2000_00", "level_2001_00", "object_24_v_supply") if f"  {name}:" in text] == [
        "level_2000_00", "level_2001_00", "object_24_v_supply"
    ]  # fmt: skip


def _uploaded(device: DeviceHandle, sheet: Path, index: int, tag: str, value: int) -> int:
    """Set `tag`, and return what a third-party SDO client then reads at `index`."""
    network = canopen.Network()
    network.connect(interface=device.interface, channel=device.channel)
    try:
        node = network.add_node(device.node, str(sheet))
        device.set(tag, value)
        return int(node.sdo[index].raw)
    finally:
        network.disconnect()
