"""The system: a system file, resolved and checked as a whole. The plant and its prototype both start from it.

Every error that can be found without a connection is found here, and reported with file, line and column: unknown buses
and profiles, two devices with the same address, tags that no profile has, programs whose variables are bound to no tag. This
module does not know which devices are emulated.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.error_collector import ErrorCollector, FollowingError, collecting
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.files.profile import DeviceProfile, Tag
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.files.yaml_file import Key, YamlFile, load, validate
from fieldtwin.gateway.devices.config import BusConfig, DeviceConfig, Heartbeat, Tpdo
from fieldtwin.gateway.devices.data_sheet import check_data_sheet
from fieldtwin.twin.site.alarm_forms import AlarmForm
from fieldtwin.twin.site.canopen_keys import canopen_bus, canopen_node, check_rpdo1
from fieldtwin.twin.site.data_files import find
from fieldtwin.twin.site.exported_tags import ExportedTag, resolve_exported_tags
from fieldtwin.twin.site.groups import kind_of
from fieldtwin.twin.site.modbus_keys import connect_pauses, device_pace, modbus_bus
from fieldtwin.twin.site.read_back_warnings import never_read_back, read_only_once
from fieldtwin.twin.site.references import no_device
from fieldtwin.twin.site.schema import BusForm, CommandsForm, DeviceForm, InvariantsForm, PlcForm, SystemForm
from fieldtwin.twin.site.serving import Serving, resolve_serving
from fieldtwin.twin.site.start_warnings import waits_for_its_command

SCHEMES = ("rtu", "ascii", "tcp", "rtu+tcp", "udp", "tls", "can")
"""The endpoint schemes that the gateway supports."""


@dataclass(frozen=True)
class System:
    """A resolved system.

    Dictionaries keep the file's order. `hash` identifies a version of the file. `warnings` are for the file's author,
    each with its place in the file.
    """

    name: str
    path: Path
    hash: str
    buses: dict[str, BusConfig]
    devices: dict[str, DeviceConfig]
    plc: PlcForm
    remote: str
    file: YamlFile
    serving: Serving = field(default_factory=Serving)
    commands: CommandsForm = field(default_factory=CommandsForm)
    warnings: tuple[str, ...] = ()
    invariants: InvariantsForm = field(default_factory=InvariantsForm)
    exported_tags: tuple[ExportedTag, ...] = ()
    alarms: dict[str, AlarmForm] = field(default_factory=dict)

    def devices_on(self, bus: str) -> list[DeviceConfig]:
        """Return the devices of a bus, in the file's order."""
        return [d for d in self.devices.values() if d.bus == bus]

    def number_of(self, name: str, value: float | str | bool | None) -> float | str | bool | None:
        """Return the number for a name in the `values` of the tag DEVICE.TAG, and every other value unchanged."""
        device, _, tag = name.rpartition(".")
        tags = self.devices[device].profile.tags if device in self.devices else {}
        return tags[tag].number_of(value) if tag in tags and isinstance(value, str) else value


def load_system(name: str, profiles: Iterable[Path] = (), errors: ErrorCollector | None = None) -> System:
    """Read a system by path or bare name. Raises `FileInvalid` or `UsageError`.

    With `errors`, the errors of separate entries are added to it, and the result contains the entries without error. Such
    a result is for checks of other files that refer to the system; it must not be run.
    """
    path = find("systems", name, extra=profiles)
    file = load(path)
    if kind := kind_of(file.data):
        systems = file.data.get("systems")
        named = ", ".join(map(str, systems)) if isinstance(systems, dict) else ""
        hint = f"run --prototype, simulate and test take a {kind}" + (f"; its systems are {named}" if named else "")
        raise file.error((kind,), f"a {kind}, not a system", expected="a system file", hint=hint)
    form = validate(file, SystemForm)
    with collecting(errors) as collector:
        return _resolve(file, form, path, tuple(profiles), collector)


def _check_sections(file: YamlFile, form: SystemForm) -> None:
    """Raise `FileInvalid` for buses without devices, and for a system with neither devices nor programs."""
    if form.buses and not form.devices:
        raise file.error(("buses",), "no device is on the buses", expected="`devices` with at least one device")
    if not form.devices and not form.plc.programs:
        expected = "`buses` and `devices`, or `plc` with a program that needs no field devices"
        raise file.error((), "a system without devices and programs", expected=expected)


