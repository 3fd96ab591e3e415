"""XDD and XDC: the way through XML changes no object, real constructs are read, and hostile XML is refused."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.descriptions.canopen import eds, xdc, xdd
from fieldtwin.descriptions.canopen.node import NodeDescription
from fieldtwin.descriptions.canopen.node_of_profile import OFFSET, VALUE_NAMES, node_of_profile
from fieldtwin.descriptions.canopen.xdd_reader import read_xdd
from fieldtwin.descriptions.canopen.xdd_writer import write_xdd
from fieldtwin.descriptions.conversion import Imported, Source
from fieldtwin.descriptions.profile_text import profile_text
from fieldtwin.descriptions.xml_tree import MAX_DEPTH, read_xml
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.protocols.canopen.eds.dictionary import load_dictionary

DEVICES = Path(__file__).parents[2] / "profiles" / "devices"
NAMES = ["io-cia401", "drive-cia402", "measuring-cia404", "encoder-cia406", "inclinometer-cia410"]


def shipped(name: str) -> DeviceProfile:
    return load_profile(DEVICES / f"{name}.yaml")


def node_of(name: str) -> NodeDescription:
    return node_of_profile(shipped(name), "XDD", (OFFSET, VALUE_NAMES))[0]


def loaded(result: Imported, folder: Path) -> DeviceProfile:
    for name, data in result.files.items():
        (folder / name).write_bytes(data)
    path = folder / "imported.yaml"
    path.write_text(profile_text(result.profile, "a test"), encoding="utf-8")
    return load_profile(path)


@pytest.mark.parametrize("name", NAMES)
def test_the_objects_of_a_node_are_the_same_after_an_xdd(name: str) -> None:
    node = node_of(name)
    again, repairs, lost = read_xdd(write_xdd(node, "x.xdd", 0), Path("x.xdd"))
    assert again.objects == node.objects
    assert (repairs, lost) == ((), ())
    stated = {key for key in node.device if not key.startswith("NrOf")}
    assert {key: int(again.device.get(key, "0"), 0) for key in stated if node.device[key].isdecimal()} == {
        key: int(node.device[key], 0) for key in stated if node.device[key].isdecimal()
    }
    assert again.device["VendorName"] == node.device["VendorName"]


@pytest.mark.parametrize("name", NAMES)
def test_a_profile_comes_back_from_its_xdd_with_units_scales_and_names_of_values(name: str, tmp_path: Path) -> None:
    profile = shipped(name)
    exported = xdd.export_description(profile, {})
    again = loaded(xdd.import_description(Source(Path("x.xdd"), exported.content), {}), tmp_path)
    theirs = {tag.object: tag for tag in again.tags.values()}
    for tag in profile.tags.values():
        other = theirs[tag.object]
        assert (other.type, other.access, other.unit, other.scale) == (tag.type, tag.access, tag.unit, tag.scale)
        assert (other.offset, other.values) == (tag.offset, tag.values)
    assert profile.eds_path is not None
    assert again.eds_path is not None
    before, after = load_dictionary(profile.eds_path, 5), load_dictionary(again.eds_path, 5)
    assert dict(after.entries) == dict(before.entries)
    assert after.mended == ()


def test_an_xdc_has_the_node_id_and_the_values_that_the_user_sets(tmp_path: Path) -> None:
    wanted = {"node": "12", "bitrate": "250", "1017:00": "500"}
    exported = xdc.export_description(shipped("drive-cia402"), wanted)
    profile = loaded(xdc.import_description(Source(Path("x.xdc"), exported.content), {}), tmp_path)
    assert profile.form.factory.node == 12
    assert profile.eds_path == tmp_path / "x.dcf"
    dictionary = load_dictionary(profile.eds_path)
    assert [(e.index, e.default) for e in dictionary if e.configured] == [(0x1017, 500)]
    assert "Baudrate=250" in profile.eds_path.read_text("utf-8").splitlines()


def test_an_xdd_loses_the_values_of_a_dcf(tmp_path: Path) -> None:
    exported = xdc.export_description(shipped("drive-cia402"), {"1017:00": "500"})
    configured = xdd.import_description(Source(Path("x.xdc"), exported.content), {})
    assert "the values that are set" in [loss.what for loss in configured.losses]
    profile = loaded(xdc.import_description(Source(Path("x.xdc"), exported.content), {}), tmp_path)
    assert "the values that are set" in [loss.what for loss in eds.export_description(profile, {}).losses]


REAL = """<?xml version="1.0" encoding="utf-8"?>
<ISO15745ProfileContainer xmlns="http://www.canopen.org/xml/1.1" xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance">
  <ISO15745Profile><ProfileBody xmlns:q1="http://www.canopen.org/xml/1.1" xmlns="">
    <q1:DeviceIdentity><q1:vendorName>Acme</q1:vendorName><q1:vendorID>327</q1:vendorID></q1:DeviceIdentity>
    <q1:ApplicationProcess>
      <q1:dataTypeList><q1:array name="a" uniqueID="A"/></q1:dataTypeList>
      <q1:parameterList>
        <parameter uniqueID="P1" access="readWrite" multiplier="0.5" offset="-40">
          <label lang="de">Drehzahl</label><label lang="en">Speed</label><description lang="en">of the shaft</description>
          <INT/><unit multiplier="1"><label lang="en">1/min</label></unit><defaultValue value="7"/>
          <allowedValues><range><minValue value="-100"/><maxValue value="200"/></range></allowedValues>
        </parameter>
      </q1:parameterList>
    </q1:ApplicationProcess>
  </ProfileBody></ISO15745Profile>
  <ISO15745Profile><ProfileBody><ApplicationLayers><CANopenObjectList>
    <CANopenObject index="2000" objectType="7" PDOmapping="TPDO" uniqueIDRef="P1"/>
    <CANopenObject index="2001" name="B" objectType="7" dataType="06" accessType="ro" defaultValue="$NODEID+9" actualValue="5"/>
    <CANopenObject index="0040" name="A type" objectType="6"/>
    %s
  </CANopenObjectList></ApplicationLayers></ProfileBody></ISO15745Profile>
