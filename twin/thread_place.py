"""Where a thread goes, as a URL: ``tcp://127.0.0.1:PORT`` on one computer, ``tls://HOST:PORT?ca=FILE&cert=FILE&key=FILE`` between
two (the plant listens, its twin comes, both show a certificate), a broker with Sparkplug B,
``mqtt://[USER@]HOST[:PORT]/GROUP/NODE[?host=NAME]``, or the modems of the system: ``modem:`` or ``modem:DEVICE`` on the plant,
which lends its mailboxes to the thread, and ``modem:[DEVICE@]tcp://HOST:PORT``, the far modem, at its twin. A password stands in
FIELDTWIN_MQTT_PASSWORD, or in the file that FIELDTWIN_MQTT_PASSWORD_FILE names, never in a URL.
"""

from __future__ import annotations

import os
from ipaddress import ip_address
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from gateway.connections.listeners import TcpListener
from gateway.connections.os_connector import OsConnector
from gateway.core.clock import Clock
from gateway.core.connection import Connector
from gateway.core.endpoint import Endpoint
from gateway.core.errors import UsageError
from gateway.core.url_secrets import without_password
from gateway.devices.config import BusConfig, DeviceConfig
from twin.system import System
from twin.thread import schema_of
from twin.thread_link import Carrier
from twin.thread_tcp import TcpDialler, TcpListening

EXPECTED = "tcp://127.0.0.1:PORT, tls://HOST:PORT?..., mqtt://HOST/GROUP/NODE, or modem:"
MODEM = "modem:"
MODEM_POLL_MS = 200
DEFAULT_HOST = "fieldtwin"
MQTT_PORT = 1883
PASSWORD = "FIELDTWIN_MQTT_PASSWORD"


def lent_transmitter(place: str, system: System) -> str:
    """The transmitter whose mailboxes the plant lends to a thread that goes to `place`; empty for other carriers.

    Raises `UsageError` when there is none, or when it is not said which.
    """
    return _transmitter(place.removeprefix(MODEM), system) if place.startswith(MODEM) else ""


def _transmitter(name: str, system: System) -> str:
    there = [d.name for d in system.devices.values() if d.profile.inbox is not None]
    if name and name not in there:
        raise UsageError(f"{name!r} is no transmitter of {system.name}", expected=", ".join(there) or "none has one")
    if not name and len(there) != 1:
        raise UsageError("which transmitter?", expected=" or ".join(MODEM + n for n in there) or "a system with one")
    return name or there[0]


async def plant_carrier(
    place: str, system: System, clock: Clock, connector: Connector | None = None
) -> tuple[Carrier, str]:
    """The plant's side, and where it is to be found: a free port is taken where the URL says 0. `connector` opens the bus of a
    modem. Raises `UsageError`."""
    if device := lent_transmitter(place, system):
        bus = system.buses[system.devices[device].bus]
        return _modem(system, device, bus.endpoint, connector or OsConnector(), clock), place
    if place.startswith("mqtt:"):
        return _mqtt(place, clock, system), place
    endpoint = _stream(place)
    if endpoint.scheme == "tcp" and not _is_loopback(endpoint.host):
        raise UsageError(
            "whoever reaches this port may command the plant", expected="a loopback address, or tls://",
            got=without_password(place), hint="tls://HOST:PORT?ca=FILE&cert=FILE&key=FILE asks for a certificate",
        )  # fmt: skip
    listening = await TcpListening.start(endpoint, TcpListener.open, [schema_of(system)])
    return listening, str(listening.bound)


def twin_carrier(place: str, system: System, clock: Clock) -> Carrier:
    """The digital twin's side. Raises `UsageError`."""
    if place.startswith(MODEM):
        name, _, far = place.removeprefix(MODEM).rpartition("@")
        if not far.startswith("tcp:"):
            raise UsageError(
                "where is the far modem?", expected="modem:[DEVICE@]tcp://HOST:PORT", got=without_password(place)
            )
        return _modem(system, _transmitter(name, system), Endpoint.parse(far), OsConnector(), clock)
    if place.startswith("mqtt:"):
        return _mqtt(place, clock, None)
    return TcpDialler(_stream(place), OsConnector(), [schema_of(system)])


def _stream(place: str) -> Endpoint:
    endpoint = Endpoint.parse(place)
    if endpoint.scheme not in ("tcp", "tls"):
        raise UsageError("a thread cannot go there", expected=EXPECTED, got=without_password(place))
    return endpoint


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def _modem(system: System, device: str, endpoint: Endpoint, connector: Connector, clock: Clock) -> Carrier:
    """The mailboxes of `device`'s modem, or of its peer, at `endpoint`."""
    from twin.thread_modem import ModemCarrier

    config = system.devices[device]
    poll = {"inbox": config.poll.get("inbox", MODEM_POLL_MS)}
    name = f"{device}_thread"
    return ModemCarrier(
        DeviceConfig(name=name, profile=config.profile, bus=name, address=config.address, poll=poll),
        BusConfig(name, endpoint, system.buses[config.bus].timeout_s, 1),
        connector,
        clock,
        [schema_of(system)],
    )


def _mqtt(place: str, clock: Clock, plant: System | None) -> Carrier:
    """An edge node of `plant`, or the host application where there is none."""
    try:
        from twin.thread_mqtt import Broker, MqttCarrier  # an extra
    except ModuleNotFoundError as e:
        raise UsageError("MQTT needs an extra", hint="pip install 'fieldtwin[mqtt]'") from e
    from twin.thread_sparkplug import EdgeNode, HostApplication, types_of

    url, names = _split(place)
    group, node = names
    host = dict(parse_qsl(url.query)).get("host", DEFAULT_HOST)
    broker = Broker(url.hostname or "", url.port or MQTT_PORT, url.username, _password())
    if plant is None:
        HostApplication(group, node, host)  # names that are none are said at once
        return MqttCarrier(broker, lambda number: HostApplication(group, node, host), clock)
    schema, types = schema_of(plant), types_of(plant)
    EdgeNode(group, node, host, schema, types, 0)
    return MqttCarrier(broker, lambda number: EdgeNode(group, node, host, schema, types, number), clock)


def _password() -> str | None:
    """The broker's, from the environment, or from the file that it names."""
    path = os.environ.get(f"{PASSWORD}_FILE")
    if not path:
        return os.environ.get(PASSWORD)
    try:
        return Path(path).read_text(encoding="utf-8").splitlines()[0].strip()
    except (OSError, UnicodeDecodeError, IndexError) as e:
        why = getattr(e, "strerror", None) or "no text in it"
        raise UsageError(f"the broker's password: {why}", got=f"{PASSWORD}_FILE={path}") from e


def _split(place: str) -> tuple[Any, list[str]]:
    try:
        url = urlsplit(place)
        names = url.path.strip("/").split("/")
        port_is_fine = url.port is None or url.port > 0
    except ValueError as e:
        raise UsageError("no broker", expected=EXPECTED, got=without_password(place)) from e
    if url.password is not None:
        hint = f"{PASSWORD} in the environment, or {PASSWORD}_FILE"
        raise UsageError("a password in a URL can be read by everybody", got=without_password(place), hint=hint)
    if not url.hostname or len(names) != 2 or not all(names) or not port_is_fine:
        raise UsageError("no broker, group and node", expected="mqtt://[USER@]HOST[:PORT]/GROUP/NODE", got=place)
    return url, names
