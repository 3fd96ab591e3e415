"""Convert the requested devices to devices on buses, with profiles, names, endpoints, addresses, supervised values and outputs.

This module reads profiles and opens no connection.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.input_file import reading
from fieldtwin.gateway.core.files.profile import DeviceProfile, Tag
from fieldtwin.gateway.core.files.profile_file import load_profile, resolve
from fieldtwin.gateway.core.files.yaml_file import parse
from fieldtwin.gateway.devices.data_sheet import check_data_sheet
from fieldtwin.gateway.protocols.canopen.eds.dictionary import load_dictionary
from fieldtwin.new_site.limits import NEVER_POLLED, Limits, Output, commanded, limits_of, supervised
from fieldtwin.new_site.wishes import EXAMPLE, LONGEST_NAME, MOST_DEVICES, DeviceWish, name_from
from fieldtwin.twin.site.data_files import data_root, find

TEMPLATES = Path(__file__).absolute().parent / "templates"
TANK = TEMPLATES / "tank.yaml"
_TANK_LIMITS = Limits(low=0.5, usual=1.5, high=2.5, beyond=2.8)
LAST_ADDRESS = {"modbus": 247, "canopen": 127}


@dataclass(frozen=True, slots=True)
class SiteBus:
    """A bus of the new site: its name, the plant's endpoint, and where the simulated devices listen."""

    name: str
    endpoint: Endpoint
    container_port: int

    @property
    def listen(self) -> str:
        """Return the endpoint of the simulated devices on the user's computer. Port 0 selects a free port."""
        if self.endpoint.is_can:
            return "can:fieldtwin/127.0.0.1:0"
        return f"pty:{self.name}" if self.endpoint.is_serial else f"{self.endpoint.scheme}://127.0.0.1:0"

    @property
    def container_listen(self) -> str:
        """Return the endpoint of the simulated devices in a container, for other containers."""
        if self.endpoint.is_can:
            return f"can:fieldtwin/0.0.0.0:{self.container_port}"
        scheme = "tcp" if self.endpoint.is_serial else self.endpoint.scheme
        return f"{scheme}://0.0.0.0:{self.container_port}"


@dataclass(frozen=True)
class SiteDevice:
    """A device of the new site. `files` are the files that its profile needs in the site's folder ``profiles``, by name."""

    name: str
    profile: DeviceProfile
    reference: str
    bus: SiteBus
    address: int
    files: Mapping[str, str]
    watched: Tag | None
    limits: Limits | None
    output: Output | None

    @property
    def is_canopen(self) -> bool:
        return self.profile.protocol == "canopen"

    @property
    def is_example(self) -> bool:
        return self.profile.path == str(TANK)

    @property
    def in_tpdo(self) -> bool:
        """Return whether the node can send the supervised value in a TPDO, according to its data sheet."""
        eds = self.profile.eds_path
        if self.watched is None or self.watched.object is None or eds is None:
            return False
        entry = load_dictionary(eds, self.address).get(*self.watched.object)
        return entry is not None and entry.pdo_mappable

    @property
    def polled(self) -> dict[str, int]:
        """Return the periods of the poll groups in ms: 500 ms for the group of the supervised value and for `fast`, 1000 ms for
        the others."""
        first = self.watched.poll if self.watched is not None else ""
        groups = {
            g: 500 if g in (first, "fast") else 1000 for g in self.profile.groups if g == first or g not in NEVER_POLLED
        }
        return {"inbox": 200, **groups} if self.profile.inbox is not None else groups


def site_devices(wishes: Iterable[DeviceWish], profiles: tuple[Path, ...] = ()) -> list[SiteDevice]:
    """Return the devices of the new site, each with a bus and a unique address.

    Raises `UsageError` and `FileInvalid` for a profile that is missing or invalid, and for addresses that clash.
    """
    chosen = list(wishes) or [DeviceWish(EXAMPLE)]
    if len(chosen) > MOST_DEVICES:
        raise UsageError("too many devices", expected=f"at most {MOST_DEVICES}", got=str(len(chosen)))
    named = _with_names(chosen)
    loaded = [(wish, *_profile(wish, profiles)) for wish in named]
    buses = _Buses()
    placed = [
        (wish, profile, reference, files, buses.bus_for(wish, profile)) for wish, profile, reference, files in loaded
    ]
    found = []
    taken: dict[str, set[int]] = {}
    for wish, profile, _, _, bus in placed:
        if wish.address is not None:
            _reserve(wish, profile, bus, taken.setdefault(bus.name, set()))
    for wish, profile, reference, files, bus in placed:
        used = taken.setdefault(bus.name, set())
        address = wish.address if wish.address is not None else _free_address(profile, bus, used)
        used.add(address)
        watched = supervised(profile)
        limits = None
        if watched is not None:
            limits = _TANK_LIMITS if profile.path == str(TANK) else limits_of(profile, watched)
        output = commanded(profile, watched)
        found.append(SiteDevice(wish.name, profile, reference, bus, address, files, watched, limits, output))
    if all(device.watched is None for device in found):
        raise UsageError(
            "no profile of these devices has a number that a program can watch",
            got=", ".join(device.profile.name for device in found),
            hint="fieldtwin new needs at least one device with a measured value",
        )
    return found


def _with_names(wishes: list[DeviceWish]) -> list[DeviceWish]:
    """Give every device a unique name: the user's, or one made of the profile's name, with a number if needed."""
    used: set[str] = set()
    for wish in wishes:
        if wish.name in used:
            raise UsageError(f"two devices are called {wish.name!r}", hint="write NAME=PROFILE with different names")
        used |= {wish.name} - {""}
    named = []
    for wish in wishes:
        name = wish.name
        if not name:
            first = name_from("tank" if wish.profile == EXAMPLE else Path(wish.profile).stem, "device")
            name, number = first, 2
            while name in used:
                name = f"{first[: LONGEST_NAME - 4].rstrip('_')}_{number}"
                number += 1
            used.add(name)
        named.append(replace(wish, name=name))
    return named