def _resolve(
    file: YamlFile, form: SystemForm, path: Path, profiles: tuple[Path, ...], errors: ErrorCollector
) -> System:
    _check_sections(file, form)
    buses: dict[str, BusConfig] = {}
    for name, bus in form.buses.items():
        with errors.collect():
            buses[name] = _bus(file, name, bus)
    known: dict[Path, DeviceProfile] = {}  # a profile that a hundred devices use is read only once
    devices: dict[str, DeviceConfig] = {}
    for name, device in form.devices.items():
        with errors.collect():
            devices[name] = _device(file, name, device, buses, path, profiles, known, errors)
    buses = connect_pauses(buses, form, devices)
    plc = _with_configured_tasks(file, form.plc, path.parent, errors)
    _check_addresses(file, buses, devices, errors)
    system = System(
        name=form.system,
        path=path,
        hash=hashlib.sha256(path.read_bytes()).hexdigest()[:16],
        buses=buses,
        devices=devices,
        plc=plc,
        remote=form.remote,
        file=file,
        commands=form.commands,
        invariants=form.invariants,
        warnings=never_read_back(file, devices)
        + read_only_once(file, devices)
        + waits_for_its_command(file, form.plc, devices),
        serving=resolve_serving(file, form.serve, form.bridge, buses, devices, plc, path.parent, errors),
        alarms=form.alarms,
        exported_tags=resolve_exported_tags(file, form.metrics, devices, errors),
    )
    _check_programs(system, errors)
    _check_write_groups(system, errors)
    return system


def _with_configured_tasks(file: YamlFile, plc: PlcForm, folder: Path, errors: ErrorCollector) -> PlcForm:
    """Return `plc` with the tasks in the sources of its programs, if it needs them."""
    texts = any(form.source.partition(":")[0].strip() != "python" for form in plc.programs.values())
    if not texts or plc.model_fields_set & {"tasks", "cycle_ms"}:
        return plc
    from fieldtwin.twin.site.programs.configured_tasks import (
        with_configured_tasks,  # load the compiler only if it is needed
    )

    return with_configured_tasks(file, plc, folder, errors)


def _outputs(plc: PlcForm) -> list[str]:
    return [tag for program in plc.programs.values() for tag in program.outputs.values()]


def _bus(file: YamlFile, name: str, form: BusForm) -> BusConfig:
    try:
        endpoint = Endpoint.parse(form.url)
        if endpoint.scheme == "pty":
            raise UsageError(
                "only an emulator can create a pty", expected="the plant's endpoint, such as rtu:/dev/ttyS0"
            )
        if endpoint.scheme not in SCHEMES:
            raise UsageError(f"this version does not support {endpoint.scheme}", expected=", ".join(SCHEMES))
    except UsageError as e:
        raise file.error(("buses", name, "url"), e.message, expected=e.expected, got=e.got) from e
    canopen = canopen_bus(file, name, form, is_can=endpoint.is_can)
    return replace(modbus_bus(file, name, form, endpoint), canopen=canopen)


def _device(
    file: YamlFile,
    name: str,
    d: DeviceForm,
    buses: dict[str, BusConfig],
    path: Path,
    profiles: Iterable[Path],
    known: dict[Path, DeviceProfile],
    errors: ErrorCollector,
) -> DeviceConfig:
    loc: tuple[Key, ...] = ("devices", name)
    if d.bus not in buses:
        if d.bus in file.section("buses"):
            raise FollowingError(f"the bus {d.bus!r} has an error", path=file.path)
        raise file.error(
            (*loc, "bus"), f"no bus {d.bus!r}", expected="one of " + ", ".join(buses), hint=did_you_mean(d.bus, buses)
        )
    try:
        found = find("devices", d.profile, beside=path, extra=profiles)
        if found not in known:
            profile = load_profile(found)
            check_data_sheet(profile)
            known[found] = profile
        profile = known[found]
    except UsageError as e:
        raise file.error((*loc, "profile"), e.message, expected=e.expected, hint=e.hint) from e
    is_can = buses[d.bus].endpoint.is_can
    if is_can != (profile.protocol == "canopen"):
        raise file.error((*loc, "bus"), f"a {profile.protocol} device on {buses[d.bus].endpoint}")
    if profile.inbox is not None and buses[d.bus].endpoint.is_serial:
        raise file.error((*loc, "bus"), f"a transmitter on {buses[d.bus].endpoint}", expected="a bus on TCP")
    address, wanted = (d.node, "node") if is_can else (d.unit, "unit")
    if address is None:
        raise file.error(loc, f"the key {wanted!r} is missing", expected=f"{wanted}: 1, the device's {wanted} ID")
    config = DeviceConfig(
        name=name,
        profile=profile,
        bus=d.bus,
        address=address,
        poll={group: p.every_ms for group, p in d.poll.items()},
        expect=dict(d.expect),
        stale_after_ms=d.stale_after_ms,
        writable=frozenset(d.writable),
        safe=_safe_outputs(file, loc, d, profile, errors),
        write_groups={group: tuple(tags) for group, tags in d.write_groups.items()},
        heartbeat=Heartbeat(d.heartbeat.producer_ms, d.heartbeat.consumer_ms) if d.heartbeat else None,
        tpdo1=Tpdo(tuple(d.tpdo1.map), d.tpdo1.event_ms) if d.tpdo1 else None,
        start=d.start,
        canopen=canopen_node(file, loc, d, path, profiles, is_can=is_can),
    )
    _check_device(file, loc, d, config, errors)
    check_rpdo1(file, loc, d, profile, bool(buses[d.bus].canopen.sync_ms))
    return device_pace(file, loc, d, config)


