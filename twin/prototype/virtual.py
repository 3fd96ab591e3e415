"""A whole prototype in one event loop, in virtual time: the unmodified gateway, PLC and emulators on in-memory
connections.

It differs from a run in real time only in the clock, the connections and the memory of the process image. The same
seed, configuration, version, Python minor version and architecture give the same events, byte for byte.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from fieldtwin.emulators.endpoints.memory_ports import MemoryNet
from fieldtwin.emulators.models.modbus.packet_link import ModemEnd
from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.gateway.connections.tap import TappedConnector
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.concurrency.async_resource import AsyncResource
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import Connector, Tap
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.image.image import Image
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.gateway import Gateway
from fieldtwin.gateway.runtime.outputs.refusals import RefusedOutput
from fieldtwin.gateway.store.exchange_log import ExchangeLog
from fieldtwin.plc.cycle.publishing import TagChange
from fieldtwin.plc.cycle.task import run_on_clock
from fieldtwin.plc.runtime.realtime import VIRTUAL_STUCK_MS, alarm_if_free
from fieldtwin.plc.runtime.runner import TaskRunner
from fieldtwin.twin.plant.mapping import MappedConnector, mapped_endpoint
from fieldtwin.twin.plant.physical import plc_config
from fieldtwin.twin.prototype.field import FieldSimulator
from fieldtwin.twin.prototype.file import Prototype
from fieldtwin.twin.prototype.prototype import DigitalTwinPrototype
from fieldtwin.twin.site.system import System

FLUSH_EVERY_NS = 60 * NS_PER_S
STARTING_NS = NS_PER_S // 20
"""Delay (ns) between the start of the simulated devices and that of the control system: devices are ready before the first
request, as in real time.
"""
_IN_MEMORY = Path(":memory:")


class VirtualPrototype(AsyncResource):
    """A prototype that runs in virtual time. Use it as ``async with VirtualPrototype(system, prototype, loop, run_dir) as run``
    inside `loop`. `run_dir` takes the audit log and retained values; the exchange log is in memory.

    `seed` replaces the prototype file's. `taps` observe the gateway's connections. `prepare` is called when everything is
    created and nothing has run yet. `water`: the acoustic connections of transmitters that are in a network. After entering,
    `field`, `gateway` and `plc` run.
    """

    def __init__(
        self,
        system: System,
        prototype: Prototype,
        loop: VirtualLoop,
        run_dir: Path,
        *,
        seed: int | None = None,
        taps: Sequence[Tap] = (),
        on_change: Callable[[TagChange], None] | None = None,
        on_refusal: Callable[[RefusedOutput], None] | None = None,
        prepare: Callable[[VirtualPrototype], None] | None = None,
        water: Mapping[str, ModemEnd] | None = None,
    ) -> None:
        super().__init__()
        self.system = system
        self.prototype = prototype if seed is None else replace(prototype, seed=seed)
        self.loop = loop
        self.clock = VirtualClock(loop)
        self.net = MemoryNet(loop)
        self.twin = DigitalTwinPrototype(system, self.prototype, self.clock)
        self.field: FieldSimulator = self.twin.field(Path("virtual"), self.net, water)
        self.gateway: Gateway
        self.plc: TaskRunner
        self.image: Image
        """The process image, for callers that observe it."""
        self.mapping: dict[Endpoint, Endpoint] = {}
        self.started_ns = loop.now_ns
        self.outputs_confirmed_safe: bool | None = None
        self._run_dir = run_dir
        self._taps = taps
        self._on_change = on_change
        self._on_refusal = on_refusal
        self._prepare = prepare

    async def _start(self) -> None:
        await self.field.open()
        self._stack.push_async_callback(self.field.aclose)
        self.mapping = {
            self.system.buses[bus].endpoint: mapped_endpoint(self.system.buses[bus].endpoint, listening)
            for bus, listening in self.field.listening.items()
        }
        ecs, clock = self.twin.ecs, self.clock
        memory = memoryview(bytearray(ecs.layout.size))
        ecs.layout.format(memory)
        self.image = self._stack.enter_context(ecs.layout.attach(memory, private=True))
        audit = AuditLog(self._run_dir / "audit.jsonl", clock)
        self._stack.callback(audit.close)
        log = ExchangeLog(_IN_MEMORY, system=self.system.name, prototype=True)
        self._stack.callback(log.close)
        connector: Connector = MappedConnector(self.net, self.mapping)
        if self._taps:
            connector = TappedConnector(connector, self._taps, clock)
        self.gateway = ecs.gateway(
            connector,
            clock,
            self.image,
            audit,
            log,
            allow_writes=True,
            free_ports=True,
            true_silences=True,
            listen=self.net.listen_for_clients,
        )
        config = plc_config(self.system, self._run_dir)
        alarm = alarm_if_free(max(VIRTUAL_STUCK_MS, config.stuck_ms))
        if alarm is not None:
            self._stack.callback(alarm.close)
        self.plc = TaskRunner(config, self.image, clock.monotonic_ns, alarm, on_change=self._on_change, modules=False)
        self._stack.callback(self.plc.close)
        self.gateway.outputs.journal.on_new = self._refused
        if self._prepare is not None:
            self._prepare(self)
        self._nursery = await self._stack.enter_async_context(Nursery())
        self._stack.push_async_callback(self._stop)
        self._nursery.start(self.field.run(), "field simulator")
        await clock.sleep_until_ns(self.loop.now_ns + STARTING_NS)
        self._nursery.start(run_on_clock(self.plc, clock), "PLC")
        self.started_ns = self.field.faults.start_ns = self.loop.now_ns
        self._nursery.start(self.gateway.run(), "gateway")
        self._nursery.start(self._flush(log), "store")

    def _refused(self, entry: RefusedOutput) -> None:
        if entry.by == "plc" and entry.tag in self.plc.outputs.last():
            value = entry.first if isinstance(entry.first, int | float) else None
            entry.program, entry.place = self.plc.origin(entry.tag, value)
        if self._on_refusal is not None:
            self._on_refusal(entry)

    async def _flush(self, log: ExchangeLog) -> None:
        while True:
            await self.clock.sleep_until_ns(self.clock.monotonic_ns() + FLUSH_EVERY_NS)
            log.flush()

    async def _stop(self) -> None:
        if not self.outputs_confirmed_safe:
            self.outputs_confirmed_safe = await self.gateway.shut_down()

    async def stop_gateway(self) -> bool:
        """Set outputs to safe values while everything still runs, and return whether the devices confirmed them."""
        await self._stop()
        return bool(self.outputs_confirmed_safe)

    def failure(self) -> BaseException | None:
        """Return the exception that ended a part of the prototype unexpectedly, if any. Such an exception is a bug of this
        project.
        """
        return self._nursery.failure()
