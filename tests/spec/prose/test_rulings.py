"""Rulings without a row in a schema: ChangeBehavior (14), and the safe state and losses (18)."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from spec_rig import CHECKOUT, CLOCK, observatory, rig
from support import run

from fieldtwin.cli.device.write_command import command as write_command
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.emulators.virtual.seal import sealed
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import NotAllowed
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.image.image import INPUTS, OUTPUTS
from fieldtwin.gateway.core.values import COMMAND, Quality, Reason
from fieldtwin.gateway.devices.config import BusConfig, DeviceConfig
from fieldtwin.gateway.runtime.gateway import make_driver
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.plc.runtime.runner import TaskRunner
from fieldtwin.run.processes.topside import TopsideController
from fieldtwin.twin.model.shadow import DigitalShadow
from fieldtwin.twin.model.thread_process import ReceivingEnd
from fieldtwin.twin.model.variables import ModelVariable
from fieldtwin.twin.plant.declared import declared_variables
from fieldtwin.twin.plant.physical import plc_lost_ms
from fieldtwin.twin.prototype.virtual import VirtualPrototype
from fieldtwin.twin.site.system import System
from fieldtwin.twin.thread.plant_thread import ImageProcess

PROFILES = sorted((CHECKOUT / "profiles" / "devices").glob("*.yaml"))

# -- 14: ChangeBehavior -----------------------------------------------------------------------------------------------


def test_ChangeBehavior_maps_a_name_to_commands_by_the_map_in_the_device_profile(tmp_path: Path) -> None:
    """Ruling 14: it belongs to the driver, and its commands take the same path as all others."""

    async def main() -> None:
        async with rig(tmp_path) as r:
            driver, unit = r.register_driver("ctd"), r.unit("ctd")
            assert driver.behaviour("off") == (driver.command("sample_period_s", -1),)
            for name, period_s in (("off", -1), ("standby", 0)):
                assert driver.change_behaviour(name) == 1
                await driver.send()
                assert list(unit.bank.read("holding", 1, 1, CLOCK.monotonic_ns())) == [period_s & 0xFFFF]
            assert unit.emulator.executed["set_period"] == 2
            with pytest.raises(NotAllowed, match=r"no behaviour 'dance'.*standby, off"):
                driver.change_behaviour("dance")
            assert not driver.consumer.queue

    run(main())


def test_ChangeBehavior_of_several_commands_sends_all_of_them_in_the_profiles_order_or_none(tmp_path: Path) -> None:
    """Ruling 14."""
    text = (CHECKOUT / "profiles" / "devices" / "ctd-reference.yaml").read_text(encoding="utf-8")
    text = text.replace("status:          {", "status:          {access: rw, ", 1)
    text = text.replace("commands: {", "commands: {set_status: status, ", 1)
    far = "far: {set_status: 1, set_period: 40000}"
    text = text.replace("behaviours: {", f"behaviours: {{start: {{set_status: 1, set_period: 5}}, {far}, ", 1)
    (tmp_path / "ctd.yaml").write_text(text, encoding="utf-8")
    driver = driver_of(tmp_path / "ctd.yaml")
    assert [command.name for command in driver.behaviour("start")] == ["set_status", "set_period"]
    with pytest.raises(NotAllowed, match="40000"):
        driver.change_behaviour("far")
    assert not driver.consumer.queue, "none, although the first of them could be sent"


def test_ChangeBehavior_is_a_write_by_name_at_the_device() -> None:
    """Ruling 14: the same map, and the same request on the wire."""

    def frames(*arguments: str) -> str:
        done = CliRunner().invoke(
            write_command, ["rtu:/dev/ttyS9", "--profile", "ctd-reference", "--dry-run", *arguments]
        )
        return done.output if done.exit_code == 0 else str(done.exception)

    assert frames("--behaviour", "off") == "01 06 00 01 ff ff d9 ba\n"
    assert frames("--behaviour", "off", "--behaviour", "standby") == frames("sample_period_s=-1", "sample_period_s=0")
    assert "standby, off" in frames("--behaviour", "dance")


@pytest.mark.parametrize("path", PROFILES, ids=lambda path: str(path.stem))
def test_ChangeBehavior_every_behaviour_of_a_shipped_profile_is_made_of_commands_of_its_driver(path: Path) -> None:
    """Ruling 14: on either protocol."""
    driver = driver_of(path)
    for name in driver.profile.form.behaviours:
        commands = driver.behaviour(name)
        assert commands
        for command in commands:
            assert type(command) is COMMAND
            assert command.data
            driver.check(command)


def driver_of(path: Path) -> Any:
    profile = load_profile(path)
    url = "can:socketcan/can0" if profile.protocol == "canopen" else "rtu:/dev/ttyS0?baudrate=19200&frame=8E1"
    bus = BusConfig("bus", Endpoint.parse(url), 1.0, 0)
    return make_driver(DeviceConfig("d", profile, "bus", 1), bus, TagTable(CLOCK), CLOCK)


# -- 18: safe and lost --------------------------------------------------------------------------------------------------


class Watched:
    """The observatory in virtual time, with a shadow that receives the contents of its process image."""

    def __init__(self, system: System, plant: VirtualPrototype, topside: TopsideController) -> None:
        self.plant, self.topside = plant, topside
        self._image = ImageProcess(system, plant.twin.ecs.layout, plant.clock)
        self._readers = plant.image.reader(INPUTS), plant.image.reader(OUTPUTS)
        self._receiving = ReceivingEnd("from the plant")
        self.shadow = DigitalShadow(self._receiving, plant.clock, declared=declared_variables(system))
        self.found: list[str] = []

    def __getitem__(self, name: str) -> ModelVariable:
        return self.shadow.digital_model.variables[name]

    def period_in_device(self) -> int:
        unit = self.plant.field.devices["ctd"].unit
        assert unit is not None
        return next(iter(unit.bank.read("holding", 1, 1, self.plant.loop.now_ns)))

    async def pass_s(self, seconds: float) -> None:
        """Let time pass, with the shadow polled twenty times a second."""
        for _ in range(round(seconds * 20)):
            await asyncio.sleep(0.05)
            self._image.look(*(reader.snapshot() for reader in self._readers))
            for event in self._image.collect():
                self._receiving.observe("plant:1", event)
            self.shadow.step()
            self.found += [f"{v.subject} {v.finding}" for v in self.shadow.verdicts.drain()]


def in_virtual_time(tmp_path: Path, main: Callable[[Watched], Coroutine[Any, Any, None]]) -> None:
    """`main` on an observatory that samples each second."""
    system, prototype = observatory()
    loop = VirtualLoop()

    @asynccontextmanager
    async def sampling() -> AsyncIterator[Watched]:
        async with VirtualPrototype(system, prototype, loop, tmp_path) as plant, Nursery() as nursery:
            topside = TopsideController(system, "modem", plant.field.far["modem"], plant.clock, plant.net)
            nursery.start(topside.run([]), "topside")
            watched = Watched(system, plant, topside)
            await watched.pass_s(3)
            topside.send(1)
            await watched.pass_s(8)
            assert watched.period_in_device() == 1
            assert (watched["ctd.sample_period_s"].value, watched["ctd.pressure"].quality) == (1, Quality.GOOD)
            assert watched["relay"].good
            watched.found.clear()
            yield watched

    async def whole() -> None:
        async with sampling() as watched:
            await main(watched)

    try:
        with sealed():
            loop.run_until_complete(whole())
    finally:
        loop.close()


@pytest.mark.parametrize("how", ["it hangs", "it ends"])
def test_PhysicalTwin_of_which_the_controller_is_dead_has_safe_outputs_and_the_model_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    """Ruling 18."""

    async def main(watched: Watched) -> None:
        if how == "it hangs":
            monkeypatch.setattr(TaskRunner, "deadline_ns", property(lambda runner: 2 * watched.plant.loop.now_ns))
        else:
            (plc,) = [task for task in asyncio.all_tasks() if task.get_name() == "PLC"]
            plc.cancel()
        await watched.pass_s(plc_lost_ms(watched.plant.system) / 1000 + 3)
        assert watched.period_in_device() == 0, "safe, by the system file"
        held = watched["ctd.sample_period_s"]
        assert (held.value, held.quality) == (0, Quality.GOOD), "what the device holds"
        why = Reason.HEARTBEAT_LOST if how == "it hangs" else Reason.NOT_OPERATIONAL
        assert (watched["relay"].value, watched["relay"].reason) == (0, why)
        assert watched.found == ["relay bad"]
        before = watched.shadow.analyze.compared
        await watched.pass_s(25)
        assert watched.shadow.analyze.compared == before, (
            "what a dead controller said last is not told again as its state"
        )
        assert watched["inclinometer.slope_long"].good, "its devices are there"
        assert watched["ctd.pressure"].reason is Reason.NOT_SAMPLING

    in_virtual_time(tmp_path, main)


def test_PhysicalTwin_of_which_a_device_is_dead_has_bad_tags_and_the_model_says_so(tmp_path: Path) -> None:
    """Ruling 18: the tags of that device, with a reason and the last value; good again when it returns."""

    async def main(watched: Watched) -> None:
        last = watched["ctd.pressure"].value
        id = watched.plant.field.faults.inject({"name": "silence", "device": "ctd"})
        await watched.pass_s(5)
        tags = [
            name for name in watched.shadow.digital_model.variables if name.startswith("ctd.") and name != "ctd.sample"
        ]
        assert {watched[name].quality for name in tags} == {Quality.BAD}
        assert watched["ctd.pressure"].reason in (Reason.TIMEOUT, Reason.UNREACHABLE)
        assert watched["ctd.pressure"].value is not None
        assert isinstance(last, float)
        assert watched["inclinometer.slope_long"].good
        assert watched["relay"].good, "its controller runs"
        assert "ctd.pressure bad" in watched.found
        watched.plant.field.faults.clear(id)
        await watched.pass_s(20)
        assert watched["ctd.pressure"].good
        assert "ctd.pressure good" in watched.found

    in_virtual_time(tmp_path, main)
