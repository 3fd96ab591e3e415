"""Reading data sheets: contents of real ones, refused constructs, and the line in the error."""

from __future__ import annotations

from pathlib import Path

import canopen
import pytest
from canopen_slave_rig import INCLINOMETER, ROOT, U8, U32, record, var
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.emulators.canopen.eds import codec
from fieldtwin.emulators.canopen.eds.dictionary import load_eds, parse_eds
from fieldtwin.emulators.canopen.node import CanopenNode, NodeContext
from fieldtwin.emulators.canopen.node_data import NodeData
from fieldtwin.gateway.core.errors import FileInvalid, UsageError

SHARED = ROOT.parent / "shared" / "data" / "eds"
"""Real data sheets next to the checkout; tests that need them are skipped without them."""


def test_the_data_sheet_of_the_inclinometer_is_read() -> None:
    dictionary = load_eds(INCLINOMETER)
    data = NodeData(dictionary, 5)
    assert data.number(0x1000) == 2 << 16 | 410
    assert data.number(0x1018, 1) == 0, "no vendor"
    assert data.get(0x1008) == b"fieldtwin reference inclinometer"
    assert (data.number(0x1014), data.number(0x1200, 1), data.number(0x1800, 1)) == (0x85, 0x605, 0x185)
    assert data.number(0x6000) == 10
    for index in (0x6010, 0x6020):
        entry = data.find(index, 0)
        assert (entry.data_type, entry.access, entry.mappable) == (0x03, "ro", True)
    assert [data.number(0x1A00, sub) for sub in (0, 1, 2)] == [2, 0x60100010, 0x60200010]
    assert "no such product exists" in INCLINOMETER.read_text()


@pytest.mark.parametrize(
    "path", [INCLINOMETER, SHARED / "sample.eds", SHARED / "cia402_slave.eds"], ids=lambda p: p.name
)
def test_agrees_with_the_canopen_package(path: Path) -> None:
    """Two readers of one file: the gateway's side uses that package, this side its own reader."""
    if not path.exists():
        pytest.skip("the file is not here")
    ours, theirs = load_eds(path), canopen.import_od(str(path), node_id=5)
    assert {index for index in theirs if index >= 0x1000} == set(ours.objects)
    compared = 0
    for entry in ours.entries():
        other = theirs[entry.index]
        if isinstance(other, canopen.objectdictionary.ODVariable):
            variable = other
        elif entry.subindex in other.subindices and entry.name != "Highest subindex supported":
            variable = other[entry.subindex]
        else:
            continue  # a compact array: that package invents the omitted values
        assert variable.pdo_mappable == entry.mappable, entry
        assert variable.access_type == entry.access, entry
        if variable.default is not None and codec.is_number(entry.data_type):
            assert codec.decode(entry.data_type, entry.initial(5)) == pytest.approx(variable.default), entry
            compared += 1
    assert compared > 20


def test_a_file_that_the_canopen_package_refuses() -> None:
    path = SHARED / "DS301_profile.eds"
    if not path.exists():
        pytest.skip("the file is not here")
    dictionary = load_eds(path)
    assert dictionary.vendor_number == 0, "VendorNumber= is empty"
    node = CanopenNode(dictionary, 9)
    assert [str(f) for f in node.start(0)] == ["709#00"]


def test_empty_values_comments_indentation_and_case() -> None:
    text = (
        "; a comment\r\n[deviceINFO]\r\n  VendorNumber=\r\n\r\n[1017]\r\nParametername=Heartbeat ; said the editor\r\n"
        "DATATYPE=0x6\r\nAccessType=RW\r\nDefaultValue= 0x10\r\nPDOMapping=\r\n"
    )
    entry = parse_eds(text).entry(0x1017, 0)
    assert entry is not None
    assert (entry.name, entry.default, entry.mappable, entry.access) == ("Heartbeat", b"\x10\0", False, "rw")


@pytest.mark.parametrize("default", ["$NODEID+0x180", "0x180+$NODEID", "384 + $NodeId", "$nodeid + 0600"])
def test_node_id_in_defaults(default: str) -> None:
    entry = parse_eds(var("1800", U32, "rw", default)).entry(0x1800, 0)
    assert entry is not None
    assert entry.initial(5) == (0x185).to_bytes(4, "little")


def test_compact_array_names_and_values() -> None:
    text = (
        "[2100]\nParameterName=Sample\nObjectType=8\nDataType=3\nAccessType=rw\nDefaultValue=-1\nCompactSubObj=3\n"
        "[2100Name]\nNrOfEntries=1\n2=Special\n[2100Value]\nNrOfEntries=1\n3=0x7FFF\n"
    )
    entries = parse_eds(text).objects[0x2100].entries
    assert [e.default.hex() for e in entries.values()] == ["03", "ffff", "ffff", "ff7f"]
    assert [e.name for e in entries.values()][1:] == ["Sample1", "Special", "Sample3"]


