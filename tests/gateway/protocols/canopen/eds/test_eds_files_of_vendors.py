"""EDS and DCF files as vendors write them: accepted constructs, corrections, and refusals with their position."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.protocols.canopen.eds.concise_dcf import settings_of
from fieldtwin.gateway.protocols.canopen.eds.datatypes import DataType
from fieldtwin.gateway.protocols.canopen.eds.dictionary import DictionaryEntry, load_dictionary, parse_dictionary

EDS = """\
[FileInfo]
FileName=probe.eds

[Comments]
Lines=2
Line1=free text = here

[DeviceInfo]
VendorName=Nobody
VendorNumber=0x55
ProductName=Probe
ProductNumber=7

[DummyUsage]
Dummy0001=0

[1000]
ParameterName=Device type
ObjectType=0x7
DataType=0x0007
AccessType=ro
DefaultValue=0x2019A
PDOMapping=0

[1008]
ParameterName=Name ; what a person calls it
DataType=0x0009
AccessType=const
DefaultValue=probe

[1800]
ParameterName=TPDO1
ObjectType=0x9
SubNumber=2

[1800sub0]
ParameterName=Highest sub-index
ObjectType=0x7
DataType=0x0005
AccessType=const
DefaultValue=1

[1800sub1]
ParameterName=COB-ID
ObjectType=0x7
DataType=0x0007
AccessType=rw
DefaultValue=$NODEID+0x180

