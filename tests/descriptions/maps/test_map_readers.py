"""Each reader on a small configuration that states everything the format can state: tags, losses and the choice of a device."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from fieldtwin.descriptions.conversion import Imported, Source
from fieldtwin.gateway.core.errors import FileInvalid, UsageError


def read(name: str, text: str, **settings: str) -> Imported:
    module = import_module(f"fieldtwin.descriptions.maps.{name}")
    found: Imported = module.import_description(Source(Path("map.txt"), text.encode()), settings)
    return found


def tags(found: Imported) -> dict[str, dict[str, Any]]:
    return {name: tag.model_dump(exclude_defaults=True) for name, tag in found.profile.tags.items()}


TELEGRAF = """
[[outputs.file]]
[[inputs.modbus]]
  name = "meter"
  slave_id = 7
  controller = "file:///dev/ttyUSB0"
  baud_rate = 9600
  parity = "E"
  coils = [{ name = "Pump 1", address = [3] }]
  holding_registers = [
    { name = "level", byte_order = "BA", data_type = "INT16", scale = 0.1, address = [8] },
    { name = "energy", measurement = "totals", byte_order = "CDAB", data_type = "UFIXED", scale = 0.01, address = [5, 6] },
    { name = "work", byte_order = "ABCDEFGH", data_type = "FLOAT64-IEEE", scale = 1.0, address = [20, 21, 22, 23] },
    { name = "high", byte_order = "AB", data_type = "UINT8H", scale = 1.0, address = [40] },
    { name = "half", byte_order = "AB", data_type = "INT8L", scale = 1.0, address = [41] },
  ]
[[inputs.modbus]]
  name = "bus"
  configuration_type = "request"
  controller = "tcp://10.0.0.9:502"
  [[inputs.modbus.request]]
    slave_id = 2
    byte_order = "DCBA"
    register = "input"
    measurement = "slow"
    fields = [
      { address = 10, name = "flow", type = "FLOAT32", scale = 0.5 },
      { address = 12, name = "unused", type = "UINT16", omit = true },
      { address = 13, name = "alarm", type = "BIT", bit = 4 },
      { address = 14, name = "serial", type = "STRING", length = 4 },
    ]
[[inputs.modbus]]
  name = "metrics"
  configuration_type = "metric"
  [[inputs.modbus.metric]]
    slave_id = 3
    byte_order = "ABCD"
    measurement = "modbus"
    fields = [{ register = "discrete", address = 0, name = "door" }, { address = 1, name = "speed", type = "UINT16" }]
"""


def test_telegraf_in_the_register_style() -> None:
    found = read("telegraf", TELEGRAF, select="meter")
    assert tags(found) == {
        "pump_1": {"at": "coil:3", "type": "bool", "description": "Pump 1"},
        "level": {"at": "holding:8", "type": "int16", "order": "DCBA", "scale": 0.1},
        "energy": {"at": "holding:5", "type": "uint32", "order": "CDAB", "scale": 0.01, "poll": "totals"},
        "work": {"at": "holding:20", "type": "float64"},
        "high": {"at": "holding:40", "bits": (8, 15)},
    }
    factory = found.profile.factory
    assert (factory.unit, factory.baudrate, factory.frame) == (7, 9600, "8E1")
    assert "field half" in {loss.place for loss in found.losses}


def test_telegraf_in_the_request_style_and_in_the_metric_style() -> None:
    assert tags(read("telegraf", TELEGRAF, select="2")) == {
        "flow": {"at": "input:10", "type": "float32", "order": "DCBA", "scale": 0.5, "poll": "slow"},
        "alarm": {"at": "input:13", "order": "DCBA", "bits": (4, 4), "poll": "slow"},
        "serial": {"at": "input:14", "type": "string", "order": "DCBA", "registers": 4, "poll": "slow"},
    }
    assert set(tags(read("telegraf", TELEGRAF, select="metrics/3"))) == {"door", "speed"}


def test_file_with_several_devices_is_refused_with_their_names() -> None:
    with pytest.raises(UsageError, match=r"3 devices; expected one of meter/7, bus/2, metrics/3"):
        read("telegraf", TELEGRAF)
    with pytest.raises(UsageError, match="did you mean 'metrics/3'"):
        read("telegraf", TELEGRAF, select="metric")


HOME_ASSISTANT = """
homeassistant: {name: Home}
modbus:
  - name: hub1
    type: serial
    port: /dev/ttyUSB0
    baudrate: 19200
    bytesize: 8
    parity: N
    stopbits: 2
    sensors:
      - {name: Grid power, slave: 4, address: 10, input_type: input, data_type: int32, swap: word, scale: 0.1, offset: -5,
         unit_of_measurement: W, device_class: power, nan_value: 0x8000}
      - {name: Old, slave: 4, address: 20, count: 2, data_type: float}
      - {name: Custom, slave: 4, address: 22, data_type: custom, count: 2, structure: ">i"}
      - {name: Pair, slave: 4, address: 24, data_type: custom, count: 2, structure: ">2h"}
      - {name: Zone, slave: 4, address: 30, data_type: uint16, virtual_count: 2}
    binary_sensors:
      - {name: Door, slave: 4, address: 3, input_type: discrete_input}
    switches:
      - {name: Pump, slave: 4, address: 5, write_type: coil, verify: {}}
      - {name: Mode, slave: 4, address: 40, command_on: 2, command_off: 1}
    climates:
      - {name: Room, slave: 4, address: 50, target_temp_register: 51}
