"""Run the observatory's gateway and PLC against a target, by a script, and capture every byte.

This starts the plant's software with the plant's file. A target only states where each endpoint of the plant is opened,
and can have a remote client command a period.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from support import eventually

from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.connections.tap import Captured, CaptureTap, TappedConnector
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import DeviceRefused, FieldtwinError
from fieldtwin.gateway.core.values import Quality
from fieldtwin.gateway.devices.canopen_device import CanopenDriver
from fieldtwin.gateway.devices.register_device import RegisterDriver
from fieldtwin.gateway.devices.transmitter import TransmitterDriver
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.buses.canopen.canopen_bus import CanopenBus
from fieldtwin.gateway.runtime.buses.modbus.jobs import BusJob
from fieldtwin.gateway.runtime.buses.modbus.modbus_bus import ModbusBus
from fieldtwin.gateway.runtime.gateway import Gateway
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.gateway.store.exchange_log import ExchangeLog
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.run.processes.children import Child
from fieldtwin.twin.plant.mapping import MappedConnector
from fieldtwin.twin.plant.physical import attached, gateway_config, image_layout, make_image, plc_config
from fieldtwin.twin.site.system import System, load_system

SYSTEM = Path(__file__).parents[3] / "profiles/systems/observatory.yaml"
SAMPLES = 2
"""Number of relayed samples before the stop command."""


class Target(Protocol):
    """The mapping of the plant's endpoints, and the remote client of the modem."""

    mapping: dict[Endpoint, Endpoint]

    async def command(self, period_s: int) -> None: ...


@dataclass
class Run:
    """The results of a run. `refused`: the result of each request that a device must refuse; `stuck`: a step that did
    not end."""

    system: System
    captured: list[Captured] = field(default_factory=list)
    refused: dict[str, str] = field(default_factory=dict)
    stuck: str = ""
    requests: dict[str, int] = field(default_factory=dict)

    def of_bus(self, bus: str) -> list[Captured]:
        """Return the traffic of one bus."""
        return [c for c in self.captured if c.endpoint == self.system.buses[bus].endpoint]


async def converse(target: Target, run_dir: Path, patience_s: float = 15.0) -> Run:
    """Run the script against `target`. A step longer than `patience_s` ends the script and is named."""
    system = load_system(str(SYSTEM))
    run = Run(system)
    clock, tap = WallClock(), CaptureTap(100_000)
    connector = TappedConnector(MappedConnector(OsConnector(), target.mapping), [tap], clock)
    layout = image_layout(system)
    make_image(layout, run_dir / "image")
    (run_dir / "plc.json").write_bytes(plc_config(system, run_dir).to_json())
    plc = Child("plc", "fieldtwin.plc", run_dir / "plc.json", run_dir)
    audit = AuditLog(run_dir / "audit.jsonl", clock)
    log = ExchangeLog(run_dir / "store.sqlite", system=system.name, prototype=True)
    try:
        await (await plc.connect()).aclose()
        with attached(layout, run_dir / "image") as image:
            gateway = Gateway(gateway_config(system, allow_writes=True), connector, clock, image, audit, log)
            async with Nursery() as nursery:
                nursery.start(gateway.run(), "gateway")
                for name, step in Script(gateway, target, tap, run).steps():
                    try:
                        await asyncio.wait_for(step(), patience_s)
                    except TimeoutError:
                        run.stuck = name
                        break
                await gateway.shut_down()
                await _until_quiet(tap, patience_s)
                run.requests = {name: sum_of(bus.totals()) for name, bus in gateway.buses.items()}
    finally:
        await plc.end()
        log.close()
        audit.close()
    run.captured = tap.captured
    return run


def sum_of(totals: dict[str, int]) -> int:
    """Return the number of requests that the gateway counted on a bus."""
    return totals.get("requests", 0) or totals.get("sdo_requests", 0)


async def _until_quiet(tap: CaptureTap, within_s: float) -> None:
    """After the node was told to leave OPERATIONAL, wait for the heartbeat that confirms it, whatever the result of the
    run."""

    def told() -> bool:
        beats = [c.item for c in tap.captured if isinstance(c.item, CanFrame) and c.item.can_id == 0x705]
        return bool(beats) and beats[-1].data == b"\x7f"

    try:
        await eventually(told, within_s=min(within_s, 2.0))
    except AssertionError:
        pass  # a planted fault may have prevented the start of the node


