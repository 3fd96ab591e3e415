"""Outputs of one device that are declared as a group are written completely or not at all.

Defect: a program set a speed that was out of range and started the drive in the same scan; the speed was refused, and the
drive was started with its old setpoint.
"""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path

import pytest
from modbus_virtual import run_virtually
from support import eventually, run
from test_canopen_outputs import DRIVEN
from test_canopen_outputs import rig as canopen_rig
from test_gateway_outputs import rig

from fieldtwin.emulators.modbus.bank import DeviceFailure, MapBank
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.devices.canopen_config import CanopenNodeConfig

APART = {"drive": ("period", "valve")}
"""Registers 0 and 4, with others between them. `period` is at most 60."""
ADJACENT = {"drive": ("valve", "level")}
"""Registers 2 to 4, named against the order of their addresses. `valve` is at most 3276.7."""


@pytest.mark.parametrize(
    ("groups", "refused", "other"),
    [(APART, ("period", 61.0), ("valve", 1.0)), (ADJACENT, ("valve", 4000.0), ("level", 2.5))],
    ids=["apart", "adjacent"],
)
def test_when_one_member_is_refused_nothing_of_the_group_is_written(
    tmp_path: Path, groups: dict[str, tuple[str, ...]], refused: tuple[str, float], other: tuple[str, float]
) -> None:
    async def main() -> None:
        async with rig(tmp_path / "a", refused[0], other[0], groups=groups) as r:
            r.writer.want(f"d.{other[0]}", other[1])
            r.writer.want(f"d.{refused[0]}", refused[1])
            await r.polls(8)
            assert r.writes == []
            assert r.writer.settled  # a held write does not delay the shutdown
            told = {e.tag: e for e in r.writer.journal.since(0)}
            assert told[f"d.{refused[0]}"].cause.value == "limit"
            assert told[f"d.{other[0]}"].cause.value == "group"
            assert f"d.{refused[0]} was refused" in told[f"d.{other[0]}"].reason
            assert {e["tag"] for e in r.audit if e["action"] == "refuse"} == set(told)
            r.writer.want(f"d.{refused[0]}", 5.0)
            await eventually(lambda: r.writer.settled and bool(r.writes))
            assert r.bus.tags.current(f"d.{other[0]}", 0).value == other[1]
            assert r.bus.tags.current(f"d.{refused[0]}", 0).value == 5

    run(main())


def test_adjacent_registers_go_in_one_request(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path / "a", "level", "valve", groups=ADJACENT) as r:
            r.writer.want("d.level", 2.5)
            await r.polls(4)
            assert r.writes == []  # the other member has no value yet
            r.writer.want("d.valve", 1.5)
            await eventually(lambda: r.holding(4) == 15)
            await eventually(lambda: r.writer.settled)
            (request,) = r.writes
            assert request[1:7] == bytes([0x10, 0, 2, 0, 3, 6])
            r.writer.want("d.valve", 2.5)  # one member changes: the group is written whole
            await eventually(lambda: r.holding(4) == 25)
            assert r.writes[1][1:7] == bytes([0x10, 0, 2, 0, 3, 6])

    run(main())


def test_other_registers_go_in_the_order_of_the_group_each_after_the_one_before(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path / "a", "valve", "period", groups=APART) as r:
            r.writer.want("d.valve", 1.5)
            r.writer.want("d.period", 7)
            await eventually(lambda: r.holding(4) == 15)
            assert [(w[1], w[3]) for w in r.writes] == [(0x10, 0), (0x10, 4)]
            assert r.holding(0) == 7

    run(main())