def _profile(wish: DeviceWish, profiles: tuple[Path, ...]) -> tuple[DeviceProfile, str, dict[str, str]]:
    """Return the profile of a device, how the system file refers to it, and the files to write for it.

    A profile that is not shipped is copied, with the data sheet that it names, so that the site works on another computer.
    """
    if wish.profile_text:
        file_name = f"{wish.name}.yaml"
        profile = resolve(parse(wish.profile_text, file_name))
        return profile, f"profiles/{file_name}", {file_name: wish.profile_text}
    path = TANK if wish.profile == EXAMPLE else find("devices", wish.profile, extra=profiles)
    if is_shipped(path):
        return load_profile(path), path.stem, {}
    profile = load_profile(path)
    check_data_sheet(profile)
    file_name = f"{wish.name}.yaml"
    files = {file_name: _text(path)}
    if profile.eds_path is not None:
        if Path(str(profile.form.eds)).name != profile.form.eds:
            raise FileInvalid(
                "the data sheet is not in the folder of the profile", path=str(path), got=str(profile.form.eds)
            )
        files[profile.form.eds] = _text(profile.eds_path)
    return profile, f"profiles/{file_name}", files


def is_shipped(path: Path) -> bool:
    """Return whether a profile comes with fieldtwin, so that its name is enough to find it on another computer."""
    return path.resolve().parent == (data_root() / "profiles" / "devices").resolve()


def _text(path: Path) -> str:
    with reading(path):
        return path.read_bytes().decode("utf-8", "surrogateescape")


class _Buses:
    """The buses of the new site. Devices with the same endpoint share a bus."""

    def __init__(self) -> None:
        self._by_wire: dict[str, SiteBus] = {}
        self._counts = {"line": 0, "lan": 0, "can": -1}
        self._default_ports: dict[tuple[int, str], str] = {}

    def bus_for(self, wish: DeviceWish, profile: DeviceProfile) -> SiteBus:
        """Return the bus of a device. Raises `UsageError` if the endpoint cannot be that of the device or the bus."""
        endpoint = Endpoint.parse(wish.endpoint or self._default(wish, profile))
        if endpoint.is_can != (profile.protocol == "canopen") or endpoint.scheme == "pty":
            raise UsageError(
                f"device {wish.name!r} cannot be at this endpoint",
                expected="can:..." if profile.protocol == "canopen" else "rtu:, ascii:, tcp:, rtu+tcp: or udp:",
                got=str(endpoint),
            )
        if endpoint.scheme == "tls":
            raise UsageError(
                "fieldtwin new cannot write a bus with certificates",
                got=str(endpoint),
                hint="use tcp:// here, then change the bus in the system file and in the prototype file",
            )
        wire = f"{endpoint.scheme} {endpoint.interface} {endpoint.path or (endpoint.host, endpoint.port)}"
        known = self._by_wire.get(wire)
        if known is None:
            if endpoint.scheme == "rtu" and not endpoint.params:
                endpoint = Endpoint.parse(f"{endpoint}?{_settings(profile)}")
            kind = "can" if endpoint.is_can else "line" if endpoint.is_serial else "lan"
            self._counts[kind] += 1
            number = self._counts[kind]
            port = {"can": 29536, "line": 4000, "lan": 1501}[kind] + number
            known = self._by_wire[wire] = SiteBus(f"{kind}{number}", endpoint, port)
        elif endpoint.params and endpoint != known.endpoint:
            raise UsageError(f"two settings for the bus of {wish.name!r}", got=f"{known.endpoint} and {endpoint}")
        return known

    def _default(self, wish: DeviceWish, profile: DeviceProfile) -> str:
        """Return the endpoint of a device for which the user names none: the usual one for its protocol.

        Devices with different serial settings get different ports.
        """
        if profile.protocol == "canopen":
            return "can:socketcan/can0"
        if "baudrate" not in profile.form.factory.model_fields_set:
            return f"tcp://{wish.name.replace('_', '-')}:502"
        factory = profile.form.factory
        key = (factory.baudrate, factory.frame)
        port = self._default_ports.setdefault(key, f"/dev/ttyUSB{len(self._default_ports)}")
        return f"rtu:{port}?{_settings(profile)}"


def _settings(profile: DeviceProfile) -> str:
    factory = profile.form.factory
    return f"baudrate={factory.baudrate}&frame={factory.frame}"


def _reserve(wish: DeviceWish, profile: DeviceProfile, bus: SiteBus, taken: set[int]) -> None:
    last = 255 if profile.protocol == "modbus" and not bus.endpoint.is_serial else LAST_ADDRESS[profile.protocol]
    what = "node ID" if profile.protocol == "canopen" else "unit ID"
    if not 1 <= (wish.address or 0) <= last:
        raise UsageError(f"the {what} of {wish.name!r}", expected=f"1 to {last}", got=str(wish.address))
    if wish.address in taken:
        raise UsageError(f"two devices on {bus.name} have the {what} {wish.address}", got=wish.name)
    taken.add(wish.address or 0)


def _free_address(profile: DeviceProfile, bus: SiteBus, used: set[int]) -> int:
    factory = profile.form.factory
    first = factory.node if profile.protocol == "canopen" else factory.unit
    last = LAST_ADDRESS[profile.protocol]
    free: int | None = next((n for n in (first, *range(1, last + 1)) if n not in used), None)
    if free is None:
        raise UsageError(f"no address is left on {bus.name}", expected=f"at most {last} devices on a bus")
    return free