class Script:
    """The steps: start, period 1, relayed samples, period 0, then requests that the devices must refuse."""

    def __init__(self, gateway: Gateway, target: Target, tap: CaptureTap, run: Run) -> None:
        self.gateway, self.target, self.tap, self.run = gateway, target, tap, run
        self.modem = gateway.drivers["modem"]
        assert isinstance(self.modem, TransmitterDriver)
        self.period = gateway.outputs.outputs[0]

    def steps(self) -> list[tuple[str, Callable[[], Awaitable[None]]]]:
        return [
            ("all devices up", self.all_up),
            ("period 1 reaches the ctd", lambda: self.commanded(1)),
            ("samples are relayed", lambda: self._until(lambda: self.modem.sent >= SAMPLES)),
            ("period 0 reaches the ctd", lambda: self.commanded(0)),
            ("the ctd says standby", lambda: self._until(lambda: self._value("ctd.status") == 0)),
            ("everything is sent", lambda: self._until(lambda: not self.modem.consumer.queue)),
            ("refusals", self.refusals),
            ("frames heard", self.frames_heard),
        ]

    async def _until(self, condition: Callable[[], bool]) -> None:
        await eventually(condition, within_s=3600)  # the caller limits the time

    def _value(self, tag: str) -> object:
        value = self.gateway.tags.current(tag, self.gateway.clock.monotonic_ns())
        return value.value if value.quality is Quality.GOOD else None

    async def frames_heard(self) -> None:
        await self._until(lambda: heard(self.tap, 0x705) >= 4 and heard(self.tap, 0x185) >= 25)

    async def all_up(self) -> None:
        """Wait until all devices are identified, configured and started, and the output holds the PLC's first value.

        The ctd holds that value already, so nothing is written.
        """
        names = ["ctd.status", "modem.link_state", "inclinometer.slope_long"]
        await self._until(lambda: all(self._value(n) is not None for n in names))
        await self._until(lambda: self.period.held == 0 and self.gateway.outputs.settled)

    async def commanded(self, period_s: int) -> None:
        before = self.modem.received
        await self.target.command(period_s)
        await self._until(lambda: self.modem.received == before + 1 and not self.modem.to_acknowledge)
        await self._until(lambda: self.period.held == period_s and self.gateway.outputs.settled)

    async def refusals(self) -> None:
        """Send requests that the devices' manuals forbid, through the queues of the running gateway."""
        ctd, incl = self.gateway.drivers["ctd"], self.gateway.drivers["inclinometer"]
        assert isinstance(ctd, RegisterDriver)
        assert isinstance(incl, CanopenDriver)
        await self._job(
            ctd, "ctd: a register between two groups", lambda: ctd.client.read_registers(1, "holding", 50, 1)
        )
        await self._job(ctd, "ctd: too many registers", lambda: ctd.client.read_registers(1, "input", 0, 61))
        await self._job(ctd, "ctd: a function", lambda: ctd.client.read_bits(1, "coil", 0, 1))
        await self._job(ctd, "ctd: a read-only register", lambda: ctd.client.write_registers(1, 0, [1]))
        modem = self.modem.client
        await self._job(self.modem, "modem: a function", lambda: modem.read_registers(1, "input", 0, 1))
        await self._job(self.modem, "modem: a hole", lambda: modem.read_registers(1, "holding", 70, 1))
        await self._job(self.modem, "modem: the inbox", lambda: modem.write_registers(1, 0, [0]))
        await self._note("inclinometer: an object", incl.master.sdo_upload(5, 0x2000, 0))
        await self._note("inclinometer: a sub-index", incl.master.sdo_upload(5, 0x1018, 9))
        await self._note("inclinometer: a constant", incl.master.sdo_download(5, 0x1018, 4, bytes((1, 0, 0, 0))))

    async def _job(self, driver: RegisterDriver, name: str, what: Callable[[], Awaitable[object]]) -> None:
        bus = self.gateway.buses[driver.config.bus]
        assert isinstance(bus, ModbusBus)
        done: asyncio.Future[FieldtwinError | None] = asyncio.get_running_loop().create_future()

        async def request() -> None:
            await what()

        bus.submit(BusJob(driver, request, done.set_result))
        error = await done
        self.run.refused[name] = "" if error is None else f"{type(error).__name__}: {error.message}"

    async def _note(self, name: str, what: Awaitable[object]) -> None:
        try:
            await what
            self.run.refused[name] = ""
        except FieldtwinError as e:
            self.run.refused[name] = f"{type(e).__name__}: {e.message}"


async def converse_on_can(target: Endpoint, run_dir: Path, patience_s: float = 15.0) -> list[Captured]:
    """Run the part of the inclinometer alone on a kernel's CAN: start, receive, and stop."""
    system = load_system(str(SYSTEM))
    plant, config = system.buses["can0"], system.devices["inclinometer"]
    clock, tap = WallClock(), CaptureTap(100_000)
    connector = TappedConnector(MappedConnector(OsConnector(), {plant.endpoint: target}), [tap], clock)
    tags = TagTable(clock)
    driver = CanopenDriver(config, tags, clock)
    tags.declare(driver.tag_names, config.stale_after_ms)
    audit = AuditLog(run_dir / "audit.jsonl", clock)
    try:
        bus = CanopenBus(plant, [driver], connector, clock, tags, audit, allow_writes=True)
        async with Nursery() as nursery:
            nursery.start(bus.run(), "bus can0")
            await eventually(lambda: heard(tap, 0x705) >= 4 and heard(tap, 0x185) >= 10, within_s=patience_s)
            for index, subindex in ((0x2000, 0), (0x1018, 9)):
                try:
                    await driver.master.sdo_upload(driver.node, index, subindex)
                except DeviceRefused:
                    pass  # expected: the comparison checks the abort code
            await bus.halt(1.0)
            await _until_quiet(tap, patience_s)
    finally:
        audit.close()
    return tap.captured


def heard(tap: CaptureTap, cob_id: int) -> int:
    """Return the number of received frames with this COB-ID."""
    return sum(
        isinstance(c.item, CanFrame) and c.item.can_id == cob_id and c.direction is Direction.RECEIVED
        for c in tap.captured
    )
