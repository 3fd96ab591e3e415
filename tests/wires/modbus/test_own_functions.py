"""Device-specific functions: declared in a profile, answered by `fieldtwin emulate`, requested by our client and a third-party
one."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from pathlib import Path

import pytest
from support import eventually, run

from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.models.modbus.recorded_device import load_replay
from fieldtwin.emulators.replay.profiled import ProfiledReplay
from fieldtwin.emulators.replay.replay import ExchangeReplay
from fieldtwin.emulators.replay.unit import ReplayUnit
from fieldtwin.gateway.connections.serial.line import SerialConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FileInvalid, ModbusExceptionReply
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.files.recording import RecordedExchange
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.protocols.modbus.requests.user import FixedShape, UserFunction
from fieldtwin.gateway.wallclock import WallClock

CHECKOUT = Path(__file__).resolve().parents[3]
PROFILE = CHECKOUT / "profiles" / "devices" / "renogy-rover.yaml"

BARE_MASTER = """
import sys, serial
with serial.Serial(sys.argv[1], 9600, timeout=3, exclusive=True) as port:
    for frame in sys.argv[2:]:
        port.write(bytes.fromhex(frame))
        print(port.read(8).hex())
"""
"""Use only the published frames, with their checksums."""
RESET, CLEAR = "0178000000016000", "0179000000015dc0"


def call(profile: DeviceProfile, name: str) -> UserFunction:
    function = profile.own_functions[name]
    return UserFunction(function.code, function.request, FixedShape(len(function.reply)))


def test_a_rover_is_reset_and_forgets_its_history(tmp_path: Path) -> None:
    profile, line = load_profile(PROFILE), tmp_path / "rover"

    async def main() -> None:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "fieldtwin", "emulate", "renogy-rover", "--on", f"pty:{line}"),
            cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(CHECKOUT)}, stderr=asyncio.subprocess.DEVNULL,
        )  # fmt: skip
        try:
            await eventually(line.exists, within_s=15)
            port = Endpoint.parse(f"rtu:{line}?baudrate=9600&frame=8N1")
            client = ModbusClient.at(port, await SerialConnection.open(port), WallClock(), timeout_s=2)
            try:
                assert any((await client.read_registers(1, "holding", 0x0118, 2)).registers)
                assert (await client.execute(1, call(profile, "clear_history"))).raw == bytes.fromhex("00 00 00 01")
                for address, count in ((0x0115, 1), (0x0118, 2), (0x011C, 2)):
                    assert not any((await client.read_registers(1, "holding", address, count)).registers)
                assert (await client.read_registers(1, "holding", 0x0100, 1)).registers == (87,)  # no history
                assert (await client.execute(1, call(profile, "factory_reset"))).raw == bytes.fromhex("00 00 00 01")
                with pytest.raises(ModbusExceptionReply) as refused:
                    await client.execute(1, UserFunction(0x79, b"\0\0\0\2", FixedShape(4)))
                assert refused.value.code == 3
                with pytest.raises(ModbusExceptionReply) as unknown:
                    await client.execute(1, UserFunction(0x7A, b"\0\0\0\1", FixedShape(4)))
                assert unknown.value.code == 1
            finally:
                await client.aclose()
            done = await asyncio.to_thread(
                subprocess.run,
                [sys.executable, "-c", BARE_MASTER, str(line), RESET, CLEAR],
                capture_output=True,
                text=True,
                timeout=20,
            )
            assert done.stdout.split() == [RESET, CLEAR], done.stderr
        finally:
            process.terminate()
            await process.wait()

    run(main(), timeout_s=60)


def a_rover() -> ReplayUnit:
    replay, unit_id = load_replay(load_profile(PROFILE), CHECKOUT / "recordings" / "renogy-rover.jsonl")
    return ProfiledReplay(load_profile(PROFILE), replay, unit_id)


def test_registered_functions_precede_recorded_ones_and_are_counted() -> None:
    unit = a_rover()
    assert unit.respond(bytes.fromhex("79 00000001"), 0) == bytes.fromhex("79 00000001")
    assert unit.respond(bytes.fromhex("03 0115 0001"), 0) == bytes.fromhex("03 02 0000")
    assert unit.respond(bytes.fromhex("79 00"), 0) == bytes.fromhex("F9 03")
    assert (unit.counters.requests, unit.counters.replies, unit.counters.exceptions) == (3, 3, 1)


@pytest.mark.parametrize("piece", [1, 3, 8])
@pytest.mark.parametrize("noise", ["", "00", "FF 00", "01 03"])
def test_a_device_specific_frame_that_looks_like_a_shorter_one_followed_by_a_zero(noise: str, piece: int) -> None:
    factory_reset = bytes.fromhex("01 78 00 00 00 01 60 00")  # 01 78 00 00 00 with the checksum 01 60, and a 00
    line = RtuServer({1: a_rover()})
    heard = bytes.fromhex(noise) + factory_reset + bytes.fromhex("01 03 01 00 00 01 85 F6")
    replies = [r for i in range(0, len(heard), piece) for r in line.feed(heard[i : i + piece], 0)]
    assert replies == [factory_reset, bytes.fromhex("01 03 02 00 57 F9 BA")]


def test_a_recording_defines_the_length_of_device_specific_functions() -> None:
    lengths = (("78 00 00 00 01", 5), ("78 01", 2), ("41 07", 2))
    made = [
        RecordedExchange(i / 10, 1, bytes.fromhex(pdu), bytes.fromhex(pdu), 0.01) for i, (pdu, _) in enumerate(lengths)
    ]
    unit = ReplayUnit(ExchangeReplay(made), 1)
    assert unit.request_lengths == {0x41: 2}  # 78h has two lengths


def test_a_recorded_unit_can_be_busy() -> None:
    unit = a_rover()
    unit.be_busy(1000)
    assert unit.respond(bytes.fromhex("03 0100 0001"), 999) == bytes.fromhex("83 06")
    assert unit.respond(bytes.fromhex("03 0100 0001"), 1000) == bytes.fromhex("03 02 0057")
    assert unit.counters.busy == 1


@pytest.mark.parametrize(
    ("section", "says"),
    [
        ('{x: {code: 0x50, request: "00"}}', "50h is not in `limits: functions`"),
        ('{x: {code: 0x78, request: "0"}}', "functions"),
        ("{x: {code: 0x78, sets: {nothing: 0}}}", "no tag 'nothing'"),
        ("{x: {code: 0x78, sets: {model: 0}}}", "is text"),
        ("{x: {code: 0x78, sets: {charging_state: 0}}}", "a part of a register"),
    ],
)
def test_a_function_that_cannot_be_is_refused_with_its_place(section: str, says: str, tmp_path: Path) -> None:
    kept = PROFILE.read_text(encoding="utf-8").rpartition("\nfunctions:")[0]
    bad = tmp_path / "bad.yaml"
    bad.write_text(f"{kept}\nfunctions: {section}\n", encoding="utf-8")
    with pytest.raises(FileInvalid) as caught:
        load_profile(bad)
    assert says in str(caught.value)
