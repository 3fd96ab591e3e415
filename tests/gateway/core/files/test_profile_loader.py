"""Device profiles: addresses in both directions, groups and commands, and every contradiction is found when the file is read."""

from __future__ import annotations

import pytest
from gateway_rig import PROFILES
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.profile import DeviceProfile, RegisterRange, resolve_address
from fieldtwin.gateway.core.files.profile_file import load_profile, resolve
from fieldtwin.gateway.core.files.yaml_file import parse

HEAD = 'device: test/device\nsource: "a test"\n'


def read(text: str) -> DeviceProfile:
    return resolve(parse(HEAD + text, "p.yaml"))


@pytest.mark.parametrize("path", sorted(PROFILES.glob("*.yaml")), ids=lambda p: p.stem)
def test_every_shipped_profile_loads_and_is_short(path: object) -> None:
    profile = load_profile(path)  # type: ignore[arg-type]
    assert profile.command_list
    assert len(PROFILES.joinpath(path.name).read_text(encoding="utf-8").splitlines()) <= 60  # type: ignore[attr-defined]
    assert profile.form.source  # the source of its numbers


@pytest.mark.parametrize(
    ("text", "expected", "shown"),
    [
        (30001, RegisterRange("input", 0, 1), "30001 (input:0)"),
        (40001, RegisterRange("holding", 0, 1), "40001 (holding:0)"),
        ("00001", RegisterRange("coil", 0, 1), "00001 (coil:0)"),
        ("10020", RegisterRange("discrete", 19, 1), "10020 (discrete:19)"),
        (400001, RegisterRange("holding", 0, 1), "40001 (holding:0)"),
        (465536, RegisterRange("holding", 65535, 1), "465536 (holding:65535)"),
        ("holding:0x10", RegisterRange("holding", 16, 1), "40017 (holding:16)"),
        ("input:9999", RegisterRange("input", 9999, 1), "310000 (input:9999)"),
    ],
)
def test_addresses_as_printed_and_as_sent(text: int | str, expected: RegisterRange, shown: str) -> None:
    found = resolve_address(text, "printed")
    assert found == expected
    assert str(found) == shown


@pytest.mark.parametrize(
    "text", [20001, 50001, 40000, 465537, "holding:65536", "holding:-1", "register:5", "five", 7, "holding:x", ""]
)
def test_invalid_addresses_are_refused(text: int | str) -> None:
    with pytest.raises(ValueError):
        resolve_address(text, "printed")


@given(st.sampled_from(["coil", "discrete", "input", "holding"]), st.integers(0, 65535))
def test_a_displayed_address_can_be_typed(table: str, address: int) -> None:
    found = resolve_address(f"{table}:{address}", "sent")
    assert resolve_address(str(found).split(" ", 1)[0], "printed") == found


def test_names_with_numbers_are_consecutive() -> None:
    tags = read("protocol: modbus\ntags:\n  voltage_l1..3: {at: 30001, type: float32}\n").tags
    assert [(t.name, t.registers.address) for t in tags.values()] == [
        ("voltage_l1", 0),
        ("voltage_l2", 2),
        ("voltage_l3", 4),
    ]


@pytest.mark.parametrize("defaults", ["", "defaults: {type: float32}\n"])
def test_a_coil_or_discrete_input_without_a_type_is_bool(defaults: str) -> None:
    """Defect: it had the default type of registers, and the first reply ended gateway, run and `read` as an internal error."""
    tags = read(f'protocol: modbus\n{defaults}tags:\n  a1..2: {{at: "coil:0"}}\n  b: {{at: 10001}}\n').tags
    assert [(t.type, t.registers.address, t.registers.count) for t in tags.values()] == [
        ("bool", 0, 1), ("bool", 1, 1), ("bool", 0, 1),
    ]  # fmt: skip


def test_the_command_list_follows_from_the_profile() -> None:
    profile = load_profile(PROFILES / "ctd-reference.yaml")
    assert profile.command_list == {"read_values", "read_status", "read_identity", "set_period"}
    assert profile.command_for("sample_period_s") == "set_period"
    modem = load_profile(PROFILES / "modem-mailbox.yaml")
    assert {"receive", "acknowledge", "send"} <= modem.command_list
    node = load_profile(PROFILES / "inclinometer-cia410.yaml")
    assert {"nmt_start", "nmt_stop"} <= node.command_list


MAILBOX = "mailbox: {inbox: {at: 40100, bytes: 8, ack: 10001}, outbox: {at: 40200, bytes: 8, ack: 40300}}\n"
TAGS = """protocol: modbus
tags:
  a: {at: 40001, access: rw}
  n: {at: 40002, type: uint32, counter: true}
  p: {at: 40004, type: int16}
"""


