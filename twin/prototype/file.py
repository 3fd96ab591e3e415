"""The prototype file: which devices are emulated, from which data source, and at which endpoint.

The process of the simulated field devices and its starter read it; the plant, gateway and PLC never do.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.candump import SUFFIX
from fieldtwin.gateway.core.files.error_collector import ErrorCollector, collecting
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.files.recording import shown
from fieldtwin.gateway.core.files.yaml_file import Key, YamlFile, load, validate
from fieldtwin.twin.prototype.simulations import check_plays, check_simulations
from fieldtwin.twin.site.data_files import find, find_recording
from fieldtwin.twin.site.schema import EmulatedForm, PrototypeForm
from fieldtwin.twin.site.system import System


@dataclass(frozen=True)
class EmulatedBus:
    """A bus of the prototype. `listen` is the endpoint at which its emulators listen; None: the plant's own bus is used.
    `pace`: a CAN bus takes as much time for a frame as its bit rate requires.
    """

    name: str
    listen: Endpoint | None
    pace: bool


@dataclass(frozen=True)
class EmulatedDevice:
    """An emulated device: its own profile, and a recording, a simulation or a model."""

    name: str
    profile: DeviceProfile
    form: EmulatedForm
    recording: Path | None

    @property
    def plays(self) -> str:
        """Return a description of the data source for users. Synthetic data is never described as measured."""
        if self.form.simulation is not None:
            return f"the simulation {self.form.simulation}"
        if self.recording is None:
            return f"the model {self.form.model}"
        return f"{self.recording.name} (log of a CAN bus)" if self.recording.suffix == SUFFIX else shown(self.recording)


@dataclass(frozen=True)
class Prototype:
    """A prototype file, in which each name of a bus, device or tag is resolved in the system."""

    path: Path
    seed: int
    buses: dict[str, EmulatedBus]
    devices: dict[str, EmulatedDevice]
    file: YamlFile
    form: PrototypeForm

    def with_listen(self, system: System, bus: str, listen: Endpoint) -> Prototype:
        """Return a copy in which the emulators of `bus` of `system` listen at a different endpoint.

        Raises `UsageError` if another bus uses that endpoint.
        """
        buses = {**self.buses, bus: replace(self.buses[bus], listen=listen)}
        if (clash := _clash(system, buses)) is not None:
            raise UsageError(clash.message, expected=clash.expected, got=f"{bus}={listen}")
        return replace(self, buses=buses)

    def with_recording(self, device: str, path: Path, speed: float | None = None) -> Prototype:
        """Return a copy in which `device` replays the recording in `path`, `speed` times as fast if given."""
        old = self.devices[device]
        form = old.form.model_copy(
            update={"recording": str(path), "simulation": None, "plays": {}, **({"speed": speed} if speed else {})}
        )
        return replace(self, devices={**self.devices, device: replace(old, form=form, recording=path)})

    def with_speed(self, speed: float) -> Prototype:
        """Return a copy in which every recording is replayed `speed` times as fast."""
        devices = {
            n: replace(d, form=d.form.model_copy(update={"speed": speed})) if d.recording else d
            for n, d in self.devices.items()
        }
        return replace(self, devices=devices)


def prototype_path(system: System) -> Path:
    """Return the default path of a system's prototype file: ``NAME.prototype.yaml`` in the same folder."""
    return system.path.with_name(f"{system.path.stem}.prototype.yaml")


def load_prototype(system: System, path: Path | None = None, errors: ErrorCollector | None = None) -> Prototype:
    """Read the prototype file of `system`. Raises `FileInvalid` or `UsageError`.

    With `errors`, the errors of separate entries are added to it, and the result contains the entries without error, which
    must not be run. `system` may have been read in the same way.
    """
    if path is None and not prototype_path(system).exists():
        if not system.file.section("buses"):  # nothing has to be emulated
            form = PrototypeForm(prototype_of=system.path.name)
            with collecting(errors) as collector:
                return _resolve(system.file, form, system.path, system, collector)
        raise FileInvalid(
            f"there is no prototype file of {system.path.name}",
            path=str(prototype_path(system)),
            expected="a file that states which devices are emulated, how, and where",
            hint="copy one of profiles/systems/, or name one with --prototype-file",
        )
    path = path or prototype_path(system)
    file = load(path)
    form = validate(file, PrototypeForm)
    if Path(form.prototype_of).name != system.path.name:
        raise file.error(
            ("prototype_of",),
            "`prototype_of` names a different system file",
            expected=system.path.name,
            got=form.prototype_of,
        )
    with collecting(errors) as collector:
        return _resolve(file, form, path, system, collector)


