"""Write a system of one device as files: a test's description of a device becomes the input of a field simulator.

A device in a test therefore has the same emulator, faults and names as in any system. The only I/O of this module is on files.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.testing.worker.sheet_profile import SHEETS, write_profile
from fieldtwin.twin.site.data_files import find, find_recording

DEVICE, BUS = "device", "wire"
RECORDINGS = {"ctd-reference": "cast.jsonl", "inclinometer-cia410": "incl.jsonl"}
"""By name of a shipped profile: the name of its recording, if that differs from the profile's name."""
KINDS = ("pty", "tcp", "udp", "rtu+tcp", "can")


@dataclass(frozen=True)
class DeviceRequest:
    """A test's request for a device.

    `on` is the kind of connection: one of `KINDS`, or ``can:INTERFACE/CHANNEL``; "" selects the usual kind of the device.
    """

    device: str
    on: str = ""
    unit: int | None = None
    recording: str = ""
    values: dict[str, Any] = field(default_factory=dict)
    identity: dict[str, str] = field(default_factory=dict)
    speed: float = 1.0
    at_end: str = "loop"
    pace: bool = False
    seed: int = 1


def write_system(
    wanted: DeviceRequest, folder: Path, profiles: tuple[Path, ...] = (), beside: Path | None = None
) -> Path:
    """Write the system file and its prototype file into `folder`; return the path of the system file.

    `beside` is the folder of the test, which may contain its own profiles, data sheets and recordings. Raises `UsageError`
    for a missing file, `FileInvalid` for an invalid profile or data sheet.
    """
    path = find("devices", wanted.device, beside=beside / "x" if beside else None, extra=profiles)
    if path.suffix.lower() in SHEETS:
        path = write_profile(path, folder)
    profile = load_profile(path)
    plant, listen = _wires(wanted.on or _usual(profile), profile)
    can = plant.startswith("can")
    form = profile.form
    unit = wanted.unit if wanted.unit is not None else form.factory.node if can else form.factory.unit
    system = {
        "fieldtwin": 1,
        "system": "test",
        "buses": {BUS: {"url": plant}},
        "devices": {DEVICE: {"profile": str(path.resolve()), "bus": BUS, "node" if can else "unit": unit}},
    }
    emulated = _stand_in(wanted, profile, path, beside)
    prototype = {
        "prototype_of": "test.yaml",
        "seed": wanted.seed,
        "buses": {BUS: {"listen": listen, "pace": wanted.pace}},
        "devices": {DEVICE: emulated},
    }
    written = folder / "test.yaml"
    written.write_text(yaml.safe_dump(system, sort_keys=False), encoding="utf-8")
    (folder / "test.prototype.yaml").write_text(yaml.safe_dump(prototype, sort_keys=False), encoding="utf-8")
    return written


def _usual(profile: DeviceProfile) -> str:
    if profile.protocol == "canopen":
        return "can"
    return "tcp" if profile.inbox is not None else "pty"


def _wires(on: str, profile: DeviceProfile) -> tuple[str, str]:
    """Return the endpoint of the plant and the endpoint at which the emulator listens."""
    kind = on.partition(":")[0]
    if kind not in KINDS:
        raise UsageError(f"a wire {on!r}", expected=", ".join(KINDS) + ", or can:INTERFACE/CHANNEL")
    if (kind == "can") != (profile.protocol == "canopen"):
        raise UsageError(f"a {profile.protocol} device on {on}", expected="can" if kind != "can" else "pty, tcp or udp")
    if kind == "can":
        return "can:socketcan/none", on if ":" in on else "can:fieldtwin/127.0.0.1:0"
    if kind == "pty":
        factory = profile.form.factory
        return f"rtu:/dev/none?baudrate={factory.baudrate}&frame={factory.frame}", "pty:wire"
    if kind == "rtu+tcp":
        return "rtu+tcp://127.0.0.1:1", "rtu+tcp://127.0.0.1:0"
    return f"{kind}://127.0.0.1:1", f"{kind}://127.0.0.1:0"


def _stand_in(wanted: DeviceRequest, profile: DeviceProfile, path: Path, beside: Path | None) -> dict[str, Any]:
    """Return the device's entry in the prototype file, which selects its emulator.

    The emulator replays the recording that the test names. Without a recording it is a model of the profile, whose registers
    accept writes or, if registers alone are not sufficient, it replays the shipped recording.
    """
    common: dict[str, Any] = {"identity": wanted.identity} if wanted.identity else {}
    if profile.inbox is not None:
        return {"model": "mailbox", "far": "tcp://127.0.0.1:0", **common}
    if wanted.values and profile.protocol == "canopen":
        raise UsageError("values for a CANopen node", expected="values= of a Modbus device, or device.set(TAG, VALUE)")
    named = wanted.recording
    model = profile.sampled is None
    if not named and (not model or profile.protocol == "canopen"):
        named = _shipped(path.stem)
    if named and wanted.values and model:
        raise UsageError("a recording and values", expected="one of them, and set() for single values")
    if named:
        found = find_recording(named, beside=beside / "x" if beside else None)
        playing = {"recording": str(found.resolve()), "speed": wanted.speed, "at_end": wanted.at_end}
        return {**playing, **common}
    if model:
        return {"model": "profile", "values": wanted.values, **common}
    raise UsageError(f"no data source for {profile.name}", expected='recording="FILE.jsonl"')


def _shipped(stem: str) -> str:
    name = RECORDINGS.get(stem, f"{stem}.jsonl")
    try:
        return str(find_recording(name))
    except UsageError:
        return ""


def endpoint_words(endpoint: Endpoint) -> dict[str, Any]:
    """Return an endpoint as plain data.

    It contains `url`, and those of `path`, `host`, `port`, `interface`, `channel`, `baudrate`, `frame` that apply.
    """
    words: dict[str, Any] = {"url": str(endpoint)}
    if endpoint.scheme == "pty" or endpoint.is_serial:
        words["path"] = endpoint.path
        if endpoint.is_serial:
            settings = endpoint.serial
            words |= {"baudrate": settings.baudrate, "frame": settings.frame}
    elif endpoint.is_can:
        words |= {"interface": endpoint.interface, "channel": endpoint.path}
    if (
        endpoint.scheme != "pty"
        and not endpoint.is_serial
        and (not endpoint.is_can or endpoint.interface == "fieldtwin")
    ):
        host, port = endpoint.address
        words |= {"host": host, "port": port}
    return words