"""


def test_home_assistant() -> None:
    found = read("home_assistant", HOME_ASSISTANT)
    assert tags(found) == {
        "grid_power": {
            "at": "input:10", "type": "int32", "order": "CDAB", "scale": 0.1, "offset": -5.0, "unit": "W",
            "sentinels": [0x8000], "description": "Grid power",
        },
        "old": {"at": "holding:20", "type": "float32", "description": "Old"},
        "custom": {"at": "holding:22", "type": "int32", "description": "Custom"},
        "zone": {"at": "holding:30", "description": "Zone"},
        "zone_1": {"at": "holding:31", "description": "Zone_1"},
        "zone_2": {"at": "holding:32", "description": "Zone_2"},
        "door": {"at": "discrete:3", "type": "bool", "description": "Door"},
        "pump": {"at": "coil:5", "type": "bool", "access": "rw", "description": "Pump"},
        "mode": {"at": "holding:40", "access": "wo", "values": {1: "off", 2: "on"}, "description": "Mode"},
    }  # fmt: skip
    lost = {loss.place for loss in found.losses}
    assert {"climates Room", "sensors Pair", "sensors Grid power"} <= lost
    assert found.profile.factory.frame == "8N2"


def test_home_assistant_with_a_unit_id_in_a_different_file() -> None:
    found = read(
        "home_assistant", "modbus:\n- {name: h, type: tcp, sensors: [{name: a, slave: !secret s, address: 1}]}"
    )
    assert found.profile.factory.unit == 1
    assert ("key slave", "unit ID") in {(loss.place, loss.what) for loss in found.losses}


def test_home_assistant_with_hubs_in_a_different_file() -> None:
    with pytest.raises(FileInvalid, match=r"map.txt:1:1: the hubs are in a different file: !include hubs.yaml"):
        read("home_assistant", "modbus: !include hubs.yaml")


SLAVE = {
    "deviceName": "Boiler", "unitId": 3, "type": "tcp", "host": "10.0.0.1", "port": 502, "byteOrder": "BIG",
    "wordOrder": "LITTLE",
    "attributes": [{"tag": "serial", "type": "string", "functionCode": 3, "objectsCount": 4, "address": 0}],
    "timeseries": [
        {"tag": "power", "type": "32int", "functionCode": 4, "objectsCount": 2, "address": 10, "divider": 10},
        {"tag": "energy", "type": "long", "functionCode": 3, "registersCount": 4, "address": 20, "multiplier": 5},
        {"tag": "relay", "type": "bits", "functionCode": 1, "objectsCount": 1, "address": 1},
        {"tag": "range", "type": "16int", "functionCode": 3, "objectsCount": 1, "address": "1-9"},
        {"tag": "mode", "type": "16uint", "functionCode": 3, "objectsCount": 1, "address": 30, "variants": {"1": "heat"}},
    ],
    "attributeUpdates": [{"tag": "mode", "type": "16uint", "functionCode": 6, "objectsCount": 1, "address": 30}],
    "rpc": {"reset": {"type": "bits", "functionCode": 5, "objectsCount": 1, "address": 9}},
}  # fmt: skip


def test_thingsboard_in_both_layouts() -> None:
    expected = {
        "serial": {"at": "holding:0", "type": "string", "registers": 4, "poll": "attributes"},
        "power": {"at": "input:10", "type": "int32", "order": "CDAB", "scale": 0.1},
        "energy": {"at": "holding:20", "type": "int64", "order": "CDAB", "scale": 5.0},
        "relay": {"at": "coil:1", "type": "bool"},
        "mode": {"at": "holding:30", "access": "rw", "values": {1: "heat"}},
        "reset": {"at": "coil:9", "type": "bool", "access": "wo"},
    }
    new = read("thingsboard", json.dumps({"master": {"slaves": [SLAVE]}}))
    assert tags(new) == expected
    connection = {key: SLAVE[key] for key in ("type", "host", "port", "byteOrder", "wordOrder")}
    device = {key: value for key, value in SLAVE.items() if key not in connection}
    old = read("thingsboard", json.dumps({"server": {"name": "server", **connection, "devices": [device]}}))
    assert tags(old) == expected
    assert old.profile.factory.unit == 3


NEURON = """group,interval,name,address,attribute,type,description,decimal,precision,bias
fast,100,level,1!400001#BL,Read Write,FLOAT,tank level,,2,
fast,100,temp,1!300011,Read,INT16,,0.1,,-40
slow,1000,alarm,1!400010.4,Read,BIT,,,,
slow,1000,pump,1!000003,Write,BIT,,,,
slow,1000,name,1!400101.10L,Read Subscribe,STRING,,,,
slow,1000,odd,1!400201.10D,Read,STRING,,,,
other,1000,there,2!400001,Read,UINT16,,,,
"""


def test_neuron_csv() -> None:
    found = read("neuron", NEURON, select="1")
    assert tags(found) == {
        "level": {
            "at": "holding:0", "type": "float32", "order": "CDAB", "access": "rw", "poll": "fast", "description": "tank level",
        },
        "temp": {"at": "input:10", "type": "int16", "scale": 0.1, "offset": -40.0, "poll": "fast"},
        "alarm": {"at": "holding:9", "bits": (4, 4), "poll": "slow"},
        "pump": {"at": "coil:2", "type": "bool", "access": "wo", "poll": "slow"},
        "name": {"at": "holding:100", "type": "string", "registers": 5, "order": "BADC", "poll": "slow"},
    }  # fmt: skip
    assert ("tag odd", "the tag") in {(loss.place, loss.what) for loss in found.losses}


def test_neuron_json_and_an_address_that_counts_from_zero() -> None:
    group = {"group": "values", "tags": [{"name": "a", "address": "5!400000", "attribute": 3, "type": 4}]}
    found = read("neuron", json.dumps({"node": "plc", "groups": [group]}), start="0")
    assert tags(found) == {"a": {"at": "holding:0", "access": "rw"}}
    assert found.profile.factory.unit == 5
    with pytest.raises(FileInvalid, match="the address, counted from 0"):
        read("neuron", json.dumps(group))


FLOW = [
    {"id": "c", "type": "modbus-client", "name": "plc", "clienttype": "tcp", "tcpHost": "10.0.0.2", "unit_id": 9},
    {"id": "r", "type": "modbus-read", "name": "Levels", "unitid": "", "dataType": "InputRegister", "adr": "4", "quantity": "2",
     "server": "c", "wires": [["x"]]},
    {"id": "w", "type": "modbus-write", "unitid": "9", "dataType": "Coil", "adr": "7", "quantity": "1", "server": "c"},
    {"id": "f", "type": "function", "name": "ask", "func": "msg.payload = {'fc': 3, 'unitid': 9, 'address': 50}",
     "wires": [["g"]]},
    {"id": "g", "type": "modbus-flex-getter", "name": "flexible", "server": "c", "wires": [[]]},
    {"id": "h", "type": "modbus-flex-getter", "name": "computed", "server": "c", "wires": [[]]},
    {"id": "s", "type": "modbus-flex-sequencer", "server": "c",
     "sequences": [{"name": "seq", "unitid": "9", "fc": "FC2", "address": "0", "quantity": "1"}]},
]  # fmt: skip


def test_node_red_flow() -> None:
    found = read("node_red", json.dumps(FLOW))
    assert tags(found) == {
        "input_4": {"at": "input:4", "description": "Levels, 0"},
        "input_5": {"at": "input:5", "description": "Levels, 1"},
        "coil_7": {"at": "coil:7", "type": "bool", "access": "wo"},
        "holding_50": {"at": "holding:50", "description": "ask"},
        "discrete_0": {"at": "discrete:0", "type": "bool", "description": "seq"},
    }
    assert found.profile.factory.unit == 9
    assert ("node computed", "the requests") in {(loss.place, loss.what) for loss in found.losses}


@pytest.mark.parametrize(
    ("name", "text", "message", "line"),
    [
        ("telegraf", "[[inputs.modbus]]\nname = ", "not TOML", 2),
        ("telegraf", "[[inputs.modbus]]\ncoils = [\n  {name = 'x', address = [1]},\n\n  {address = [2]},\n]", "`name`", 5),
        ("telegraf", "a = 1\n[[inputs.modbus]]\n\nslave_id = 300", "`slave_id`", 4),
        (
            "telegraf",
            "[[inputs.modbus]]\n[[inputs.modbus]]\nname='b'\nslave_id = 2\ncoils = []\n"
            "holding_registers = [ # two\n {name='x', byte_order='XY', data_type='INT16', address=[1]}]",
            "the byte order of 'x'",
            7,
        ),
        ("telegraf", "[[inputs.modbus]]\nslave_id = 2\ncoils = [{name='x', address=[1, 3]}]", "consecutive", 3),
        ("home_assistant", "modbus:\n- name: a\n  type: tcp\n  sensors:\n  - {name: x, address: 70000}", "`address`", 5),
        ("home_assistant", "modbus:\n- name: a\n  sensors:\n  - {name: x,\n     address: 1, data_type: int17}", "`data_type`", 5),
        ("home_assistant", "sensor: []\n", "no `modbus:`", 1),
        ("home_assistant", "modbus:\n\t- x", "not YAML", 2),
        ("thingsboard", '{"master": {"slaves": [\n{"timeseries": [{"tag": "x",\n"functionCode": 7}]}]}}', "`functionCode`", 3),
        ("thingsboard", '{"slaves": [{"timeseries": [{"tag": "x",\n"address": 1, "type": "13int"}]}]}', "the type of 'x'", 2),
        ("thingsboard", '{"a": 1,\n "a": 2}', "defined twice", 1),
        ("thingsboard", '{"a": \n nope}', "not JSON", 2),
        ("neuron", "group,name,address,type\ng,a,1!400001,INT16\ng,b,1!900001,INT16\n", "the address", 3),
        ("neuron", "group,name,type\n", "no column 'address'", 1),
        ("node_red", '[{"type": "modbus-read",\n "dataType": "Coil", "adr": "x"}]', "the address", 2),
        ("node_red", '{"a": 1}', "the flow", 1),
    ],
)  # fmt: skip
def test_wrong_file_is_refused_with_its_line(name: str, text: str, message: str, line: int) -> None:
    with pytest.raises(FileInvalid) as caught:
        read(name, text, **({"select": "b"} if "'b'" in text else {}))
    assert message in str(caught.value)
    assert caught.value.line == line


@pytest.mark.parametrize("name", ["telegraf", "home_assistant", "thingsboard", "neuron", "node_red", "sunspec"])
def test_text_without_a_device_binary_data_and_a_large_file_are_refused(name: str) -> None:
    module = import_module(f"fieldtwin.descriptions.maps.{name}")
    deep = b"[" * (100 if name == "home_assistant" else 100_000)  # PyYAML needs seconds for its limit of nesting
    for data in (b"", b"[]", b"{}", b"\xff\xfe\x00", deep, b" " * (8 * 1024 * 1024 + 1), b"a: &a [*a]"):
        with pytest.raises(FileInvalid):
            module.import_description(Source(Path("map.txt"), data), {})


def test_too_many_tags_are_refused() -> None:
    flow = [{"type": "modbus-read", "dataType": "Coil", "adr": str(i * 2000), "quantity": "2000"} for i in range(6)]
    with pytest.raises(FileInvalid, match="too many tags; expected at most 10000"):
        read("node_red", json.dumps(flow))


def test_name_of_the_profile_is_checked() -> None:
    assert read("node_red", json.dumps(FLOW), device="acme/plc-1").profile.device == "acme/plc-1"
    with pytest.raises(UsageError, match="cannot use --set device"):
        read("node_red", json.dumps(FLOW), device="Acme PLC")


def test_bits_after_the_first_of_a_coil_of_telegraf_are_listed_as_lost() -> None:
    text = '[[inputs.modbus]]\ncoils = [{ name = "valves", address = [3, 4, 5] }]\n'
    found = read("telegraf", text)
    assert tags(found) == {"valves": {"at": "coil:3", "type": "bool"}}
    assert [(loss.place, loss.what) for loss in found.losses] == [("field valves", "the 2 bits after 3")]


def test_tags_of_a_metric_of_telegraf_are_listed_as_lost() -> None:
    text = TELEGRAF.rstrip() + '\n    [inputs.modbus.metric.tags]\n      room = "A1"\n'
    found = read("telegraf", text, select="metrics")
    assert ("metric 1", "tag room of the metric") in {(loss.place, loss.what) for loss in found.losses}