def _check_device(
    file: YamlFile, loc: tuple[Key, ...], d: DeviceForm, config: DeviceConfig, errors: ErrorCollector
) -> None:
    """Check that every tag and poll group in the device's entry exists in its profile and fits its use."""
    profile = config.profile
    groups = [*profile.groups, *(["inbox"] if profile.inbox else [])]
    for group in d.poll:
        if group not in groups:
            error = file.error(
                (*loc, "poll", group),
                f"no poll group {group!r}",
                expected=", ".join(groups),
                hint=did_you_mean(group, groups),
            )
            errors.add(error)
    for tag in d.expect:
        with errors.collect():
            _known(file, (*loc, "expect", tag), profile, tag)
    for i, tag in enumerate(d.tpdo1.map if d.tpdo1 else []):
        with errors.collect():
            _known(file, (*loc, "tpdo1", "map", i), profile, tag)


def _safe_outputs(
    file: YamlFile, loc: tuple[Key, ...], d: DeviceForm, profile: DeviceProfile, errors: ErrorCollector
) -> dict[str, int | float]:
    """Check `writable` and `safe`. Return the safe value of each tag as a number; the file may give the name of a value."""
    mailbox = {"outbox", "inbox_ack"} if profile.inbox else set()
    for i, tag in enumerate(d.writable):
        if tag not in mailbox:
            with errors.collect():
                _writable(file, (*loc, "writable", i), profile, tag)
    numbers: dict[str, int | float] = {}
    for tag, given in d.safe.items():
        with errors.collect():
            numbers[tag] = _safe_output(file, (*loc, "safe", tag), d, profile, tag, given)
    return numbers


def _safe_output(
    file: YamlFile, loc: tuple[Key, ...], d: DeviceForm, profile: DeviceProfile, tag: str, given: float | bool | str
) -> int | float:
    described = _writable(file, loc, profile, tag)
    if tag not in d.writable:
        raise file.error(loc, f"{tag!r} has a safe value and is not in `writable`")
    value = described.number_of(given)
    names = [name for _, name in described.values]
    if isinstance(value, str) or (isinstance(given, bool) and not described.is_bit):
        raise file.error(
            loc,
            f"the safe value of {tag!r}",
            expected=" or ".join(["true or false" if described.is_bit else "a number", *names]),
            got=str(given).lower() if isinstance(given, bool) else repr(given),
            hint=did_you_mean(value, names) if isinstance(value, str) else "",
        )
    limits = described.limits
    if limits and not limits[0] <= value <= limits[1]:
        raise file.error(loc, f"the safe value of {tag!r}", expected=f"{limits[0]:g} to {limits[1]:g}", got=f"{given}")
    return int(value) if isinstance(value, bool) else value


def _known(file: YamlFile, loc: tuple[Key, ...], profile: DeviceProfile, tag: str) -> Tag:
    if tag not in profile.tags:
        raise file.error(
            loc,
            f"{profile.name} has no tag {tag!r}",
            expected=", ".join(profile.tags),
            hint=did_you_mean(tag, profile.tags),
        )
    return profile.tags[tag]


def _writable(file: YamlFile, loc: tuple[Key, ...], profile: DeviceProfile, name: str) -> Tag:
    tag = _known(file, loc, profile, name)
    if not tag.writable:
        raise file.error(loc, f"the tag {name!r} of {profile.name} is read-only")
    if tag.bits is not None or tag.scale_by is not None:
        why = "only a part of a register" if tag.bits is not None else "scaled by another register"
        raise file.error(
            loc,
            f"the gateway cannot write the tag {name!r} of {profile.name}, because it is {why}",
            expected="a tag of the whole register, without `bits` and `scale_by`",
        )
    return tag


