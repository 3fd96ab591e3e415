"""Every shipped profile of a real device is short and names its source, and its driver reads the device's recording, replayed
on a real protocol stack, as the original values of the recording."""

from __future__ import annotations

import asyncio
import random
import sys
from pathlib import Path

import pytest
from support import eventually, run

from fieldtwin.emulators.endpoints.modbus_server import serve_mbap
from fieldtwin.emulators.endpoints.socket_end import SocketListener
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.replay.replay import ExchangeReplay
from fieldtwin.emulators.replay.unit import ReplayUnit
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.files.recording import RecordingReader
from fieldtwin.gateway.core.values import Quality
from fieldtwin.gateway.devices.config import BusConfig, DeviceConfig
from fieldtwin.gateway.devices.register_device import RegisterDriver
from fieldtwin.gateway.runtime.buses.modbus.modbus_bus import ModbusBus
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.gateway.wallclock import WallClock

ROOT = Path(__file__).resolve().parents[3]
sys.path.insert(0, str(ROOT / "scripts"))

import make_device_recordings  # noqa: E402

DEVICES = sorted(make_device_recordings.DEVICES)


def shipped(name: str) -> DeviceProfile:
    return load_profile(ROOT / "profiles" / "devices" / f"{name}.yaml")


@pytest.mark.parametrize("name", DEVICES)
def test_a_device_is_at_most_forty_lines_and_cites_its_source(name: str) -> None:
    text = (ROOT / "profiles" / "devices" / f"{name}.yaml").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 40
    assert len(shipped(name).form.source) > 20


@pytest.mark.parametrize("name", DEVICES)
def test_the_shipped_recording_is_the_output_of_the_script_and_marked_synthetic(name: str, tmp_path: Path) -> None:
    make_device_recordings.make(name, tmp_path, make_device_recordings.DEFAULT_SEED)
    assert (tmp_path / f"{name}.jsonl").read_bytes() == (ROOT / "recordings" / f"{name}.jsonl").read_bytes()
    with RecordingReader(ROOT / "recordings" / f"{name}.jsonl") as reader:
        assert reader.header.source == "synthetic"
        assert reader.header.profile_hash == shipped(name).hash


@pytest.mark.parametrize("name", DEVICES)
def test_the_driver_reads_the_recorded_values_of_the_device(name: str) -> None:
    profile = shipped(name)
    unit = profile.form.factory.unit

    async def main() -> TagTable:
        replay = ExchangeReplay.load(ROOT / "recordings" / f"{name}.jsonl")
        units = {unit: ReplayUnit(replay, unit)}
        clock = WallClock()
        listener = await SocketListener.open(
            Endpoint.parse("tcp://127.0.0.1:0"), lambda c: serve_mbap(c, MbapServer(units), clock)
        )
        tags = TagTable(clock)
        trigger = profile.form.trigger
        config = DeviceConfig("d", profile, "line", unit, poll=dict.fromkeys(profile.groups, 50))
        driver = RegisterDriver(config, tags)
        driver.may_trigger = trigger is not None
        tags.declare(driver.tag_names, 60_000)
        bus = ModbusBus(BusConfig("line", listener.bound), [driver], OsConnector(), clock, tags, lambda d: None)
        async with Nursery() as nursery:
            running = nursery.start(bus.run(), "bus")

            def all_read() -> bool:
                assert not running.done(), running.exception()
                return all(tags.current(n, clock.monotonic_ns()).raw for n in driver.tag_names)

            await eventually(all_read, what=f"values of {name}")
        await listener.aclose()
        await asyncio.sleep(0)
        return tags

    tags = run(main())
    made = [make_device_recordings.DEVICES[name](random.Random(f"{name} {make_device_recordings.DEFAULT_SEED}"), 0)]
    for tag in profile.tags.values():
        if not tag.readable or tag.bits or tag.scale_by:
            continue
        value = tags.current(f"d.{tag.name}", 1)
        raw = made[0][tag.name]
        if tag.type == "int16" and isinstance(raw, int):
            raw &= 0xFFFF  # as stated by sentinels
        if isinstance(raw, str):
            assert value.value == raw
        elif not tag.counter and isinstance(raw, int) and raw not in tag.sentinels:
            # the first round's raw number, scaled; later rounds vary by a few counts
            signed = raw - 0x10000 if tag.type == "int16" and raw & 0x8000 else raw
            assert value.value == pytest.approx(signed * tag.scale + tag.offset, abs=40 * tag.scale)
        assert value.quality is Quality.GOOD or raw in tag.sentinels


def test_the_inverter_s_scale_factors_and_sentinels() -> None:
    profile = shipped("sunspec-inverter-103")
    assert profile.tags["power"].scale_by == "w_sf"
    assert 0xFFFF in profile.tags["current_l3"].sentinels
