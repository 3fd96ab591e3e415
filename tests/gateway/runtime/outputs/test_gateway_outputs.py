"""The PLC's commands and safe values up to an emulated device's registers, and values that must never reach them."""

from __future__ import annotations

import asyncio
import json
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from gateway_rig import FieldBus, RunningBus, profile, running_bus, unit
from hypothesis import given
from hypothesis import strategies as st
from support import eventually, run

from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.errors import NotAllowed, Unreachable
from fieldtwin.gateway.core.values import COMMAND
from fieldtwin.gateway.devices.codec import decode, encode
from fieldtwin.gateway.devices.config import DeviceConfig
from fieldtwin.gateway.devices.register_device import RegisterDriver, SensorDriver
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.outputs.output import Output
from fieldtwin.gateway.runtime.outputs.outputs import OutputWriter
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.gateway.wallclock import WallClock

PROFILE = """
tags:
  serial:   {at: "holding:100", type: string, registers: 2, poll: identity}
  period:   {at: "holding:0", type: int16, poll: status, access: rw, range: [-5, 60]}
  level:    {at: "holding:2", type: float32, poll: status, access: rw}
  valve:    {at: "holding:4", type: int16, scale: 0.1, poll: status, access: rw}
  code:     {at: "holding:6", type: uint16, poll: status, access: wo}
  switch:   {at: "coil:0", type: bool, poll: status, access: rw}
  locked:   {at: "holding:8", type: uint16, poll: status, access: rw}
"""
WRITABLE = frozenset({"period", "level", "valve", "code", "switch"})


class Rig:
    """An output writer over a running bus; `cells` are the device's registers."""

    def __init__(self, bus: RunningBus, writer: OutputWriter, cells: MapBank, audit: Path) -> None:
        self.bus, self.writer, self.cells, self._audit = bus, writer, cells, audit

    def holding(self, address: int) -> int:
        return self.cells.peek("holding", address)

    @property
    def writes(self) -> list[bytes]:
        """The write requests received by the device, function 05 to 10h."""
        return [adu for adu in self.bus.field.heard if adu[1] in (0x05, 0x06, 0x0F, 0x10)]

    @property
    def audit(self) -> list[dict[str, object]]:
        return [json.loads(line) for line in self._audit.read_text(encoding="utf-8").splitlines()]

    async def polls(self, count: int = 3) -> None:
        """Wait until the device was read `count` more times: time enough for an unexpected write."""
        device = self.bus.bus.devices[0]
        wanted = device.polls + count
        await eventually(lambda: device.polls >= wanted)


@asynccontextmanager
async def rig(
    audit: Path,
    *outputs: str,
    allow_writes: bool = True,
    safe: dict[str, float] | None = None,
    expect: dict[str, str] | None = None,
    text: str = PROFILE,
    bank: type[MapBank] = MapBank,
    groups: dict[str, tuple[str, ...]] | None = None,
) -> AsyncIterator[Rig]:
    p = profile(text)
    cells = bank([CellSpan("holding", 0, 200), CellSpan("coil", 0, 8)])
    cells.poke("holding", 100, 0x6162, 0x6300)
    config = DeviceConfig(
        "d",
        p,
        "bus",
        1,
        poll={"status": 20},
        writable=WRITABLE,
        safe=safe or {},
        expect=expect or {},
        stale_after_ms=500,
        write_groups=groups or {},
    )
    clock = WallClock()
    log = AuditLog(audit, clock)

    def make(tags: TagTable) -> list[RegisterDriver]:
        return [SensorDriver(config, tags)]

    try:
        async with running_bus(make, FieldBus({1: unit(cells)})) as bus:
            driver = bus.bus.devices[0].driver
            made = [Output(f"d.{o}", o, driver, bus.bus, config.safe.get(o)) for o in outputs]
            writer = OutputWriter(made, bus.tags, log, allow_writes)
            bus.lost.clear()

            async def ticking() -> None:
                while True:
                    for lost in bus.lost:
                        writer.forget(lost)
                    bus.lost.clear()
                    writer.tick(clock.monotonic_ns())
                    await asyncio.sleep(0.005)

            async with Nursery() as nursery:
                task = nursery.start(ticking(), "ticks")
                yield Rig(bus, writer, cells, audit)
                assert not task.done(), task.exception()
    finally:
        log.close()


def test_a_value_is_written_once_and_read_back(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path / "a", "period") as r:
            r.writer.want("d.period", 5)
            await eventually(lambda: r.holding(0) == 5)
            await eventually(lambda: r.writer.settled)
            await r.polls(5)
            assert len(r.writes) == 1
            assert r.bus.tags.current("d.period", 0).value == 5
            assert [(e["action"], e["by"], e["old"], e["new"]) for e in r.audit[:1]] == [("write", "plc", 0, 5)] or (
                r.audit[0]["old"] is None  # written before its first poll
            )
            assert [e["result"] for e in r.audit] == ["asked", "done"]

    run(main())