def test_a_member_that_the_device_refuses_stops_those_after_it(tmp_path: Path) -> None:
    """The drive answers exception 04 for the first member: the second, which would start it, is not sent."""

    class Refusing(MapBank):
        broken = True

        def write(self, table, address, values, now_ns):  # type: ignore[no-untyped-def]
            if self.broken and address == 0:
                raise DeviceFailure("a test", where="here")
            super().write(table, address, values, now_ns)

    async def main() -> None:
        async with rig(tmp_path / "a", "valve", "period", groups=APART, bank=Refusing) as r:
            r.writer.want("d.valve", 1.5)
            r.writer.want("d.period", 7)
            await eventually(lambda: r.writer.failures >= 2)
            assert {w[3] for w in r.writes} == {0}
            assert {e.tag: e.cause.value for e in r.writer.journal.since(0)} == {
                "d.period": "device",
                "d.valve": "group",
            }
            r.cells.broken = False  # type: ignore[attr-defined]
            await eventually(lambda: r.holding(4) == 15 and r.holding(0) == 7)

    run(main())


def test_safe_values_do_not_ask_the_group(tmp_path: Path) -> None:
    """The program requests an impossible speed when the PLC is lost: the drive is still stopped."""

    async def main() -> None:
        async with rig(tmp_path / "a", "valve", "period", groups=APART, safe={"valve": -1}) as r:
            r.writer.want("d.valve", 1.5)
            r.writer.want("d.period", 61)
            await r.polls(3)
            r.writer.make_safe("a test")
            await eventually(lambda: r.holding(4) == 0xFFF6)
            await eventually(lambda: r.writer.settled)
            assert r.holding(0) == 0
            r.writer.release()
            r.writer.want("d.period", 6)
            r.writer.want("d.valve", 1.5)
            await eventually(lambda: r.holding(4) == 15 and r.holding(0) == 6)

    run(main())


def test_a_client_cannot_write_a_member_alone(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path / "a", "valve", "period", groups=APART) as r:
            ended: list[FieldtwinError | None] = []
            r.writer.request("d.valve", 1.0, "127.0.0.1:5", ended.append)
            await eventually(lambda: bool(ended))
            assert "group" in str(ended[0])
            assert r.writes == []
            assert r.audit[-1]["by"] == "127.0.0.1:5"

    run(main())


TOO_MUCH = 2.0**40
"""More than the 32 bits of the drive's target velocity."""


@pytest.mark.parametrize("by_rpdo", [True, False], ids=["in one RPDO", "over SDO"])
def test_a_drive_is_not_started_with_its_old_speed(tmp_path: Path, *, by_rpdo: bool) -> None:
    config = replace(DRIVEN, write_groups={"drive": ("target_velocity", "controlword")})
    if not by_rpdo:
        config = replace(config, canopen=CanopenNodeConfig())

    async def main() -> None:
        async with canopen_rig(tmp_path, config) as r:
            r.want(controlword=6, target_velocity=500)
            await asyncio.sleep(0.5)
            assert (r.field.held(0x6040), r.field.held(0x60FF)) == (6, 500)
            before = (len(r.field.rpdos), len(r.field.downloads))
            r.want(controlword=15, target_velocity=TOO_MUCH)
            await asyncio.sleep(1)
            assert (len(r.field.rpdos), len(r.field.downloads)) == before
            assert r.field.held(0x6040) == 6
            r.want(target_velocity=800)
            await asyncio.sleep(0.5)
            assert (r.field.held(0x6040), r.field.held(0x60FF)) == (15, 800)
            if by_rpdo:
                assert r.field.rpdos[-1] == "207#0F0020030000"
            else:
                order = [f.data[1:3] for f in r.field.downloads][-2:]
                assert order == [bytes([0xFF, 0x60]), bytes([0x40, 0x60])]

    run_virtually(main())


def test_without_a_group_the_drive_is_started_with_its_old_speed(tmp_path: Path) -> None:
    """The purpose of a group; and the refused speed is in the journal."""

    async def main() -> None:
        async with canopen_rig(tmp_path) as r:
            r.want(controlword=15, target_velocity=TOO_MUCH)
            await asyncio.sleep(0.5)
            assert (r.field.held(0x6040), r.field.held(0x60FF)) == (15, 0)
            (entry,) = r.writer.journal.since(0)
            assert (entry.tag, entry.cause.value, entry.fault) == ("d.target_velocity", "limit", "program")

    run_virtually(main())
