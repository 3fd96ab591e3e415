"""The Asset Interfaces Description: what is written, what independent readers accept, and what is read from other versions."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from aas_core3 import jsonization, verification
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.descriptions.aas.aid import export_description, import_description
from fieldtwin.descriptions.conversion import Imported, Source
from fieldtwin.descriptions.profile_text import checked_profile, profile_text
from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid, UsageError
from fieldtwin.gateway.core.files.profile_file import load_profile

PROFILES = Path(__file__).parents[3] / "profiles" / "devices"
DEVICE = """
device: acme/pump
source: a test
protocol: modbus
numbering: sent
factory: {unit: 9}
tags:
  speed: {at: 'holding:5', type: uint32, order: CDAB, access: rw, unit: rpm, range: [0, 3000], description: of the rotor}
  level: {at: 'input:8', type: int16, scale: 0.1, unit: m}
  power: {at: 'input:9', type: float32, range: [0, 1.5]}
  x: {at: 'coil:2', type: bool}
"""


def exported() -> dict[str, Any]:
    profile = checked_profile(DEVICE, "pump.yaml")
    found: dict[str, Any] = json.loads(export_description(profile, {"endpoint": "tcp://192.0.2.7"}).content)
    return found


def imported(data: bytes, **settings: str) -> Imported:
    return import_description(Source(Path("pump.json"), data), settings)


def elements(environment: dict[str, Any]) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = environment["submodels"][0]["submodelElements"]
    return found


def child(element: dict[str, Any], *names: str) -> dict[str, Any]:
    for name in names:
        element = next(each for each in element["value"] if each["idShort"] == name)
    return element


@pytest.mark.parametrize("name", ["eastron-sdm630", "sunspec-inverter-103", "delta-vfd-e", "modem-mailbox"])
def test_independent_reader_accepts_the_shell(name: str) -> None:
    out = export_description(load_profile(PROFILES / f"{name}.yaml"), {}).content
    environment = jsonization.environment_from_jsonable(json.loads(out))
    assert [str(error.cause) for error in verification.verify(environment)] == []


def test_elements_have_the_semantic_ids_of_the_specification() -> None:
    [interface] = elements(exported())
    forms = child(interface, "InteractionMetadata", "properties", "speed", "forms")
    found = {each["idShort"]: (each["value"], each["semanticId"]["keys"][0]["value"]) for each in forms["value"]}
    modbus = "https://www.w3.org/2019/wot/modbus#"
    assert found["href"] == ("5?quantity=2", "https://www.w3.org/2019/wot/hypermedia#hasTarget")
    assert found["modv_function"] == ("readHoldingRegisters", f"{modbus}hasFunction")
    assert found["modv_type"] == ("xsd:unsignedInt", f"{modbus}hasPayloadDataType")
    assert found["modv_mostSignificantWord"] == ("false", f"{modbus}hasMostSignificantWord")
    assert child(interface, "EndpointMetadata", "base")["value"] == "modbus+tcp://192.0.2.7:502/9/"
    assert interface["supplementalSemanticIds"][0]["keys"][0]["value"] == "http://www.w3.org/2011/modbus"


def test_import_has_unit_range_description_and_no_write_access() -> None:
    found = imported(json.dumps(exported()).encode())
    tags = {name: tag.model_dump(exclude_defaults=True) for name, tag in found.profile.tags.items()}
    assert tags == {
        "speed": {
            "at": "holding:5", "type": "uint32", "order": "CDAB", "unit": "rpm", "range": (0, 3000),
            "description": "of the rotor",
        },
        "level_raw": {"at": "input:8", "type": "int16", "description": "Raw value: multiply it by 0.1, to get m"},
        "power": {"at": "input:9", "type": "float32", "range": (0, 1.5)},
        "x": {"at": "coil:2", "type": "bool"},
    }  # fmt: skip
    assert found.profile.factory.unit == 9


def test_terms_of_the_endpoint_apply_to_forms_that_do_not_state_them() -> None:
    environment = exported()
    [interface] = elements(environment)
    forms = child(interface, "InteractionMetadata", "properties", "power", "forms")
    flags = [each for each in forms["value"] if each["idShort"].startswith("modv_mostSignificant")]
    forms["value"] = [each for each in forms["value"] if each not in flags and each["idShort"] != "modv_function"]
    for flag in flags:
        child(interface, "EndpointMetadata")["value"].append(flag | {"value": "false"})
    power = imported(json.dumps(environment).encode()).profile.tags["power"]
    assert (power.order, power.access) == ("DCBA", "ro")


def test_interface_is_selected_if_the_file_has_several() -> None:
    environment = exported()
    second = copy.deepcopy(elements(environment)[0]) | {"idShort": "InterfaceMODBUS02"}
    child(second, "EndpointMetadata", "base")["value"] = "modbus+tcp://192.0.2.8:502/3/"
    elements(environment).append(second)
    data = json.dumps(environment).encode()
    with pytest.raises(UsageError, match="one of InterfaceMODBUS, InterfaceMODBUS02"):
        imported(data)
    assert imported(data, interface="InterfaceMODBUS02").profile.factory.unit == 3


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "expected AASX, JSON or XML"),
        (b"hello", "expected AASX, JSON or XML"),
        (b"{}", "it contains no shell and no submodel"),
        (b"{", "JSONDecodeError"),
        (b"<a/>", "not a file of Asset Administration Shells"),
        (b'<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "document type"),
        (b"PK\x03\x04", "the package is damaged"),
        (b'{"a": ' * 100_000, "not a file of Asset Administration Shells"),
    ],
)
def test_other_file_is_an_error(data: bytes, message: str) -> None:
    with pytest.raises(FileInvalid, match=message):
        imported(data)


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        yield (*path, key)
        yield from places(inner, (*path, key))


VALUES = st.sampled_from(
    [None, True, -1, 1 << 40, "", "x", "modbus+tcp://h/1", "xs:integer", "Property", [], {}, [{}], "١"]
)


@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_changed_shell_gives_a_profile_or_an_error_with_the_file(data: st.DataObject) -> None:
    environment = exported()
    for _ in range(2):
        *way, last = data.draw(st.sampled_from(list(places(environment))))
        inner: Any = environment
        for key in way:
            inner = inner[key]
        inner[last] = data.draw(VALUES)
    try:
        found = imported(json.dumps(environment).encode())
    except FieldtwinError as e:
        error = str(e)
    else:
        error = ""
        checked_profile(profile_text(found.profile, "a test"), "pump.yaml")
    assert not error or "pump.json" in error


def test_element_that_the_sdk_skips_is_listed_as_lost() -> None:
    environment = exported()
    [interface] = elements(environment)
    child(interface, "title")["valueType"] = "xs:nothing"
    found = imported(json.dumps(environment).encode())
    assert any(loss.place == "the file" for loss in found.losses)
