"""The simulated field devices: the emulators of a prototype on real connections, in one process.

Each emulated bus has one listener (a pty, a TCP socket, a software CAN bus or a kernel CAN interface) that serves every
device of that bus. This module connects the emulators to the system file; it does not know what gateway and PLC do.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping, Sized
from pathlib import Path

from fieldtwin.emulators.canopen.node import CanopenNode
from fieldtwin.emulators.canopen.remarks import Remark
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.client_counts import ClientCounts, CountDifference
from fieldtwin.emulators.context import EndOfRecording
from fieldtwin.emulators.distorted_registers import DistortedRegisters
from fieldtwin.emulators.emulator import EmulatedUnit
from fieldtwin.emulators.endpoints.modbus_server import Latency, as_recorded, serve_mbap, serve_rtu, serve_udp
from fieldtwin.emulators.endpoints.ports import CanPort, Listening, OnClient, OsPorts, Ports
from fieldtwin.emulators.journal import DeviceValueLog, share_of
from fieldtwin.emulators.modbus.ascii import AsciiSlave
from fieldtwin.emulators.modbus.bank import RegisterBank
from fieldtwin.emulators.modbus.line import LineSlave
from fieldtwin.emulators.modbus.mbap import MbapSlave
from fieldtwin.emulators.modbus.rtu import RtuSlave
from fieldtwin.emulators.modbus.unit import ModbusUnit, UnitLimits
from fieldtwin.emulators.models.emulated_node import NodeOptions, emulated_node
from fieldtwin.emulators.models.mailbox_modem import MailboxModem, ModemPair
from fieldtwin.emulators.models.packet_link import LinkImpairments, ModemEnd
from fieldtwin.emulators.models.register_device import ProfileRegisters, add_own_functions
from fieldtwin.emulators.models.sampled_sensor import SampledSensor
from fieldtwin.emulators.models.simulated_registers import SimulatedRegisters
from fieldtwin.emulators.recorded_device import RecordedDevice, load_replay
from fieldtwin.emulators.replay.can_log import CanLog
from fieldtwin.emulators.replay.replay import ExchangeReplay
from fieldtwin.emulators.signals import SignalPlayer, Signals, SignalTrack
from fieldtwin.emulators.stated import parts_of
from fieldtwin.gateway.core.clock import NS_PER_MS, Clock
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import ByteConnection, CanConnection, RS232Connection, TCPConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.candump import SUFFIX
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.devices.config import DeviceConfig
from fieldtwin.twin.prototype.field_faults import FieldFaults
from fieldtwin.twin.prototype.field_status import FieldStatus, SimulatedDeviceStatus
from fieldtwin.twin.prototype.file import EmulatedBus, EmulatedDevice, Prototype
from fieldtwin.twin.prototype.simulations import Simulations
from fieldtwin.twin.site.system import System


class FieldDevice:
    """An emulated device in this process: its counters and the values that it held."""

    def __init__(
        self, emulated: EmulatedDevice, unit: EmulatedUnit | RecordedDevice | None, node: CanopenNode | None
    ) -> None:
        self.emulated = emulated
        self.plays = emulated.plays
        self.unit = unit
        self.node = node
        self.journal: DeviceValueLog = DeviceValueLog()
        self.remarks: list[str] = []
        """Remarks about values that do not fit a node's data sheet, with what to do about them."""

    @property
    def command_list(self) -> frozenset[str]:
        """Return the commands that this device accepts, according to its own profile."""
        return self.emulated.profile.command_list

    def executed(self) -> dict[str, int]:
        """Return how often each command of the list was executed; empty for a CANopen node, whose commands are not
        counted by name.
        """
        return {} if self.unit is None else {c: self.unit.emulator.executed[c] for c in sorted(self.command_list)}

    def counters(self) -> dict[str, int]:
        """Return the requests taken and the replies sent, as the device counts them."""
        if self.node is not None:
            return dict(
                self.node.counters.as_dict(),
                requests=self.node.counters.sdo_requests,
                replies=self.node.counters.sdo_replies,
            )
        assert self.unit is not None
        c = self.unit.counters
        return {"requests": c.requests, "replies": c.replies, "exceptions": c.exceptions, "broadcasts": c.broadcasts}


def _taken(units: Mapping[int, EmulatedUnit | RecordedDevice]) -> tuple[int, int]:
    """Return the numbers of requests and replies of all units of a line so far."""
    counters = [unit.counters for unit in units.values()]
    return sum(c.requests for c in counters), sum(c.replies for c in counters)


