"""A bit of a register is a bool with `type: bool`: a program has it as a BOOL. Without the type it is an integer, and a BOOL that
is bound to it is an error at the binding, which says what to do."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from fieldtwin.cli.main import main
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.devices.codec import decode
from fieldtwin.site.check import check_site

PROFILE = """\
device: test/drive
source: none
protocol: modbus
tags:
  status:  {at: 30001}
  running: {at: 30001, type: bool, bits: [1, 1]}
  fault:   {at: 30001, type: bool, bits: [2, 2]}
  lamp:    {at: 40001, access: rw, range: [0, 1]}
"""
SITE = {
    "drive.yaml": PROFILE,
    "lamp.st": """\
PROGRAM Lamp
VAR_INPUT
  running : BOOL;
  fault : BOOL;
END_VAR
VAR_OUTPUT
  lamp : UINT;
END_VAR
  lamp := BOOL_TO_UINT(running AND NOT fault);
END_PROGRAM
""",
    "site.yaml": """\
fieldtwin: 1
system: site
buses: {lan: {url: "tcp://192.0.2.1:502"}}
devices: {drive: {profile: ./drive.yaml, bus: lan, unit: 1, poll: {values: {every_ms: 100}}, writable: [lamp]}}
plc:
  programs:
    lamp:
      source: lamp.st
      inputs:
        running: {tag: drive.running}
        fault: {tag: drive.fault}
      outputs: {lamp: drive.lamp}
""",
    "site.prototype.yaml": """\
prototype_of: site.yaml
buses: {lan: {listen: "tcp://127.0.0.1:0"}}
devices: {drive: {model: profile, values: {status: 3}}}
""",
    "bits.scenario.yaml": """\
scenario: The program has each bit as a BOOL
system: site.yaml
steps:
  - wait: {until: "drive.lamp == 1 and drive.running and not drive.fault", within: 5s}
  - set: {tag: drive.fault, value: true}
  - expect: {that: "drive.lamp == 0 and drive.status == 7", within: 2s}
  - set: {tag: drive.running, value: 0}
  - expect: {that: "drive.status == 5 and drive.running == 0", within: 2s}
""",
}


@pytest.fixture
def site(tmp_path: Path) -> Path:
    for name, text in SITE.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    return tmp_path


def test_program_reads_bits_of_a_register_as_bools(
    site: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert check_site(site).errors == []
    monkeypatch.setattr(sys, "argv", ["fieldtwin", "test", str(site / "bits.scenario.yaml")])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0, capsys.readouterr().out


@pytest.mark.parametrize("order", ["ABCD", "BADC"])
def test_bit_is_taken_from_the_ordered_register(tmp_path: Path, order: str) -> None:
    path = tmp_path / "drive.yaml"
    path.write_text(PROFILE.replace("bits: [1, 1]", f"bits: [1, 1], order: {order}"), encoding="utf-8")
    tags = load_profile(path).tags
    data = b"\0\2" if order == "ABCD" else b"\2\0"
    assert decode(tags["running"], data, 0).value is True
    assert decode(tags["fault"], b"\0\2", 0).value is False


def test_bool_bound_to_an_integer_bit_is_an_error_at_its_binding(site: Path) -> None:
    (site / "drive.yaml").write_text(PROFILE.replace("type: bool, ", ""), encoding="utf-8")
    errors = check_site(site).errors
    assert [(Path(e.path).name, e.line) for e in errors] == [("site.yaml", 10), ("site.yaml", 11)]
    assert "input 'running' of program lamp and drive.running differ in kind" in str(errors[0])
    assert "`type: bool`" in errors[0].hint


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("[1, 1]", "[1, 2]", r"'running' is a bool; expected one bit, \[1, 1\]"),
        ("[1, 1]", "[16, 16]", "within 0 to 15"),
        ("type: bool, bits: [1, 1]", "type: uint32, bits: [1, 1]", "expected type uint16 or bool"),
    ],
)
def test_bits_that_are_no_part_of_a_register_are_refused(tmp_path: Path, old: str, new: str, told: str) -> None:
    path = tmp_path / "drive.yaml"
    path.write_text(PROFILE.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(FileInvalid, match=told):
        load_profile(path)


def test_bits_of_a_canopen_object_are_refused_with_the_way_a_program_reads_them(tmp_path: Path) -> None:
    path = tmp_path / "valves.yaml"
    path.write_text(
        "device: test/valves\nsource: none\nprotocol: canopen\n"
        'tags: {acid: {object: "6200:01", type: uint8, bits: [0, 0]}}\n',
        encoding="utf-8",
    )
    with pytest.raises(FileInvalid, match=r"expected a tag of the whole object .*`outputs AND 1`"):
        load_profile(path)
