"""Both readers of data sheets accept the same files and interpret each object identically.

Defect: a DOMAIN with the DefaultValue ``@ABCD`` refused the whole data sheet in `emulate` and `check --eds`, while `read
--eds` accepted it. Each construct here was in a real file or follows from CiA 306-1; the readers differed in most of them.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from eds_agreement import NODE, differences
from hypothesis import example, given
from hypothesis import strategies as st

from fieldtwin.emulators.canopen.eds.dictionary import Dictionary, parse_eds
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.protocols.canopen.eds.concise_dcf import settings_of
from fieldtwin.gateway.protocols.canopen.eds.dictionary import ObjectDictionary, load_dictionary, parse_dictionary

ROOT = Path(__file__).parents[5]
SHIPPED = sorted((ROOT / "profiles" / "devices").glob("*.eds"))
HEAD = "[DeviceInfo]\nVendorName=x\n[1000]\nParameterName=Device type\nDataType=7\nAccessType=ro\nDefaultValue=0x191\n"


def one(kind: int | str, *lines: str, access: str = "AccessType=rw", object_type: str = "0x7") -> str:
    """A data sheet with one object at 2000h."""
    text = f"[2000]\nParameterName=Probe\nObjectType={object_type}\nDataType={kind}\n{access}\n"
    return HEAD + text + "".join(f"{line}\n" for line in lines)


def read_both(text: str) -> tuple[Dictionary, ObjectDictionary]:
    node, master = parse_eds(text, "x.eds"), parse_dictionary(text, NODE, path="x.eds")
    assert differences(node, master) == []
    return node, master


UNREADABLE = {
    "a DOMAIN with a text": one(0xF, "DefaultValue=@ABCD"),
    "a DOMAIN with an odd number of digits": one(0xF, "DefaultValue=ABC"),
    "an OCTET_STRING with a text": one(0xA, "DefaultValue=hello"),
    "a number that is no number": one(7, "DefaultValue=none"),
    "a number too large for its type": one(5, "DefaultValue=300"),
    "a negative number of an unsigned type": one(6, "DefaultValue=-1"),
    "a digit that no octal number has": one(7, "DefaultValue=08"),
    "a node id that is subtracted": one(7, "DefaultValue=$NODEID-1"),
    "a real number that is none": one(8, "DefaultValue=1,5"),
    "a real number too large for its type": one(8, "DefaultValue=1e99"),
    "a truth value in words": one(1, "DefaultValue=TRUE"),
    "a time that is no number": one(0xC, "DefaultValue=noon"),
    "a ParameterValue that is no number": one(7, "ParameterValue=none"),
    "a limit that is no number": one(7, "LowLimit=none", "HighLimit=5"),
    "a limit that is not a number": one(8, "LowLimit=0", "HighLimit=NaN"),
    "a limit too large for its type": one(5, "HighLimit=300"),
    "limits the wrong way round": one(7, "LowLimit=3", "HighLimit=1"),
    "a real type's limits the wrong way round": one(8, "LowLimit=3.5", "HighLimit=1.5"),
    "a data type that is not described": one(0x40),
    "a reserved data type": one(0x17, "DefaultValue=0102"),
    "no access type": one(7, access=""),
    "an empty access type": one(7, access="AccessType="),
    "a subindex of a single variable": one(7, "[2000sub1]", "ParameterName=s", "DataType=5", "AccessType=ro"),
    "a subindex of no object": one(7, "[2001sub1]", "ParameterName=s", "DataType=5", "AccessType=ro"),
    "an object of an unknown kind": one(7, "[2001]", "ParameterName=s", "ObjectType=0x55"),
    "values of a compact array that has fewer": HEAD
    + "[2000]\nParameterName=A\nObjectType=8\nDataType=5\nAccessType=rw\nCompactSubObj=2\n[2000Value]\n3=1\n",
    "a compact array of 255 entries": HEAD
    + "[2000]\nParameterName=A\nObjectType=8\nDataType=7\nAccessType=ro\nCompactSubObj=255\n",
    "a key that is given twice with one value": one(7, "DefaultValue=5", "DefaultValue=5"),
    "a DOMAIN whose file is missing": one(0xF, "DownloadFile=none.bin", object_type="2"),
    "no name": HEAD + "[2000]\nDataType=5\nAccessType=rw\n",
    "a node id that no node can have": one(7, "[DeviceComissioning]", "NodeID=255"),
    "a bit rate in bit/s": one(7, "[DeviceComissioning]", "Baudrate=125000"),
    "a vendor number in words": one(7).replace("VendorName=x", "VendorNumber=none"),
}
"""Invalid content of a file is omitted or interpreted, and both readers report it."""


@pytest.mark.parametrize("text", UNREADABLE.values(), ids=UNREADABLE)
def test_invalid_content_is_noted_by_both_readers_and_refuses_nothing(text: str) -> None:
    node, master = read_both(text)
    assert node.entry(0x1000, 0) is not None
    assert node.notes, "the emulated node's reader says nothing"
    assert master.mended, "the gateway's reader says nothing"


PLAIN = {
    "a DOMAIN in hexadecimal": (one(0xF, "DefaultValue=40414243"), b"@ABC"),
    "a DOMAIN with 0x": (one(0xF, "DefaultValue=0x40414243"), b"@ABC"),
    "a DOMAIN by its object type": (one(7, object_type="2"), None),
    "a DOMAIN without a data type": (one("", "DefaultValue=01 02", object_type="2"), b"\1\2"),
    "an OCTET_STRING in groups": (one(0xA, "DefaultValue=01 02 03"), b"\1\2\3"),
    "an OCTET_STRING with 0x and an odd digit": (one(0xA, "DefaultValue=0x102"), b"\1\2"),
    "an octal number": (one(7, "DefaultValue=010"), 8),
    "a signed number by its bits": (one(2, "DefaultValue=0xFF"), -1),
    "a signed number of 24 bits by its bits": (one(0x10, "DefaultValue=0xFFFFFF"), -1),
    "limits by their bits": (one(3, "LowLimit=0x8000", "HighLimit=0x7FFF"), None),
    "limits of 40 bits": (one(0x12, "LowLimit=-1", "HighLimit=0"), None),
    "limits of a real type": (one(8, "LowLimit=-4.5", "HighLimit=4.5", "DefaultValue=5.2"), 5.199999809265137),
    "a real number by its bits": (one(8, "DefaultValue=0x40490FDB"), 3.1415927410125732),
    "a time as a number": (one(0xC, "DefaultValue=0"), bytes(6)),
    "a time as its octets": (one(0xD, "DefaultValue=010203040506"), bytes(range(1, 7))),
    "the node id alone": (one(5, "DefaultValue=$NODEID"), NODE),
    "the node id behind": (one(7, "DefaultValue=0x180 + $NodeID"), 0x185),
    "a text with another alphabet": (one(0xB, "DefaultValue=abc\u2713"), "abc\u2713"),
    "a truth value": (one(1, "DefaultValue=1"), True),
    "a ParameterValue beside a DefaultValue": (one(7, "DefaultValue=1", "ParameterValue=2"), 2),
    "a type of a tool's own": (one(0xA0, "DefaultValue=7", "[A0sub1]", "DefaultValue=0x05"), 7),
    "remarks with a cross": (one(7, "# a remark", "DefaultValue=7"), 7),
    "a remark after a heading": (one(7, "DefaultValue=7").replace("[2000]", "[2000] ; the probe"), 7),
    "free text in a section of no object": (one(7, "DefaultValue=7", "[Tool]", "made on a Friday"), 7),
    "a data type's definition with parts": (
        one(7, "DefaultValue=7", "[0040]", "ParameterName=d", "ObjectType=6", "[0040sub1]", "ParameterName=p",
            "DataType=5", "AccessType=ro"),
        7,
    ),
    "lists and counts that are no numbers": (
        one(7, "DefaultValue=7", "SubNumber=?", "[OptionalObjects]", "SupportedObjects=?", "1=?"),
        7,
    ),
}  # fmt: skip
"""Valid content, with the value that 2000h starts with."""


@pytest.mark.parametrize(("text", "value"), PLAIN.values(), ids=PLAIN)
def test_valid_content_has_one_meaning_for_both_readers(text: str, value: object) -> None:
    _, master = read_both(text)
    entry = master.get(0x2000)
    assert entry is not None
    assert entry.default == value


def test_a_record_may_be_stored_compactly() -> None:
    text = HEAD + "[2000]\nParameterName=R\nObjectType=9\nDataType=5\nAccessType=rw\nCompactSubObj=3\nDefaultValue=4\n"
    _, master = read_both(text)
    assert [entry.default for entry in master if entry.index == 0x2000] == [3, 4, 4, 4]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_both_readers_take_every_encoding(tmp_path: Path, encoding: str) -> None:
    from fieldtwin.emulators.canopen.eds.dictionary import load_eds

    path = tmp_path / "x.eds"
    path.write_bytes(one(7, "DefaultValue=7").replace("VendorName=x", "VendorName=Müller").encode(encoding))
    node, master = load_eds(path), load_dictionary(path, NODE)
    assert differences(node, master) == []
    assert node.vendor_name == master.vendor_name == "Müller"


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_both_readers_agree_on_every_shipped_data_sheet(path: Path) -> None:
    node, master = read_both(path.read_text("utf-8"))
    assert node.notes == () == master.mended


@pytest.mark.parametrize(
    "line", ["DataType=word", "AccessType=perhaps", "PDOMapping=perhaps", "ObjectType=perhaps", "LowLimit"]
)
def test_an_unclear_kind_of_object_is_refused_by_both_readers_at_the_same_line(line: str) -> None:
    key = line.partition("=")[0]
    lines = [old for old in one(7).splitlines() if not old.startswith(key) or old.endswith("ro")]
    text = "\n".join([*lines, line])
    if key in ("DataType", "AccessType"):  # keep the valid line of the device type
        text = "\n".join([*HEAD.splitlines(), "[2000]", "ParameterName=P", *_rest(key), line])
    errors = []
    for read in (parse_eds, lambda text, path: parse_dictionary(text, NODE, path=path)):
        with pytest.raises(FileInvalid) as caught:
            read(text, "x.eds")
        errors.append(caught.value)
    assert {error.line for error in errors} == {len(text.splitlines())}


def _rest(key: str) -> list[str]:
    return [line for line in ("DataType=7", "AccessType=rw") if not line.startswith(key)]


def test_a_configuration_that_cannot_be_read_is_refused_when_it_would_be_sent() -> None:
    """Reading the sheet is harmless, but configuring a node with a part of it is not."""
    for line in ("ParameterValue=none", "DownloadFile=none.bin"):
        text = one(0xF, line, object_type="2")
        with pytest.raises(FileInvalid, match=r"\[2000\]|2000h|2000sub0"):
            settings_of(parse_dictionary(text, NODE, path="x.dcf", folder=ROOT))


KINDS = st.sampled_from([*range(0x1D), 0x40, 0xA0])
TEXTS = st.one_of(
    st.integers(-(1 << 65), 1 << 65).map(str), st.integers(0, 1 << 65).map(hex),
    st.integers(0, 1 << 33).map(lambda n: f"$NODEID+0x{n:X}"), st.integers(0, 0o7777).map(lambda n: f"0{n:o}"),
    st.floats(width=32).map(str), st.floats().map(str),
    st.binary(max_size=9).map(bytes.hex), st.text("0123456789abcdefxX+-. $NODEID@", max_size=12),
)  # fmt: skip


@given(KINDS, TEXTS, TEXTS, TEXTS, TEXTS, st.sampled_from(["7", "2"]))
@example(0xF, "@ABCD", "", "", "", "7")
@example(0xC, "0", "", "", "", "7")
@example(0xC, "", "0x1000000000", "", "", "7")  # a number with a length of six octets
def test_both_readers_agree_on_any_value(
    kind: int, default: str, parameter: str, low: str, high: str, object_type: str
) -> None:
    values = (f"DefaultValue={default}", f"ParameterValue={parameter}", f"LowLimit={low}", f"HighLimit={high}")
    text = one(f"0x{kind:X}", *values, object_type=object_type)
    node, master = parse_eds(text), parse_dictionary(text, NODE)
    assert differences(node, master) == []
