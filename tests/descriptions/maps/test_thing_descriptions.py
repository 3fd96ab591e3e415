"""Thing Descriptions with the Modbus binding: what an export states, and how unstated terms are read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from fieldtwin.descriptions.conversion import Imported, Source
from fieldtwin.descriptions.maps.wot import export_description, import_description
from fieldtwin.descriptions.profile_text import checked_profile
from fieldtwin.gateway.core.errors import FileInvalid, UsageError

DEVICE = """
device: acme/pump
source: a test
protocol: modbus
numbering: sent
factory: {unit: 9}
timing: {timeout_ms: 700}
tags:
  speed: {at: 'holding:5', type: uint32, order: CDAB, access: rw, unit: rpm, range: [0, 3000], description: of the rotor}
  level: {at: 'input:8', type: int16, scale: 0.1, offset: -4, unit: m}
  run: {at: 'coil:2', type: bool, access: rw, danger: starts-a-motor}
  reset: {at: 'coil:3', type: bool, access: wo}
  serial: {at: 'holding:20', type: string, registers: 4, order: DCBA}
"""


def exported(**settings: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(export_description(checked_profile(DEVICE, "pump.yaml"), settings).content)
    return found


def imported(thing: dict[str, Any], **settings: str) -> Imported:
    return import_description(Source(Path("pump.td.json"), json.dumps(thing).encode()), settings)


def of(*forms: dict[str, Any], **schema: Any) -> dict[str, Any]:
    """Return a thing with one property, `x`."""
    return {
        "title": "acme",
        "base": "modbus+tcp://192.0.2.7:502/1/",
        "properties": {"x": schema | {"forms": list(forms)}},
    }


def tag(thing: dict[str, Any], **settings: str) -> dict[str, Any]:
    return next(iter(imported(thing, **settings).profile.tags.values())).model_dump(exclude_defaults=True)


def test_export_states_address_order_and_type_without_a_default() -> None:
    speed = exported(endpoint="tcp://192.0.2.7:1502")["properties"]["speed"]
    assert speed == {
        "type": "integer",
        "unit": "rpm",
        "minimum": 0,
        "maximum": 3000,
        "description": "of the rotor",
        "forms": [
            {
                "href": "modbus+tcp://192.0.2.7:1502/9/5?quantity=2",
                "contentType": "application/octet-stream;length=4;byteSeq=LITTLE_ENDIAN_BYTE_SWAP;signed=false",
                "modv:entity": "HoldingRegister",
                "modv:type": "xsd:unsignedInt",
                "modv:zeroBasedAddressing": True,
                "modv:mostSignificantByte": True,
                "modv:mostSignificantWord": False,
                "modv:timeout": 700,
                "op": ["readproperty", "writeproperty"],
            }
        ],
    }


def test_scaled_value_is_exported_as_raw_value_with_its_conversion() -> None:
    found = exported()["properties"]
    assert "level" not in found
    assert found["level_raw"]["description"] == "Raw value: multiply it by 0.1, then add -4, to get m"
    assert "unit" not in found["level_raw"]


def test_scaled_tag_is_left_out_if_a_tag_has_the_name_of_its_raw_value() -> None:
    profile = checked_profile(DEVICE + "  level_raw: {at: 'input:9'}\n", "pump.yaml")
    out = export_description(profile, {})
    assert json.loads(out.content)["properties"]["level_raw"]["forms"][0]["href"].endswith("/9?quantity=1")
    assert ("tag level", "the tag") in {(loss.place, loss.what) for loss in out.losses}


def test_dangerous_write_is_not_exported_and_a_write_only_value_is_not_read() -> None:
    found = exported()["properties"]
    assert (found["run"]["readOnly"], found["run"]["forms"][0]["op"]) == (True, ["readproperty"])
    assert (found["reset"]["writeOnly"], found["reset"]["forms"][0]["op"]) == (True, ["writeproperty"])


def test_export_to_another_transport_than_modbus_tcp_is_refused() -> None:
    with pytest.raises(UsageError, match="Modbus TCP only"):
        exported(endpoint="rtu:/dev/ttyUSB0")


@pytest.mark.parametrize(
    ("numbers", "setting", "addresses"),
    [
        (("0", "7"), {}, (0, 7)),
        (("1", "7"), {"numbering": "one"}, (0, 6)),
        (("40001", "40008"), {"numbering": "printed"}, (0, 7)),
        (("400001", "465536"), {"numbering": "printed"}, (0, 65535)),
        (("40001", "40008"), {"numbering": "one"}, (40000, 40007)),
        (("40001", "40008"), {"numbering": "sent"}, (40001, 40008)),
    ],
)
def test_addresses_without_zero_based_addressing(
    numbers: tuple[str, str], setting: dict[str, str], addresses: tuple[int, int]
) -> None:
    thing = of(*({"href": number, "modv:entity": "HoldingRegister"} for number in numbers), type="integer")
    found = imported(thing, **setting)
    assert [each.at for each in found.profile.tags.values()] == [f"holding:{address}" for address in addresses]


@pytest.mark.parametrize("number", ["1", "40001"])
def test_addresses_whose_numbering_is_not_stated_are_not_guessed(number: str) -> None:
    thing = of({"href": number, "modv:entity": "HoldingRegister"}, type="integer")
    with pytest.raises(UsageError, match="--set numbering=sent"):
        imported(thing)
    with pytest.raises(UsageError, match="expected sent, one, printed"):
        imported(thing, numbering="zero")


@pytest.mark.parametrize(
    ("terms", "order"),
    [
        ({}, None),
        ({"modv:mostSignificantWord": False}, "CDAB"),
        ({"modv:mostSignificantByte": False, "modv:mostSignificantWord": True}, "BADC"),
        ({"modv:mostSignificantByte": False, "modv:mostSignificantWord": False}, "DCBA"),
        ({"modv:mostSignificantByte": False}, "DCBA"),
        ({"contentType": "application/octet-stream; byteSeq=BIG_ENDIAN_BYTE_SWAP"}, "BADC"),
    ],
)
def test_byte_order_of_a_form(terms: dict[str, Any], order: str | None) -> None:
    form = {
        "href": "4?quantity=2",
        "modv:entity": "InputRegister",
        "modv:type": "xsd:float",
        "modv:zeroBasedAddressing": True,
    }
    assert tag(of(form | terms, type="number")).get("order") == order


@pytest.mark.parametrize(
    ("schema", "terms", "kind"),
    [
        ({"type": "integer"}, {}, "int16"),
        ({"type": "integer", "minimum": 0}, {}, "uint16"),
        ({"type": "integer"}, {"contentType": "application/octet-stream;length=4;signed=false"}, "uint32"),
        ({"type": "number"}, {"href": "4?quantity=4"}, "float64"),
        ({"type": "integer"}, {"modv:type": "xsd:unsignedLong"}, "uint64"),
        ({"type": "string"}, {"href": "4?quantity=3"}, "string"),
        ({"type": "boolean"}, {}, "uint16"),
    ],
)
def test_type_of_the_registers(schema: dict[str, Any], terms: dict[str, Any], kind: str) -> None:
    form = {
        "href": "4",
        "modv:entity": "HoldingRegister",
        "modv:zeroBasedAddressing": True,
        "op": "readproperty",
    } | terms
    assert tag(of(form, **schema)).get("type", "uint16") == kind


@pytest.mark.parametrize(
    ("schema", "terms", "why"),
    [
        ({"type": "number"}, {}, "a number of 1 registers"),
        ({"type": "array"}, {"href": "4?quantity=8"}, "its type is array"),
        (
            {"type": "integer"},
            {"href": "4?quantity=1", "modv:type": "xsd:int"},
            "has 2 registers, but the form states 1",
        ),
    ],
)
def test_value_that_cannot_be_decoded_surely_is_left_out(
    schema: dict[str, Any], terms: dict[str, Any], why: str
) -> None:
    form = {"href": "4", "modv:entity": "HoldingRegister", "modv:zeroBasedAddressing": True} | terms
    with pytest.raises(FileInvalid, match=why):
        imported(of(form, **schema))


def test_forms_for_reading_and_for_writing_are_one_tag() -> None:
    forms = (
        {"href": "/1/2", "op": "readproperty", "modv:function": "readCoil"},
        {"href": "/1/2", "op": "writeproperty", "modv:function": "writeSingleCoil"},
        {"href": "https://192.0.2.7/run"},
    )
    found = imported(of(*forms, type="boolean"), numbering="sent")
    assert {name: each.access for name, each in found.profile.tags.items()} == {"x": "rw"}
    assert ("property x", "https is not Modbus") in {(loss.place, loss.why) for loss in found.losses}


@pytest.mark.parametrize(
    ("base", "form"),
    [
        ("modbus+tcp://192.0.2.7:502/9/", {"href": "4"}),
        ("modbus+tcp://192.0.2.7:502/9", {"href": "4?quantity=1"}),
        ("modbus+tcp://192.0.2.7:502/9", {"href": "?address=4&quantity=1"}),
        ("modbus+tcp://192.0.2.7:502/9/", {"href": "/9/4"}),
        ("modbus+tcp://192.0.2.7:502", {"href": "/9/4"}),
        ("modbus+tcp://192.0.2.7:502/", {"href": "/", "modbus:unitID": 9, "modbus:address": 4}),
        ("", {"href": "modbus+tcp://192.0.2.7?unitID=9&address=4"}),
    ],
)
def test_unit_and_address_in_base_href_or_terms(base: str, form: dict[str, Any]) -> None:
    thing = of(form | {"modbus:entity": "Coil", "modv:zeroBasedAddressing": True}, type="boolean") | {"base": base}
    profile = imported(thing).profile
    assert (profile.factory.unit, profile.tags["x"].at) == (9, "coil:4")


def test_unit_is_selected_if_the_thing_has_several() -> None:
    thing = of({"href": "/1/2", "modv:entity": "Coil"}, {"href": "/7/2", "modv:entity": "Coil"}, type="boolean")
    with pytest.raises(UsageError, match="acme/1, acme/7"):
        imported(thing)
    assert imported(thing, select="7", numbering="sent").profile.factory.unit == 7


@pytest.mark.parametrize(
    ("form", "message"),
    [
        ({"href": "modbus+tcp://192.0.2.7/1/x", "modv:entity": "Coil"}, "the address of 'x'"),
        ({"href": "70000", "modv:entity": "Coil", "modv:zeroBasedAddressing": True}, "expected 0 to 65535"),
        ({"href": "3"}, "expected `modv:entity` or `modv:function`"),
        ({"href": "3", "modv:entity": "Register"}, "expected coil, discreteinput"),
        ({"href": "modbus+tcp://a b/1/2", "modv:entity": "Coil"}, "modbus\\+tcp://HOST:PORT/UNIT/ADDRESS"),
    ],
)
def test_wrong_form_is_an_error_at_its_line(form: dict[str, Any], message: str) -> None:
    text = json.dumps(of(form, type="boolean"), indent=1).encode()
    with pytest.raises(FileInvalid, match=message) as error:
        import_description(Source(Path("pump.td.json"), text), {})
    assert error.value.line > 5