def _check_addresses(
    file: YamlFile, buses: dict[str, BusConfig], devices: dict[str, DeviceConfig], errors: ErrorCollector
) -> None:
    """Check that the devices on a bus have different addresses. Two buses on one CAN interface count as one."""
    taken: dict[tuple[str, int], str] = {}
    for name, device in devices.items():
        endpoint = buses[device.bus].endpoint
        key = (str(replace(endpoint, params=())) if endpoint.is_can else device.bus, device.address)
        if key in taken:
            what, other = "node" if device.profile.protocol == "canopen" else "unit", taken[key]
            where = "" if devices[other].bus == device.bus else f" on {devices[other].bus!r}"
            error = file.error(
                ("devices", name, what),
                f"{name!r} has {what} {device.address} on {device.bus!r}, and so has {other!r}{where}",
                expected=f"a different {what} id",
                hint=f"{other!r} is in line {file.line(('devices', other, what))}",
            )
            errors.add(error)
        taken[key] = name


def _check_programs(system: System, errors: ErrorCollector) -> None:
    """Check that inputs and outputs of programs are tags or messages of devices, and that one program only writes an
    output.
    """
    written: dict[str, str] = {}
    for name, program in system.plc.programs.items():
        loc: tuple[Key, ...] = ("plc", "programs", name)
        for variable, form in program.inputs.items():
            if form.tag.partition(".")[0] in system.plc.programs:
                continue  # a variable of another program, which is checked when the programs are assembled
            with errors.collect():
                _check_input(system, (*loc, "inputs", variable, "tag"), form.tag)
        for variable, tag in program.outputs.items():
            spot = (*loc, "outputs", variable)
            with errors.collect():
                _check_output(system, spot, tag)
                if tag in written:
                    raise system.file.error(spot, f"{tag!r} is already written by {written[tag]!r}")
                written[tag] = name


def _check_input(system: System, loc: tuple[Key, ...], tag: str) -> None:
    device, local = _split(system, loc, tag, system.plc.programs)
    names = [t.name for t in device.profile.tags.values() if t.readable and not t.is_text]
    names += [*device.profile.messages, *(["inbox"] if device.profile.inbox else [])]
    _in(system.file, loc, device, local, names)


def _check_output(system: System, loc: tuple[Key, ...], tag: str) -> None:
    device, local = _split(system, loc, tag)
    names = [t.name for t in device.profile.tags.values() if t.writable]
    names += ["outbox"] if device.profile.outbox else []
    _in(system.file, loc, device, local, names)
    if local not in device.writable:
        raise system.file.error(loc, f"{tag!r} is not in `writable` of {device.name!r}")


def _check_write_groups(system: System, errors: ErrorCollector) -> None:
    """Check that members of groups are outputs of programs, each in one group only, so that none is written alone."""
    written = set(_outputs(system.plc))
    for name, device in system.devices.items():
        seen: dict[str, str] = {}
        for group, tags in device.write_groups.items():
            for n, tag in enumerate(tags):
                at = ("devices", name, "write_groups", group, n)
                if f"{name}.{tag}" not in written or device.profile.inbox is not None:
                    outputs = [t.partition(".")[2] for t in sorted(written) if t.partition(".")[0] == name]
                    error = system.file.error(
                        at,
                        f"{tag!r} is not an output of a program, so it cannot be in a group",
                        expected=", ".join(outputs) or "outputs of programs; this device has none",
                        hint=did_you_mean(tag, outputs),
                    )
                    errors.add(error)
                if tag in seen:
                    errors.add(system.file.error(at, f"{tag!r} is already in the group {seen[tag]!r}"))
                seen[tag] = group


def _split(system: System, loc: tuple[Key, ...], tag: str, programs: Iterable[str] = ()) -> tuple[DeviceConfig, str]:
    """Return the device and the local name of DEVICE.TAG. `programs` are the names of programs, which the error message
    suggests if the reference fits one of them.
    """
    device, _, local = tag.partition(".")
    if device not in system.devices:
        raise no_device(system.file, loc, device, programs)
    return system.devices[device], local


def _in(file: YamlFile, loc: tuple[Key, ...], device: DeviceConfig, local: str, names: list[str]) -> None:
    if local not in names:
        raise file.error(
            loc,
            f"{device.name!r} has no {local!r} for this use",
            expected=", ".join(names) or "none",
            hint=did_you_mean(local, names),
        )
