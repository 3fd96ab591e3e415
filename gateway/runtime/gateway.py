"""The gateway: buses, drivers, tags, outputs and the process image, assembled and run.

The caller passes a Connector, a clock and a process image, so the gateway runs in the same way on a real plant and in a
simulation (digital twin prototype). Its status is plain data for the control channel, not formatted for display.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from operator import attrgetter

from fieldtwin.gateway.connections.sockets.listeners import TcpListener
from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S, Clock
from fieldtwin.gateway.core.concurrency.cycle import run_cycle
from fieldtwin.gateway.core.concurrency.events import Consumer
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import Connector, Listen
from fieldtwin.gateway.core.image.image import Image
from fieldtwin.gateway.core.values import DATA, Reason
from fieldtwin.gateway.devices.canopen_device import CanopenDriver
from fieldtwin.gateway.devices.config import BusConfig, DeviceConfig
from fieldtwin.gateway.devices.register_device import RegisterDriver, SensorDriver
from fieldtwin.gateway.devices.transmitter import TransmitterDriver
from fieldtwin.gateway.runtime.alarms.alarm_list import AlarmConfig, AlarmList
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.bridge.bridge import Bridge, BridgeConfig
from fieldtwin.gateway.runtime.buses.bus import Bus
from fieldtwin.gateway.runtime.buses.canopen.canopen_bus import CanopenBus
from fieldtwin.gateway.runtime.buses.modbus.modbus_bus import ModbusBus
from fieldtwin.gateway.runtime.image_io import ImageExchange
from fieldtwin.gateway.runtime.mailboxes.acked_commands import AckedCommandStore
from fieldtwin.gateway.runtime.mailboxes.pump import MailboxPump
from fieldtwin.gateway.runtime.outputs.output import Output
from fieldtwin.gateway.runtime.outputs.outputs import OutputWriter
from fieldtwin.gateway.runtime.plc_variables import PlcVariables
from fieldtwin.gateway.runtime.serve import ServeConfig, TagServer
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.gateway.store.exchange_log import ExchangeLog

PLC_GRACE_NS = 10 * NS_PER_S
"""The time after the gateway's start within which the PLC has to appear. Otherwise the outputs get their safe values."""
_NUMBERS = (int, float)
_IS_IDLE = attrgetter("is_idle")


@dataclass(frozen=True)
class GatewayConfig:
    """The configuration of a gateway.

    When the PLC's last scan is older than `plc_lost_ms`, the gateway no longer follows its outputs. `allow_writes` applies to all
    buses except those in `read_only`.
    """

    buses: dict[str, BusConfig]
    devices: dict[str, DeviceConfig]
    cycle_ms: int
    plc_lost_ms: int
    outputs: frozenset[str] = field(default_factory=frozenset)
    log_tags: frozenset[str] = field(default_factory=frozenset)
    allow_writes: bool = False
    read_only: frozenset[str] = frozenset()
    remote: bool = False
    serve: tuple[ServeConfig, ...] = ()
    bridges: tuple[BridgeConfig, ...] = ()
    delegated: frozenset[str] = frozenset()
    """Names of the transmitters (modems) whose mailboxes a digital thread reads and writes instead of the gateway."""
    alarms: tuple[AlarmConfig, ...] = ()

    def may_write(self, bus: str) -> bool:
        """Return whether the gateway may write to the devices of a bus."""
        return self.allow_writes and bus not in self.read_only


def make_driver(config: DeviceConfig, bus: BusConfig, tags: TagTable, clock: Clock) -> RegisterDriver | CanopenDriver:
    """Return the driver that a device's profile and bus require."""
    if config.profile.protocol == "canopen":
        return CanopenDriver(config, tags, clock)
    if config.profile.inbox is not None:
        return TransmitterDriver(config, tags)
    return SensorDriver(config, tags) if bus.endpoint.is_serial else RegisterDriver(config, tags)


def stale_limits(driver: RegisterDriver | CanopenDriver) -> dict[str, int | None]:
    """Return how long each readable tag is good without being refreshed, in ms. Tags that are read cyclically become
    stale; a register that is read once, at identification, does not (None)."""
    config, tags = driver.config, [t for t in driver.profile.tags.values() if t.readable]
    if isinstance(driver, CanopenDriver):
        return {f"{config.name}.{tag.name}": driver.stale_after_ms(tag) for tag in tags}
    cyclic = {t.name for g in config.poll for t in driver.profile.group(g)}
    return {
        f"{config.name}.{tag.name}": max(config.stale_after_ms, 3 * config.poll.get(tag.poll, 0))
        if tag.name in cyclic
        else None
        for tag in tags
    }