</ISO15745ProfileContainer>
"""
"""The constructs of files of several makers: two namespaces, parameters, two digits of a data type, and types in the list."""


def real(more: str = "") -> Source:
    return Source(Path("real.xdd"), (REAL % more).encode())


def test_an_object_takes_from_its_parameter_what_it_does_not_state() -> None:
    node, repairs, lost = read_xdd(real().data, Path("real.xdd"))
    speed, other = node.values()
    assert (speed.name, speed.type_code, speed.access, speed.mappable) == ("Speed", 3, "rw", True)
    assert (speed.low, speed.high, speed.default) == ("-100", "200", "7")
    assert (speed.unit, speed.factor, speed.offset, speed.remark) == ("1/min", "0.5", "-40", "of the shaft")
    assert (other.default, other.configured, other.type_code) == ("$NODEID+9", "5", 6)
    assert node.device["VendorNumber"] == "327"
    assert repairs == ()
    assert [loss.what for loss in lost] == ["the composed data types"]
    more = '<CANopenObject index="2003" name="Mine" objectType="7" accessType="ro" defaultValue="9" uniqueIDRef="P1"/>'
    mine = read_xdd(real(more).data, Path("real.xdd"))[0].value(0x2003, 0)
    assert mine is not None
    assert (mine.name, mine.type_code, mine.access, mine.default, mine.high) == ("Mine", 3, "ro", "9", "200")
    tag = xdd.import_description(real(), {}).profile.tags["speed"]
    assert (tag.range, tag.scale, tag.offset) == ((-90, 60), 0.5, -40)


@pytest.mark.parametrize(
    ("more", "repair"),
    [
        ('<CANopenObject index="2002" name="x" objectType="7"/>', "2002h:00 has no basic data type: left out"),
        ('<CANopenObject index="2002" name="x" objectType="8"/>', "2002h has no sub-objects: left out"),
        (
            '<CANopenObject index="2002" name="x" objectType="7" dataType="0005" defaultValue="300"/>',
            "defaultValue of 2002h:00: '300' is not a value of its type: left out",
        ),
        (
            '<CANopenObject index="2002" name="x" objectType="7" dataType="0005" lowLimit="9" highLimit="1"/>',
            "the limits of 2002h:00 are not in order: both left out",
        ),
        (
            '<CANopenObject index="2002" name="x" objectType="7" dataType="0005" accessType="maybe"/>',
            "accessType 'maybe' is unknown: read as rw",
        ),
    ],
)
def test_a_repair_is_listed_with_its_line(more: str, repair: str) -> None:
    repairs = xdd.import_description(real(more), {}).repairs
    assert repairs == (f"line 20: {repair}",)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ('<CANopenObject index="2001" objectType="7" dataType="0005"/>', "real.xdd:20: the object 2001h occurs twice"),
        (
            '<CANopenObject index="xyz" objectType="7"/>',
            "real.xdd:20: index of <CANopenObject>; expected hexadecimal digits",
        ),
        (
            '<CANopenObject index="2002" objectType="var"/>',
            "objectType cannot be read; expected 2, 7, 8 or 9; got 'var'",
        ),
        ("<CANopenObject>", "real.xdd:21:5: not XML: mismatched tag"),
    ],
)
def test_what_cannot_be_repaired_is_refused_with_its_line(more: str, message: str) -> None:
    with pytest.raises(FileInvalid) as caught:
        xdd.import_description(real(more), {})
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('<!DOCTYPE x [<!ENTITY e SYSTEM "file:///etc/passwd">]><x>&e;</x>', "declares a document type"),
        ("<a>" * (MAX_DEPTH + 1) + "</a>" * (MAX_DEPTH + 1), "too many elements"),
        ("<a/>", "no CANopen objects in this file"),
        ("<CANopenObjectList/>", "no CANopen objects in this file"),
        ("<r><CANopenObjectList/></r>", "no CANopen objects in this file"),
        ("", "not XML: no element found"),
        ('<?xml version="1.0" encoding="none"?><a/>', "its encoding is not supported: unknown encoding"),
    ],
)
def test_other_and_hostile_xml_is_refused(text: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message):
        xdd.import_description(Source(Path("bad.xdd"), text.encode()), {})


@settings(max_examples=200, deadline=None)
@given(data=st.binary(max_size=200) | st.text(alphabet='<>/="ab&;! []', max_size=80).map(str.encode))
def test_any_bytes_are_xml_or_an_error_of_the_file(data: bytes) -> None:
    with contextlib.suppress(FileInvalid):
        read_xml(data, "any.xml")


@settings(max_examples=50, deadline=None)
@given(name=st.text(max_size=20), remark=st.text(max_size=20))
def test_every_text_can_be_written(name: str, remark: str) -> None:
    node = node_of("encoder-cia406")
    first = node.objects[0]
    changed = replace(first, name=name, values=(replace(first.values[0], name=name, remark=remark),))
    again, _, _ = read_xdd(write_xdd(replace(node, objects=(changed,)), name, 0), Path("x.xdd"))
    assert [v.index for v in again.values()] == [first.index]


ORDER = [
    "label",
    "description",
    "type",
    "denotation",
    "actualValue",
    "defaultValue",
    "substituteValue",
    "allowedValues",
    "unit",
]
"""The elements of a parameter in the order of the schema (CiA 311 1.1, A.1.3), with `type` for the one of its data type."""


@pytest.mark.parametrize("name", NAMES)
def test_exported_elements_have_the_order_of_the_schema(name: str) -> None:
    root = read_xml(write_xdd(node_of(name), "x.xdd", 0, xdc=True), "x.xdc")
    for parameter in root.all("parameter"):
        places = [ORDER.index(each.name if each.name in ORDER else "type") for each in parameter.children]
        assert places == sorted(places)
        assert ORDER.index("type") in places
    body = [each.name for each in next(root.all("ProfileBody")).children]
    assert body in (["DeviceIdentity", "DeviceManager", "DeviceFunction"], [*body[:3], "ApplicationProcess"])


def test_exported_file_has_the_elements_and_attributes_that_the_schema_requires() -> None:
    node = replace(node_of("io-cia401"), bitrate_kbit=None)
    root = read_xml(write_xdd(node, "x.xdc", 0, xdc=True), "x.xdc")
    characteristic = next(root.all("characteristic"))
    assert [each.name for each in characteristic.children] == ["characteristicName", "characteristicContent"]
    commissioning = next(root.all("deviceCommissioning"))
    required = {"nodeID", "nodeName", "actualBaudRate", "networkNumber", "networkName", "CANopenManager"}
    assert set(commissioning.attributes) == required
    assert read_xdd(write_xdd(node, "x.xdc", 0, xdc=True), Path("x.xdc"))[0].bitrate_kbit is None
