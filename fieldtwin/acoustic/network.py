"""A network: systems whose modems share one acoustic channel. This module reads and checks network files.

Each system is a separate plant with its own file, and does not depend on the network. `Network.whole` combines
all systems into one, for scenarios and reports: every name is prefixed with the name of its system, as in
`west.ctd.pressure`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from typing import Any

from fieldtwin.acoustic.faults import check_water_fault, random_losses
from fieldtwin.acoustic.schema import SHIP, WATER, NetworkForm, TopsideForm
from fieldtwin.emulators.faults.loss.drop import Drop
from fieldtwin.emulators.faults.schema import FaultSpec
from fieldtwin.emulators.wires.acoustic import AcousticMedium, AcousticProperties, Spoils
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.yaml_file import Key, YamlFile, load, validate
from fieldtwin.twin.prototype.fault_aims import target
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.prototype.group import GroupMember, SystemGroup
from fieldtwin.twin.site.data_files import find, search_path
from fieldtwin.twin.site.schema import InputForm, PlcForm, ProgramForm
from fieldtwin.twin.site.system import System, load_system


@dataclass(frozen=True)
class AcousticMember(GroupMember):
    """A system of a network. `modem` is the device in the acoustic channel, at position `at_m` in m."""

    modem: str
    at_m: tuple[float, ...]

    @property
    def profile(self) -> DeviceProfile:
        """Return the profile of the modem."""
        return self.prototype.devices[self.modem].profile


@dataclass(frozen=True)
class Network(SystemGroup):
    """A network: the content of a network file, with the systems that the file names."""

    members: Mapping[str, AcousticMember]
    water: AcousticProperties
    ship: TopsideForm | None
    file: YamlFile

    kind = "network"

    @property
    def shared(self) -> tuple[str, ...]:
        return (WATER,)

    @property
    def places(self) -> dict[str, tuple[float, ...]]:
        """Return the positions (m) of all modems in the acoustic channel: by system name, and by `SHIP` for the topside modem."""
        places = {name: member.at_m for name, member in self.members.items()}
        return places | ({SHIP: tuple(self.ship.at_m)} if self.ship is not None else {})

    def medium(self, seed: int, spoils: Spoils | None = None) -> AcousticMedium:
        """Return the acoustic channel with all its modems."""
        return AcousticMedium(self.water, self.places, seed, spoils)

    def split(self, name: str) -> tuple[str, str]:
        member, _, local = name.partition(".")
        if member not in self.members or not local:
            raise UsageError(
                f"no system of the network in {name!r}",
                expected=", ".join(self.members),
                hint=did_you_mean(member, self.members),
            )
        return member, local

    def check_fault(self, spec: FaultSpec) -> None:
        if spec.aim.bus == WATER:
            check_water_fault(self.places, spec)
        else:
            target(self.whole, spec)

    def place(self, faults: Iterable[Mapping[str, Any]]) -> dict[str, tuple[dict[str, Any], ...]]:
        found: dict[str, tuple[dict[str, Any], ...]] = {}
        for fault in faults:
            where, local = self.place_of(fault)
            found[where] = (*found.get(where, ()), local)
        return found

    def place_of(self, fault: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
        """Return the system of a fault, or `WATER`, and the fault with the names that this system itself uses.

        Raises `UsageError` for an unknown system.
        """
        if fault.get("bus") == WATER:
            return WATER, dict(fault)
        member, _ = self.split(str(fault.get("device") or fault.get("bus") or ""))
        local = {key: self.split(said)[1] if key in ("device", "bus") else said for key, said in fault.items()}
        return member, local

    def random_shared_faults(
        self, random: Random, kinds: Collection[str], mean_s: float, last_s: float
    ) -> list[dict[str, Any]]:
        return [] if kinds and Drop.name not in kinds else random_losses(self.places, random, mean_s, last_s)

    @property
    def whole(self) -> System:
        first = next(iter(self.members.values())).system
        return System(
            name=self.name,
            path=self.path,
            hash=" ".join(member.system.hash for member in self.members.values()),
            buses={
                f"{m.name}.{n}": replace(bus, name=f"{m.name}.{n}")
                for m in self.members.values()
                for n, bus in m.system.buses.items()
            },
            devices={
                f"{m.name}.{n}": replace(device, name=f"{m.name}.{n}", bus=f"{m.name}.{device.bus}")
                for m in self.members.values()
                for n, device in m.system.devices.items()
            },
            plc=PlcForm.model_construct(
                cycle_ms=first.plc.cycle_ms,
                watchdog=first.plc.watchdog,
                outputs_at=first.plc.outputs_at,
                tasks={},
                programs={
                    f"{m.name}.{n}": _renamed(program, m)
                    for m in self.members.values()
                    for n, program in m.system.plc.programs.items()
                },
            ),
            remote=first.remote,
            file=self.file,
        )


def _renamed(program: ProgramForm, member: AcousticMember) -> ProgramForm:
    beside = member.system.path.parent / program.source
    return ProgramForm.model_construct(
        source=str(beside.resolve()) if beside.exists() else program.source,
        dialect=program.dialect,
        libraries=[str(member.system.path.parent / library) for library in program.libraries],
        machine_code=program.machine_code,
        task=None,
        inputs={
            n: InputForm.model_construct(tag=f"{member.name}.{i.tag}", if_bad=i.if_bad)
            for n, i in program.inputs.items()
        },
        outputs={n: f"{member.name}.{tag}" for n, tag in program.outputs.items()},
    )


def load_network(path: Path, profiles: Iterable[Path] = ()) -> Network:
    """Read a network file and all files that it names. Raises `FileInvalid` with the place of the error."""
    file, profiles = load(path), tuple(profiles)
    form = validate(file, NetworkForm)
    members = {name: _member(file, form, name, path, profiles) for name in form.systems}
    _check(file, form, members)
    water = AcousticProperties(
        form.water.range_m,
        form.water.sound_m_per_s,
        form.water.bytes_per_s,
        form.water.overhead_bytes,
        form.water.loss,
    )
    return Network(form.network, path, form.seed, members, water, form.ship, file)


def _member(file: YamlFile, form: NetworkForm, name: str, path: Path, profiles: tuple[Path, ...]) -> AcousticMember:
    said, loc = form.systems[name], ("systems", name)
    try:
        system = load_system(str(find("systems", said.system, beside=path, extra=profiles)), profiles)
    except UsageError as e:
        near = did_you_mean(
            said.system, [p.name for folder in (path.parent, *search_path(profiles)) for p in _files(folder)]
        )
        raise file.error((*loc, "system"), e.message, expected=e.expected, hint=near or e.hint) from e
    other = path.parent / said.prototype if said.prototype is not None else None
    if other is not None and not other.is_file():
        raise file.error((*loc, "prototype"), f"no file {said.prototype!r}", expected="a file in the same folder")
    prototype = load_prototype(system, other)
    modems = [n for n, d in prototype.devices.items() if d.form.model == "mailbox"]
    if said.modem not in modems:
        raise file.error(
            (*loc, "modem"),
            f"{said.modem!r} is not a modem of {system.name}",
            expected=", ".join(modems) or "a device with `model: mailbox` in its prototype file",
            hint=did_you_mean(said.modem, modems),
        )
    return AcousticMember(name, system, prototype, said.modem, tuple(said.at_m))


def _files(folder: Path) -> list[Path]:
    """Return the system files in `folder`, and in its subfolder `systems`."""
    return [p for place in (folder, folder / "systems") for p in sorted(place.glob("*.yaml")) if "." not in p.stem]


def _check(file: YamlFile, form: NetworkForm, members: dict[str, AcousticMember]) -> None:
    """Check the properties that depend on several systems: coordinates, names, mailbox sizes and modem addresses."""
    first = next(iter(form.systems.values()))
    places: list[tuple[tuple[Key, ...], list[float]]] = [(("systems", n), m.at_m) for n, m in form.systems.items()]
    if form.ship is not None:
        places.append((("ship",), form.ship.at_m))
    for loc, at_m in places:
        if len(at_m) != len(first.at_m):
            raise file.error(
                (*loc, "at_m"),
                "not as many coordinates as the first has",
                expected=str(len(first.at_m)),
                got=str(len(at_m)),
            )
    for reserved in (SHIP, WATER):
        if reserved in members:
            raise file.error(("systems", reserved), f"{reserved!r} is not a valid name for a system of a network")
    smallest = min(m.profile.inbox.bytes for m in members.values() if m.profile.inbox is not None)
    seen: dict[str, str] = {}
    for name, member in members.items():
        outbox = member.profile.outbox
        if outbox is not None and outbox.bytes > smallest:
            raise file.error(
                ("systems", name, "modem"),
                "its messages are too long for another system's mailbox",
                expected=f"at most {smallest} bytes",
                got=str(outbox.bytes),
            )
        address = member.prototype.devices[member.modem].form.identity.get("address", "")
        if address and address in seen:
            raise file.error(
                ("systems", name),
                f"its modem has the address {address}, as {seen[address]}'s has",
                expected="a different one",
            )
        seen[address] = name
