"""canbusload of can-utils counts the bits of the same frames as the modelled bus, stuff bits included."""

from __future__ import annotations

import asyncio
import random
import shutil
import socket
from pathlib import Path

import pytest
from support import run

from fieldtwin.emulators.endpoints.can.software_end import open_can_end
from fieldtwin.emulators.wires.can_timing import bits_on_wire
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.endpoint import Endpoint

COUNT = 300


def frames() -> list[CanFrame]:
    chance = random.Random(4)
    made = []
    for _ in range(COUNT):
        extended, remote = chance.random() < 0.3, chance.random() < 0.1
        can_id = chance.getrandbits(29 if extended else 11)
        data = bytes(chance.choice((0x00, 0xFF, 0x0F, chance.getrandbits(8))) for _ in range(chance.randrange(9)))
        if remote:  # without a length: tools differ in whether a remote frame's length code implies data
            made.append(CanFrame(can_id, extended=extended, remote=True, dlc=0))
        else:
            made.append(CanFrame(can_id, data, extended=extended))
    return made


@pytest.mark.socketcan
@pytest.mark.skipif(shutil.which("canbusload") is None, reason="needs can-utils")
def test_bits_are_those_that_canbusload_counts() -> None:
    if not hasattr(socket, "PF_CAN") or not Path("/sys/class/net/vcan0").exists():
        pytest.skip("no vcan0 here: scripts/test-vcan")

    async def main() -> None:
        end = await open_can_end(Endpoint.parse("can:socketcan/vcan0"), 0)
        load = await asyncio.create_subprocess_exec(
            *("stdbuf", "-oL", "canbusload", "-e", "vcan0@1000000"), stdout=asyncio.subprocess.PIPE
        )
        assert load.stdout is not None
        try:
            await asyncio.wait_for(load.stdout.readline(), 20)
            while b"vcan0@" not in await asyncio.wait_for(load.stdout.readline(), 20):
                pass  # it counts from here on
            for frame in frames():
                await end.send(frame)
            counted = bits = 0
            while counted < COUNT:
                line = (await asyncio.wait_for(load.stdout.readline(), 20)).decode()
                if "vcan0@" in line:
                    _, seen, total, *_ = line.split()
                    counted, bits = counted + int(seen), bits + int(total)
            assert (counted, bits) == (COUNT, sum(bits_on_wire(frame) for frame in frames()))
        finally:
            load.kill()
            await load.wait()
            await end.aclose()

    run(main(), 120)
