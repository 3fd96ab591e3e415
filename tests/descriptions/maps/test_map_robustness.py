"""A configuration with an unexpected value gives an error that names the file, and no other exception."""

from __future__ import annotations

import copy
import csv
import io
import json
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.descriptions.conversion import Source
from fieldtwin.descriptions.maps.documents import parse_yaml
from fieldtwin.descriptions.profile_text import checked_profile, profile_text
from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid

REGISTER = {"tag": "a", "type": "32int", "functionCode": 3, "objectsCount": 2, "address": 10, "divider": 10, "multiplier": 2,
            "byteOrder": "BIG", "variants": {"1": "on"}, "bit": 3}  # fmt: skip
SAMPLES: dict[str, Any] = {
    "thingsboard": {
        "master": {"slaves": [{
            "deviceName": "d", "unitId": 1, "type": "serial", "baudrate": 9600, "parity": "N", "bytesize": 8, "stopbits": 1,
            "timeseries": [REGISTER], "attributes": [REGISTER], "attributeUpdates": [REGISTER], "rpc": {"a": REGISTER},
        }]}
    },
    "home_assistant": {
        "modbus": [{
            "name": "h", "type": "serial", "baudrate": 9600, "bytesize": 8, "parity": "N", "stopbits": 1,
            "sensors": [{"name": "s", "slave": 1, "address": 1, "input_type": "input", "data_type": "int32", "swap": "word",
                         "scale": 2, "offset": 1, "nan_value": "0x8000", "count": 2, "virtual_count": 1}],
            "binary_sensors": [{"name": "b", "address": 1, "input_type": "coil"}],
            "switches": [{"name": "w", "address": 2, "write_type": "holding", "command_on": 1, "verify": {"address": 2}}],
            "climates": [{"name": "c", "address": 3}],
        }]
    },
    "node_red": [
        {"id": "c", "type": "modbus-client", "clienttype": "serial", "serialBaudrate": "9600", "serialParity": "none"},
        {"id": "r", "type": "modbus-read", "name": "n", "dataType": "Coil", "adr": "4", "quantity": "2", "server": "c"},
        {"id": "i", "type": "inject", "payload": '{"fc": 3, "unitid": 1, "address": 4}', "wires": [["g"]]},
        {"id": "g", "type": "modbus-flex-getter", "server": "c", "wires": [[]]},
        {"id": "s", "type": "modbus-flex-sequencer", "server": "c", "sequences": [{"fc": "FC1", "address": "1"}]},
    ],
    "neuron": {
        "groups": [{"group": "g", "tags": [{"name": "a", "address": "1!400001#BL", "attribute": 3, "type": 9, "decimal": 0.1,
                                            "bias": 1, "precision": 2, "description": "x"}]}]
    },
    "sunspec": {
        "id": 7, "group": {
            "name": "g", "points": [{"name": "ID", "type": "uint16", "size": 1},
                                    {"name": "V", "type": "int16", "size": 1, "sf": "V_SF", "units": "V", "access": "RW",
                                     "symbols": [{"name": "a", "value": 1}]},
                                    {"name": "V_SF", "type": "sunssf", "size": 1}],
            "groups": [{"name": "m", "count": 2, "points": [{"name": "T", "type": "string", "size": 4, "static": "S"}]}],
        },
    },
    "wot": {
        "title": "t", "base": "modbus+tcp://192.0.2.7:502/1/", "actions": {"go": {}},
        "properties": {
            "a": {"type": "integer", "minimum": 0, "maximum": 9, "unit": "V", "description": "text", "readOnly": True, "forms": [
                {"href": "10?quantity=2", "op": ["readproperty"], "modv:entity": "HoldingRegister", "modv:type": "xsd:int",
                 "modv:mostSignificantByte": False, "modv:pollingTime": 5,
                 "contentType": "application/octet-stream;length=4;byteSeq=BIG_ENDIAN;signed=false"},
                {"href": "/1/10", "modv:function": "writeSingleHoldingRegister", "op": "writeproperty"}]},
            "b": {"type": "boolean", "forms": [{"href": "modbus+tcp://h/1", "modbus:address": 3, "modbus:function": 1}]},
        },
    },
}  # fmt: skip
VALUES = st.one_of(
    st.none(), st.booleans(), st.integers(-10, 70_000), st.sampled_from([1 << 64, -1, 1e308, -0.5, 0]), st.text(max_size=6),
    st.sampled_from(["", "0x10", "LITTLE", "custom", "string", "2!300004.3", "1!400001.10D", "modbus-write", "١"]),
    st.just([]), st.just({}), st.just([{}]), st.just([None]), st.just({"x": {"address": 1}}),
)  # fmt: skip


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of each value below `value`."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        yield (*path, key)
        yield from places(inner, (*path, key))


