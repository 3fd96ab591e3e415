"""One emulated device on its own endpoints: `fieldtwin emulate DEVICE|RECORDING --on ENDPOINT...`.

The same device may listen on several endpoints at once; all of them share its registers.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fieldtwin.capture.recordings.rotating_file import exchanges_of, header_of, oldest_part
from fieldtwin.console import stderr
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.context import EndOfRecording
from fieldtwin.emulators.device_faults import DeviceFaults
from fieldtwin.emulators.distorted_registers import DistortedRegisters
from fieldtwin.emulators.endpoints.bus_server import SoftBusServer
from fieldtwin.emulators.endpoints.faulty import FaultyEnd
from fieldtwin.emulators.endpoints.faulty_udp import FaultyDatagrams
from fieldtwin.emulators.endpoints.modbus_server import as_recorded, serve_mbap, serve_rtu, serve_udp
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.emulators.endpoints.socket_end import OnClient, SocketEnd, SocketListener
from fieldtwin.emulators.endpoints.udp_end import UdpEnd
from fieldtwin.emulators.faults.engine import WireFaults
from fieldtwin.emulators.faults.fault import Active
from fieldtwin.emulators.faults.frames import Framing
from fieldtwin.emulators.modbus.ascii import AsciiSlave
from fieldtwin.emulators.modbus.line import LineSlave
from fieldtwin.emulators.modbus.mbap import MbapSlave
from fieldtwin.emulators.modbus.rtu import RtuSlave
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.emulators.models.emulated_node import NodeOptions, emulated_node
from fieldtwin.emulators.models.mailbox_modem import ModemPair
from fieldtwin.emulators.models.register_device import ProfileRegisters, add_own_functions
from fieldtwin.emulators.models.sampled_sensor import SampledSensor
from fieldtwin.emulators.recorded_device import load_replay
from fieldtwin.emulators.replay.can_log import CanLog
from fieldtwin.emulators.replay.profiled import ProfiledReplay
from fieldtwin.emulators.replay.replay import ExchangeReplay, NeverRecorded
from fieldtwin.emulators.replay.unit import ReplayUnit
from fieldtwin.emulators.signals import SignalPlayer, SignalTrack
from fieldtwin.emulators.stated import parts_of
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.concurrency.stop_signal import stop_signal
from fieldtwin.gateway.core.connection import ByteConnection, CanConnection
from fieldtwin.gateway.core.endpoint import SERIAL_SCHEMES, Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.candump import SUFFIX
from fieldtwin.gateway.core.files.profile import DeviceProfile, load_profile
from fieldtwin.gateway.core.files.recording import looks_like_another_file, shown
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.run.emulate.can_bus import only_bus, stand_on_bus
from fieldtwin.run.emulate.data_sheet import print_remarks
from fieldtwin.run.emulate.fault_counts import struck
from fieldtwin.run.processes.until_stopped import until_stopped
from fieldtwin.twin.prototype.field import unit_limits
from fieldtwin.twin.site.data_files import find_recording

DEFAULT_RECORDINGS = {"fieldtwin/ctd-reference": "cast.jsonl", "fieldtwin/inclinometer-cia410": "incl.jsonl"}
"""Shipped reference devices whose recording has a different name than their profile."""
MAX_CLIENTS = 32
LINE_PARAMS = ("mode", "echo")
"""Parameters of an emulated line, apart from its serial settings."""


async def run_device(
    kind: str,
    path: Path,
    endpoints: tuple[str, ...],
    unit_id: int | None,
    recording: Path | None,
    speed: float,
    bitrate: int | None = None,
    *,
    unknown: NeverRecorded = NeverRecorded.EXCEPTION,
    at_end: EndOfRecording = EndOfRecording.HOLD,
    options: NodeOptions | None = None,
    extras: Extras | None = None,
) -> int:
    """Serve until SIGINT or SIGTERM; raise the error that ended the serving.

    `bitrate` is for a CAN bus, None for the default. `unknown` and `at_end` are for a recording without a profile: the
    reply to a request that was never recorded, and the behaviour at the end of the recording. `options` are for a
    CANopen node, `extras` for a Modbus device.
    """
    host = DeviceHost(speed, extras or Extras())
    stop = stop_signal()
    try:
        async with Nursery() as nursery:  # inside: servers stop before their connections close
            wires = [Endpoint.parse(url) for url in endpoints]
            if kind == "recording":
                host.fault(None)
                units = host.replayed(path, unit_id, unknown, at_end)
                wires = [as_it_was_recorded(wire, header_of(path).endpoint) for wire in wires]
            else:
                profile = load_profile(path)
                wires = [_as_from_the_factory(wire, profile) for wire in wires]
                if profile.protocol == "canopen":
                    await host.serve_can(nursery, profile, wires, unit_id, recording, bitrate, options)
                    units = {}
                elif options is not None:
                    raise UsageError("--model and --defaults are for a CANopen node", got=profile.name)
                else:
                    units = {unit_id or profile.form.factory.unit: host.modbus(profile, recording)}
            if units:
                for wire in wires:
                    await host.serve(nursery, units, wire)
            await until_stopped(nursery, stop)
    finally:
        await host.aclose()
        for active in host.put_in:
            stderr.print(struck(active), soft_wrap=True, markup=False)
    return 0


@dataclass(frozen=True)
class Extras:
    """Optional settings of a Modbus device.

    `values` are the initial values of its tags (None: its recording, or zeros), `faults` the faults as a fault file
    states them, `seed` the seed of random choices; with `any_unit` the device answers every unit ID on TCP.
    """

    values: Mapping[str, float | str] | None = None
    faults: tuple[dict[str, Any], ...] = ()
    seed: int = 1
    any_unit: bool = False


class DeviceHost:
    """A builder of a device and its servers."""

    def __init__(self, speed: float, extras: Extras = Extras()) -> None:
        self._extras = extras
        self._faults: DeviceFaults | None = None
        self._clock = WallClock()
        self._speed = speed
        self._closing: list[
            SocketListener | UdpEnd | FaultyDatagrams | SoftBusServer | ByteConnection | CanConnection
        ] = []

    def modbus(self, profile: DeviceProfile, recording: Path | None) -> ModbusUnit:
        """Return the unit that a Modbus profile describes."""
        self.fault(profile)
        if self._extras.values is not None:
            return self._stated(profile, self._extras.values)
        if profile.inbox is not None:
            pair = ModemPair(profile, bytes_per_s=400, latency_s=0.2, loss=0.0, seed=1)
            return ModbusUnit(pair.near, unit_limits(profile), name=profile.name)
        if profile.sampled is None:
            return self._recorded(profile, recording)
        identity = {t.name: "0000" for t in profile.tags.values() if t.type == "string"}
        bank = SampledSensor(profile, self._player(profile, recording), identity)
        return ModbusUnit(bank, unit_limits(profile), name=profile.name)

    def _recorded(self, profile: DeviceProfile, recording: Path | None) -> ModbusUnit:
        """Return a device that replays exchanges: a given recording, or the shipped one under the profile's name.

        Without either, the device is built from its profile alone.
        """
        if recording is None and self._recording_of(profile) is None:
            stderr.print(f"{profile.name}: no recording; every register of its profile begins with 0", soft_wrap=True)
            return self._stated(profile, {})
        path = find_recording(str(recording or f"{Path(profile.path).stem}.jsonl"))
        replay, recorded = load_replay(profile, path)
        stderr.print(f"{profile.name} plays {shown(path)}", soft_wrap=True)
        return ProfiledReplay(profile, replay, recorded)

    def _stated(self, profile: DeviceProfile, values: Mapping[str, float | str]) -> ModbusUnit:
        """Return a device that is defined by its profile and the initial values of its tags alone."""
        bank = ProfileRegisters(profile, values, self._clock.monotonic_ns())
        seen = DistortedRegisters(bank, bank.peek, profile, bank.journal)
        unit = ModbusUnit(seen, unit_limits(profile), name=profile.name, **parts_of(profile))
        add_own_functions(unit, bank, profile)
        if self._faults is not None:
            self._faults.on_values(seen.distortions)
        return unit

    def fault(self, profile: DeviceProfile | None) -> None:
        """Prepare the faults of the device; their times count from now."""
        if self._extras.faults:
            start_ns = round(asyncio.get_running_loop().time() * NS_PER_S)
            self._faults = DeviceFaults(self._extras.faults, profile, self._extras.seed, start_ns)

    @property
    def put_in(self) -> list[Active]:
        """The faults that were injected, once for each endpoint."""
        return self._faults.put_in if self._faults is not None else []

    def replayed(
        self, path: Path, unit_id: int | None, unknown: NeverRecorded, at_end: EndOfRecording
    ) -> dict[int, ModbusUnit]:
        """Return the units of a recording of exchanges, or only the requested one. A single unit answers any unit ID."""
        if header_of(path).kind != "exchanges":
            raise UsageError(
                "a recording of signals needs a device to play it",
                where=str(path),
                hint=f"fieldtwin emulate PROFILE --recording {path.name} --on ...",
            )
        replay = ExchangeReplay(exchanges_of(path), never_recorded=unknown, when_used_up=at_end)
        if not replay.units:
            raise UsageError("the recording holds no exchange", where=str(path))
        stderr.print(f"plays {shown(oldest_part(path))}", soft_wrap=True)
        if replay.context.dropped:
            stderr.print(
                f"  the recording is too long: the oldest {replay.context.dropped} exchanges are left out",
                soft_wrap=True,
            )
        if unit_id is None:
            return {number: ReplayUnit(replay, number, f"{path.name}:{number}") for number in replay.units}
        recorded = replay.units[0] if len(replay.units) == 1 else unit_id
        return {unit_id: ReplayUnit(replay, recorded, f"{path.name}:{recorded}")}

    @staticmethod
    def _recording_of(profile: DeviceProfile) -> str | None:
        """Return the recording that a shipped device replays by default: the one with its profile's name.

        A dump of this name, from which `infer` drafted the profile, does not count as a recording.
        """
        name = DEFAULT_RECORDINGS.get(profile.name, f"{Path(profile.path).stem}.jsonl")
        try:
            found = find_recording(name)
        except UsageError:
            return None
        return None if looks_like_another_file(found) else str(found)

    def _player(self, profile: DeviceProfile, recording: Path | None) -> SignalPlayer:
        name = recording or self._recording_of(profile)
        if name is None:
            raise UsageError(f"{profile.name} needs a recording", hint="--recording FILE")
        path = find_recording(str(name))
        track = SignalTrack.load(path)
        stderr.print(f"{profile.name} plays {shown(path)}", soft_wrap=True)
        return SignalPlayer(track, self._clock.monotonic_ns(), speed=self._speed, at_end=EndOfRecording.LOOP)

    async def serve(self, nursery: Nursery, units: dict[int, ModbusUnit], wire: Endpoint) -> None:
        """Serve Modbus units on a serial port, real or virtual, a serial line over a socket, or Modbus over TCP, UDP or TLS.

        A virtual port is made where there is no port at that path. A line accepts ``mode=ascii``, and ``echo=1`` if the
        client is to receive its own bytes.
        """
        if wire.scheme in SERIAL_SCHEMES and Path(wire.path).is_char_device():
            await self._serve_port(nursery, units, wire)
        elif wire.scheme in ("pty", *SERIAL_SCHEMES):
            await self._serve_pty(nursery, units, wire)
        elif wire.scheme == "rtu+tcp":
            line, echo = _line(wire, units), wire.param("echo") == "1"
            await self._listen(wire, units, lambda c: serve_rtu(c, line, self._clock, as_recorded(), echo=echo), 1)
        elif wire.scheme in ("tcp", "tls"):
            await self._listen(
                wire, units, lambda c: serve_mbap(c, self._mbap(units), self._clock, as_recorded()), MAX_CLIENTS
            )
        elif wire.scheme == "udp":
            end = await UdpEnd.open(wire)
            faults = self._faults.on_wire(Framing.MBAP) if self._faults is not None else None
            datagrams = end if faults is None else FaultyDatagrams(end, faults)
            self._closing.append(datagrams)
            nursery.start(serve_udp(datagrams, self._mbap(units), self._clock, as_recorded()), f"units on {wire}")
            stderr.print(f"units {_list(units)} on {end.bound}", soft_wrap=True)
        else:
            raise UsageError(
                f"cannot emulate on {wire}",
                expected="rtu:PATH, ascii:PATH, pty:PATH, tcp://HOST:PORT, rtu+tcp://HOST:PORT, udp://HOST:PORT or tls://HOST:PORT",
            )

    async def _serve_port(self, nursery: Nursery, units: dict[int, ModbusUnit], wire: Endpoint) -> None:
        """Serve units on an existing port: this process acts as a device on a real line."""
        line: LineSlave = AsciiSlave(units) if wire.scheme == "ascii" else RtuSlave(units)
        end = self._behind_faults(await OsConnector().open_bytes(wire), line)
        self._closing.append(end)
        nursery.start(serve_rtu(end, line, self._clock, as_recorded(wire.serial)), f"units on {wire}")
        stderr.print(
            f"units {_list(units)} on the port {wire.path} ({wire.serial.baudrate} {wire.serial.frame})", soft_wrap=True
        )

    async def _serve_pty(self, nursery: Nursery, units: dict[int, ModbusUnit], wire: Endpoint) -> None:
        line, echo = _line(wire, units), wire.param("echo") == "1"
        scheme = "ascii" if isinstance(line, AsciiSlave) else "rtu"
        settings = tuple((name, value) for name, value in wire.params if name not in LINE_PARAMS)
        plant = Endpoint(scheme, path=wire.path, params=settings)
        end = self._behind_faults(await PtyEnd.open(Path(wire.path), plant, plant.serial), line)
        self._closing.append(end)
        serving = serve_rtu(end, line, self._clock, as_recorded(plant.serial), echo=echo)
        nursery.start(serving, f"units on {wire}")
        framing = f"{plant.serial.baudrate} {plant.serial.frame}" + (", ASCII" if scheme == "ascii" else "")
        stderr.print(f"units {_list(units)} on {wire.path} ({framing})", soft_wrap=True)

    async def _listen(
        self, wire: Endpoint, units: dict[int, ModbusUnit], on_client: OnClient, max_clients: int
    ) -> None:
        if self._faults is not None:
            framing = Framing.MBAP if wire.scheme in ("tcp", "tls") else _framing(_is_ascii(wire))
            on_client = _behind(self._faults.on_wire(framing), on_client)
        listener = await SocketListener.open(wire, on_client, max_clients)
        self._closing.append(listener)
        stderr.print(f"units {_list(units)} on {listener.bound}", soft_wrap=True)

    def _mbap(self, units: dict[int, ModbusUnit]) -> MbapSlave:
        return MbapSlave(units, any_unit=self._extras.any_unit)

    def _behind_faults(self, end: ByteConnection, line: LineSlave) -> ByteConnection:
        if self._faults is None:
            return end
        return FaultyEnd(end, self._faults.on_wire(_framing(isinstance(line, AsciiSlave))))

    async def serve_can(
        self,
        nursery: Nursery,
        profile: DeviceProfile,
        wires: list[Endpoint],
        node_id: int | None,
        recording: Path | None,
        bitrate: int | None,
        options: NodeOptions | None = None,
    ) -> None:
        """Serve a CANopen node on one bus: see `can_here.stand_on_bus`."""
        wire = only_bus(wires)
        played: SignalPlayer | CanLog | None = None
        if recording is not None and recording.suffix == SUFFIX:
            played = CanLog(find_recording(str(recording)))
            stderr.print(f"{profile.name} plays {played.path.name} (a log of a CAN bus)", soft_wrap=True)
        elif recording or self._recording_of(profile):
            played = self._player(profile, recording)
        number, now_ns = node_id or profile.form.factory.node, self._clock.monotonic_ns()
        made = emulated_node(profile, number, played, now_ns, options=options)
        print_remarks(profile.name, made.remarks)
        node = made.node
        opened: list[SoftBusServer | CanConnection] = []
        try:
            connection, where = await stand_on_bus(wire, bitrate, profile.name, opened)
        finally:
            self._closing += opened
        nursery.start(serve_node(connection, node, self._clock), f"node on {wire}")
        stderr.print(f"node {node.node_id} on {where}", soft_wrap=True)

    async def aclose(self) -> None:
        for thing in reversed(self._closing):
            await thing.aclose()


def as_it_was_recorded(wire: Endpoint, recorded: str) -> Endpoint:
    """Return `wire`, with the recording's serial settings where it does not state them and the recording is of a line."""
    then = Endpoint.parse(recorded) if recorded.partition(":")[0] in SERIAL_SCHEMES else None
    if then is None or wire.scheme not in ("pty", *SERIAL_SCHEMES) or _is_ascii(wire) != (then.scheme == "ascii"):
        return wire
    return replace(wire, params=tuple((dict(then.params) | dict(wire.params)).items()))