def test_entries_beyond_a_compact_array_are_noted() -> None:
    text = "[2100]\nParameterName=A\nObjectType=8\nDataType=3\nAccessType=rw\nCompactSubObj=3\n"
    text += "[2100Value]\nNrOfEntries=1\n4=1\n"
    dictionary = parse_eds(text + "[2100Denotation]\nNrOfEntries=1\n1=aft\n")
    assert [str(note) for note in dictionary.notes] == ["line 9: entry 4 of [2100Value] is left out, there are 3"]


def test_a_domain_holds_the_file_that_a_dcf_names(tmp_path: Path) -> None:
    path = tmp_path / "unit.dcf"
    path.write_text(
        "[2100]\nParameterName=T\nObjectType=2\nDataType=15\nAccessType=rw\n"
        "UploadFile=was.bin\nDownloadFile=C:\\job\\table.bin\n"
    )
    dictionary = load_eds(path)
    assert [str(note) for note in dictionary.notes] == [
        "line 6: UploadFile of [2100]: nothing is stored there",
        "line 7: DownloadFile of [2100] cannot be read, the object is empty",
    ]
    (tmp_path / "table.bin").write_bytes(bytes(range(9)))
    entry = load_eds(path).entry(0x2100, 0)
    assert entry is not None
    assert entry.default == bytes(range(9))


def test_a_dcf_s_parameter_values_and_node_id() -> None:
    text = "[DeviceComissioning]\nNodeID=0x10\n" + var("1017", 6, "rw", 0) + "ParameterValue=500\n"
    dictionary = parse_eds(text)
    assert dictionary.node_id == 16
    assert dictionary.entry(0x1017, 0).default == b"\xf4\x01"  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("text", "line", "says"),
    [
        ("", 0, "without objects"),
        ("ParameterName=x\n", 1, "[section]"),
        ("[1000]\nnonsense\n", 2, "key=value"),
        ("[1000\n", 1, "header"),
        ("[1000]\nDataType=7\n[1000]\n", 3, "twice"),
        ("[1000]\nDataType=7\nDATATYPE=8\n", 3, "twice"),
        ("[1000]\nParameterName=x\n", 1, "no DataType"),
        ("[1000]\nDataType=seven\n", 2, "not a number"),
        ("[1000]\nDataType=7\nAccessType=maybe\n", 3, "ro, wo"),
        ("[DeviceInfo]\nCompactPDO=3\nNrOfTXPDO=513\n[1000]\nDataType=7\n", 3, "NrOfTXPDO"),
    ],
)
def test_a_broken_file_names_the_line(text: str, line: int, says: str) -> None:
    with pytest.raises(FileInvalid) as caught:
        parse_eds(text, "broken.eds")
    assert caught.value.line == line
    assert says in str(caught.value)
    assert str(caught.value).startswith("broken.eds")


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid, match=r"none\.eds"):
        load_eds(tmp_path / "none.eds")


def test_a_file_in_windows_encoding(tmp_path: Path) -> None:
    path = tmp_path / "umlaut.eds"
    path.write_bytes("[DeviceInfo]\nProductName=Gerät\n".encode("cp1252") + var("1000", U32).encode())
    assert load_eds(path).product_name == "Gerät"


@given(st.text(max_size=300) | st.text(alphabet="[]=0123456789ABsub;$\n\r \t", max_size=300))
def test_any_text_is_read_or_refused(text: str) -> None:
    try:
        parse_eds(text)
    except FileInvalid:
        pass


@given(
    st.sampled_from([(0x02, 8), (0x03, 16), (0x10, 24), (0x04, 32), (0x12, 40), (0x15, 64)]),
    st.data(),
)
def test_signed_numbers_survive(kind: tuple[int, int], data: st.DataObject) -> None:
    data_type, bits = kind
    value = data.draw(st.integers(-(1 << bits - 1), (1 << bits - 1) - 1))
    raw = codec.encode_text(data_type, str(value))
    assert len(raw) == bits // 8 == codec.size_bytes(data_type)
    assert codec.decode(data_type, raw) == value
    assert codec.encode_text(data_type, hex(value & (1 << bits) - 1)) == raw, (
        "two's complement, as data sheets write it"
    )


def test_factory_values_must_fit() -> None:
    dictionary = parse_eds(record("1018", [var("1018sub0", U8, "ro", 4), var("1018sub4", U32, "ro", 0)]))
    node = CanopenNode(dictionary, 1, NodeContext(factory={(0x1018, 4): b"\x2a\0\0\0"}))
    assert node.data.number(0x1018, 4) == 42
    with pytest.raises(UsageError, match="wrong length"):
        CanopenNode(dictionary, 1, NodeContext(factory={(0x1018, 4): b"\x2a"}))
    with pytest.raises(UsageError, match="no such object"):
        CanopenNode(dictionary, 1, NodeContext(factory={(0x1018, 5): b"\x2a"}))
    with pytest.raises(UsageError, match="node id"):
        CanopenNode(dictionary, 128)
