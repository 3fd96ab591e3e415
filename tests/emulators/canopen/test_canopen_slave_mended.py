"""Data sheets as tools write them: corrections are reported with their line; unusable ones with file, section and key."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from canopen_slave_rig import Rig, record, var
from support import eventually, run

from fieldtwin.emulators.canopen.eds.dictionary import load_eds, parse_eds
from fieldtwin.emulators.canopen.eds.text import MAX_LINES
from fieldtwin.emulators.canopen.node import CanopenNode
from fieldtwin.gateway.core.errors import FileInvalid

CHECKOUT = Path(__file__).parents[3]
LEAST = var("1000", 7, "ro", "0x0")


def notes(text: str) -> list[str]:
    return [str(note) for note in parse_eds(text).notes]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[DeviceInfo]\nVendorNumber=\n" + LEAST, "line 2: VendorNumber of [DeviceInfo] is empty, taken as 0"),
        ("[1000]\nDataType=7\nPDOMapping=\n", "line 3: PDOMapping of [1000] is empty, taken as 0"),
        ("[1000]\nDataType=7\nAccessType=\n", "line 3: AccessType of [1000] is missing, taken as rw"),
        ("[1000]\nDataType=7 ; unsigned\n", "line 2: a comment after the value of datatype in [1000] is left out"),
        ("[1000]\nDataType=7\nLowLimit=5\nHighLimit=3\n", "line 3: LowLimit of [1000] is above its HighLimit"),
        ("[2000]\nDataType=0x0070\n", "line 2: DataType 0070h of [2000] is not described, taken as DOMAIN"),
        ("[1000]\nDataType=5\nDefaultValue=300\n", "line 3: DefaultValue of [1000] is not a value of data type 0005h: 300"),
        ("[1000]\nDataType=5\nLowLimit=x\n", "line 3: LowLimit of [1000] is not a number of its type, left out: x"),
        (LEAST + "[1001sub1]\nDataType=5\n", "[1001sub1] is left out, there is no [1001]"),
        (LEAST + "[1002]\nObjectType=99\n", "ObjectType 63h of [1002] is unknown, the object is left out"),
        (LEAST + "[DeviceComissioning]\nNodeID=128\n", "NodeID of [DeviceComissioning] is not 1 to 127, left out"),
        (LEAST + "[DeviceComissioning]\nBaudrate=-1\n", "Baudrate of [DeviceComissioning] is not 1 to 1000, left out"),
        (LEAST + "[DeviceCommissioning]\nNodeID=9\n", "[DeviceCommissioning] taken as [DeviceComissioning]"),
        (LEAST + "[MandatoryObjects]\nSupportedObjects=2\n1=0x1000\n2=0x1001\n", "object 1001h is listed in"),
        (LEAST + "[OptionalObjects]\nSupportedObjects=0\n1=0x2000\n[2000]\nDataType=5\n", "1 objects are described, but"),
        (record("1018", [var("1018sub0", 5, "ro", 1)]).replace("SubNumber=1", "SubNumber=5"), "SubNumber of [1018] is 5, 1"),
    ],
)  # fmt: skip
def test_corrections_are_reported(text: str, told: str) -> None:
    assert any(told in note for note in notes(text)), notes(text)


def test_nothing_is_reported_for_a_correct_file() -> None:
    assert parse_eds("[DeviceInfo]\nVendorName=x\n" + LEAST).notes == ()
    for shipped in sorted((CHECKOUT / "profiles" / "devices").glob("*.eds")):
        assert load_eds(shipped).notes == (), shipped


@pytest.mark.parametrize(
    ("encoding", "told"),
    [
        ("utf-8-sig", []),
        ("utf-16", ["the file is in UTF-16"]),
        ("cp1252", ["line 2: not UTF-8, taken as Windows-1252"]),
    ],
)
def test_data_sheets_in_several_encodings_are_read(tmp_path: Path, encoding: str, told: list[str]) -> None:
    path = tmp_path / "x.eds"
    path.write_bytes(("[DeviceInfo]\nVendorName=Müller\n" + LEAST).encode(encoding))
    found = load_eds(path)
    assert found.vendor_name == "Müller"
    assert [str(note) for note in found.notes] == told


def test_compact_pdos_work() -> None:
    """Five undescribed TPDOs: four on the predefined identifiers, mapped by the client."""
    text = "[DeviceInfo]\nCompactPDO=0x13\nNrOfRXPDO=1\nNrOfTXPDO=5\n" + LEAST + var("2002", 6, "ro", 0x1234, 1)
    assert [str(note) for note in parse_eds(text).notes] == [
        "line 2: 1 of 1 PDOs from 1400h on are made by CompactPDO",
        "line 2: 5 of 5 PDOs from 1800h on are made by CompactPDO",
    ]
    rig = Rig(text)
    assert rig.read(0x1801, 1) == 0x285
    assert rig.read(0x1804, 1) == 0x80000000, "the predefined set has four"
    assert rig.read(0x1400, 1) == 0x205
    assert rig.read(0x1800, 0) == 5
    assert rig.read_code(0x1800, 3) == "06090011", "the mask has no inhibit time"
    assert rig.write(0x1800, 1, 0x80000185, 4) == ""
    assert rig.write(0x1A00, 1, 0x20020010, 4) == ""
    assert rig.write(0x1A00, 0, 1, 1) == ""
    assert rig.write(0x1800, 1, 0x185, 4) == ""
    assert rig.nmt(1) == ["185#3412"]


def test_a_described_pdo_is_not_made_again() -> None:
    text = (
        "[DeviceInfo]\nCompactPDO=1\nNrOfTXPDO=2\n"
        + LEAST
        + record("1800", [var("1800sub0", 5, "ro", 1), var("1800sub1", 7, "rw", "0x3FF")])
    )
    dictionary = parse_eds(text)
    assert sorted(index for index in dictionary.objects if index >= 0x1800) == [0x1800, 0x1801, 0x1A01]
    assert CanopenNode(dictionary, 3).data.number(0x1800, 1) == 0x3FF
    assert CanopenNode(dictionary, 3).data.number(0x1801, 1) == 0x283


def test_a_dcf_commissions() -> None:
    found = parse_eds(LEAST + "[DeviceComissioning]\nNodeID=0x11\nBaudrate=500\n")
    assert (found.node_id, found.bit_rate) == (17, 500_000)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[1000]\nDataType=seven\n", r"bad\.eds:2: .*DataType of \[1000\]"),
        ("[1000]\nnonsense\n", r"bad\.eds:2: .*in \[1000\]"),
        ("[DeviceInfo]\nNrOfRXPDO=600\nCompactPDO=1\n" + LEAST, r"bad\.eds:2: .*NrOfRXPDO"),
        ("[1000]\nDataType=7\nPDOMapping=yes\n", r"bad\.eds:3: .*PDOMapping of \[1000\]"),
        ("\n" * MAX_LINES, r"bad\.eds: .*too long"),
    ],
)
def test_malformed_files_name_file_section_and_key(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "bad.eds"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(FileInvalid) as caught:
        load_eds(path)
    assert re.search(told, str(caught.value)), caught.value


def test_the_command_reports_corrections_and_the_nodes_place(tmp_path: Path) -> None:
    path = tmp_path / "thing.dcf"
    path.write_text(
        "[DeviceInfo]\nVendorNumber=\n" + LEAST + "[DeviceComissioning]\nNodeID=23\nBaudrate=250\n", encoding="utf-8"
    )
    command = [sys.executable, "-m", "fieldtwin", "emulate", str(path), "--on", "can:fieldtwin/127.0.0.1:0"]
    said = tmp_path / "said"
    with said.open("w") as file, subprocess.Popen(command, stderr=file, cwd=CHECKOUT) as process:
        try:
            wait_for(lambda: "node 23 on can:fieldtwin/127.0.0.1:" in said.read_text(), process)
        finally:
            process.send_signal(signal.SIGINT)
        assert process.wait(10) == 0, said.read_text()
    assert said.read_text().startswith("thing.dcf, line 2: VendorNumber of [DeviceInfo] is empty, taken as 0\n")


def wait_for(condition: Callable[[], bool], process: subprocess.Popen[bytes]) -> None:
    async def main() -> None:
        await eventually(lambda: condition() or process.poll() is not None, within_s=15)

    run(main())
    assert condition()
