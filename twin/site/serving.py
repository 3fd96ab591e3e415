"""The `serve` and `bridge` sections of a system file, resolved: which clients the gateway answers, with which data, and
what they may request.

Every error is found here, and reported with file, line and column: tags that do not exist or do not fit, overlapping
registers, unknown buses, invalid ranges. Nothing is opened here.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from fieldtwin.gateway.connections.sockets.tls_listen import check_files
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.error_collector import ErrorCollector, FollowingError
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.gateway.core.files.yaml_file import Key, YamlFile
from fieldtwin.gateway.devices.config import BusConfig, DeviceConfig
from fieldtwin.gateway.protocols.modbus.server.analysis import READ_FUNCTIONS, WRITE_FUNCTIONS, ServedTable
from fieldtwin.gateway.runtime.bridge.bridge import BridgeConfig, Route
from fieldtwin.gateway.runtime.bridge.policy import AllowRule, Network, Policy, network
from fieldtwin.gateway.runtime.serve import BIT_TABLES, QUALITY_TABLE, ServeConfig, ServedTag
from fieldtwin.twin.site.references import no_device
from fieldtwin.twin.site.schema import AllowForm, BridgeForm, PlcForm
from fieldtwin.twin.site.serve_forms import (
    HttpServeForm,
    ModbusServeForm,
    MqttServeForm,
    OpcuaServeForm,
    ServedTagForm,
    ServeForm,
)
from fieldtwin.twin.site.servers.serving_http import HttpServeConfig, resolve_http
from fieldtwin.twin.site.servers.serving_mqtt import MqttServeConfig, resolve_mqtt
from fieldtwin.twin.site.servers.serving_opcua import OpcuaServeConfig, resolve_opcua

TABLES: tuple[ServedTable, ...] = ("input", "holding", "discrete", "coil")
ADDRESSES = 0x10000
WORDS = {"read": READ_FUNCTIONS, "write": WRITE_FUNCTIONS}

OPENPLC_SIZES: Mapping[ServedTable, int] = {"coil": 800, "discrete": 800, "input": 1024, "holding": 8192}
"""The numbers of registers and bits that OpenPLC serves."""
ListeningServer = OpcuaServeConfig | HttpServeConfig
"""A server that runs in a separate process and listens at an address of this computer."""
SeparateServer = ListeningServer | MqttServeConfig
"""A server that runs in a separate process."""


@dataclass(frozen=True)
class Serving:
    """The sections `serve` and `bridge` of a system file, resolved, with the addresses that the file states."""

    serve: tuple[ServeConfig, ...] = ()
    """The servers of kind `modbus`, which run in the gateway's process."""
    bridges: tuple[BridgeConfig, ...] = ()
    opcua: tuple[OpcuaServeConfig, ...] = ()
    """The servers of kind `opcua`, each of which runs in a separate process."""
    http: tuple[HttpServeConfig, ...] = ()
    """The servers of kind `http`, each of which runs in a separate process."""
    mqtt: tuple[MqttServeConfig, ...] = ()
    """The servers of kind `mqtt`, each of which runs in a separate process."""

    @property
    def separate(self) -> tuple[SeparateServer, ...]:
        """Return the servers that run in separate processes."""
        return *self.listening, *self.mqtt

    @property
    def listening(self) -> tuple[ListeningServer, ...]:
        """Return the servers that listen in separate processes."""
        return *self.opcua, *self.http

    def for_run(self, *, allow_writes: bool, free_ports: bool, read_only: Collection[str] = ()) -> Serving:
        """Return the sections as a gateway runs them. A bridge to a bus in `read_only` passes no writes.

        With `free_ports` (a prototype) sockets take a free port of the same host. In a prototype the connector also opens a
        different port in place of a serial line.
        """
        bridges = [
            replace(b, policy=replace(b.policy, allow_writes=allow_writes and b.buses.isdisjoint(read_only)))
            for b in self.bridges
        ]
        if not free_ports:
            return Serving(self.serve, tuple(bridges), self.opcua, self.http, self.mqtt)
        return Serving(
            tuple(replace(s, listen=_free(s.listen)) for s in self.serve),
            tuple(replace(b, listen=_free(b.listen)) for b in bridges),
            tuple(o.on_free_port() for o in self.opcua),
            tuple(h.on_free_port() for h in self.http),
            self.mqtt,
        )


def _free(endpoint: Endpoint) -> Endpoint:
    return endpoint if endpoint.is_serial else endpoint.with_address(endpoint.host, 0)


