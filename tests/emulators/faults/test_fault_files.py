"""Errors in fault files are reported with file, line, column and the nearest known word; also `fieldtwin faults`."""

from __future__ import annotations

import json
import re
from pathlib import Path
from random import Random

import pytest
from click.testing import CliRunner

from fieldtwin.cli.emulate.faults_command import command
from fieldtwin.emulators.faults.can_engine import aimed
from fieldtwin.emulators.faults.fault import Active, Aim
from fieldtwin.emulators.faults.frames import Framing
from fieldtwin.emulators.faults.json_schema import fault_defs
from fieldtwin.emulators.faults.on_link import wire_faults
from fieldtwin.emulators.faults.registry import FAULTS
from fieldtwin.emulators.faults.schema import load_faults, parse_fault, seconds
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.twin.prototype.fault_aims import target
from fieldtwin.twin.site.system import load_system


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("faults:\n  - {name: silence, device: ctd, untl: 12s}\n", ":2:34: unknown key 'untl' in fault silence"),
        ("faults:\n  - {name: silence, device: ctd, untl: 12s}\n", "did you mean 'until'?"),
        ("faults:\n  - name: delay\n    by_ms: -4\n", ":3:5: by_ms; expected more than 0; got -4"),
        ("faults:\n  - {name: slience}\n", ":2:6: no fault 'slience'"),
        ("faults:\n  - {name: slience}\n", "did you mean 'silence'?"),
        ("faults:\n  - {nam: slience}\n", ":2:5: a fault without a name"),
        ("faults:\n  - silence\n", ":2:5: a fault"),
        ("faults: []\n", ":1:1: a list of faults"),
        ("fault: []\n", ":1:1: unknown key 'fault'"),
        ("faults:\n  - {name: delay, from: 5 s}\n", ":2:19: a time; expected 5s, 250ms, 2min or 24h; got '5 s'"),
        ("faults:\n  - {name: delay, until: soon}\n", ":2:19: a time"),
        ("faults:\n  - {name: delay, from: 5s, until: 5s}\n", ":2:29: the fault ends before it begins"),
        ("faults:\n  - {name: delay, direction: back}\n", "'request', 'reply', 'both'"),
        ("faults:\n  - {name: delay, probability: 2}\n", ":2:19: probability"),
        ("faults:\n  - {name: drop, id: a}\n  - {name: echo, id: a}\n", ":3:18: the id 'a' is defined twice"),
        ("faults:\n  - {name: drop, by_ms: 5}\n", ":2:18: unknown key 'by_ms' in fault drop"),
    ],
)
def test_an_error_in_a_fault_file_is_reported_at_its_position(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "faults.yaml"
    path.write_text(text)
    with pytest.raises(FileInvalid) as raised:
        load_faults(path)
    assert told in str(raised.value)
    assert str(path) in str(raised.value)


def test_a_valid_fault_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "faults.yaml"
    path.write_text(
        "faults:\n  - {name: drop, device: ctd, from: 250ms, until: 2min}\n  - {id: mine, name: delay, by_ms: 5}\n"
    )
    first, second = load_faults(path)
    spec = parse_fault(first)
    assert (spec.id, spec.from_s, spec.until_s, spec.aim.device) == ("drop-1", 0.25, 120.0, "ctd")
    assert second == {"id": "mine", "name": "delay", "by_ms": 5}


def test_times_with_units_are_read_as_seconds() -> None:
    assert [seconds(t) for t in ("5s", "250ms", "2min", "24h", "7", 1.5)] == [5.0, 0.25, 120.0, 86_400.0, 7.0, 1.5]


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ({"name": "stuck"}, "values of a device"),
        ({"name": "bus-off"}, "CAN buses"),
        ({"name": "drop", "device": "ctd"}, "a link has no device or bus names"),
        ({"name": "drop", "address": "here"}, "an address"),
        ({"name": "drop", "address": "coils:1"}, "an address"),
        ({"name": "drop", "address": "70000"}, "an address"),
    ],
)
def test_a_link_knows_neither_names_nor_values(said: dict[str, str], told: str) -> None:
    with pytest.raises(UsageError, match=told):
        wire_faults([said], Framing.RTU, 1, 0)


def test_every_fault_can_be_injected_with_its_name_alone() -> None:
    for name, kind in FAULTS.items():
        fault = parse_fault({"name": name}).make()
        assert isinstance(fault, kind)
        assert kind.summary
        for parameter in kind.form.model_fields.values():
            assert not parameter.is_required(), name


def test_the_command_lists_every_fault() -> None:
    told = CliRunner().invoke(command, ["--json"])
    listed = json.loads(told.stdout)
    assert [one["name"] for one in listed] == list(FAULTS)
    (delay,) = json.loads(CliRunner().invoke(command, ["delay", "--json"]).stdout)
    assert delay["parameters"]["by_ms"] == {
        "default": 50.0,
        "type": "number",
        "exclusiveMinimum": 0,
        "maximum": 600_000,
    }
    (abort,) = json.loads(CliRunner().invoke(command, ["sdo-abort", "--json"]).stdout)
    assert abort["codes"]["0x06020000"] == "object does not exist"
    refused = CliRunner().invoke(command, ["dely"])
    assert isinstance(refused.exception, UsageError)
    assert refused.exception.hint == "did you mean 'delay'?"


