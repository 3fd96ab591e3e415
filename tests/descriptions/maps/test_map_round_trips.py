"""A profile that is exported and imported again is the same, except for the losses that the export lists."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fieldtwin.descriptions.conversion import Exported, Source
from fieldtwin.descriptions.profile_text import checked_profile, profile_text
from fieldtwin.gateway.core.files.profile import BIT_TABLES, DeviceProfile, Tag
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.files.profile_schema import ProfileForm, TagForm

PROFILES = Path(__file__).parents[3] / "profiles" / "devices"
FORMATS: list[tuple[str, dict[str, str]]] = [
    ("maps.telegraf", {"style": "request"}), ("maps.telegraf", {"style": "register"}), ("maps.home_assistant", {}),
    ("maps.thingsboard", {}), ("maps.neuron", {}), ("maps.wot", {}), ("aas.aid", {}),
]  # fmt: skip
SHIPPED = [
    path for path in sorted(PROFILES.glob("*.yaml")) if load_profile(path).protocol == "modbus"
]  # all the map formats hold Modbus registers only

LOST_WITH = {
    "unit": "unit of measurement", "values": "names of values", "range": "permitted range", "counter": "mark as a counter",
    "nonvolatile": "mark as stored without power", "danger": "danger of a write", "access": "write access",
}  # fmt: skip
"""The property of a tag, and the loss that permits it to differ."""


def exported_and_imported(
    name: str, options: dict[str, str], profile: DeviceProfile
) -> tuple[Exported, DeviceProfile | None]:
    module = import_module(f"fieldtwin.descriptions.{name}")
    out = module.export_description(profile, options)
    if all(any(loss.place == f"tag {tag}" and loss.what == "the tag" for loss in out.losses) for tag in profile.tags):
        return out, None
    back = module.import_description(Source(Path("map.txt"), out.content), {})
    return out, checked_profile(profile_text(back.profile, "a test"), "map.yaml")


def effective_order(tag: Tag) -> str:
    """The order, without differences that do not matter for a value of one register, a text or a bit."""
    if tag.registers.table in BIT_TABLES:
        return "none"
    if tag.type in ("string", "bytes") or tag.registers.count == 1:
        return "swapped" if tag.order in ("BADC", "DCBA") and tag.type != "bytes" else "plain"
    return tag.order


def assert_equal_except_losses(profile: DeviceProfile, out: Exported, back: DeviceProfile | None) -> None:
    lost = {(loss.place.removesuffix("_raw"), loss.what) for loss in out.losses}
    for tag in profile.tags.values():
        place = f"tag {tag.name}"
        if (place, "the tag") in lost:
            assert back is None or tag.name not in back.tags
            continue
        assert back is not None
        unscaled = (place, "scale and offset") in lost
        found = back.tags[f"{tag.name}_raw" if unscaled or (place, "scale factor") in lost else tag.name]
        assert found.type == ("uint16" if (place, "type bool") in lost else tag.type)
        for key in ("at", "bits"):
            assert getattr(found, key) == getattr(tag, key), (tag.name, key)
        assert (found.scale, found.offset) == ((1, 0) if unscaled else (tag.scale, tag.offset)), tag.name
        assert effective_order(found) == effective_order(tag)
        for key, what in LOST_WITH.items():
            assert getattr(found, key) == getattr(tag, key) or (place, what) in lost, (tag.name, key)
        assert found.poll == tag.poll or any(where == place and "poll group" in what for where, what in lost), tag.name
        assert set(found.sentinels) == set(tag.sentinels) or any(
            where == place and "values that mean" in what for where, what in lost
        )
    if back is not None:
        assert len(back.tags) == sum((f"tag {name}", "the tag") not in lost for name in profile.tags)
        assert back.form.factory.unit == profile.form.factory.unit


@pytest.mark.parametrize(("name", "options"), FORMATS)
@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_profile_returns_from_each_format(path: Path, name: str, options: dict[str, str]) -> None:
    profile = load_profile(path)
    out, back = exported_and_imported(name, options, profile)
    assert_equal_except_losses(profile, out, back)


ORDERS = st.sampled_from(["ABCD", "CDAB", "BADC", "DCBA"])
TEXTS = st.text(st.characters(codec="utf-8", categories=("L", "N", "P", "S", "Zs")), min_size=1, max_size=8).map(
    str.strip
)


@st.composite
def tags(draw: Callable[..., Any]) -> TagForm:
    table = draw(st.sampled_from(["coil", "discrete", "input", "holding"]))
    at = f"{table}:{draw(st.integers(0, 65_000))}"
    access = draw(st.sampled_from(["ro", "rw"])) if table in ("coil", "holding") else "ro"
    common = {"at": at, "access": access, "poll": draw(st.sampled_from(["values", "status", "attributes"]))}
    common["danger"] = draw(st.sampled_from(["", "", "starts-a-motor"]))
    common["secret"] = draw(st.integers(0, 9)) == 0
    if table in ("coil", "discrete"):
        return TagForm(type="bool", **common)
    kind = draw(
        st.sampled_from(
            [
                "int16",
                "uint16",
                "int32",
                "uint32",
                "int64",
                "uint64",
                "float32",
                "float64",
                "string",
                "bcd16",
                "bool",
                "bytes",
            ]
        )
    )
    common |= {"type": kind, "order": draw(ORDERS)}
    if kind in ("string", "bytes"):
        return TagForm(registers=draw(st.integers(1, 20)), **common)
    if kind in ("uint16", "bool") and draw(st.booleans()):
        low = draw(st.integers(0, 15))
        if kind == "bool":
            return TagForm(bits=(low, low), **common | {"access": "ro", "order": "ABCD"})
        return TagForm(bits=(low, draw(st.integers(low, 15))), **common | {"access": "ro", "order": "ABCD"})
    if kind == "bool":
        return TagForm(**common)
    return TagForm(
        scale=draw(st.sampled_from([1.0, 0.1, 0.001, 10.0, 2.5, 1 / 3, -0.5, 1e-7])),
        offset=draw(st.sampled_from([0.0, 0.0, -40.0, 0.25])),
        unit=draw(st.sampled_from(["", "V", "%", "degC", "5"]) | TEXTS),
        sentinels=draw(st.lists(st.sampled_from([0, 0x8000, 0xFFFF, 0x8000_0000, 1 << 63]), max_size=2, unique=True)),
        counter=draw(st.booleans()),
        **common,
    )


profiles = st.builds(
    lambda named, unit: ProfileForm(
        device="test/map",
        source="a test",
        protocol="modbus",
        numbering="sent",
        factory={"unit": unit},
        tags=named,  # type: ignore[arg-type]
    ),
    st.dictionaries(st.from_regex(r"[a-z][a-z0-9_]{0,8}", fullmatch=True), tags(), min_size=1, max_size=6),
    st.integers(0, 255),
)


@pytest.mark.parametrize(("name", "options"), FORMATS)
@given(form=profiles)
@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_generated_profile_returns_from_each_format(name: str, options: dict[str, str], form: ProfileForm) -> None:
    profile = checked_profile(profile_text(form, "a test"), "test.yaml")
    out, back = exported_and_imported(name, options, profile)
    assert_equal_except_losses(profile, out, back)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_flow_of_node_red_requests_the_registers_of_the_profile(path: Path) -> None:
    profile = load_profile(path)
    out, back = exported_and_imported("maps.node_red", {}, profile)
    assert back is not None
    lost = {loss.place for loss in out.losses if loss.what == "the tag"}
    expected = {
        (tag.registers.table, tag.registers.address + i)
        for tag in profile.tags.values()
        if f"tag {tag.name}" not in lost
        for i in range(tag.registers.count)
    }
    assert {(tag.registers.table, tag.registers.address) for tag in back.tags.values()} == expected