def resolve_serving(
    file: YamlFile,
    serve: Mapping[str, ServeForm],
    bridge: Mapping[str, BridgeForm],
    buses: Mapping[str, BusConfig],
    devices: Mapping[str, DeviceConfig],
    plc: PlcForm,
    folder: Path,
    errors: ErrorCollector,
) -> Serving:
    """Resolve and check both sections. Errors are added to `errors`; the result contains the entries without error.

    The sources of the programs of `plc` are searched in `folder`.
    """
    outputs = {tag for program in plc.programs.values() for tag in program.outputs.values()}
    servers: list[ServeConfig] = []
    opcua: list[OpcuaServeConfig] = []
    http: list[HttpServeConfig] = []
    mqtt: list[MqttServeConfig] = []
    for name, form in serve.items():
        with errors.collect():
            if isinstance(form, OpcuaServeForm):
                opcua.append(resolve_opcua(file, name, form))
            elif isinstance(form, HttpServeForm):
                http.append(resolve_http(file, name, form))
            elif isinstance(form, MqttServeForm):
                mqtt.append(resolve_mqtt(file, name, form))
            else:
                tags = _located(file, name, form, plc, folder)
                servers.append(_server(file, name, form, devices, outputs, tags, errors))
    bridges: list[BridgeConfig] = []
    for name, bridge_form in bridge.items():
        with errors.collect():
            bridges.append(_bridge(file, name, bridge_form, buses, errors))
    taken: dict[str, str] = {str(b.endpoint): f"bus {b.name!r}" for b in buses.values() if b.endpoint.is_serial}
    for section, name, listen in [
        *(("serve", s.name, s.listen) for s in servers),
        *(("bridge", b.name, b.listen) for b in bridges),
    ]:
        if not listen.is_serial and listen.port == 0:
            continue  # the operating system chooses a free port
        if str(listen) in taken:
            errors.add(file.error((section, name, "url"), f"{listen} is taken by {taken[str(listen)]}"))
        taken[str(listen)] = f"{section} {name!r}"
    fronts = [*(s.listen for s in servers), *(b.listen for b in bridges)]
    places = {(listen.host, listen.port): taken[str(listen)] for listen in fronts if str(listen) in taken}
    separate: list[ListeningServer] = [*opcua, *http]
    for server in separate:
        place = (server.host, server.port)
        if server.port and place in places:
            errors.add(file.error(("serve", server.name, "url"), f"{server.url} is taken by {places[place]}"))
        places[place] = f"serve {server.name!r}"
    return Serving(tuple(servers), tuple(bridges), tuple(opcua), tuple(http), tuple(mqtt))


# -- serve ---------------------------------------------------------------------------------------------------------------


def _server(
    file: YamlFile,
    name: str,
    form: ModbusServeForm,
    devices: Mapping[str, DeviceConfig],
    outputs: set[str],
    tags: list[ServedTag],
    errors: ErrorCollector,
) -> ServeConfig:
    """Return a server of kind `modbus`. `tags` are its located variables, to which the tags of the file are added."""
    loc: tuple[Key, ...] = ("serve", name)
    for tag, tag_form in form.tags.items():
        with errors.collect():
            tags.append(_served(file, (*loc, "tags", tag), tag, tag_form, devices, outputs))
    _check_overlaps(file, loc, tags)
    return ServeConfig(
        name=name,
        listen=_endpoint(file, loc, form.url, ("tcp", "tls")),
        unit=form.unit,
        tags=tuple(tags),
        if_bad=form.if_bad,
        networks=_networks(file, (*loc, "from"), form.networks),
        clients=form.clients,
        roles=_roles(file, (*loc, "roles"), form.roles, form.url),
        write_roles=_roles(file, (*loc, "write_roles"), form.write_roles, form.url),
        idle_s=form.idle_s,
        sizes=OPENPLC_SIZES if form.addresses else {},
    )


def _located(file: YamlFile, name: str, form: ModbusServeForm, plc: PlcForm, folder: Path) -> list[ServedTag]:
    """Return the located variables of the programs, if the server has them."""
    if form.addresses is None:
        return []
    from fieldtwin.twin.site.programs.located_variables import (
        served_by_address,  # load the compiler only if it is needed
    )

    return served_by_address(file, ("serve", name, "addresses"), plc, folder, write=form.write)