def changed(value: Any, path: tuple[Any, ...], new: Any) -> Any:
    """Return a copy of `value` with `new` at `path`."""
    result = copy.deepcopy(value)
    inner = result
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = new
    return result


def read(name: str, data: bytes) -> None:
    """Import `data`. A profile that comes out is one that the profile reader accepts."""
    module = import_module(f"fieldtwin.descriptions.maps.{name}")
    try:
        found = module.import_description(Source(Path("map.txt"), data), {})
    except FieldtwinError as e:
        error = str(e)
    else:
        error = ""
    if error:
        assert "map.txt" in error
        return
    checked_profile(profile_text(found.profile, "a test"), "map.yaml")


@pytest.mark.parametrize("name", SAMPLES)
@given(data=st.data())
@settings(max_examples=40, deadline=None)
def test_changed_value_gives_a_profile_or_an_error_with_the_file(name: str, data: st.DataObject) -> None:
    sample = SAMPLES[name]
    sample = changed(sample, data.draw(st.sampled_from(list(places(sample)))), data.draw(VALUES))
    sample = changed(sample, data.draw(st.sampled_from(list(places(sample)))), data.draw(VALUES))
    text = yaml.safe_dump(sample) if name == "home_assistant" else json.dumps(sample)
    read(name, text.encode())


def test_nested_brackets_of_yaml_are_refused_before_they_are_parsed() -> None:
    with pytest.raises(FileInvalid, match="more than 64 nested") as error:
        parse_yaml(Source(Path("map.txt"), b"modbus: " + b"[" * 200_000))
    assert (error.value.line, error.value.column) == (1, 73)


CELLS = st.one_of(
    st.text(max_size=8), st.sampled_from(["1!400001", "1!000001.3#BB", "INT16", "BIT", "STRING", "Read", "-1", "1e400"])
)


@given(rows=st.lists(st.lists(CELLS, min_size=6, max_size=6), max_size=4))
@settings(max_examples=40, deadline=None)
def test_any_csv_gives_a_profile_or_an_error_with_the_file(rows: list[list[str]]) -> None:
    out = io.StringIO()
    csv.writer(out).writerows([["group", "name", "address", "attribute", "type", "decimal"], *rows])
    read("neuron", out.getvalue().encode())


LINES = st.sampled_from([
    "[[inputs.modbus]]", "slave_id = 1", "slave_id = 'x'", 'configuration_type = "request"', 'configuration_type = "metric"',
    "[[inputs.modbus.request]]", "[[inputs.modbus.metric]]", 'register = "coil"', "register = []",
    "byte_order = {}", "configuration_type = []", 'byte_order = "CDAB"',
    'coils = [{name="a", address=[1]}]', "coils = {}",
    'holding_registers = [{name="a", address=[1], data_type="FIXED", scale=inf}]',
    'input_registers = [{name="", address=[]}]', 'fields = [{name="f", address=1, type="BIT", bit=99}]', "fields = [1]",
    'fields = [{name="f", address=1, type="STRING"}]', "baud_rate = 0", 'parity = "X"', "name = 5", "controller = 1979-05-27",
])  # fmt: skip


@given(lines=st.lists(LINES, max_size=8, unique=True))
@settings(max_examples=100, deadline=None)
def test_any_lines_of_toml_give_a_profile_or_an_error_with_the_file(lines: list[str]) -> None:
    read("telegraf", "\n".join(lines).encode())
