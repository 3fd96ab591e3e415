"""The first writes of a run. Defect: at a temperature of 21.6 a program set the fan from 2 to 1 and back: its first scans saw
0.0.

Also: a value that a device already holds is not written again, and a safe value is written although no program writes its tag.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from fan_hall import VirtualHall, hall, writes

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.twin.prototype.virtual import VirtualPrototype


@pytest.mark.parametrize("if_bad", ["pass", "hold", "trip", 5.0])
@pytest.mark.parametrize("language", ["st", "python"])
def test_an_input_that_was_never_read_writes_nothing(tmp_path: Path, language: str, if_bad: str | float) -> None:
    VirtualHall(hall(tmp_path, language=language, if_bad=if_bad), tmp_path).run(5)
    assert writes(tmp_path) == []


def test_values_that_the_device_does_not_hold_are_written_once(tmp_path: Path) -> None:
    VirtualHall(hall(tmp_path, mode=0), tmp_path).run(5)
    assert writes(tmp_path) == [("fan.mode", 0, 2, "plc")]


def test_an_output_that_is_read_seldom_is_written_only_after_its_first_reading(tmp_path: Path) -> None:
    VirtualHall(hall(tmp_path, every_ms=5_000), tmp_path).run(20)
    assert writes(tmp_path) == []


def test_an_output_that_is_never_read_is_written(tmp_path: Path) -> None:
    system = hall(tmp_path, writable="mode, lamp")
    system.write_text(system.read_text().replace("mode: fan.mode", "mode: fan.lamp"))
    VirtualHall(system, tmp_path).run(5)
    assert writes(tmp_path) == [("fan.lamp", None, 2, "plc")]


def test_a_device_that_loses_its_value_gets_it_again(tmp_path: Path) -> None:
    async def lose(run: VirtualPrototype) -> None:
        run.field.faults.set_value("fan", "mode", 7)
        await run.clock.sleep_until_ns(run.loop.now_ns + 3 * NS_PER_S)

    VirtualHall(hall(tmp_path), tmp_path).run(5, lose)
    assert set(writes(tmp_path)) == {("fan.mode", 7, 2, "plc")}


def test_a_restart_of_the_programs_writes_nothing(tmp_path: Path) -> None:
    async def restart(run: VirtualPrototype) -> None:
        run.plc.restart()
        await run.clock.sleep_until_ns(run.loop.now_ns + 3 * NS_PER_S)
        assert run.plc.status().state == "running"

    VirtualHall(hall(tmp_path), tmp_path).run(5, restart)
    assert writes(tmp_path) == []


def test_a_safe_value_is_written_although_no_program_writes_the_tag(tmp_path: Path) -> None:
    """Defect: the tag was omitted without a message: a different client had set it, and it kept that value on stop."""
    VirtualHall(hall(tmp_path, writable="mode, speed", safe="speed: 0"), tmp_path).run(5)
    assert writes(tmp_path) == [("fan.speed", 3, 0, "safe: the gateway stops")]


def test_a_safe_value_without_a_program_is_written_when_the_plc_is_lost_and_not_after_that(tmp_path: Path) -> None:
    async def lose_the_plc(run: VirtualPrototype) -> None:
        run.plc.stop()
        await run.clock.sleep_until_ns(run.loop.now_ns + 2 * NS_PER_S)
        assert writes(tmp_path) == [("fan.speed", 3, 0, "safe: the PLC stopped")]
        run.plc.restart()
        run.plc.run_once()  # it is alive again
        await run.clock.sleep_until_ns(run.loop.now_ns + NS_PER_S // 10)
        assert not run.gateway.outputs.safe_active
        run.field.faults.set_value("fan", "speed", 9)  # a different client commands it now
        written = len(writes(tmp_path))
        while run.loop.now_ns - run.started_ns < 10 * NS_PER_S:
            run.plc.run_once()
            await run.clock.sleep_until_ns(run.loop.now_ns + NS_PER_S // 100)
        assert len(writes(tmp_path)) == written

    VirtualHall(hall(tmp_path, writable="mode, speed", safe="speed: 0"), tmp_path).run(5, lose_the_plc)
