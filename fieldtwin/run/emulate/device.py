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
from fieldtwin.emulators.context import EndOfRecording
from fieldtwin.emulators.device_faults import DeviceFaults
from fieldtwin.emulators.endpoints.ports import OsPorts
from fieldtwin.emulators.faults.frames import framing_of
from fieldtwin.emulators.host import EmulatorHost, ModbusWire
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.emulators.models.canopen.emulated_node import NodeOptions, emulated_node
from fieldtwin.emulators.models.modbus.emulated_modbus import (
    ConnectionKind,
    EmulatedModbus,
    mailbox_device,
    recorded_device,
    register_device,
    sampled_device,
)
from fieldtwin.emulators.models.modbus.mailbox_modem import ModemPair
from fieldtwin.emulators.models.modbus.recorded_device import load_replay
from fieldtwin.emulators.replay.can_log import CanLog
from fieldtwin.emulators.replay.replay import ExchangeReplay, NeverRecorded
from fieldtwin.emulators.replay.unit import ReplayUnit
from fieldtwin.emulators.signals import SignalPlayer, SignalTrack
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.concurrency.stop_signal import stop_signal
from fieldtwin.gateway.core.connection import RS232Connection, TCPConnection
from fieldtwin.gateway.core.endpoint import SERIAL_SCHEMES, Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.candump import SUFFIX
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.files.recording import looks_like_another_file, shown
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.run.emulate.can_bus import only_bus, open_bus
from fieldtwin.run.emulate.data_sheet import print_remarks, report_second_node
from fieldtwin.run.emulate.fault_counts import effect_text
from fieldtwin.run.emulate.serve_until import serve_until
from fieldtwin.twin.site.data_files import find_recording

DEFAULT_RECORDINGS = {"fieldtwin/ctd-reference": "cast.jsonl", "fieldtwin/inclinometer-cia410": "incl.jsonl"}
"""Shipped reference devices whose recording has a different name than their profile."""
LINE_PARAMS = ("mode", "echo")
"""Parameters of an emulated line, apart from its serial settings."""


@dataclass(frozen=True)
class ModbusExtras:
    """Optional settings of a Modbus device.

    `values` are the initial values of its tags (None: its recording, or zeros), `faults` the faults as a fault file
    states them, `seed` the seed of random choices; with `any_unit` the device answers every unit ID on TCP.
    """

    values: Mapping[str, float | str] | None = None
    faults: tuple[dict[str, Any], ...] = ()
    seed: int = 1
    any_unit: bool = False


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
    extras: ModbusExtras | None = None,
) -> int:
    """Serve until SIGINT or SIGTERM; raise the error that ended the serving.

    `bitrate` is for a CAN bus, None for the default. `unknown` and `at_end` are for a recording without a profile: the
    reply to a request that was never recorded, and the behaviour at the end of the recording. `options` are for a
    CANopen node, `extras` for a Modbus device.
    """
    extras = extras or ModbusExtras()
    clock, stop = WallClock(), stop_signal()
    host = EmulatorHost(clock, OsPorts())
    wires = [Endpoint.parse(url) for url in endpoints]
    profile = load_profile(path) if kind != "recording" else None
    units: dict[int, ModbusUnit] = {}
    faults = None
    if extras.faults:  # the times of the faults count from now
        start_ns = round(asyncio.get_running_loop().time() * NS_PER_S)
        faults = DeviceFaults(extras.faults, profile, extras.seed, start_ns)
    try:
        if profile is None:
            units = replayed_units(path, unit_id, unknown, at_end)
            wires = [as_it_was_recorded(wire, header_of(path).endpoint) for wire in wires]
        elif profile.protocol == "canopen":
            await _serve_node(host, clock, profile, only_bus(wires), unit_id, recording, speed, bitrate, options)
        elif options is not None:
            raise UsageError("--model and --defaults are for a CANopen node", got=profile.name)
        else:
            wires = [_as_from_the_factory(wire, profile) for wire in wires]
            made = _modbus_device(profile, _kind(profile, wires), recording, extras.values, speed, clock)
            if faults is not None:
                faults.on_values(made.distortions)
            units = {unit_id or profile.form.factory.unit: made.unit}
        if units:
            for wire in wires:
                await serve_units(host, wire, units, faults, any_unit=extras.any_unit)
        await serve_until(stop, host)
    finally:
        await host.aclose()
        for active in faults.put_in if faults is not None else ():
            stderr.print(effect_text(active), soft_wrap=True, markup=False)
    return 0


# -- the device ---------------------------------------------------------------------------------------------------------


def _modbus_device(
    profile: DeviceProfile,
    kind: ConnectionKind,
    recording: Path | None,
    values: Mapping[str, float | str] | None,
    speed: float,
    clock: Clock,
) -> EmulatedModbus:
    """Return the device that a Modbus profile describes, with `values` or the values of a recording.

    The recording is `recording`, or the shipped one under the profile's name. Without any of them, the
    registers begin with 0, or with the nearest value in their range.
    """
    if values is not None:
        return register_device(profile, kind, values, clock.monotonic_ns())
    if profile.inbox is not None:
        pair = ModemPair(profile, bytes_per_s=400, latency_s=0.2, loss=0.0, seed=1)
        return mailbox_device(profile, kind, pair.near)
    if profile.sampled is not None:
        identity = {t.name: "0000" for t in profile.tags.values() if t.type == "string"}
        return sampled_device(profile, kind, _player(profile, recording, speed, clock), identity)
    if recording is None and _recording_of(profile) is None:
        stderr.print(
            f"{profile.name}: no recording; the registers of its profile begin with 0, or with the nearest value in their range",
            soft_wrap=True,
        )
        return register_device(profile, kind, {}, clock.monotonic_ns())
    path = find_recording(str(recording or f"{Path(profile.path).stem}.jsonl"))
    replay, recorded = load_replay(profile, path)
    stderr.print(f"{profile.name} plays {shown(path)}", soft_wrap=True)
    return recorded_device(profile, kind, replay, recorded)