def _served(
    file: YamlFile,
    loc: tuple[Key, ...],
    name: str,
    form: ServedTagForm,
    devices: Mapping[str, DeviceConfig],
    outputs: set[str],
) -> ServedTag:
    device, tag = _tag(file, loc, name, devices)
    places = [(table, at) for table in TABLES if (at := getattr(form, table)) is not None]
    if len(places) != 1:
        raise file.error(loc, f"{name!r} has no table", expected="one of " + ", ".join(TABLES))
    table, address = places[0]
    is_bit = table in BIT_TABLES
    kind = form.type or ("bool" if is_bit else _usual_type(tag))
    if is_bit != (kind == "bool") and is_bit:
        raise file.error((*loc, "type"), f"a {table} is a bool", got=kind)
    if tag.is_text:
        raise file.error(loc, f"{name!r} is text and cannot be served")
    served = ServedTag(name, table, address, kind, form.order, form.quality, form.write)
    if address + served.count > ADDRESSES:
        raise file.error((*loc, table), f"{name!r} ends after the last register", expected="at most 65535")
    if form.write:
        _check_writable(file, (*loc, "write"), served, device, tag, outputs)
    elif not tag.readable:
        raise file.error(loc, f"{name!r} cannot be read")
    return served


def _tag(
    file: YamlFile, loc: tuple[Key, ...], name: str, devices: Mapping[str, DeviceConfig]
) -> tuple[DeviceConfig, Tag]:
    device_name, _, local = name.partition(".")
    device = devices.get(device_name)
    if device is None:
        raise no_device(file, loc, device_name)
    tag = device.profile.tags.get(local)
    if tag is None:
        known = device.profile.tags
        raise file.error(
            loc, f"{device_name!r} has no tag {local!r}", expected=", ".join(known), hint=did_you_mean(local, known)
        )
    return device, tag


def _usual_type(tag: Tag) -> str:
    """Return the default type of a served value: the device's own type for an integer, else a floating-point type."""
    if tag.type == "bool":
        return "uint16"
    if not tag.is_integer:
        return "float64" if tag.type == "float64" else "float32"
    return {"int8": "int16", "uint8": "uint16", "bcd16": "uint16", "bcd32": "uint32"}.get(tag.type, tag.type)


def _check_writable(
    file: YamlFile, loc: tuple[Key, ...], served: ServedTag, device: DeviceConfig, tag: Tag, outputs: set[str]
) -> None:
    if served.table not in ("holding", "coil"):
        raise file.error(loc, f"a {served.table} register cannot be written", expected="holding or coil")
    if not tag.writable or device.profile.protocol != "modbus" or device.profile.inbox is not None:
        raise file.error(loc, f"the tag {tag.name!r} of {device.name!r} cannot be written")
    if tag.name not in device.writable:
        raise file.error(loc, f"{served.tag!r} is not in `writable` of {device.name!r}")
    if served.tag in outputs:
        raise file.error(loc, f"{served.tag!r} is already written by a program", hint="one writer per tag")


def _check_overlaps(file: YamlFile, loc: tuple[Key, ...], tags: Iterable[ServedTag]) -> None:
    """Check that no two values or quality registers share a register."""
    taken: dict[tuple[str, int], str] = {}
    for served in tags:
        spans: list[tuple[ServedTable, int, int, str, str]] = [
            (served.table, served.address, served.count, served.table, served.tag)
        ]
        if served.quality_at is not None:
            spans.append((QUALITY_TABLE[served.table], served.quality_at, 1, "quality", f"the quality of {served.tag}"))
        for table, first, count, key, what in spans:
            for at in range(first, first + count):
                if (table, at) in taken:
                    raise file.error(
                        (*loc, "tags", served.tag, key), f"{what} overlaps {taken[table, at]} at {table}:{at}"
                    )
                taken[table, at] = what


# -- bridge --------------------------------------------------------------------------------------------------------------


def _bridge(
    file: YamlFile, name: str, form: BridgeForm, buses: Mapping[str, BusConfig], errors: ErrorCollector
) -> BridgeConfig:
    loc: tuple[Key, ...] = ("bridge", name)
    listen = _endpoint(file, loc, form.url, ("tcp", "tls", "rtu"))
    if form.to is None and not form.units:
        raise file.error(loc, "this bridge has no target", expected="`to: BUS`, or `units: {1: BUS/1}`")
    if form.to is not None:
        _modbus_bus(file, (*loc, "to"), form.to, buses)
    routes: dict[int, Route] = {}
    for unit, text in form.units.items():
        with errors.collect():
            routes[unit] = _route(file, (*loc, "units", unit), unit, text, buses)
    rules = tuple(_rule(file, (*loc, "allow", i), rule, form.url) for i, rule in enumerate(form.allow)) or (
        AllowRule(),
    )
    return BridgeConfig(
        name=name,
        listen=listen,
        to=form.to,
        routes=routes,
        policy=Policy(rules),
        broadcast=form.broadcast is not False,
        answer_broadcast=form.broadcast == "answer",
        cache_ms=form.cache_ms,
        clients=form.clients,
        queue=form.queue,
        in_flight=form.in_flight,
        idle_s=form.idle_s,
    )