class Gateway:
    """The gateway, which runs until cancelled; `shut_down` then brings the outputs to their safe values."""

    def __init__(
        self,
        config: GatewayConfig,
        connector: Connector,
        clock: Clock,
        image: Image,
        audit: AuditLog,
        log: ExchangeLog,
        listen: Listen = TcpListener.open,
        taken: AckedCommandStore | None = None,
    ) -> None:
        self.config = config
        self.clock = clock
        self.tags = TagTable(clock)
        self.log = log
        self._audit = audit
        self._started_ns = clock.monotonic_ns()
        self.drivers: dict[str, RegisterDriver | CanopenDriver] = {}
        self.buses: dict[str, Bus] = {}
        self._modbus: dict[str, ModbusBus] = {}
        """The Modbus buses among `buses`, which can carry mailboxes and bridges."""
        for device in config.devices.values():
            driver = make_driver(device, config.buses[device.bus], self.tags, clock)
            self.let_trigger(driver)
            self.drivers[device.name] = driver
            self._declare(driver)
        for n, bus in enumerate(config.buses.values()):
            self._make_bus(bus, connector, n / len(config.buses))
        self.bridges = [Bridge(b, self._modbus, connector, clock, audit, self._blocked, listen) for b in config.bridges]
        self.outputs = OutputWriter(
            self._make_outputs(), self.tags, audit, config.allow_writes, read_only=config.read_only
        )
        self.pumps = [
            MailboxPump(
                d,
                self._modbus[d.config.bus],
                audit,
                allow_writes=config.may_write(d.config.bus),
                remote=config.remote,
                delegated=d.config.name in config.delegated,
                taken=taken,
                journal=self.outputs.journal,
            )
            for d in self.drivers.values()
            if isinstance(d, TransmitterDriver)
        ]
        written = {t.variable.partition(".")[0] for s in config.serve for t in s.tags if t.variable}
        self.plc_variables = PlcVariables(sorted(written), clock)
        self.servers = [
            TagServer(s, self.tags, self.outputs, clock, listen, audit, self.plc_variables) for s in config.serve
        ]
        sources = {**self._message_sources(), **self.plc_variables.sources}
        self.exchange = self.plc_variables.exchange = ImageExchange(image, self.tags, sources)
        self.alarms = AlarmList(config.alarms, self.tags, audit)
        self.plc_alive = False
        self.plc_losses = 0
        self.period_ns = config.cycle_ms * NS_PER_MS
        self.running = True
        self.deadline_ns = 0
        """The time (monotonic ns) of the next exchange with the PLC."""
        self._stopping = False

    def _declare(self, driver: RegisterDriver | CanopenDriver) -> None:
        for name, stale_ms in stale_limits(driver).items():
            self.tags.declare([name], stale_ms)

    def let_trigger(self, driver: RegisterDriver | CanopenDriver) -> None:
        """Allow or forbid the driver to write the register that starts a measurement of its device, as configured."""
        device, trigger = driver.config, driver.config.profile.form.trigger
        if isinstance(driver, RegisterDriver) and trigger is not None:
            driver.may_trigger = self.config.may_write(device.bus) and trigger.tag in device.writable

    def _make_bus(self, bus: BusConfig, connector: Connector, offset: float) -> None:
        on_it = [d for d in self.drivers.values() if d.config.bus == bus.name]
        if bus.endpoint.is_can:
            nodes = [d for d in on_it if isinstance(d, CanopenDriver)]
            self.buses[bus.name] = CanopenBus(
                bus,
                nodes,
                connector,
                self.clock,
                self.tags,
                self._audit,
                self.config.may_write(bus.name),
                self._on_offline,
            )
        elif on_it or any(bus.name in b.buses for b in self.config.bridges):
            units = [d for d in on_it if isinstance(d, RegisterDriver)]
            made = ModbusBus(bus, units, connector, self.clock, self.tags, self._on_offline, offset)
            self.buses[bus.name] = self._modbus[bus.name] = made

    def _make_outputs(self) -> list[Output]:
        """Return every tag that a program or a client of the gateway may write, and every tag that has a safe value."""
        served = {t.tag for s in self.config.serve for t in s.tags if t.write and not t.variable}
        safe = {f"{device.name}.{local}" for device in self.config.devices.values() for local in device.safe}
        return [
            self._make_output(tag)
            for tag in sorted(self.config.outputs | served | safe)
            if not isinstance(self.drivers[tag.partition(".")[0]], TransmitterDriver)
        ]

    def _make_output(self, tag: str) -> Output:
        device, _, local = tag.partition(".")
        driver = self.drivers[device]
        output = Output(tag, local, driver, self.buses[driver.config.bus], driver.config.safe.get(local))
        output.commanded = tag in self.config.outputs
        return output

    def complete_outputs(self, driver: RegisterDriver | CanopenDriver) -> None:
        """Add as outputs the tags that got a safe value from a new configuration of a driver's device."""
        known = {output.tag for output in self.outputs.outputs}
        tags = [f"{driver.config.name}.{local}" for local in driver.config.safe]
        if not isinstance(driver, TransmitterDriver):
            self.outputs.outputs += [self._make_output(tag) for tag in tags if tag not in known]

    def offer(self, tag: str) -> None:
        """Make a `writable` tag an output, so that a user can write it although neither a program nor a server does.

        Any other tag is left as it is; a write of it is then refused.
        """
        name, _, local = tag.partition(".")
        device, known = self.config.devices.get(name), {output.tag for output in self.outputs.outputs}
        if device is None or tag in known or local not in device.writable:
            return
        if not isinstance(self.drivers[name], TransmitterDriver):
            self.outputs.outputs.append(self._make_output(tag))

    def client_tags(self) -> list[str]:
        """Return the tags that a client may write: those that are `writable`, on a bus that may be written to, that neither a
        program commands nor a group contains.
        """
        return [
            f"{device.name}.{local}"
            for device in self.config.devices.values()
            if self.config.may_write(device.bus) and not isinstance(self.drivers[device.name], TransmitterDriver)
            for local in device.writable
            if f"{device.name}.{local}" not in self.config.outputs
            and not self.outputs.is_in_group(f"{device.name}.{local}")
        ]

    def _message_sources(self) -> dict[str, Consumer[DATA]]:
        sources: dict[str, Consumer[DATA]] = {pump.driver.message_tag: pump.inbox for pump in self.pumps}
        for driver in self.drivers.values():
            if driver.message_tag is not None and driver.message_tag not in sources:
                consumer: Consumer[DATA] = Consumer(driver.emitter.event, capacity=256)
                driver.emitter.subscribe(consumer)
                sources[driver.message_tag] = consumer
        return sources

    def _blocked(self, bus: str, unit: int) -> str:
        """Return why a bridge's client must not write to a unit, or ""; unit 0 means every unit of the bus."""
        on_it = [d for d in self.drivers.values() if d.config.bus == bus and unit in (d.config.address, 0)]
        return next((f"{d.config.where}: {d.identity_error}" for d in on_it if d.identity_error), "")

    def _on_offline(self, driver: RegisterDriver | CanopenDriver) -> None:
        self.outputs.forget(driver)

    # -- running --------------------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Run every bus and the exchange with the PLC, until cancelled or until one of them fails (an internal
        error)."""
        async with Nursery() as nursery:
            for name, bus in self.buses.items():
                nursery.start(bus.run(), f"bus {name}")
            self.deadline_ns = self.clock.monotonic_ns()
            nursery.start(run_cycle(self.clock, self), "exchange with the PLC")
            for server in self.servers:
                nursery.start(server.run(), f"server {server.config.name}")
            for bridge in self.bridges:
                nursery.start(bridge.run(), f"bridge {bridge.config.name}")
            await nursery.wait()

    def run_once(self) -> None:
        """Exchange data with the PLC now, and set the time of the next exchange."""
        now_ns = self.clock.monotonic_ns()
        self.tick(now_ns)
        # missed cycles are skipped, and not made up for in a burst
        self.deadline_ns = max(self.deadline_ns + self.period_ns, now_ns)

    def repeats_until(self, until_ns: int) -> bool:
        """Return whether every `tick` before `until_ns` would only repeat the last one, see `Cycle`."""
        lost_ns = self.config.plc_lost_ms * NS_PER_MS
        return (
            self.exchange.repeats_until(until_ns)
            and self.plc_alive
            and not self._stopping
            and self.alarms.repeats_until(until_ns)
            and until_ns - self.exchange.plc_heard_ns <= lost_ns
            and self.outputs.is_idle
            and self._is_idle()
            and self.plc_variables.is_idle
        )

    def _is_idle(self) -> bool:
        """Return whether no message is passed on, and none was delivered since the last `tick`."""
        return (
            all(map(_IS_IDLE, self.pumps))
            and not any(map(self.log.pending, self.config.log_tags))
            and not any(self.exchange.undelivered.values())
        )

    def skip(self, count: int, last_ns: int) -> None:
        """Count ticks that do not take place, see `Cycle`."""
        self.deadline_ns += count * self.period_ns
        self.exchange.skip(count, last_ns)
        self.outputs.now_ns = last_ns
        for pump in self.pumps:
            pump.now_ns = last_ns

    def _undelivered(self) -> dict[str, int]:
        """Return, by tag, how many messages of the PLC have not reached their mailbox or the exchange log."""
        undelivered = {pump.driver.outbox_tag: pump.undelivered for pump in self.pumps}
        for tag in self.config.log_tags:
            undelivered[tag] = self.log.pending(tag)
        return undelivered

    def tick(self, now_ns: int) -> None:
        """Exchange data with the PLC once, and act on its outputs. Never waits."""
        for pump in self.pumps:
            pump.refuse_when_local()
        self.exchange.undelivered = self._undelivered()
        self.exchange.exchange(now_ns)
        for tag, messages in self.exchange.new_messages.items():
            for pump in self.pumps:
                if pump.driver.outbox_tag == tag:
                    pump.offer([m.data for m in messages])
            if tag in self.config.log_tags:
                self.log.append([(tag, m.seq, m.t_ns, m.data) for m in messages])
        self._check_plc(now_ns)
        self.plc_variables.alive = self.plc_alive
        self.plc_variables.tick(now_ns)
        self.alarms.tick(now_ns, self.exchange.outputs, plc_alive=self.plc_alive)
        self.outputs.tick(now_ns)
        for pump in self.pumps:
            pump.tick(now_ns, self.exchange.all_consumed(pump.driver.message_tag))

    def _check_plc(self, now_ns: int) -> None:
        """Follow the PLC's commands, unless its heartbeat stopped or it reports that it stopped."""
        if self._stopping:
            return
        x = self.exchange
        age_ms = x.plc_age_ms(now_ns)
        alive = age_ms <= self.config.plc_lost_ms and not x.plc_stopped
        if alive:
            if not self.plc_alive:
                self.outputs.release()
            for tag in self.config.outputs:
                seen = x.outputs.get(tag)
                if seen is not None and isinstance(seen.value, _NUMBERS):
                    self.outputs.want(tag, seen.value)
                elif seen is not None and seen.reason is Reason.NOT_A_NUMBER:
                    self.outputs.want_no_number(tag)
        elif self.plc_alive or (not self.outputs.safe_active and now_ns - self._started_ns > PLC_GRACE_NS):
            self.plc_losses += 1
            self.outputs.make_safe("the PLC stopped" if x.plc_stopped else "the PLC's heartbeat was lost")
        self.plc_alive = alive

    async def shut_down(self, timeout_s: float = 1.0) -> bool:
        """Make the outputs safe, stop nodes and end polls, while `run` still runs. Return whether every output was
        confirmed in time."""
        if self._stopping:
            return self.outputs.settled
        deadline_ns = self.clock.monotonic_ns() + int(timeout_s * NS_PER_S)
        self._stopping = True
        self.outputs.make_safe("the gateway stops")
        self.outputs.tick(self.clock.monotonic_ns())
        while not self.outputs.settled and self.clock.monotonic_ns() < deadline_ns:
            await self.clock.sleep_until_ns(self.clock.monotonic_ns() + 5 * NS_PER_MS)
        for bus in self.buses.values():
            await bus.halt(timeout_s / 2)
        self.outputs.journal.flush()
        return self.outputs.settled