def _as_from_the_factory(wire: Endpoint, profile: DeviceProfile) -> Endpoint:
    """Return `wire` with the device's factory settings where a virtual port's settings are not stated.

    ASCII keeps its own character frame.
    """
    if wire.scheme not in ("pty", *SERIAL_SCHEMES):
        return wire
    factory = profile.form.factory
    usual = {"baudrate": str(factory.baudrate)}
    if not _is_ascii(wire):
        usual["frame"] = factory.frame
    return replace(wire, params=tuple((usual | dict(wire.params)).items()))


def _is_ascii(wire: Endpoint) -> bool:
    mode = wire.param("mode", "ascii" if wire.scheme == "ascii" else "rtu")
    if mode not in ("rtu", "ascii"):
        raise UsageError(f"endpoint {wire}: mode", expected="rtu or ascii", got=repr(mode))
    return mode == "ascii"


def _line(wire: Endpoint, units: dict[int, ModbusUnit]) -> LineSlave:
    return AsciiSlave(units) if _is_ascii(wire) else RtuSlave(units)


def _framing(ascii_: bool) -> Framing:
    return Framing.ASCII if ascii_ else Framing.RTU


def _behind(faults: WireFaults, serve: OnClient) -> OnClient:
    """Return a server of clients that applies the faults of their connection."""

    async def client(connection: SocketEnd) -> None:
        if faults.refuses(round(asyncio.get_running_loop().time() * NS_PER_S)):
            return
        end = FaultyEnd(connection, faults)
        try:
            await serve(end)  # type: ignore[arg-type]  # a connection like the one that it stands for
        finally:
            await end.aclose()

    return client


def _list(units: dict[int, ModbusUnit]) -> str:
    return ", ".join(map(str, units))