def _advised(remark: Remark) -> str:
    """Return a remark with the keys of the prototype file that can resolve it."""
    if remark.by_parameter_value:
        return f"{remark.text} (`parameter_values: false` starts with the DefaultValues)"
    return f"{remark.text} (`cia: 402` chooses a model, `cia: none` means it)" if remark.model else remark.text


class FieldSimulator:
    """Builds every emulator of a prototype and runs them on their connections.

    Virtual serial ports get their links in `run_dir`. After `open`, `listening` holds the endpoint at which each
    emulated bus listens (with the free ports that were chosen), and `far` those of the far modems. `water`: the
    acoustic ends of transmitters that are in a network's acoustic channel and have no far modem of their own.
    """

    def __init__(
        self,
        system: System,
        prototype: Prototype,
        run_dir: Path,
        clock: Clock,
        ports: Ports | None = None,
        water: Mapping[str, ModemEnd] | None = None,
    ) -> None:
        self.system = system
        self.prototype = prototype
        self.devices: dict[str, FieldDevice] = {}
        self.listening: dict[str, Endpoint] = {}
        self.far: dict[str, Endpoint] = {}
        self.far_units: dict[str, ModbusUnit] = {}
        self.signals: dict[str, Signals] = {}
        """The signals that devices play, by device name."""
        self.faults = FieldFaults(system, prototype.seed, clock)
        self._run_dir = run_dir
        self._clock = clock
        self._nursery = Nursery()
        self._ports = ports or OsPorts()
        self._listeners: list[Listening] = []
        self._buses: list[CanPort] = []
        self._can_ports: dict[str, CanPort] = {}
        self._clients: dict[str, ClientCounts] = {}
        self._lines: list[CountDifference] = []
        self._connections: list[ByteConnection | CanConnection] = []
        self._pairs: dict[str, ModemPair] = {}
        self._water = water or {}
        self._tracks: dict[Path, SignalTrack] = {}
        self._replays: dict[tuple[Path, str, str, EndOfRecording], tuple[ExchangeReplay, int]] = {}

    async def open(self) -> None:
        """Build and start listening. Raises `EndpointBusy`, `Unreachable` or `FileInvalid`; then nothing stays open."""
        try:
            self._simulations = Simulations(
                self.prototype.file, self.prototype.form, self.system, self._clock.monotonic_ns()
            )
            for bus in self.prototype.buses.values():
                if bus.listen is not None:
                    await self._open_bus(bus, bus.listen)
            self._simulations.connect({name: device.journal for name, device in self.devices.items()})
            for device in self.devices.values():
                device.journal.keep(share_of(len(self.devices)))
        except BaseException:
            await self.aclose()
            raise
        finally:
            self._tracks.clear()
            self._replays.clear()

    async def run(self) -> None:
        """Serve until cancelled. Raises any exception of an emulator."""
        # Socket servers have no task in this nursery, so this task keeps it running.
        self._nursery.start(asyncio.Event().wait(), "until cancelled")
        try:
            await self._nursery.wait()
        finally:
            await self.aclose()

    async def aclose(self) -> None:
        """Stop every emulator and close every connection."""
        await self._nursery.__aexit__(None, None, None)
        for listener in self._listeners:
            await listener.aclose()
        for connection in self._connections:
            await connection.aclose()
        self._listeners.clear()
        self._buses.clear()
        self._connections.clear()

    # -- wires ----------------------------------------------------------------------------------------------------------

    async def _open_bus(self, bus: EmulatedBus, listen: Endpoint) -> None:
        on_it = [d for d in self.system.devices_on(bus.name) if d.name in self.prototype.devices]
        if listen.is_can:
            await self._open_can(bus, listen, on_it)
            return
        units = {d.address: self._modbus_unit(d) for d in on_it}
        stated_s = max((self.prototype.devices[d.name].form.latency_ms for d in on_it), default=0.0) / 1000
        plant, echo = self.system.buses[bus.name].endpoint, self.system.buses[bus.name].echo
        latency_s: float | Latency = stated_s
        if not stated_s and any(isinstance(unit, RecordedDevice) for unit in units.values()):
            latency_s = as_recorded(plant.serial if listen.scheme == "pty" and bus.pace else None)
        if listen.scheme == "pty":
            pace = plant.serial if bus.pace else None
            port, self.listening[bus.name] = await self._ports.serial(self._run_dir / listen.path, plant, pace)
            end = self.faults.on_bytes(bus.name, port)
            self._connections.append(end)
            self._nursery.start(
                serve_rtu(end, line_of(plant, units), self._clock, latency_s, echo=echo), f"emulators on {bus.name}"
            )
        elif listen.scheme == "udp":
            datagrams = self.faults.on_datagrams(bus.name, await self._ports.datagrams(listen))
            self._listeners.append(datagrams)
            self.listening[bus.name] = datagrams.bound
            serving = serve_udp(datagrams, MbapSlave(units), self._clock, latency_s, clients=self._counts(bus.name))
            self._nursery.start(serving, f"emulators on {bus.name}")
        elif plant.is_serial or plant.scheme == "rtu+tcp":
            line, counted = line_of(plant, units), CountDifference(self._counts(bus.name), lambda: _taken(units))
            self._lines.append(counted)

            async def serve_line(end: ByteConnection, client: str) -> None:
                counted.change(client)
                try:
                    await serve_rtu(end, line, self._clock, latency_s, echo=echo)
                finally:
                    counted.change("")

            self.listening[bus.name] = await self._listen(listen, self._behind(bus.name, serve_line), 1)
        else:
            clients = self._counts(bus.name)

            async def serve(end: ByteConnection, client: str) -> None:
                counts = clients.of(client)
                counts.open = True
                try:
                    await serve_mbap(end, MbapSlave(units, counts=counts), self._clock, latency_s)
                finally:
                    counts.open = False

            self.listening[bus.name] = await self._listen(listen, self._behind(bus.name, serve))
        for device in on_it:
            await self._open_far(device, stated_s)

    def _counts(self, bus: str) -> ClientCounts:
        return self._clients.setdefault(bus, ClientCounts())

    def _behind(self, bus: str, serve: Callable[[ByteConnection, str], Awaitable[None]]) -> OnClient:
        """Wrap `serve` so that clients connect through the faults of their bus. `serve` also gets each client's address."""

        async def client(connection: ByteConnection) -> None:
            if self.faults.refuses(bus):
                return
            end = self.faults.on_bytes(bus, connection)
            try:
                await serve(end, getattr(connection, "peer", "?"))
            finally:
                await end.aclose()

        return client

    async def _listen(self, endpoint: Endpoint, on_client: OnClient, max_clients: int = 32) -> Endpoint:
        listener = await self._ports.listen(endpoint, on_client, max_clients)
        self._listeners.append(listener)
        return listener.bound

    async def _open_far(self, device: DeviceConfig, latency_s: float) -> None:
        """Open the far modem of a transmitter, on its own socket."""
        pair, form = self._pairs.get(device.name), self.prototype.devices[device.name].form
        if pair is None or form.far is None:
            return
        unit = ModbusUnit(
            pair.far, unit_limits(self.prototype.devices[device.name].profile), name=f"{device.name} (far)"
        )
        self.far_units[device.name] = unit
        self.far[device.name] = await self._listen(
            Endpoint.parse(form.far), lambda c: serve_mbap(c, MbapSlave({device.address: unit}), self._clock, latency_s)
        )

    async def _open_can(self, bus: EmulatedBus, listen: Endpoint, on_it: list[DeviceConfig]) -> None:
        bitrate = self.system.buses[bus.name].bitrate
        nodes = [self._canopen_node(d) for d in on_it]
        port = await self._ports.can_bus(listen, bitrate, paced=bus.pace)
        self._listeners.append(port)
        self._buses.append(port)
        self._can_ports[bus.name] = port
        self.listening[bus.name] = port.bound
        runner = port.runner
        if runner is not None:
            self.faults.on_wire(bus.name, runner.disturb, runner.undisturb)
        connections = [self.faults.on_can(bus.name, await port.join(d.name), d.address) for d in on_it]
        self._connections.extend(connections)
        for device, node, connection in zip(on_it, nodes, connections, strict=True):
            self._nursery.start(serve_node(connection, node, self._clock), f"node {device.name}")

    async def join(self, bus: str, name: str) -> CanConnection:
        """Join an emulated CAN bus as a passive listener. The caller closes the connection."""
        for port in self._buses:
            if port.bound == self.listening.get(bus):
                return await port.join(name)
        raise UsageError(f"no emulated CAN bus {bus!r}", expected=", ".join(str(p.bound) for p in self._buses) or "one")

    # -- devices --------------------------------------------------------------------------------------------------------

    def _modbus_unit(self, config: DeviceConfig) -> EmulatedUnit | RecordedDevice:
        emulated = self.prototype.devices[config.name]
        unit = self._made_unit(config, emulated)
        if emulated.form.busy is not None:
            unit.be_busy_behind(emulated.form.busy.every, emulated.form.busy.for_ms * NS_PER_MS)
        return unit

    def _made_unit(self, config: DeviceConfig, emulated: EmulatedDevice) -> EmulatedUnit | RecordedDevice:
        if emulated.form.model == "mailbox":
            modem = self._modem(config, emulated)
            seen = DistortedRegisters(modem, modem.peek, emulated.profile, modem.journal)
            unit = self._emulated_unit(config, seen, ())
            self.faults.on_values(config.name, seen.distortions)
            device = self.devices[config.name] = FieldDevice(emulated, unit, None)
            device.journal = modem.journal
            return unit
        if emulated.form.model == "profile" or (emulated.form.simulation and emulated.profile.sampled is None):
            return self._stated_unit(config, emulated)
        if emulated.profile.sampled is None:
            return self._recorded_unit(config, emulated)
        player = self._signals(emulated)
        bank = SampledSensor(emulated.profile, player, emulated.form.identity)
        seen = DistortedRegisters(bank, bank.peek, emulated.profile, bank.journal, bank.own_tags, bank.distortions)
        unit = self._emulated_unit(config, seen, player)
        device = self.devices[config.name] = FieldDevice(emulated, unit, None)
        device.journal = bank.journal
        self.faults.on_values(config.name, bank.distortions)
        return unit

    def _modem(self, config: DeviceConfig, emulated: EmulatedDevice) -> MailboxModem:
        """Return a transmitter: in a network's acoustic channel, or with its own far modem and link."""
        end, link = self._water.get(config.name), emulated.form.far_link
        if end is not None:
            return MailboxModem(emulated.profile, end, end, emulated.form.identity)
        pair = self._pairs[config.name] = ModemPair(
            emulated.profile,
            bytes_per_s=link.bytes_per_s,
            latency_s=link.latency_ms / 1000,
            loss=link.loss,
            seed=self.prototype.seed,
            untamed=LinkImpairments(link.lost, link.repeated, link.overtakes),
            identity=emulated.form.identity,
        )
        return pair.near

    def _stated_unit(self, config: DeviceConfig, emulated: EmulatedDevice) -> EmulatedUnit:
        """Return a device without a recording: its profile, and the values of its tags from the prototype file."""
        tags = emulated.profile.tags
        stated = {name: tags[name].number_of(value) for name, value in emulated.form.values.items()}
        values = {**stated, **emulated.form.identity}
        now_ns = self._clock.monotonic_ns()
        try:
            if emulated.form.simulation is None:
                bank = ProfileRegisters(emulated.profile, values, now_ns)
            else:
                bank = SimulatedRegisters(emulated.profile, values, self._signals(emulated), now_ns)
        except FileInvalid as e:
            raise FileInvalid(
                f"{config.name!r}: {e.message}", path=str(self.prototype.path), expected=e.expected, got=e.got
            ) from e
        seen = DistortedRegisters(bank, bank.peek, emulated.profile, bank.journal)
        unit = self._emulated_unit(config, seen, ())
        self.faults.on_values(config.name, seen.distortions)
        add_own_functions(unit, bank, emulated.profile)
        device = self.devices[config.name] = FieldDevice(emulated, unit, None)
        device.journal = bank.journal
        return unit

    def _recorded_unit(self, config: DeviceConfig, emulated: EmulatedDevice) -> RecordedDevice:
        """Return a device that replays its recorded exchanges."""
        assert emulated.recording is not None
        profile, at_end = emulated.profile, EndOfRecording.parse(emulated.form.at_end)
        key = emulated.recording, profile.path, profile.hash, at_end
        if key not in self._replays:  # a recording shared by many devices is read and kept in memory once
            self._replays[key] = load_replay(profile, emulated.recording, at_end)
        replay, unit_id = self._replays[key]
        kind = self._kind(config)
        unit = RecordedDevice(profile, replay.copy(), unit_id, kind, emulated.form.identity, config.name)
        device = self.devices[config.name] = FieldDevice(emulated, unit, None)
        device.journal = unit.journal
        self.faults.on_values(config.name, unit.distortions)
        return unit

    def _kind(self, config: DeviceConfig) -> type[RS232Connection] | type[TCPConnection]:
        return RS232Connection if self.system.buses[config.bus].endpoint.is_serial else TCPConnection

    def _emulated_unit(self, config: DeviceConfig, bank: RegisterBank, context: Sized) -> EmulatedUnit:
        """Return the device on a connection of the plant's kind, whatever carries that connection in this run."""
        profile = self.prototype.devices[config.name].profile
        limits, parts = unit_limits(profile), parts_of(profile)
        return EmulatedUnit(bank, profile, self._kind(config), context, limits, config.name, parts)

    def _canopen_node(self, config: DeviceConfig) -> CanopenNode:
        emulated = self.prototype.devices[config.name]
        recording = self._node_recording(emulated)
        try:
            made = emulated_node(
                emulated.profile,
                config.address,
                recording,
                self._clock.monotonic_ns(),
                emulated.form.identity,
                NodeOptions(emulated.form.cia, emulated.form.parameter_values),
            )
        except UsageError as e:
            raise FileInvalid(
                f"{config.name!r}: {e.message}", path=str(self.prototype.path), expected=e.expected, got=e.got
            ) from e
        device = self.devices[config.name] = FieldDevice(emulated, None, made.node)
        device.journal = made.journal
        device.remarks = [_advised(remark) for remark in made.remarks]
        self.faults.on_values(config.name, made.distortions)
        return made.node

    def _node_recording(self, emulated: EmulatedDevice) -> Signals | CanLog | None:
        if emulated.recording is None:
            return None if emulated.form.simulation is None else self._signals(emulated)
        if emulated.recording.suffix != SUFFIX:
            return self._signals(emulated)
        return CanLog(emulated.recording, emulated.form.speed, EndOfRecording.parse(emulated.form.at_end))

    def _signals(self, emulated: EmulatedDevice) -> Signals:
        """Return the signals that the device plays: of its simulation, or of its recording, starting now."""
        self.signals[emulated.name] = signals = self._made_signals(emulated)
        return signals

    def _made_signals(self, emulated: EmulatedDevice) -> Signals:
        form = emulated.form
        if form.simulation is not None:
            return self._simulations.signals_of(emulated.name, form, emulated.profile)
        assert emulated.recording is not None
        if emulated.recording not in self._tracks:
            self._tracks[emulated.recording] = SignalTrack.load(emulated.recording)
        return SignalPlayer(
            self._tracks[emulated.recording],
            self._clock.monotonic_ns(),
            speed=form.speed,
            at_end=EndOfRecording.parse(form.at_end),
        )

    def _clients_by_bus(self) -> dict[str, dict[str, dict[str, int]]]:
        """Return, by bus and client, the requests that reached a device and their replies.

        Kernel CAN buses and ptys are not included.
        """
        for line in self._lines:
            line.settle()
        found = {bus: counts.describe() for bus, counts in self._clients.items()}
        for bus, port in self._can_ports.items():
            found[bus] = port.stats().get("sdo_clients", {})
        return found

    # -- what others see ------------------------------------------------------------------------------------------------

    def status(self) -> FieldStatus:
        """Return counters by device, for the control channel."""
        return FieldStatus(
            system=self.system.name,
            system_hash=self.system.hash,
            devices={
                name: SimulatedDeviceStatus(
                    profile=d.emulated.profile.name,
                    recording=str(d.emulated.recording or d.emulated.form.simulation or d.emulated.form.model),
                    plays=d.plays,
                    remarks=d.remarks,
                    commands=sorted(d.command_list),
                    executed=d.executed(),
                    unlisted=d.unit.unlisted if d.unit is not None else 0,
                    counters=d.counters(),
                    held=d.journal.number,
                    held_dropped=d.journal.dropped,
                )
                for name, d in self.devices.items()
            },
            clients=self._clients_by_bus(),
            faults=self.faults.describe(),
            struck=self.faults.history.describe(),
            listening={bus: str(endpoint) for bus, endpoint in self.listening.items()},
            far={device: str(endpoint) for device, endpoint in self.far.items()},
            links={
                name: {
                    "sent": p.up.sent + p.down.sent,
                    "resent": p.up.resent + p.down.resent,
                    "delivered": p.up.delivered + p.down.delivered,
                }
                for name, p in self._pairs.items()
            },
            buses={str(bus.bound): stats for bus in self._buses if (stats := bus.stats())},
            set=self.faults.values_set(),
        )

    def held_since(self, numbers: dict[str, int]) -> dict[str, list[tuple[int, str, str, int]]]:
        """Return the values that each device held after the given journal numbers: (number, tag, hex, monotonic ns)."""
        return {
            name: [(h.number, h.tag, h.raw.hex(), h.t_ns) for h in d.journal.since(numbers.get(name, 0))]
            for name, d in self.devices.items()
        }


def line_of(plant: Endpoint, units: Mapping[int, ModbusUnit]) -> LineSlave:
    """Return the units of a serial line, in the framing of the plant's endpoint."""
    return AsciiSlave(units) if plant.scheme == "ascii" else RtuSlave(units)


def unit_limits(profile: DeviceProfile) -> UnitLimits:
    limits = profile.form.limits
    functions = frozenset(limits.functions) if limits.functions is not None else UnitLimits().functions
    return UnitLimits(functions=functions, read_registers=limits.read_registers, even_only=limits.even_only)
