"""Schemas Communication and EmulatedCommunication."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from spec_rig import CLOCK, Rig, copy_systems, observatory, rig
from support import run

from fieldtwin.emulators.emulator import EmulatedCommunication, SensorEmulator
from fieldtwin.emulators.link import EmulatedLink
from fieldtwin.gateway.core.concurrency.events import Consumer
from fieldtwin.gateway.core.connection import PROTOCOL
from fieldtwin.gateway.core.device import Communication
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import CommandListMismatch
from fieldtwin.gateway.core.values import DATA
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.prototype.prototype import DigitalTwinPrototype
from fieldtwin.twin.site.system import load_system

NAMES = st.frozensets(st.sampled_from([f"command_{letter}" for letter in "abcdef"]))


@pytest.mark.parametrize("kind", [Communication, EmulatedCommunication])
@given(driver=NAMES, device=NAMES)
def test_Communication_holds_exactly_when_both_inclusions_do(
    kind: type[Communication], driver: frozenset[str], device: frozenset[str]
) -> None:
    communication = kind("ctd", driver, device)
    if driver == device:
        communication.check()
        return
    with pytest.raises(CommandListMismatch) as caught:
        communication.check()
    left, right = caught.value.got.split(";")
    assert all((name in left) == (name in driver - device) for name in driver | device)
    assert all((name in right) == (name in device - driver) for name in driver | device)


def test_Communication_of_every_shipped_device_holds() -> None:
    twin = DigitalTwinPrototype(*observatory(), CLOCK)
    assert set(twin.communications) == {"ctd", "inclinometer", "modem"}
    for name, communication in twin.communications.items():
        assert communication.driver_commands == communication.device_commands, name
        assert communication.driver_commands


@pytest.mark.parametrize(
    ("old", "new"), [("set_period", "set_interval"), ("commands: {set_period: sample_period_s}", "")]
)
def test_Communication_that_differs_is_refused_when_the_system_is_put_together(
    tmp_path: Path, old: str, new: str
) -> None:
    """Ruling 12: derived from the profiles on both sides; the error names the commands missing on either."""
    systems = copy_systems(tmp_path)
    devices = systems.parent / "devices"
    other = (devices / "ctd-reference.yaml").read_text(encoding="utf-8").replace(old, new)
    if not new:
        other = other.replace('behaviours: {standby: {set_period: 0}, "off": {set_period: -1}}\n', "")
    (devices / "ctd-other.yaml").write_text(other, encoding="utf-8")
    path = systems / "observatory.prototype.yaml"
    text = path.read_text(encoding="utf-8").replace(
        "ctd:          {", f"ctd:          {{profile: {devices}/ctd-other.yaml, "
    )
    path.write_text(text, encoding="utf-8")
    system = load_system(str(systems / "observatory.yaml"), [tmp_path / "profiles"])
    with pytest.raises(CommandListMismatch, match="unknown to the device: set_period") as caught:
        DigitalTwinPrototype(system, load_prototype(system), CLOCK)
    assert "unknown to the driver: set_" in str(caught.value)


async def both_ways(r: Rig) -> None:
    """ReadFromDriver: the driver sends, the device receives. ReadFromDevice: the device sends, the driver receives."""
    driver, unit = r.register_driver("ctd"), r.unit("ctd")
    assert isinstance(unit.emulator, SensorEmulator)
    subscriber: Consumer[DATA] = Consumer(driver.emitter.event)
    driver.emitter.subscribe(subscriber)
    await driver.receive("values")
    driver.consumer.observe(driver.command("sample_period_s", 3600))
    await driver.send()
    assert list(unit.bank.read("holding", 1, 1, CLOCK.monotonic_ns())) == [3600]
    await driver.receive("values")
    held = b"".join(word.to_bytes(2) for word in unit.bank.read("input", 0, 10, CLOCK.monotonic_ns()))
    assert subscriber.consume().data == held
    assert sum(unit.emulator.executed.values()) == unit.counters.requests == unit.counters.replies


def test_Communication_ReadFromDevice_and_ReadFromDriver(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            await both_ways(r)

    run(main())


def test_EmulatedCommunication_goes_both_ways_through_an_EmulatedConnection(tmp_path: Path) -> None:
    """emulator <-> EmulatedConnection <-> driver: a virtual serial port carried over TCP. The driver opens the plant's
    endpoint; the emulator's device is still connected by RS232."""

    async def main() -> None:
        system, prototype = observatory()
        prototype = prototype.with_listen(system, "line1", Endpoint.parse("tcp://127.0.0.1:0"))
        async with rig(tmp_path / "a", prototype) as far_side:
            link = EmulatedLink(Endpoint("pty", path=str(tmp_path / "port")), far_side.field.listening["line1"])
            await link.open()
            serving = asyncio.create_task(link.serve())
            try:
                async with rig(tmp_path / "b", None, {"line1": Endpoint("pty", path=str(tmp_path / "port"))}) as near:
                    crossed = Rig(near.twin, far_side.field, near.tags, near.drivers)
                    await both_ways(crossed)
                    assert near.unit("ctd").counters.requests == 0  # this emulator received no request
                assert link.connection.type is PROTOCOL.TCP
                assert link.connection.protocol is PROTOCOL.RS232
                assert far_side.unit("ctd").emulator.connection.type is PROTOCOL.RS232
                assert link.connection.written_bytes > 0
                assert link.connection.read_bytes > 0
                assert link.connection.dropped_write_bytes == link.connection.dropped_read_bytes == 0
            finally:
                serving.cancel()
                await asyncio.gather(serving, return_exceptions=True)
                await link.aclose()

    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    run(main())
