"""EDS and DCF: a profile survives the way through an EDS except for the listed losses, and the canopen package accepts it."""

from __future__ import annotations

from pathlib import Path

import canopen.objectdictionary
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.descriptions.canopen import dcf, eds
from fieldtwin.descriptions.canopen.eds_reader import read_eds
from fieldtwin.descriptions.canopen.eds_writer import write_eds
from fieldtwin.descriptions.canopen.node import RECORD, VAR, NodeDescription, NodeObject, NodeValue, number_of
from fieldtwin.descriptions.canopen.profile_of_node import mapped_objects
from fieldtwin.descriptions.canopen.tag_names import tag_names
from fieldtwin.descriptions.conversion import Imported, Source
from fieldtwin.descriptions.profile_text import checked_profile, profile_text
from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.profile import DeviceProfile, Tag
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.protocols.canopen.eds.dictionary import load_dictionary, parse_dictionary
from fieldtwin.gateway.protocols.canopen.pdo.mapping import PdoMapping

DEVICES = Path(__file__).parents[2] / "profiles" / "devices"
NAMES = ["io-cia401", "drive-cia402", "measuring-cia404", "encoder-cia406", "inclinometer-cia410"]


def shipped(name: str) -> DeviceProfile:
    return load_profile(DEVICES / f"{name}.yaml")


def loaded(result: Imported, folder: Path) -> DeviceProfile:
    """Write an imported profile with its files, and load it."""
    for name, data in result.files.items():
        (folder / name).write_bytes(data)
    path = folder / "imported.yaml"
    path.write_text(profile_text(result.profile, "a test"), encoding="utf-8")
    return load_profile(path)


def by_object(profile: DeviceProfile) -> dict[tuple[int, int], Tag]:
    return {tag.object: tag for tag in profile.tags.values() if tag.object is not None}


@pytest.mark.parametrize("name", NAMES)
def test_a_profile_comes_back_from_its_eds_except_for_the_listed_losses(name: str, tmp_path: Path) -> None:
    profile = shipped(name)
    exported = eds.export_description(profile, {})
    again = by_object(loaded(eds.import_description(Source(tmp_path / f"{name}.eds", exported.content), {}), tmp_path))
    lost = {(loss.place, loss.what) for loss in exported.losses}
    for key, tag in by_object(profile).items():
        place, other = f"tag {tag.name}", again[key]
        for what, one, two in (
            ("its name", tag.name, other.name),
            (f"its type {tag.type}", tag.type, other.type),
            (f"its access {tag.access}", tag.access, other.access),
            ("its offset", tag.offset, other.offset),
            ("the names of its values", tag.values, other.values),
            ("`danger`", tag.danger, other.danger),
            ("its unit", tag.unit, other.unit),
            ("its scale", tag.scale, other.scale),
        ):
            assert (one == two) != ((place, what) in lost), f"{place}: {what}: {one!r} and {two!r}"
        if tag.range is not None:
            assert other.limits == tag.range


@pytest.mark.parametrize("name", NAMES)
def test_the_object_dictionary_of_an_exported_eds_is_that_of_the_profile(name: str, tmp_path: Path) -> None:
    profile = shipped(name)
    text = eds.export_description(profile, {}).content.decode()
    assert profile.eds_path is not None
    before, after = load_dictionary(profile.eds_path, 5), parse_dictionary(text, 5)
    assert after.mended == ()
    assert dict(after.entries) == dict(before.entries)
    emulated = parse_eds(text, "exported.eds")  # the emulators' own reader
    assert not emulated.notes
    assert {entry.key for entry in emulated.entries() if entry.index >= 0x1000} == set(before.entries)


@pytest.mark.parametrize("name", NAMES)
def test_the_canopen_package_reads_an_exported_eds(name: str, tmp_path: Path) -> None:
    profile, path = shipped(name), tmp_path / "exported.eds"
    path.write_bytes(eds.export_description(profile, {}).content)
    theirs = canopen.objectdictionary.import_od(str(path), 5)
    for (index, subindex), tag in by_object(profile).items():
        entry = (
            theirs[index] if isinstance(theirs[index], canopen.objectdictionary.ODVariable) else theirs[index][subindex]
        )
        assert (entry.unit, entry.factor) == (tag.unit, tag.scale)


def test_a_range_of_a_profile_becomes_raw_limits(tmp_path: Path) -> None:
    profile = changed("drive-cia402", "target_torque:    {", "target_torque:    {range: [-50, 50], ", tmp_path)
    entry = parse_dictionary(eds.export_description(profile, {}).content.decode(), 5).get(0x6071)
    assert entry is not None
    assert (entry.low, entry.high) == (-500, 500)