@pytest.mark.parametrize(
    ("tag", "value", "address"),
    [("level", 0.1, 2), ("level", 1 / 3, 2), ("valve", 1.234, 4), ("code", 7, 6)],
    ids=["a float that float32 cannot hold", "a third", "a value between two steps", "a tag that cannot be read"],
)
def test_a_value_that_the_device_rounds_is_not_written_repeatedly(
    tmp_path: Path, tag: str, value: float, address: int
) -> None:
    async def main() -> None:
        async with rig(tmp_path / "a", tag) as r:
            r.writer.want(f"d.{tag}", value)
            await eventually(lambda: r.holding(address) != 0)
            await eventually(lambda: r.writer.settled)
            await r.polls(12)  # a rewrite would come after 100 ms
            assert len(r.writes) == 1
            assert r.writer.rewrites == 0

    run(main())


def test_a_coil_is_written_and_confirmed(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path / "a", "switch") as r:
            r.writer.want("d.switch", 1)
            await eventually(lambda: r.cells.peek("coil", 0) == 1)
            await eventually(lambda: r.writer.settled)
            assert r.writer.failures == 0
            await r.polls(8)
            assert len(r.writes) == 1

    run(main())


def test_a_device_that_restarted_is_commanded_again(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path / "a", "period") as r:
            r.writer.want("d.period", 5)
            await eventually(lambda: r.holding(0) == 5 and r.writer.settled)
            r.cells.poke("holding", 0, 0)  # the device forgot the value, and the line never noticed
            await eventually(lambda: r.holding(0) == 5)
            assert r.writer.rewrites == 1
            r.bus.field.unplug()
            await eventually(lambda: not r.bus.bus.connected)
            r.cells.poke("holding", 0, 0)
            r.bus.field.plugged = True
            await eventually(lambda: r.holding(0) == 5)

    run(main())


def test_safe_values_win_until_the_plc_is_back(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path / "a", "period", "level", safe={"period": -1}) as r:
            r.writer.want("d.period", 5)
            r.writer.want("d.level", 2.5)
            await eventually(lambda: r.holding(0) == 5 and r.holding(2) != 0)
            r.writer.make_safe("a test")
            await eventually(lambda: r.holding(0) == 0xFFFF)
            assert r.writer.safe_active
            level = struct.unpack(">f", struct.pack(">HH", r.holding(2), r.holding(3)))
            assert level == (2.5,)  # an output without a safe value keeps what it has
            r.writer.release()
            r.writer.want("d.period", 5)
            await eventually(lambda: r.holding(0) == 5)
            assert [e["by"] for e in r.audit if e["tag"] == "d.period" and e["result"] == "asked"] == [
                "plc", "safe: a test", "plc",
            ]  # fmt: skip

    run(main())


@pytest.mark.parametrize(
    ("tag", "value", "options", "told"),
    [
        ("period", 5, {"allow_writes": False}, "read-only"),
        ("locked", 5, {}, "not marked writable"),
        ("period", 61, {}, "outside its limits"),
        ("level", 1e39, {}, "outside its limits"),
        ("level", float("nan"), {}, "outside its limits"),
        ("valve", 4000.0, {}, "outside its limits"),
    ],
)
def test_a_forbidden_write_is_refused_once_and_recorded(
    tmp_path: Path, tag: str, value: float, options: dict[str, bool], told: str
) -> None:
    async def main() -> None:
        async with rig(tmp_path / "a", tag, **options) as r:  # type: ignore[arg-type]
            r.writer.want(f"d.{tag}", value)
            await eventually(lambda: r.writer.refusals == 1)
            await r.polls(5)
            assert r.writes == []
            assert r.writer.refusals == 1
            assert [e["action"] for e in r.audit] == ["refuse"]
            assert told in str(r.audit[0]["result"])
            assert r.writer.settled  # a refused value does not block others
            if value != value or value > 60:
                r.writer.want(f"d.{tag}", 2)  # the next value is evaluated separately
                await eventually(lambda: len(r.writes) == 1)

    run(main())


def test_another_device_than_expected_is_not_written(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path / "a", "period", expect={"serial": "xyz"}, safe={"period": 0}) as r:
            await eventually(lambda: r.bus.bus.devices[0].driver.identity_error != "")
            r.writer.want("d.period", 5)
            await r.polls(2)
            r.writer.make_safe("a test")
            await r.polls(1)
            assert r.writes == []
            r.cells.poke("holding", 100, 0x7879, 0x7A00)
            # differs from the safe value, because a device that already holds it is not written
            r.cells.poke("holding", 0, 7)
            await eventually(
                lambda: len(r.writes) == 1, within_s=15
            )  # the pause before the next identity request grows
            assert r.holding(0) == 0

    run(main())


def test_a_device_that_acknowledges_and_does_not_hold_is_a_failure(tmp_path: Path) -> None:
    class Forgetful(MapBank):
        def write(self, table, address, values, now_ns):  # type: ignore[no-untyped-def]
            return

    async def main() -> None:
        async with rig(tmp_path / "a", "period", bank=Forgetful) as r:
            r.writer.want("d.period", 5)
            await eventually(lambda: r.writer.failures == 1)
            assert "holds a different value" in str(r.audit[-1]["result"])
            assert not r.writer.settled

    run(main())