def _resolve(file: YamlFile, form: PrototypeForm, path: Path, system: System, errors: ErrorCollector) -> Prototype:
    for section, names in (("buses", form.buses), ("devices", form.devices)):
        declared = list(system.file.section(section))
        for name in names:
            if name not in declared:
                what = "bus" if section == "buses" else "device"
                error = file.error(
                    (section, name),
                    f"the system has no {what} {name!r}",
                    expected=", ".join(declared),
                    hint=did_you_mean(name, declared),
                )
                errors.add(error)
    check_simulations(file, form, system, errors)
    buses: dict[str, EmulatedBus] = {}
    for name in system.buses:
        with errors.collect():
            buses[name] = _bus(file, system, form, name)
    with errors.collect():
        _check_wires(file, system, buses)
    emulated = [n for n, d in system.devices.items() if d.bus in buses and buses[d.bus].listen is not None]
    devices: dict[str, EmulatedDevice] = {}
    for name in emulated:
        if name in form.devices:
            with errors.collect():
                devices[name] = _device(file, system, name, form, errors)
    if missing := [name for name in emulated if name not in form.devices]:
        errors.add(file.error(("devices",), f"no entry for {', '.join(missing)}", expected="an entry each"))
    return Prototype(path, form.seed, buses, devices, file, form)


def _bus(file: YamlFile, system: System, form: PrototypeForm, name: str) -> EmulatedBus:
    entry = form.buses.get(name)
    if entry is None:
        raise file.error(
            ("buses",), f"the bus {name!r} is not mapped", expected=f"`{name}: {{listen: ...}}`, or `{name}: plant`"
        )
    if entry == "plant":
        return EmulatedBus(name, None, False)
    assert not isinstance(entry, str)
    try:
        listen = Endpoint.parse(entry.listen)
    except UsageError as e:
        raise file.error(("buses", name, "listen"), e.message, expected=e.expected, got=e.got) from e
    plant = system.buses[name].endpoint
    kinds = ("can",) if plant.is_can else ("pty", "tcp") if plant.is_serial else (plant.scheme,)
    if listen.scheme not in kinds:
        raise file.error(
            ("buses", name, "listen"),
            f"no endpoint that replaces {plant}",
            expected=" or ".join(kinds),
            got=listen.scheme,
        )
    return EmulatedBus(name, listen, entry.pace)


def _anywhere(listen: Endpoint) -> bool:
    """Return whether the operating system chooses a free port for the endpoint, so that it cannot clash."""
    if listen.is_can:
        return listen.path.endswith(":0")
    return listen.scheme != "pty" and listen.port == 0


class _Clash(NamedTuple):
    """Two buses that cannot share an endpoint: the second and the first, and the nodes with the same id, if any."""

    buses: tuple[str, str]
    nodes: tuple[str, str] | None
    message: str
    expected: str


def _clash(system: System, buses: Mapping[str, EmulatedBus]) -> _Clash | None:
    """Return the first clash between buses, if any.

    Several CAN buses may share one software bus if all their nodes have different ids; a duplicate ID is a fault, which has to
    be injected (`duplicate-node`). A port or a socket belongs to one bus.
    """
    wires: dict[Endpoint, str] = {}
    nodes: dict[tuple[Endpoint, int], str] = {}
    for name, bus in buses.items():
        if bus.listen is None or _anywhere(bus.listen):
            continue  # the plant's own bus, or a free port
        wire = replace(bus.listen, params=())
        other = wires.setdefault(wire, name)
        if other != name and not wire.is_can:
            said = f"{name!r} listens at {wire}, and so does {other!r}"
            return _Clash((name, other), None, said, "a separate endpoint for each bus")
        for device in system.devices_on(name) if wire.is_can else ():
            first = nodes.setdefault((wire, device.address), device.name)
            if first != device.name:
                other = system.devices[first].bus
                said = f"{device.name!r} of {name!r} has node id {device.address} at {wire}, and so has {first!r} of {other!r}"
                return _Clash(
                    (name, other), (device.name, first), said, "a separate bus for each, or different node IDs"
                )
    return None