def test_a_tag_whose_object_the_eds_lacks_becomes_an_object(tmp_path: Path) -> None:
    profile = changed("drive-cia402", "tags:", 'tags:\n  extra: {object: "2345:00", type: float32}', tmp_path)
    entry = parse_dictionary(eds.export_description(profile, {}).content.decode(), 5).get(0x2345)
    assert entry is not None
    assert (entry.name, entry.type_code) == ("extra", 8)


def changed(name: str, old: str, new: str, folder: Path) -> DeviceProfile:
    """Return a shipped profile with a change of its text."""
    text = (DEVICES / f"{name}.yaml").read_text(encoding="utf-8")
    assert old in text
    (folder / f"{name}.eds").write_bytes((DEVICES / f"{name}.eds").read_bytes())
    path = folder / f"{name}.yaml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    return load_profile(path)


def test_a_modbus_profile_cannot_become_an_eds() -> None:
    with pytest.raises(UsageError, match=r"modbus device; expected a canopen device for EDS"):
        eds.export_description(shipped("eastron-sdm630"), {})


def test_a_dcf_has_the_node_id_and_the_values_that_the_user_sets(tmp_path: Path) -> None:
    wanted = {"node": "12", "bitrate": "250", "1017:00": "500"}
    exported = dcf.export_description(shipped("drive-cia402"), wanted)
    path = tmp_path / "node12.dcf"
    path.write_bytes(exported.content)
    dictionary = load_dictionary(path)
    assert dictionary.node_id == 12
    assert [(e.index, e.default) for e in dictionary if e.configured] == [(0x1017, 500)]
    theirs = canopen.objectdictionary.import_od(str(path))
    assert (theirs.node_id, theirs.bitrate, theirs[0x1017].value) == (12, 250_000, 500)
    profile = loaded(dcf.import_description(Source(path, exported.content), {}), tmp_path)
    assert profile.form.factory.node == 12
    assert profile.eds_path == path
    again = dcf.export_description(profile, {}).content.decode().partition("[DeviceInfo]")
    assert again[2] == exported.content.decode().partition("[DeviceInfo]")[2]


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"9999:00": "1"}, "no object 9999:00"),
        ({"1017:00": "70000"}, "cannot use --set 1017:00=70000"),
        ({"1000:00": "1"}, r"1000:00 \(Device type\) cannot be written"),
        ({"node": "128"}, "a number from 1 to 127"),
        ({"x:y": "1"}, "cannot read the object 'x:y'"),
    ],
)
def test_a_wrong_setting_of_a_dcf_is_refused(setting: dict[str, str], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        dcf.export_description(shipped("drive-cia402"), setting)


def test_an_imported_profile_polls_what_the_pdos_carry(tmp_path: Path) -> None:
    name = "drive-cia402.eds"
    profile = loaded(eds.import_description(Source(Path(name), (DEVICES / name).read_bytes()), {}), tmp_path)
    assert profile.tags["statusword"].poll == "values"
    assert profile.tags["serial_number"].poll == "identity"
    assert profile.tags["following_error_window"].poll == "parameters"
    assert profile.tags["controlword"].access == "rw"
    assert profile.form.identify[0].tag == "serial_number"


def test_the_user_chooses_which_objects_become_tags() -> None:
    source = Source(Path("drive.eds"), (DEVICES / "drive-cia402.eds").read_bytes())
    count = {
        choice: len(eds.import_description(source, {"objects": choice}).profile.tags)
        for choice in ("pdo", "application", "all")
    }
    assert 0 < count["pdo"] < count["application"] < count["all"]
    with pytest.raises(UsageError, match="expected application, pdo, all"):
        eds.import_description(source, {"objects": "some"})
    with pytest.raises(UsageError, match="MAKER/TYPE"):
        eds.import_description(source, {"device": "Acme Drive"})


ONE_OBJECT = (
    "[DeviceInfo]\nVendorName=Acme\nProductName=T 1000\n[{}]\nParameterName=Speed\nObjectType=7\nAccessType=rw\n"
)


@pytest.mark.parametrize(
    ("keys", "what"),
    [
        ("DataType=0x0010\n", "its tag, of type INTEGER24"),
        ("DataType=0x0008\nLowLimit=1.5\n", "its limit"),
        ("DataType=0x0003\nFactor=half\n", "the factor half"),
    ],
)
def test_what_a_profile_cannot_say_is_listed(keys: str, what: str) -> None:
    text = ONE_OBJECT.format("2000") + keys + "[2001]\nParameterName=Other\nDataType=7\nAccessType=ro\n"
    result = eds.import_description(Source(Path("t.eds"), text.encode()), {})
    assert [loss.what for loss in result.losses] == [what]
    assert result.losses[0].place == "object 2000h:00"
    assert result.profile.device == "acme/t-1000"


def test_one_limit_of_an_integer_is_completed_by_that_of_its_type() -> None:
    text = ONE_OBJECT.format("2000") + "DataType=0x0006\nHighLimit=0x64\n"
    tag = eds.import_description(Source(Path("t.eds"), text.encode()), {}).profile.tags["speed"]
    assert tag.range == (0, 100)


def test_an_array_without_sub_objects_is_listed_as_left_out() -> None:
    text = (
        ONE_OBJECT.format("2000") + "DataType=6\n[2001]\nParameterName=Valve\nObjectType=8\nDataType=8\nAccessType=rw\n"
    )
    result = eds.import_description(Source(Path("t.eds"), text.encode()), {})
    assert result.repairs == ("[2001]: left out, 'Valve' has no sub-objects (line 9)",)
    assert list(result.profile.tags) == ["speed"]


def test_a_file_without_objects_for_tags_is_refused() -> None:
    text = ONE_OBJECT.format("1017") + "DataType=6\n"
    with pytest.raises(FileInvalid, match="no object becomes a tag"):
        eds.import_description(Source(Path("t.eds"), text.encode()), {})


def test_tag_names_differ_and_are_valid() -> None:
    objects = [(0x6000, 1, "Inputs", "Value"), (0x6001, 1, "Outputs", "Value"), (0x6002, 0, "24 V", "24 V")]
    assert tag_names(objects) == ["inputs_value", "outputs_value", "n24_v"]
    assert tag_names([(0x2000, 0, "Größe", "Größe"), (0x2001, 0, "+", "+")]) == ["gr_e", "object_2001_00"]


NUMBERS = {3: (-0x8000, 0x7FFF), 5: (0, 0xFF), 7: (0, 0xFFFFFFFF)}
TEXTS = st.text(
    st.characters(categories=("L", "N", "P", "S"), max_codepoint=0x2FF, exclude_characters=";[]=#"), max_size=30
)


@st.composite
def nodes(draw: st.DrawFn) -> NodeDescription:
    """Return a node with objects of whole numbers: single ones and records, with limits and defaults."""

    def value(index: int, subindex: int) -> NodeValue:
        code = draw(st.sampled_from(sorted(NUMBERS)))
        low, high = sorted(draw(st.tuples(*[st.integers(*NUMBERS[code])] * 2)))
        relative = code == 7 and draw(st.booleans())
        default = f"$NODEID+0x{draw(st.integers(0, 0x7FF)):X}" if relative else str(draw(st.integers(low, high)))
        return NodeValue(
            index,
            subindex,
            draw(TEXTS) or "a value",
            code,
            draw(st.sampled_from(["ro", "rw", "wo", "const", "rwr", "rww"])),
            default=draw(st.sampled_from(["", default])),
            low=str(low),
            high=str(high),
            mappable=draw(st.booleans()),
        )

    objects = []
    for index in sorted(draw(st.sets(st.integers(0x2000, 0x20FF), min_size=1, max_size=6))):
        if draw(st.booleans()):
            single = value(index, 0)
            objects.append(NodeObject(index, single.name, VAR, (single,)))
        else:
            subs = sorted(draw(st.sets(st.integers(0, 254), min_size=1, max_size=4)))
            objects.append(NodeObject(index, draw(TEXTS) or "a record", RECORD, tuple(value(index, s) for s in subs)))
    return NodeDescription(tuple(objects), {"VendorName": draw(TEXTS)})


@settings(max_examples=60, deadline=None)
@given(node=nodes())
def test_any_node_is_read_as_it_was_written(node: NodeDescription) -> None:
    again, repairs = read_eds(write_eds(node, "any.eds", 0), Path("any.eds"))
    assert again.objects == node.objects
    assert repairs == ()


def test_numbers_with_a_node_id_are_computed() -> None:
    assert number_of("$NODEID+0x180", 5) == 0x185
    assert number_of("0x200 + $nodeid", 1) == 0x201
    assert number_of("", 1) is None
    assert number_of("text", 1) is None


def test_mapped_objects_are_those_of_the_mapping_records() -> None:
    node, _ = read_eds((DEVICES / "io-cia401.eds").read_bytes(), Path("io.eds"))
    words = [0x60000108, 0x60000208]
    wanted = {(e.index, e.subindex) for e in PdoMapping.from_words(words).entries}
    assert wanted <= set(mapped_objects(node, 6))


def test_a_profile_with_text_that_yaml_could_misread_is_written_as_it_is() -> None:
    text = ONE_OBJECT.format("2000") + 'DataType=6\nUnit=%"{: \nDescription=yes: # "no"\n'
    result = eds.import_description(Source(Path("t.eds"), text.encode()), {})
    profile = checked_profile(profile_text(result.profile, "x\ny"), "t.yaml")
    assert profile.tags["speed"].unit == '%"{:'
    assert profile.form.tags["speed"].description == 'yes: # "no"'
