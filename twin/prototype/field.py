"""The simulated field devices: the emulators of a prototype on real connections, in one process.

Each emulated bus has one listener (a pty, a TCP socket, a software CAN bus or a kernel CAN interface) that serves every device
of that bus. This module connects the emulators to the system file; it does not depend on gateway and PLC.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from fieldtwin.emulators.canopen.eds.remarks import Remark
from fieldtwin.emulators.canopen.node import CanopenNode
from fieldtwin.emulators.context import EndOfRecording
from fieldtwin.emulators.emulator import EmulatedUnit
from fieldtwin.emulators.endpoints.ports import OsPorts, Ports
from fieldtwin.emulators.host import EmulatorHost, ModbusWire
from fieldtwin.emulators.journal import DeviceValueLog, share_of
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.emulators.models.canopen.emulated_node import NodeOptions, emulated_node
from fieldtwin.emulators.models.modbus.emulated_modbus import (
    ConnectionKind,
    EmulatedModbus,
    mailbox_device,
    recorded_device,
    register_device,
    sampled_device,
    unit_limits,
)
from fieldtwin.emulators.models.modbus.mailbox_modem import MailboxModem, ModemPair
from fieldtwin.emulators.models.modbus.packet_link import LinkImpairments, ModemEnd
from fieldtwin.emulators.models.modbus.recorded_device import RecordedDevice, load_replay
from fieldtwin.emulators.replay.can_log import CanLog
from fieldtwin.emulators.replay.replay import ExchangeReplay
from fieldtwin.emulators.signals import SignalPlayer, Signals, SignalTrack
from fieldtwin.gateway.core.clock import NS_PER_MS, Clock
from fieldtwin.gateway.core.connection import CanConnection, RS232Connection, TCPConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.candump import SUFFIX
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


def _advised(remark: Remark) -> str:
    """Return a remark with the keys of the prototype file that can resolve it."""
    if remark.by_parameter_value:
        return f"{remark.text} (`parameter_values: false` starts with the DefaultValues)"
    return f"{remark.text} (`cia: 402` chooses a model, `cia: none` means it)" if remark.model else remark.text


class FieldSimulator:
    """Builds every emulator of a prototype and runs them on their connections.

    The symbolic links of virtual serial ports are created in `run_dir`. After `open`, `listening` holds the endpoint at which
    each emulated bus listens (with the free ports that were chosen), and `far` holds the endpoints of the modems at the remote
    end of a link. `water`: the acoustic connections of transmitters that are in a network's acoustic channel, and that
    therefore have no separate remote modem.
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
        """The signals that give devices their values, by device name."""
        self.faults = FieldFaults(system, prototype.seed, clock)
        self.failures: dict[str, str] = {}
        """The devices that fell silent because their simulation has failed, with the error."""
        self._is_open = False
        self._run_dir = run_dir
        self._clock = clock
        self._ports = ports or OsPorts()
        self._host = EmulatorHost(clock, self._ports)
        self._pairs: dict[str, ModemPair] = {}
        self._water = water or {}
        self._tracks: dict[Path, SignalTrack] = {}
        self._replays: dict[tuple[Path, str, str, EndOfRecording], tuple[ExchangeReplay, int]] = {}
        self._to_close = ExitStack()

    async def open(self) -> None:
        """Create the emulators and start listening. Raises `EndpointBusy`, `Unreachable` or `FileInvalid`; then nothing stays
        open.
        """
        try:
            self._simulations = Simulations(
                self.prototype.file,
                self.prototype.form,
                self.system,
                self._clock.monotonic_ns(),
                self._simulation_failed,
            )
            self._to_close.callback(self._simulations.close)
            for bus in self.prototype.buses.values():
                if bus.listen is not None:
                    await self._open_bus(bus, bus.listen)
            self._simulations.connect({name: device.journal for name, device in self.devices.items()})
            for name in self.failures:  # of a simulation that has failed while devices were being made
                self.faults.silence(name)
            self._is_open = True
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
        await self._host.run()

    async def aclose(self) -> None:
        """Stop every emulator, close every connection, and end the simulations."""
        try:
            await self._host.aclose()
        finally:
            self._to_close.close()

    def end_simulations(self) -> None:
        """End the processes of simulations, of devices that are not served any more."""
        self._to_close.close()

    def _simulation_failed(self, simulation: str, error: FileInvalid) -> None:
        """Make the devices of a failed simulation silent. Its last values must not be read as current ones."""
        forms = self.prototype.form.devices
        for name in [name for name in self.system.devices if name in forms and forms[name].simulation == simulation]:
            self.failures[name] = str(error)
            if self._is_open:
                self.faults.silence(name)
            print(f"{name} is silent from now on: {error}", file=sys.stderr, flush=True)

    async def join(self, bus: str, name: str) -> CanConnection:
        """Join an emulated CAN bus as a passive listener. The caller closes the connection."""
        return await self._host.join(bus, name)

    # -- wires ----------------------------------------------------------------------------------------------------------

    async def _open_bus(self, bus: EmulatedBus, listen: Endpoint) -> None:
        on_it = [d for d in self.system.devices_on(bus.name) if d.name in self.prototype.devices]
        if listen.is_can:
            await self._open_can(bus, listen, on_it)
            return
        if listen.scheme == "pty":
            listen = replace(listen, path=str(self._run_dir / listen.path))
        wire = ModbusWire(
            bus.name,
            listen,
            self.system.buses[bus.name].endpoint,
            pace=bus.pace,
            echo=self.system.buses[bus.name].echo,
            latency_s=max((self.prototype.devices[d.name].form.latency_ms for d in on_it), default=0.0) / 1000,
        )
        units = {d.address: self._modbus_unit(d) for d in on_it}
        self.listening[bus.name] = await self._host.serve_units(wire, units, self.faults.on_bus(bus.name))
        for device in on_it:
            await self._open_far(device, wire.latency_s)

    async def _open_far(self, device: DeviceConfig, latency_s: float) -> None:
        """Open the remote modem of a transmitter, on its own socket."""
        pair, emulated = self._pairs.get(device.name), self.prototype.devices[device.name]
        if pair is None or emulated.form.far is None:
            return
        name, listen = f"{device.name} (far)", Endpoint.parse(emulated.form.far)
        unit = self.far_units[device.name] = ModbusUnit(pair.far, unit_limits(emulated.profile), name=name)
        wire = ModbusWire(name, listen, plant=listen, latency_s=latency_s)
        self.far[device.name] = await self._host.serve_units(wire, {device.address: unit})

    async def _open_can(self, bus: EmulatedBus, listen: Endpoint, on_it: list[DeviceConfig]) -> None:
        nodes = {d.name: self._canopen_node(d) for d in on_it}
        port = await self._ports.can_bus(listen, self.system.buses[bus.name].bitrate, paced=bus.pace)
        self.listening[bus.name] = port.bound
        if port.runner is not None:
            self.faults.on_wire(bus.name, port.runner.disturb, port.runner.undisturb)
        await self._host.serve_nodes(bus.name, port, nodes, self.faults.on_bus(bus.name))

    # -- devices --------------------------------------------------------------------------------------------------------

    def _modbus_unit(self, config: DeviceConfig) -> EmulatedUnit | RecordedDevice:
        emulated = self.prototype.devices[config.name]
        made = self._made_device(config, emulated)
        if emulated.form.busy is not None:
            made.unit.be_busy_after(emulated.form.busy.every, emulated.form.busy.for_ms * NS_PER_MS)
        self.faults.on_values(config.name, made.distortions)
        device = self.devices[config.name] = FieldDevice(emulated, made.unit, None)
        device.journal = made.journal
        return made.unit

    def _made_device(self, config: DeviceConfig, emulated: EmulatedDevice) -> EmulatedModbus:
        profile, form, kind = emulated.profile, emulated.form, self._kind(config)
        if form.model == "mailbox":
            return mailbox_device(profile, kind, self._modem(config, emulated), config.name)
        if form.model == "profile" or (form.simulation and profile.sampled is None):
            return self._register_device(config, emulated)
        if profile.sampled is None:
            replay, unit_id = self._replay(emulated)
            return recorded_device(profile, kind, replay, unit_id, form.identity, config.name)
        period_s = int(form.values.get(profile.sampled.period, 0))
        return sampled_device(profile, kind, self._signals(emulated), form.identity, config.name, period_s)

    def _modem(self, config: DeviceConfig, emulated: EmulatedDevice) -> MailboxModem:
        """Return a transmitter: in a network's acoustic channel, or with its own remote modem and link."""
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

    def _register_device(self, config: DeviceConfig, emulated: EmulatedDevice) -> EmulatedModbus:
        """Return a device without a recording: its profile, and the values of its tags from the prototype file."""
        profile, form = emulated.profile, emulated.form
        stated = {name: profile.tags[name].number_of(value) for name, value in form.values.items()}
        now_ns = self._clock.monotonic_ns()
        signals = None if form.simulation is None else self._signals(emulated)
        try:
            return register_device(
                profile, self._kind(config), {**stated, **form.identity}, now_ns, signals, config.name
            )
        except FileInvalid as e:
            raise FileInvalid(
                f"{config.name!r}: {e.message}", path=str(self.prototype.path), expected=e.expected, got=e.got
            ) from e

    def _replay(self, emulated: EmulatedDevice) -> tuple[ExchangeReplay, int]:
        """Return a copy of the device's recording, and the device's unit ID in it. Devices that share a recording read it
        once.
        """
        assert emulated.recording is not None
        profile, at_end = emulated.profile, EndOfRecording.parse(emulated.form.at_end)
        key = emulated.recording, profile.path, profile.hash, at_end
        if key not in self._replays:
            self._replays[key] = load_replay(profile, emulated.recording, at_end)
        replay, unit_id = self._replays[key]
        return replay.copy(), unit_id

    def _kind(self, config: DeviceConfig) -> ConnectionKind:
        """Return the kind of the plant's connection, such as a serial line, even if this run carries it over TCP or in memory."""
        return RS232Connection if self.system.buses[config.bus].endpoint.is_serial else TCPConnection

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
        """Return the signals that give the device its values: those of its simulation, or of its recording, starting now."""
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
            clients={bus: clients for bus, clients in self._host.clients().items() if bus in self.listening},
            faults=self.faults.active(),
            struck=self.faults.history.struck(),
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
            buses=self._host.can_stats(),
            set=self.faults.values_set(),
            failures=dict(self.failures),
        )

    def held_since(self, numbers: dict[str, int]) -> dict[str, list[tuple[int, str, str, int]]]:
        """Return the values that each device held after the given journal numbers: (number, tag, hex, monotonic ns)."""
        return {
            name: [(h.number, h.tag, h.raw.hex(), h.t_ns) for h in d.journal.since(numbers.get(name, 0))]
            for name, d in self.devices.items()
        }
