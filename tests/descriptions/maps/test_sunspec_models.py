"""SunSpec models: the definitions that pysunspec2 ships are imported, and pysunspec2 reads our export."""

from __future__ import annotations

import json
import random
from dataclasses import replace
from pathlib import Path

import pytest
import sunspec2
from sunspec2.device import Model
from sunspec2.mdef import from_json_str

from fieldtwin.descriptions.conversion import Source
from fieldtwin.descriptions.maps.sunspec import export_description, import_description
from fieldtwin.descriptions.profile_text import checked_profile, profile_text
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.profile_file import load_profile, resolve
from fieldtwin.gateway.core.files.yaml_file import YamlFile
from fieldtwin.gateway.devices.codec import decode

ROOT = Path(__file__).parents[3]
MODELS = sorted((Path(sunspec2.__file__).parent / "models" / "json").glob("model_*.json"))


def imported(path: Path, **settings: str) -> DeviceProfile:
    found = import_description(Source(path, path.read_bytes()), settings)
    return checked_profile(profile_text(found.profile, "a test"), "model.yaml")


def model_path(number: int) -> Path:
    return next(path for path in MODELS if path.stem == f"model_{number}")


def test_every_model_that_pysunspec2_ships_is_imported() -> None:
    assert len(MODELS) > 100
    for path in MODELS:
        definition = json.loads(path.read_text(encoding="utf-8"))
        found = import_description(Source(path, path.read_bytes()), {"base": "100"})
        profile = resolve(YamlFile(path.name, found.profile.model_dump(exclude_defaults=True), {}))
        assert profile.tags["id"].registers.address == 100
        lost = sum(loss.what == "the tag" for loss in found.losses)  # points that no single request can read
        assert len(profile.tags) + lost >= len(definition["group"]["points"]), path.name


def test_points_have_the_addresses_that_pysunspec2_computes() -> None:
    for number in (1, 103, 160, 705, 64411):  # 64411 has points that no single request can read
        path = model_path(number)
        profile = imported(path, base="40002", repeat="0")
        offset = 40002
        for point in json.loads(path.read_text(encoding="utf-8"))["group"]["points"]:
            found = [tag.registers.count for tag in profile.tags.values() if tag.registers.address == offset]
            assert found == ([point["size"]] if point["size"] <= 125 else []), point["name"]
            offset += point["size"]


def test_scale_factors_units_symbols_and_missing_values_are_kept() -> None:
    tags = imported(model_path(103), base="40070").tags
    assert (tags["a"].scale_by, tags["a"].unit, tags["a"].sentinels) == ("a_sf", "A", (0xFFFF,))
    assert tags["wh"].counter
    assert dict(tags["st"].values)[4] == "MPPT"
    assert tags["a_sf"].type == "int16"


def test_repeating_group_is_read_as_often_as_the_user_states() -> None:
    found = import_description(Source(model_path(160), model_path(160).read_bytes()), {"repeat": "3"})
    assert {"module_1_id", "module_2_id", "module_3_id"} <= set(found.profile.tags)
    assert found.profile.tags["module_3_dcw"].scale_by == "dcw_sf"
    assert [loss.what for loss in found.losses].count("number of repetitions") == 1


def test_inverter_returns_from_sunspec() -> None:
    path = ROOT / "profiles" / "devices" / "sunspec-inverter-103.yaml"
    profile = load_profile(path)
    out = export_description(profile, {"model": "103", "base": "40070", "length": "50"})
    lost = {loss.place for loss in out.losses if loss.what == "the tag"}
    back = import_description(Source(Path("model_103.json"), out.content), {"base": "40070"})
    found = checked_profile(profile_text(back.profile, "a test"), "model.yaml").tags
    for name, tag in profile.tags.items():
        if f"tag {name}" in lost:
            continue
        for key in ("at", "type", "unit", "scale_by", "counter", "access", "values"):
            assert getattr(found[name], key) == getattr(tag, key), (name, key)
    assert "tag inverter_header" in lost
    assert found["id"].registers.address == 40070


def test_pysunspec2_decodes_the_exported_model_as_the_gateway_does() -> None:
    profile = load_profile(ROOT / "profiles" / "devices" / "sunspec-inverter-103.yaml")
    out = export_description(profile, {"model": "103", "base": "40070", "length": "50"})
    definition = from_json_str(out.content.decode())
    random_bytes = random.Random(103).randbytes(2 * 50)
    data = (103).to_bytes(2) + (50).to_bytes(2) + random_bytes
    model = Model(model_id=103, model_len=50, data=data, model_def=definition)
    compared = 0
    for name, tag in profile.tags.items():
        if name not in model.points or tag.is_text:
            continue
        at = 2 * (tag.registers.address - 40070)
        ours = decode(replace(tag, sentinels=(), range=None), data[at : at + 2 * tag.registers.count], 0).value
        assert model.points[name].value in (ours, None), name  # None: a sentinel
        compared += 1
    assert compared > 30


def test_export_needs_the_number_and_the_base_of_the_model() -> None:
    profile = load_profile(ROOT / "profiles" / "devices" / "sunspec-inverter-103.yaml")
    with pytest.raises(UsageError, match="its number and its base address"):
        export_description(profile, {})


@pytest.mark.parametrize(
    ("text", "message", "line"),
    [
        ('{"id": 1}', "`group`", 1),
        ('{"id": 0, "group": {}}', "`id`", 1),
        ('{"id": 1,\n "group": {"points": [\n  {"name": "X", "type": "uint17"}]}}', "the type of the point 'X'", 3),
        (
            '{"id": 1,\n "group": {"points": [\n  {"name": "X", "type": "int16", "size": 2}]}}',
            "the size of the point 'X'",
            3,
        ),
        (
            '{"id": 1,\n "group": {"points": [\n  {"name": "X", "type": "int16", "sf": "Y_SF"}]}}',
            "no point is called 'Y_SF'",
            3,
        ),
    ],
)
def test_wrong_definition_is_refused_with_its_line(text: str, message: str, line: int) -> None:
    with pytest.raises(FileInvalid) as caught:
        import_description(Source(Path("m.json"), text.encode()), {})
    assert message in str(caught.value)
    assert caught.value.line == line


def test_groups_that_are_nested_without_end_are_refused() -> None:
    group: dict[str, object] = {"name": "inner", "points": []}
    for _ in range(30):
        group = {"name": "outer", "points": [], "groups": [group]}
    with pytest.raises(FileInvalid, match="nested too deeply"):
        import_description(Source(Path("m.json"), json.dumps({"id": 1, "group": group}).encode()), {})