def _modbus_bus(file: YamlFile, loc: tuple[Key, ...], name: str, buses: Mapping[str, BusConfig]) -> None:
    known = [b.name for b in buses.values() if not b.endpoint.is_can]
    if name in file.section("buses") and name not in buses:
        raise FollowingError(f"the bus {name!r} has an error", path=file.path)
    if name not in known:
        raise file.error(
            loc, f"no Modbus bus {name!r}", expected=", ".join(known) or "none", hint=did_you_mean(name, known)
        )


def _route(file: YamlFile, loc: tuple[Key, ...], unit: int, text: str, buses: Mapping[str, BusConfig]) -> Route:
    bus, _, number = text.partition("/")
    if not 0 <= unit <= 255 or not number.isascii() or not number.isdigit() or not 1 <= int(number) <= 255:
        raise file.error(loc, "a route", expected="UNIT: BUS/UNIT such as 11: line1/1", got=f"{unit}: {text}")
    _modbus_bus(file, loc, bus, buses)
    return Route(bus, int(number))


def _rule(file: YamlFile, loc: tuple[Key, ...], form: AllowForm, url: str) -> AllowRule:
    functions: set[int] = set()
    for i, entry in enumerate(form.functions):
        if isinstance(entry, int):
            _in_range(file, (*loc, "functions", i), "a function code", entry, 1, 127)
            functions.add(entry)
        else:
            functions |= WORDS[entry]
    units = None
    if form.units is not None:
        spans = [_span(file, (*loc, "units", i), entry, 255) for i, entry in enumerate(form.units)]
        units = frozenset(unit for low, high in spans for unit in range(low, high + 1))
    addresses: dict[str, tuple[tuple[int, int], ...]] | None = None
    if form.addresses is not None:
        addresses = {
            table: tuple(_span(file, (*loc, "addresses", table, i), e, ADDRESSES - 1) for i, e in enumerate(entries))
            for table, entries in form.addresses.items()
        }
    networks, roles = _networks(file, (*loc, "from"), form.networks), _roles(file, (*loc, "roles"), form.roles, url)
    return AllowRule(networks, units, frozenset(functions), addresses, roles)


def _roles(file: YamlFile, loc: tuple[Key, ...], roles: list[str] | None, url: str) -> frozenset[str] | None:
    """Return the roles, which require TLS: a client's certificate names its roles."""
    if roles is None:
        return None
    if not url.lower().startswith("tls:"):
        raise file.error(loc, "roles are in clients' certificates", expected="a tls:// url", got=url)
    return frozenset(roles)


def _span(file: YamlFile, loc: tuple[Key, ...], entry: int | str, most: int) -> tuple[int, int]:
    """Return the first and last number of ``7`` or ``"0..99"``."""
    first, dots, last = str(entry).partition("..")
    digits = (first, last if dots else first)
    if not all(d.isascii() and d.isdigit() for d in digits):
        raise file.error(loc, "a number, or a range such as 0..99", got=repr(entry))
    low, high = (int(d) for d in digits)
    _in_range(file, loc, "the last one", high, low, most)
    return low, high


def _in_range(file: YamlFile, loc: tuple[Key, ...], what: str, value: int, low: int, high: int) -> None:
    if not low <= value <= high:
        raise file.error(loc, what, expected=f"{low} to {high}", got=str(value))


def _networks(file: YamlFile, loc: tuple[Key, ...], texts: Iterable[str]) -> tuple[Network, ...]:
    found = []
    for i, text in enumerate(texts):
        try:
            found.append(network(text))
        except UsageError as e:
            raise file.error((*loc, i), e.message, expected=e.expected, got=e.got) from e
    return tuple(found)


def _endpoint(file: YamlFile, loc: tuple[Key, ...], url: str, schemes: tuple[str, ...]) -> Endpoint:
    try:
        endpoint = Endpoint.parse(url)
        if endpoint.scheme not in schemes:
            raise UsageError(
                "the gateway does not listen there", expected=" or ".join(f"{s}:" for s in schemes), got=url
            )
        if endpoint.scheme == "tls":
            check_files(endpoint)
    except UsageError as e:
        raise file.error((*loc, "url"), e.message, expected=e.expected, got=e.got) from e
    return endpoint
