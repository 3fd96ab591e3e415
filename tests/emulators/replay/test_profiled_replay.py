"""Emulators of the shipped real devices follow their profiles for unrecorded requests: functions, counts, half values,
writable and unreadable registers. Recorded answers take precedence."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.emulators.models.modbus.recorded_device import RecordedDevice, load_replay
from fieldtwin.emulators.replay.profiled import ProfiledReplay
from fieldtwin.emulators.replay.replay import ExchangeReplay
from fieldtwin.gateway.core.connection import RS232Connection
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.files.recording import RecordedExchange

ROOT = Path(__file__).resolve().parents[3]


def device(name: str, **identity: str) -> RecordedDevice:
    profile = load_profile(ROOT / "profiles" / "devices" / f"{name}.yaml")
    replay, unit_id = load_replay(profile, ROOT / "recordings" / f"{name}.jsonl")
    return RecordedDevice(profile, replay, unit_id, RS232Connection, identity)


@pytest.mark.parametrize(
    ("name", "request_hex", "reply_hex"),
    [
        ("eastron-sdm630", "06 0002 0001", "86 01"),  # function 06 does not exist
        ("eastron-sdm630", "04 0000 0003", "84 03"),  # MB-048: half a value
        ("eastron-sdm630", "04 0001 0002", "84 02"),
        ("eastron-sdm630", "04 0000 0052", "84 03"),  # at most 80 registers
        ("eastron-sdm630", "04 0000 007E", "84 03"),
        ("eastron-sdm630", "04 FFFE 0004", "84 02"),  # MB-037
        ("eastron-sdm630", "04 FFFE 0100", "84 03"),  # MB-038
        ("eastron-sdm630", "03 000E 0002", "83 02"),  # the password is write-only
        ("eastron-sdm630", "10 000E 0002 04 42700000", "10 000E 0002"),
        ("eastron-sdm630", "10 000A 0002 04 42700000", "90 02"),  # the system type is read-only
        ("eastron-sdm630", "10 0002 0002 03 427000", "90 03"),  # MB-040
        ("delta-vfd-e", "06 2001 0DAC", "06 2001 0DAC"),
        ("delta-vfd-e", "06 2101 0001", "86 02"),
        ("delta-vfd-e", "10 2001 0002 04 00000000", "90 02"),  # MB-041: partly outside
        ("delta-vfd-e", "04 2100 0001", "84 01"),
        ("renogy-rover", "06 010A 0001", "06 010A 0001"),
        ("renogy-rover", "03 010A 0001", "83 02"),
        ("renogy-rover", "79 00000001", "79 00000001"),
        ("sunspec-inverter-103", "06 9C44 0001", "86 01"),
        ("aqualabo-c4e", "03 0001 0001", "83 02"),
    ],
)
def test_unrecorded_requests_follow_the_profile(name: str, request_hex: str, reply_hex: str) -> None:
    unit = device(name)
    assert unit.respond(bytes.fromhex(request_hex), 0) == bytes.fromhex(reply_hex)
    assert unit.counters.requests == unit.counters.replies == 1
    assert unit.counters.exceptions == (bytes.fromhex(reply_hex)[0] >= 0x80)


def test_written_values_read_back_and_were_held() -> None:
    unit = device("delta-vfd-e")
    unit.respond(bytes.fromhex("06 2001 1388"), 5)
    assert unit.respond(bytes.fromhex("03 2001 0001"), 6) == bytes.fromhex("03 02 1388")
    assert [(h.tag, h.raw) for h in unit.journal.since(0)] == [("frequency_set", bytes.fromhex("1388"))]
    assert unit.emulator.executed["set_frequency"] == 1


def test_a_separate_identity() -> None:
    unit = device("renogy-rover", model="ROVER-7")
    assert unit.respond(bytes.fromhex("03 000C 0008"), 0) == bytes.fromhex("03 10") + b"ROVER-7".ljust(16, b"\0")


def test_recorded_answers_precede_the_profile() -> None:
    profile = load_profile(ROOT / "profiles" / "devices" / "eastron-sdm630.yaml")
    odd, reply = bytes.fromhex("04 0000 0001"), bytes.fromhex("04 02 4366")
    replay = ExchangeReplay([RecordedExchange(0.0, 1, odd, reply, 0.02)])
    unit = ProfiledReplay(profile, replay, 1)
    assert unit.respond(odd, 0) == reply
    assert unit.latency_s == 0.02


def test_counters_never_run_backwards_unless_the_device_clears_them() -> None:
    unit = device("renogy-rover")
    read = bytes.fromhex("03 011C 0002")
    seen = [int.from_bytes((unit.respond(read, 0) or b"")[2:]) for _ in range(40)]
    assert seen == sorted(seen)
    assert seen[-1] > seen[0]
    unit.respond(bytes.fromhex("79 00000001"), 0)
    assert unit.respond(read, 0) == bytes.fromhex("03 04 00000000")


@settings(max_examples=150)
@given(st.binary(min_size=1, max_size=20))
def test_any_request_is_answered_with_its_function_or_not_at_all(pdu: bytes) -> None:
    reply = ROVER.respond(pdu, 0)
    assert reply is None or reply[0] in (pdu[0], pdu[0] | 0x80)


ROVER = device("renogy-rover")