[6010]
ParameterName=Slope
ObjectType=0x7
DataType=0x0003
AccessType=ro
LowLimit=-900
HighLimit=0x384
PDOMapping=1
"""


def test_a_correct_file_is_read_without_corrections() -> None:
    od = parse_dictionary(EDS, 5)
    assert (od.vendor_name, od.vendor_number, od.product_name, od.product_number) == ("Nobody", 0x55, "Probe", 7)
    assert (od.node_id, od.mended, len(od)) == (5, (), 5)
    assert od.get(0x1000) == DictionaryEntry(0x1000, 0, "Device type", 7, "ro", 0x2019A)
    assert od.get(0x1008) == DictionaryEntry(0x1008, 0, "Name", 9, "const", "probe")
    assert od.get(0x1800, 1) == DictionaryEntry(0x1800, 1, "TPDO1.COB-ID", 7, "rw", 0x185)
    assert od.get(0x6010) == DictionaryEntry(0x6010, 0, "Slope", DataType.INTEGER16, "ro", None, -900, 900, True)
    assert od.get(0x6010, 1) is None
    cob_id = od.find("COB-ID")
    assert (cob_id.readable, cob_id.writable) == (True, True)
    with pytest.raises(UsageError, match="did you mean 'Slope'"):
        od.find("slope")


def test_without_node_id_dependent_values_are_unknown() -> None:
    entry = parse_dictionary(EDS).get(0x1800, 1)
    assert entry is not None
    assert entry.default is None


def test_a_dcf_brings_its_node_id_and_values() -> None:
    text = EDS + "\n[DeviceComissioning]\nNodeID=0x09\nBaudrate=125\n"
    od = parse_dictionary(text.replace("DefaultValue=probe", "DefaultValue=probe\nParameterValue=north"))
    assert od.node_id == 9
    assert [od.find(n).default for n in ("COB-ID", "Name")] == [0x189, "north"]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("VendorNumber=0x55", "VendorNumber=", "VendorNumber: empty"),
        ("PDOMapping=1", "PDOMapping=", "[6010] PDOMapping: empty"),
        ("Name=Slope\nObjectType=0x7", "Name=Slope\nObjectType=", "[6010] ObjectType: empty, read as 0x7"),
        (
            "AccessType=const\nDefaultValue=probe",
            "AccessType=const\nAccessType=const\nDefaultValue=probe",
            "occurs twice",
        ),
        ("[1008]", "[1007sub1]\nParameterName=lost\nDataType=5\nAccessType=ro\n[1008]", "no [1007]"),
        ("[1008]", "[1000sub1]\nParameterName=odd\nDataType=5\nAccessType=ro\n[1008]", "single variable"),
        ("[DeviceInfo]", "[DeviceInfo]\nCompactPDO=0x1F", "CompactPDO"),
        ("AccessType=ro\nLowLimit", "AccessType=\nLowLimit", "[6010] AccessType: missing, read as rw"),
    ],
)
def test_corrections_are_reported(old: str, new: str, said: str) -> None:
    assert old in EDS
    od = parse_dictionary(EDS.replace(old, new), 5)
    assert any(said in line for line in od.mended), od.mended
    assert od.get(0x1000) == parse_dictionary(EDS, 5).get(0x1000)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("ParameterName=Slope", "parametername=Slope"),
        ("[1800sub1]", "[1800SUB01]"),
        ("LowLimit=-900", "  LowLimit = -900"),
        ("DataType=0x0003", "DataType=003"),
        ("\n", "\r\n"),
        ("[FileInfo]", "\ufeff[FileInfo]"),
        ("[1800]\nParameterName=TPDO1\nObjectType=0x9\nSubNumber=2\n", ""),
    ],
)
def test_harmless_variants_are_accepted(old: str, new: str, tmp_path: Path) -> None:
    text = EDS.replace(old, new)
    if not new:
        text += "\n" + old  # the object after its sub-objects
    path = tmp_path / "probe.eds"
    path.write_bytes(text.encode())
    assert load_dictionary(path, 5).entries == parse_dictionary(EDS, 5).entries


COMPACT = EDS + (
    "[3000]\nParameterName=Valve\nObjectType=0x8\nCompactSubObj=5\nDataType=0x6\nAccessType=rw\nDefaultValue=4\n"
    "[3000Value]\nNrOfEntries=2\n1=0x1234\n4=99\n"
    "[3000Name]\nNrOfEntries=1\n4=Big valve\n"
    "[3000Denotation]\nNrOfEntries=1\n4=the one aft\n"
)


def test_a_dcf_sets_entries_of_compact_arrays() -> None:
    od = parse_dictionary(COMPACT)
    assert [(e.subindex, e.name, e.default) for e in od if e.index == 0x3000 and e.configured] == [
        (1, "Valve.Valve1", 0x1234),
        (4, "Valve.Big valve", 99),
    ]
    assert [e.default for e in od if e.index == 0x3000] == [5, 0x1234, 4, 4, 99, 4]
    assert [str(setting) for setting in settings_of(od)] == ["3000h:01 = 34 12", "3000h:04 = 63 00"]
    assert parse_dictionary(COMPACT.replace("4=99", "6=99")).mended == ("[3000Value] 6: left out, there are 5 entries",)
    with pytest.raises(FileInvalid, match=r"ParameterValue .*Valve1"):
        settings_of(parse_dictionary(COMPACT.replace("0x1234", "0x12345")))
    assert "not a compact array" in parse_dictionary(COMPACT.replace("CompactSubObj=5\n", "")).mended[0]


def test_a_domain_is_set_to_the_file_that_a_dcf_names(tmp_path: Path) -> None:
    domain = (
        "[5000]\nParameterName=Table\nObjectType=0x2\nDataType=0xF\nAccessType=rw\n"
        "UploadFile=was.bin\nDownloadFile=C:\\job\\table.bin\n"
    )
    path = tmp_path / "unit.dcf"
    path.write_text(EDS + domain, encoding="ascii")
    assert "[5000] DownloadFile: cannot be read: No such file or directory (line 64)" in load_dictionary(path).mended
    with pytest.raises(FileInvalid, match=r"5000sub0.*the file of a DOMAIN"):
        settings_of(load_dictionary(path))
    (tmp_path / "table.bin").write_bytes(bytes(range(9)))
    od = load_dictionary(path)
    assert [(s.index, s.data) for s in settings_of(od)] == [(0x5000, bytes(range(9)))]
    assert od.mended == ("[5000] UploadFile: nothing is stored there",)
    assert not settings_of(parse_dictionary(EDS + domain)), "of a text, no files are read"


def test_compact_arrays_have_all_their_entries() -> None:
    text = EDS + (
        "[3000]\nParameterName=Valve\nObjectType=0x8\nCompactSubObj=3\nDataType=0x6\nAccessType=rw\nDefaultValue=4\n"
        "[3000Name]\nNrOfEntries=1\n2=Big valve\n"
        "[3001]\nParameterName=Plain\nObjectType=0x8\nCompactSubObj=2\nDataType=0x5\nAccessType=ro\n"
        "[3002]\nParameterName=Not compact\nObjectType=0x8\nSubNumber=1\nCompactSubObj=0\n"
        "[3002sub0]\nParameterName=Count\nDataType=5\nAccessType=ro\nDefaultValue=0\n"
    )
    od = parse_dictionary(text)
    assert [(e.subindex, e.name, e.default) for e in od if e.index == 0x3000] == [
        (0, "Valve.Number of entries", 3),
        (1, "Valve.Valve1", 4),
        (2, "Valve.Big valve", 4),
        (3, "Valve.Valve3", 4),
    ]
    assert [e.subindex for e in od if e.index == 0x3001] == [0, 1, 2]
    assert [e.subindex for e in od if e.index == 0x3002] == [0]


@pytest.mark.parametrize(
    ("old", "new", "line", "match"),
    [
        ("DataType=0x0003", "DataType=word", 53, r"\[6010\] DataType: cannot be read; expected a number; got 'word'"),
        ("DataType=0x0003\n", "", 50, r"\[6010\] DataType: is missing"),
        ("AccessType=ro\nLowLimit", "AccessType=any\nLowLimit", 54, r"\[6010\] AccessType: cannot be read"),
        (
            "ParameterName=Slope",
            "ParameterName=Slope\nParameterName=Tilt",
            52,
            "ParameterName occurs twice; got also line 51",
        ),
        ("[6010]", "[1000]", 50, r"\[1000\] occurs twice"),
        ("[6010]", "[6010", 50, "without its bracket"),
        ("LowLimit=-900", "LowLimit", 55, "neither section nor key"),
        ("PDOMapping=1", "PDOMapping=08", 57, "PDOMapping: cannot be read"),
    ],
)
def test_refusals_name_the_place(old: str, new: str, line: int, match: str) -> None:
    assert old in EDS
    with pytest.raises(FileInvalid, match=match) as caught:
        parse_dictionary(EDS.replace(old, new), 5, path="probe.eds")
    assert str(caught.value).startswith(f"probe.eds:{line}: ")


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid, match="cannot be read"):
        load_dictionary(tmp_path / "none.eds")
    with pytest.raises(FileInvalid, match="no object"):
        parse_dictionary("[FileInfo]\nFileName=x\n")


def test_an_encoding_other_than_utf8_is_read_and_reported(tmp_path: Path) -> None:
    path = tmp_path / "probe.eds"
    path.write_bytes(EDS.replace("Nobody", "Mößler").encode("cp1252"))
    od = load_dictionary(path)
    assert od.vendor_name == "Mößler"
    assert od.mended == ("not UTF-8: read as Windows-1252",)


KEYS = [
    "ParameterName",
    "ObjectType",
    "DataType",
    "AccessType",
    "PDOMapping",
    "DefaultValue",
    "LowLimit",
    "CompactSubObj",
]
LINES = st.one_of(
    st.sampled_from(
        ["[1000]", "[1000sub0]", "[1000sub1]", "[1000Name]", "[DeviceInfo]", "[DeviceComissioning]", "[x]"]
    ),
    st.builds(
        lambda k, v: f"{k}={v}",
        st.sampled_from([*KEYS, "VendorNumber", "NodeID", "NrOfEntries", "1"]),
        st.sampled_from(["", "0", "1", "0x7", "8", "9", "0x1B", "0x40", "$NODEID+1", "ro", "99999999999", "%s", "é"]),
    ),
    st.text(max_size=12),
)


@given(lines=st.lists(LINES, max_size=25))
def test_any_text_is_a_dictionary_or_refused(lines: list[str]) -> None:
    try:
        od = parse_dictionary("\n".join(lines), 5)
    except FileInvalid:
        return
    for entry in od:
        assert entry.access
        assert od.get(entry.index, entry.subindex) is entry
