"""mbpoll, a program based on libmodbus, reads and commands the emulated ctd; it prints the values that the ctd holds."""

from __future__ import annotations

import asyncio
import re
import shutil
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from support import run

from fieldtwin.emulators.endpoints.modbus_server import serve_mbap, serve_rtu
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.emulators.endpoints.socket_end import SocketListener
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.emulators.models.modbus.emulated_modbus import unit_limits
from fieldtwin.emulators.models.modbus.sampled_sensor import SampledSensor
from fieldtwin.emulators.signals import SignalPlayer, SignalTrack
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.wallclock import WallClock

pytestmark = [
    pytest.mark.interop,
    pytest.mark.skipif(shutil.which("mbpoll") is None, reason="mbpoll is not installed"),
]
ROOT = Path(__file__).parents[3]
PLANT = Endpoint.parse("rtu:/dev/ttyS0?baudrate=19200&frame=8E1")
HOUR = "3600"
"""A period so long that the first sample, taken at once, remains the only one."""


class Master:
    """mbpoll with the arguments for one wire."""

    def __init__(self, sensor: SampledSensor, *wire: str) -> None:
        self.sensor = sensor
        self._wire = wire

    async def __call__(self, kind: str, first: int, *values: str, count: int = 1) -> list[str]:
        """Read `count` values from reference `first`, or write `values`; return the printed values, or the error message."""
        what = ["-t", kind, "-r", str(first), "-B", "-1", "-o", "2"]
        reading = [] if values else ["-c", str(count)]
        process = await asyncio.create_subprocess_exec(
            "mbpoll", *self._wire[:-1], *what, *reading, self._wire[-1], *values,
            stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
        )  # fmt: skip
        out, _ = await process.communicate()
        text = out.decode()
        if process.returncode:
            return [text]
        return re.findall(r"^\[\d+\]:\s+(\S+)", text, re.MULTILINE)

    def held(self, tag: str) -> bytes:
        """Return the last bytes that the sensor held for a tag."""
        return [h.raw for h in self.sensor.journal.since(0) if h.tag == tag][-1]


@asynccontextmanager
async def ctd(wire: str, folder: Path) -> AsyncIterator[Master]:
    clock = WallClock()
    profile = load_profile(ROOT / "profiles/devices/ctd-reference.yaml")
    player = SignalPlayer(SignalTrack.load(ROOT / "recordings/cast.jsonl"), clock.monotonic_ns())
    sensor = SampledSensor(profile, player, {"serial": "0042"})
    unit = ModbusUnit(sensor, unit_limits(profile))
    if wire == "rtu":
        end = await PtyEnd.open(folder / "ctd", PLANT, PLANT.serial)
        async with Nursery() as nursery:
            nursery.start(serve_rtu(end, RtuServer({1: unit}), clock), "ctd")
            yield Master(sensor, "-m", "rtu", "-b", "19200", "-P", "even", "-s", "1", "-a", "1", str(end.link))
        await end.aclose()
        return
    listener = await SocketListener.open(
        Endpoint.parse("tcp://127.0.0.1:0"), lambda c: serve_mbap(c, MbapServer({1: unit}), clock)
    )
    yield Master(sensor, "-m", "tcp", "-p", str(listener.bound.port), "-a", "1", "127.0.0.1")
    await listener.aclose()


@pytest.mark.parametrize("wire", ["rtu", "tcp"])
def test_mbpoll_reads_the_values_of_the_ctd(wire: str, tmp_path: Path) -> None:
    async def main() -> None:
        async with ctd(wire, tmp_path) as mbpoll:
            assert await mbpoll("4", 1, count=2) == ["0", "0"]  # standby, period 0
            assert await mbpoll("3:float", 1, count=3) == ["nan", "nan", "nan"]  # no sample yet
            await mbpoll("4", 2, HOUR)
            assert await mbpoll("4", 1, count=2) == ["1", HOUR]  # sampling

            printed = [float(text) for text in await mbpoll("3:float", 1, count=3)]
            held = [struct.unpack(">f", mbpoll.held(t))[0] for t in ("pressure", "temperature", "conductivity")]
            assert printed == pytest.approx(held, rel=1e-5)  # mbpoll prints six digits
            assert 4.0 < printed[0] < 6.0  # a soak at the surface: dbar
            numbers = [int.from_bytes(mbpoll.held(t)) for t in ("sample_count", "instrument_time")]
            assert await mbpoll("3:int", 7, count=2) == [str(n) for n in numbers]
            assert numbers[0] == 1
            words = struct.unpack(">10H", b"".join(struct.pack(">f", v) for v in held) + struct.pack(">2I", *numbers))
            assert await mbpoll("3:hex", 1, count=10) == [f"0x{w:04X}" for w in words]

            serial = await mbpoll("4:hex", 101, count=4)
            assert bytes.fromhex("".join(w[2:] for w in serial)) == mbpoll.held("serial") == b"0042\0\0\0\0"

    run(main())


@pytest.mark.parametrize("wire", ["rtu", "tcp"])
def test_mbpoll_is_refused_according_to_the_profile(wire: str, tmp_path: Path) -> None:
    async def main() -> None:
        async with ctd(wire, tmp_path) as mbpoll:
            assert "Illegal data address" in (await mbpoll("4", 50))[0]
            assert "Illegal data value" in (await mbpoll("3", 1, count=61))[0]
            assert "Illegal function" in (await mbpoll("0", 1))[0]
            assert "Illegal data address" in (await mbpoll("4", 1, "1"))[0]  # the status comes from the ctd itself
            assert await mbpoll("4", 2, "65535") == []  # -1, as mbpoll accepts it
            assert mbpoll.held("sample_period_s") == b"\xff\xff"
            assert await mbpoll("4", 1) == ["2"]  # off

    run(main())