@pytest.mark.parametrize(
    ("said", "told", "column"),
    [
        ("{name: silence, device: ctb}", "did you mean 'ctd'", 21),
        ("{name: silence, bus: lam}", "did you mean 'lan'", 21),
        ("{name: silence, device: ctd, bus: lan}", "ctd is on another bus; expected line1; got lan", 34),
        ("{name: silence, device: ctd, register: presure}", "did you mean 'pressure'", 34),
        ("{name: silence, bus: lan, register: pressure}", "a register needs a device", 31),
        ("{name: silence}", "has no target", 6),
        ("{name: corrupt-crc, device: inclinometer}", "for serial lines and sockets; got bus 'can0'", 6),
        ("{name: bus-off, device: ctd}", "for CAN buses", 6),
        ("{name: stuck, bus: lan}", "unknown key 'bus' in fault stuck", 19),
        ("{name: stuck, device: ctd, register: serial}", "ctd.serial is not a number", 32),
        ("{name: drop, device: ctd, address: 'holdng:3'}", "holding:0x10", 31),
        ("{name: drop, device: ctd, direction: replly}", "did you mean 'reply'", 31),
        ("{name: drop, device: ctd, unti: 5s}", "did you mean 'until'", 31),
        ("{name: drop, device: ctd, until: soon}", "5s, 250ms, 2min or 24h", 31),
        (
            "{name: corrupt-crc, bus: lan}",
            "fault corrupt-crc changes nothing in Modbus TCP frames; expected RTU frames or ASCII frames",
            6,
        ),
        ("{name: wrong-transaction, device: ctd}", "changes nothing in RTU frames; expected Modbus TCP frames", 6),
        ("{name: fewer-registers, device: ctd, function: 6}", "expected function 01h, 02h, 03h, 04h, 17h; got", 41),
        ("{name: drop, device: ctd, address: 'holding:3', function: 4}", "changes no frame at this target", 31),
        ("{name: drop, device: ctd, unit: 77}", "ctd has a different address; expected 1; got 77", 31),
        ("{name: heartbeat-loss, device: inclinometer, cob_id: 0x185}", "changes no frame with the COB-ID 185h", 50),
        (
            "{name: heartbeat-loss, device: inclinometer, register: slope_long}",
            "changes no frame that names an object",
            50,
        ),
        ("{name: sdo-toggle, device: inclinometer, index: 0x6010}", "changes no frame that names an object", 45),
        ("{name: sdo-abort, device: inclinometer, index: 0x6010, direction: request}", "names an object", 45),
        ("{name: boot-storm, device: inclinometer, nth: 3}", "only sends additional frames", 45),
    ],
)
def test_a_fault_that_a_system_cannot_have_is_refused_at_its_position(
    tmp_path: Path, said: str, told: str, column: int
) -> None:
    system = load_system("observatory")
    path = tmp_path / "f.yaml"
    path.write_text(f"faults:\n  - {said}\n")
    with pytest.raises(FileInvalid, match=re.escape(told)) as e:
        load_faults(path, lambda spec: target(system, spec))
    assert e.value.line == 2
    assert abs(e.value.column - column) <= 5


@pytest.mark.parametrize(
    "said",
    [
        "{name: corrupt-crc, device: ctd, function: 3}",
        "{name: wrong-transaction, bus: lan, unit: 1}",
        "{name: fewer-registers, device: ctd, address: 'holding:3'}",
        "{name: heartbeat-loss, device: inclinometer, cob_id: 0x705}",
        "{name: sdo-abort, device: inclinometer, register: slope_long}",
        "{name: duplicate-node, device: inclinometer, index: 0x1000}",
        "{name: sync-jitter, device: inclinometer, cob_id: 0x080}",
        "{name: lost-frame, bus: can0, cob_id: 0x185}",
        "{name: bus-off, device: inclinometer}",
    ],
)
def test_a_fault_with_an_effect_at_its_target_is_accepted(tmp_path: Path, said: str) -> None:
    system = load_system("observatory")
    path = tmp_path / "f.yaml"
    path.write_text(f"faults:\n  - {said}\n")
    assert load_faults(path, lambda spec: target(system, spec))


def test_a_segment_names_no_object() -> None:
    active = Active("f", parse_fault({"name": "lost-frame"}).make(), Aim(index=0x4142), Random(1), 0, None)
    assert not aimed(active, CanFrame(0x585, bytes.fromhex("01 42 41 00 00 00 00 00")))
    assert not aimed(active, CanFrame(0x605, bytes.fromhex("60 42 41 00 00 00 00 00")))
    assert aimed(active, CanFrame(0x585, bytes.fromhex("43 42 41 00 00 00 00 00")))
    assert aimed(active, CanFrame(0x605, bytes.fromhex("40 42 41 00 00 00 00 00")))


def test_the_schema_knows_each_fault_as_it_is_read() -> None:
    (one,) = [f for f in fault_defs()["Fault"]["oneOf"] if f["title"] == "odd-sdo"]
    assert one["properties"]["size_by"] == {"default": 0, "maximum": 1000, "minimum": -1000, "type": "integer"}
    assert "function" not in one["properties"]
    for described in fault_defs()["Fault"]["oneOf"]:
        for key in described["properties"]:
            values = {
                "name": described["title"],
                "from": 1,
                "until": 2,
                "direction": "both",
                "bus": "b",
                "device": "d",
                "optional": True,
            }
            value = values.get(key, described["properties"][key].get("default", 1))
            if key in ("id", "register", "device", "bus"):
                value = "x"
            parse_fault({"name": described["title"], key: value})