@pytest.mark.parametrize(
    ("text", "line", "told"),
    [
        ("protocol: modbus\ntags:\n  a: {at: 20001}\n", 5, "starts with 2"),
        ("protocol: modbus\ntags:\n  a: {object: \"6010:00\"}\n", 5, "`at: 30001`"),
        ("protocol: modbus\ntags:\n  a: {at: 40001, type: string}\n", 5, "`registers: N`"),
        ("protocol: modbus\ntags:\n  a: {at: 465536, type: float32}\n", 5, "exceeds the table"),
        ("protocol: modbus\ntags:\n  A: {at: 40001}\n", 5, "pattern"),
        ("protocol: modbus\ntags:\n  a1..2: {at: 40001}\n  a2: {at: 40009}\n", 6, "'a2' is defined twice"),
        ("protocol: modbus\ntags:\n  a: {at: 40001, typ: int16}\n", 5, "did you mean 'type'?"),
        ("protocol: modbus\ntags:\n  a: {at: 40001, type: int12}\n", 5, "int16"),
        ("protocol: modbus\ntags:\n  a: {at: 40001, type: uint8}\n", 5, "16 bits at least"),
        ("protocol: modbus\ntags:\n  a: {at: 00001, type: uint16}\n", 5, "is a single bit; expected bool; got uint16"),
        ("protocol: modbus\ntags:\n  a: {at: 10001, type: string, registers: 2}\n", 5, "expected bool; got string"),
        ("protocol: canopen\neds: x.eds\ntags:\n  a: {at: 40001}\n", 6, "`object:"),
        ("protocol: canopen\ntags: {}\n", 1, "needs an EDS"),
        (TAGS + "commands: {set_b: b}\n", 8, "no tag 'b'"),
        (TAGS + "commands: {set_n: n}\n", 8, "read-only"),
        (TAGS + "behaviours: {off: {fly: 1}}\n", 8, "no command 'fly'"),
        (TAGS + "messages: {m: {at: 40001, registers: 2, when: z}}\n", 8, "no tag 'z'"),
        (TAGS + "messages: {m: {at: 40001, registers: 90, when: n}}\nlimits: {read_registers: 60}\n", 8, "60"),
        (TAGS + "messages: {m: {at: 00001, registers: 2, when: n}}\n", 8, "expected a holding or input register; got coil:0"),
        (TAGS + MAILBOX, 8, "expected a holding or input register; got discrete:0"),
        (TAGS + "sampled: {count: z, period: p}\n", 8, "no tag 'z'"),
        (TAGS + "sampled: {count: n, period: p, poll: fast}\n", 8, "fast"),
        (TAGS + "  f: {at: 40010, type: float32}\nsampled: {count: f, period: p}\n", 9, "whole number"),
        (TAGS + "identify: [{tag: z}]\n", 8, "no tag 'z'"),
    ],
)  # fmt: skip
def test_contradictions_are_found_when_the_file_is_read(text: str, line: int, told: str) -> None:
    with pytest.raises(FileInvalid) as error:
        read(text)
    assert told in str(error.value)
    assert error.value.line == line
    assert error.value.path == "p.yaml"


CANOPEN = "protocol: canopen\neds: x.eds\ntags:\n"


@pytest.mark.parametrize(
    ("first", "second", "place", "told"),
    [
        ('whole: {object: "6200:01", type: int8}', 'again: {object: "6200:01", type: int8}', "7:11",
         "6200h:01 already has the tag 'whole'"),
        ('word: {object: "60FD:00", type: uint32}', 'rest: {object: "60fd:00", type: bool}', "7:10",
         "60FDh:00 already has the tag 'word'"),
        ('out1..2: {object: "6200:01"}', 'last: {object: "6200:02", access: wo}', "7:10", "6200h:02 already has the tag 'out2'"),
        ('last: {object: "6200:02"}', 'out1..2: {object: "6200:01"}', "7:13", "6200h:02 already has the tag 'last'"),
    ],
)  # fmt: skip
def test_second_tag_of_a_canopen_object_is_an_error_because_a_pdo_would_set_only_one(
    first: str, second: str, place: str, told: str
) -> None:
    with pytest.raises(FileInvalid, match=r"expected one tag for each object .*`values`.*`outputs AND 1`") as error:
        read(f"{CANOPEN}  {first}\n  {second}\n")
    assert f"p.yaml:{place}: the object {told}" in str(error.value)


@pytest.mark.parametrize("kind", ["uint8", "uint16", "uint32", "bool"])
def test_bits_of_a_canopen_object_are_an_error_for_every_type(kind: str) -> None:
    with pytest.raises(FileInvalid, match=r"expected a tag of the whole object .*`values`.*`outputs AND 1`") as error:
        read(CANOPEN + f'  acid: {{object: "6200:01", type: {kind}, bits: [0, 0]}}\n')
    assert (error.value.line, error.value.message) == (6, "'acid' is a part of a CANopen object")


def test_the_hash_depends_on_the_content_and_not_on_the_notation() -> None:
    plain = read("protocol: modbus\ntags:\n  a: {at: 40001}\n")
    styled = read("# a comment\nprotocol: modbus\ntags:\n  a:\n    at: 40001\n")
    other = read("protocol: modbus\ntags:\n  a: {at: 40002}\n")
    assert plain.hash == styled.hash != other.hash


def test_an_identification_names_the_text_that_it_lacks() -> None:
    with pytest.raises(FileInvalid, match=r"p\.yaml:4:1: `identification` has no 2 \(revision\)"):
        read("protocol: modbus\nidentification: {0: Example, 1: FM-300}\ntags: {a: {at: 30001}}\n")


def test_an_address_that_is_no_address_is_refused_with_the_forms_of_a_coil_too() -> None:
    with pytest.raises(FileInvalid, match=r"00001 \(coil\).*coil:0"):
        read("protocol: modbus\ntags: {a: {at: 1, type: bool}}\n")


@pytest.mark.parametrize("text", ["holding:0..5", "holding:", "holding:x", "holding:-1"])
def test_an_address_that_is_not_one_number_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(ValueError, match="one number, such as holding:100"):
        resolve_address(text, "sent")
