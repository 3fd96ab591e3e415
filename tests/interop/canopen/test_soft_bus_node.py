"""A bare python-can program commands the emulated inclinometer over the software bus, using CiA 301 only."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable
from pathlib import Path

import can
import pytest
from support import run
from targets import field_side, recording

from fieldtwin.gateway.connections.soft_bus import SoftBus
from fieldtwin.gateway.core.endpoint import Endpoint

pytestmark = pytest.mark.interop


class Program:
    """Blocking python-can calls, like those of any such program."""

    def __init__(self, bus: can.BusABC) -> None:
        self.bus = bus

    def send(self, cob_id: int, data: str) -> None:
        self.bus.send(can.Message(arbitration_id=cob_id, data=bytes.fromhex(data), is_extended_id=False), 2.0)

    def next(self, cob_id: int) -> bytes:
        """Return the data of the next frame with this COB-ID."""
        while (frame := self.bus.recv(5.0)) is not None:
            if frame.arbitration_id == cob_id:
                return bytes(frame.data)
        raise AssertionError(f"nothing heard on {cob_id:03X}h")

    def sdo(self, request: str) -> str:
        self.send(0x605, request)
        return self.next(0x585).hex(" ").upper()


def session(program: Program) -> None:
    assert program.sdo("40 18 10 04 00 00 00 00") == "43 18 10 04 ED 03 00 00"  # serial number 1005
    assert program.sdo("40 00 20 00 00 00 00 00") == "80 00 20 00 00 00 02 06"  # no such object
    assert program.sdo("23 18 10 04 01 00 00 00") == "80 18 10 04 02 00 01 06"  # read-only
    assert program.sdo("2B 17 10 00 64 00 00 00") == "60 17 10 00 00 00 00 00"  # heartbeat every 100 ms
    assert program.next(0x705) == b"\x7f"  # PRE-OPERATIONAL, from power-on
    assert program.sdo("2B 00 18 05 32 00 00 00") == "60 00 18 05 00 00 00 00"  # TPDO1 every 50 ms
    program.send(0x000, "01 05")
    slopes = [[round(100 * a), round(100 * b)] for _, a, b in recording("incl.jsonl")]
    for _ in range(5):
        long, lateral = struct.unpack("<hh", program.next(0x185))
        # a recorded point, or between two adjacent ones: 100 ms change it by 0.4 degrees at most
        assert min(abs(long - a) + abs(lateral - b) for a, b in slopes) <= 40
    while program.next(0x705) != b"\x05":
        pass  # heartbeats that were on their way when it was started
    program.send(0x000, "80 05")
    while program.next(0x705) != b"\x7f":
        pass


def test_a_bare_python_can_program_commands_the_node(short_dir: Callable[[], Path]) -> None:
    async def main() -> None:
        async with field_side(short_dir()) as status:
            channel = Endpoint.parse(status["listening"]["can0"]).path

            def talk() -> None:
                with SoftBus(channel) as bus:
                    session(Program(bus))

            await asyncio.to_thread(talk)

    run(main(), timeout_s=50)