def _check_wires(file: YamlFile, system: System, buses: Mapping[str, EmulatedBus]) -> None:
    clash = _clash(system, buses)
    if clash is None:
        return
    hint = f"{clash.buses[1]!r} is in line {file.line(('buses', clash.buses[1]))}"
    if clash.nodes is not None:
        lines = [f"{node!r} in line {system.file.line(('devices', node))}" for node in clash.nodes]
        hint += f"; of {system.path.name}: {' and '.join(lines)}. To test two nodes with one ID, use the fault duplicate-node"
    raise file.error(("buses", clash.buses[0], "listen"), clash.message, expected=clash.expected, hint=hint)


def _device(file: YamlFile, system: System, name: str, whole: PrototypeForm, errors: ErrorCollector) -> EmulatedDevice:
    config, form = system.devices[name], whole.devices[name]
    loc = ("devices", name)
    profile = config.profile
    if form.profile is not None:
        try:
            profile = load_profile(find("devices", form.profile, beside=file_path(file)))
        except UsageError as e:
            raise file.error((*loc, "profile"), e.message, expected=e.expected, hint=e.hint) from e
    if [form.recording, form.model, form.simulation].count(None) != 2:
        raise file.error(
            loc,
            f"the data source of {name!r}",
            expected="one of `recording: FILE`, `simulation: NAME` and `model: NAME`",
        )
    check_plays(file, whole, name, profile, errors)
    if form.model == "mailbox" and (profile.inbox is None or form.far is None):
        raise file.error(
            loc, f"the mailbox model for {name!r}", expected="a profile with a mailbox, and `far: ENDPOINT`"
        )
    if form.model == "profile" and (profile.sampled is not None or profile.inbox is not None):
        expected = "`recording: FILE`, of its signals" if profile.sampled is not None else "`model: mailbox`"
        raise file.error((*loc, "model"), f"{name!r} needs more than its registers", expected=expected)
    _check_stated(file, loc, form, profile, errors)
    recording = None
    if form.recording is not None:
        try:
            recording = find_recording(form.recording, beside=file_path(file))
        except UsageError as e:
            raise file.error((*loc, "recording"), e.message, expected=e.expected, hint=e.hint) from e
        if recording.suffix == SUFFIX and profile.protocol != "canopen":
            raise file.error(
                (*loc, "recording"), "a log of a CAN bus", expected="a recording (JSON Lines)", got=recording.name
            )
    for tag in form.identity:
        if tag not in profile.tags:
            errors.add(_no_tag(file, (*loc, "identity", tag), profile, tag))
    return EmulatedDevice(name, profile, form, recording)


def _no_tag(file: YamlFile, loc: tuple[Key, ...], profile: DeviceProfile, tag: str) -> FileInvalid:
    return file.error(
        loc,
        f"{profile.name} has no tag {tag!r}",
        expected=", ".join(profile.tags),
        hint=did_you_mean(tag, profile.tags),
    )


def _check_stated(
    file: YamlFile, loc: tuple[Key, ...], form: EmulatedForm, profile: DeviceProfile, errors: ErrorCollector
) -> None:
    """Check keys that apply to some devices only: `busy` to Modbus devices, `values` to Modbus devices without a
    recording, and the keys about a data sheet to CANopen devices."""
    for key, said in (("cia", form.cia is not None), ("parameter_values", not form.parameter_values)):
        if said and profile.protocol != "canopen":
            raise file.error(
                (*loc, key), f"`{key}` applies to devices with a data sheet (EDS)", expected="a CANopen device"
            )
    if form.busy is not None and profile.protocol != "modbus":
        raise file.error((*loc, "busy"), "no key of this protocol", expected="a Modbus device")
    if profile.sampled is not None:
        period = profile.sampled.period
        for tag, value in form.values.items():
            if tag != period or not isinstance(value, int) or isinstance(value, bool):
                expected = (
                    f"only `{period}: SECONDS`, a whole number; signals give the other values of a sensor that samples"
                )
                errors.add(file.error((*loc, "values", tag), "a value of a register", expected=expected))
        return
    if form.values and ((form.model != "profile" and form.simulation is None) or profile.protocol != "modbus"):
        expected = "`model: profile` or a simulation, of a Modbus device"
        raise file.error((*loc, "values"), "values of registers", expected=expected)
    for tag in form.values:
        if tag not in profile.tags:
            errors.add(_no_tag(file, (*loc, "values", tag), profile, tag))


def file_path(file: YamlFile) -> Path:
    """Return the path of a parsed file."""
    return Path(file.path)