def replayed_units(
    path: Path, unit_id: int | None, unknown: NeverRecorded, at_end: EndOfRecording
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


def _kind(profile: DeviceProfile, wires: list[Endpoint]) -> ConnectionKind:
    """Return the kind of connection of the emulated device, which is that of its first endpoint. A modem always counts as TCP."""
    on_line = plant_of(wires[0]).is_serial and profile.inbox is None
    return RS232Connection if on_line else TCPConnection


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


def _player(profile: DeviceProfile, recording: Path | None, speed: float, clock: Clock) -> SignalPlayer:
    name = recording or _recording_of(profile)
    if name is None:
        raise UsageError(f"{profile.name} needs a recording", hint="--recording FILE")
    path = find_recording(str(name))
    track = SignalTrack.load(path)
    stderr.print(f"{profile.name} plays {shown(path)}", soft_wrap=True)
    return SignalPlayer(track, clock.monotonic_ns(), speed=speed, at_end=EndOfRecording.LOOP)


# -- its endpoints ------------------------------------------------------------------------------------------------------


async def serve_units(
    host: EmulatorHost,
    wire: Endpoint,
    units: Mapping[int, ModbusUnit],
    faults: DeviceFaults | None = None,
    *,
    any_unit: bool = False,
) -> None:
    """Serve Modbus units on a serial port, real or virtual, a serial line over a socket, or Modbus over TCP, UDP or TLS.

    A virtual port is made if the path does not exist. A line accepts ``mode=ascii``, and ``echo=1`` if the
    client is to receive its own bytes.
    """
    if wire.is_can:
        raise UsageError(
            f"cannot emulate on {wire}",
            expected="rtu:PATH, ascii:PATH, pty:PATH, tcp://HOST:PORT, rtu+tcp://HOST:PORT, udp://HOST:PORT or tls://HOST:PORT",
        )
    named = f"units {', '.join(map(str, units))} on"
    plant, listen = plant_of(wire), wire
    if wire.scheme in SERIAL_SCHEMES and not Path(wire.path).is_char_device():
        listen = Endpoint("pty", path=wire.path)
    served = ModbusWire(str(wire), listen, plant, echo=wire.param("echo") == "1", any_unit=any_unit)
    on_wire = None if faults is None else faults.on_wire(framing_of(plant))
    if listen.scheme in SERIAL_SCHEMES:  # the port exists: this process acts as a device on a real line
        host.serve_line(served, units, await OsConnector().open_bytes(wire), on_wire)
        stderr.print(f"{named} the port {wire.path} ({wire.serial.baudrate} {wire.serial.frame})", soft_wrap=True)
        return
    bound = await host.serve_units(served, units, on_wire)
    if bound.scheme == "pty":
        framing = f"{plant.serial.baudrate} {plant.serial.frame}" + (", ASCII" if plant.scheme == "ascii" else "")
        stderr.print(f"{named} {wire.path} ({framing})", soft_wrap=True)
    else:
        stderr.print(f"{named} {bound}", soft_wrap=True)


async def _serve_node(
    host: EmulatorHost,
    clock: Clock,
    profile: DeviceProfile,
    wire: Endpoint,
    node_id: int | None,
    recording: Path | None,
    speed: float,
    bitrate: int | None,
    options: NodeOptions | None,
) -> None:
    """Serve a CANopen node on one bus: see `can_bus.open_bus`."""
    played: SignalPlayer | CanLog | None = None
    if recording is not None and recording.suffix == SUFFIX:
        played = CanLog(find_recording(str(recording)))
        stderr.print(f"{profile.name} plays {played.path.name} (a log of a CAN bus)", soft_wrap=True)
    elif recording or _recording_of(profile):
        played = _player(profile, recording, speed, clock)
    number, now_ns = node_id or profile.form.factory.node, clock.monotonic_ns()
    made = emulated_node(profile, number, played, now_ns, options=options)
    print_remarks(profile.name, made.remarks)
    report_second_node(made.node)
    port, where = await open_bus(wire, bitrate)
    await host.serve_nodes(str(wire), port, {profile.name: made.node})
    stderr.print(f"node {made.node.node_id} on {where}", soft_wrap=True)


def as_it_was_recorded(wire: Endpoint, recorded: str) -> Endpoint:
    """Return `wire`; if it does not state serial settings and the recording was made on a serial line, add the settings of the
    recording.
    """
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


def plant_of(wire: Endpoint) -> Endpoint:
    """Return the serial line that `wire` represents (a virtual or real port, or a line over TCP), with its framing and serial
    settings; for any other connection, `wire` itself.
    """
    if wire.scheme not in ("pty", "rtu+tcp", *SERIAL_SCHEMES):
        return wire
    settings = tuple((name, value) for name, value in wire.params if name not in LINE_PARAMS)
    return Endpoint("ascii" if _is_ascii(wire) else "rtu", path=wire.path, params=settings)


def _is_ascii(wire: Endpoint) -> bool:
    mode = wire.param("mode", "ascii" if wire.scheme == "ascii" else "rtu")
    if mode not in ("rtu", "ascii"):
        raise UsageError(f"endpoint {wire}: mode", expected="rtu or ascii", got=repr(mode))
    return mode == "ascii"