def test_a_failing_write_is_recorded_with_its_requester(tmp_path: Path) -> None:
    """Defect: a write of the program was in progress when the gateway stopped, and its failure was recorded as a failure of
    the safe state, with the program's value."""
    writers: list[OutputWriter] = []

    class StopsMeanwhile(MapBank):
        def write(self, table, address, values, now_ns):  # type: ignore[no-untyped-def]
            if values == [5] or values == (5,):
                writers[0].make_safe("a test")  # while the write is in progress; and the value is not held
                return
            super().write(table, address, values, now_ns)

    async def main() -> None:
        async with rig(tmp_path / "a", "period", safe={"period": -1}, bank=StopsMeanwhile) as r:
            writers.append(r.writer)
            r.writer.want("d.period", 5)
            await eventually(lambda: r.holding(0) == 0xFFFF, within_s=15)
            await eventually(lambda: str(r.audit[-1]["result"]) == "done")
            assert {(e["new"], e["by"]) for e in r.audit} == {(5, "plc"), (-1, "safe: a test")}
            assert [entry.by for entry in r.writer.journal.status().entries] == ["plc"]

    run(main())


def test_without_a_record_only_safe_values_are_written() -> None:
    """/dev/full is a full disk: the log opens, and cannot be written."""

    async def main() -> None:
        async with rig(Path("/dev/full"), "period", "locked", safe={"period": -1}) as r:
            r.writer.want("d.period", 5)
            r.writer.want("d.locked", 5)  # a refusal that cannot be recorded must not stop the gateway
            await eventually(lambda: r.writer.failures >= 1)
            await r.polls(5)
            assert r.writes == []
            r.writer.make_safe("a test")
            await eventually(lambda: r.holding(0) == 0xFFFF)

    run(main())


# -- the codec that decides what is written -----------------------------------------------------------------------------

NUMBERS = {
    "int16": ("h", 16), "uint16": ("H", 16), "int32": ("i", 32), "uint32": ("I", 32), "int64": ("q", 64), "uint64": ("Q", 64),
}  # fmt: skip


@given(
    kind=st.sampled_from([*NUMBERS, "float32", "float64", "bool"]),
    order=st.sampled_from(["ABCD", "CDAB", "BADC", "DCBA"]),
    scale=st.sampled_from([1.0, 0.1, 0.01, -2.0]),
    offset=st.sampled_from([0.0, -40.0, 100.0]),
    value=st.one_of(st.floats(), st.integers(-(2**70), 2**70), st.booleans()),
)
def test_any_requested_value_is_encoded_or_refused(
    kind: str, order: str, scale: float, offset: float, value: float
) -> None:
    """No value of a PLC may raise an error except `NotAllowed`, and an encoded value decodes to itself within a step."""
    plain = kind == "bool"
    extra = "" if plain else f", scale: {scale!r}, offset: {offset!r}, order: {order}"
    p = profile(f'tags:\n  x: {{at: "holding:0", type: {kind}, access: rw{extra}}}\n')
    tag = p.tags["x"]
    try:
        data = encode(tag, value)
    except NotAllowed:
        return
    assert len(data) == 2 * tag.registers.count
    back = decode(tag, data, 1).value
    assert isinstance(back, int | float)
    if kind == "bool":
        assert back == bool(value)
    elif kind.startswith("float"):
        assert back == pytest.approx(
            float(value), rel=1e-6, abs=1e-30 if scale == 1 and not offset else 1e-4 + abs(value) * 1e-6
        )
    else:
        assert abs(back - value) <= abs(scale) / 2 + abs(value) * 1e-12


def test_a_range_wider_than_its_type_does_not_bypass_the_type() -> None:
    tag = profile('tags:\n  x: {at: "holding:0", type: uint16, access: rw, range: [0, 100000]}\n').tags["x"]
    assert encode(tag, 65535) == b"\xff\xff"
    with pytest.raises(NotAllowed):
        encode(tag, 65536)


def test_the_audit_log_is_the_owners_and_appends(tmp_path: Path) -> None:
    clock = WallClock()
    for i in range(2):
        log = AuditLog(tmp_path / "a", clock)
        log.note("write", "d", by="plc", result="done", new=i)
        log.close()
    lines = [json.loads(line) for line in (tmp_path / "a").read_text(encoding="utf-8").splitlines()]
    assert [e["new"] for e in lines] == [0, 1]
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o600
    with pytest.raises(Unreachable, match="cannot open the audit log"):
        AuditLog(tmp_path / "no" / "a", clock)
    full = AuditLog(Path("/dev/full"), clock)
    with pytest.raises(Unreachable, match="cannot write the audit log"):
        full.note("write", "d", by="plc", result="asked")
    full.close()


def test_a_command_that_the_device_does_not_know_is_refused() -> None:
    p = profile(PROFILE)
    driver = RegisterDriver(DeviceConfig("d", p, "bus", 1), TagTable(WallClock()))
    with pytest.raises(NotAllowed):
        driver.command("serial", 1)
    with pytest.raises(NotAllowed):
        driver.command("nothing", 1)
    assert driver.command("period", -1) == COMMAND(b"\xff\xff", "set_period")
