"""Where a thread goes, as a URL: ``tcp://127.0.0.1:PORT`` on one computer, ``tls://HOST:PORT?ca=FILE&cert=FILE&key=FILE`` between
two (the plant listens, its twin comes, both show a certificate), or a broker with Sparkplug B,
``mqtt://[USER@]HOST[:PORT]/GROUP/NODE[?host=NAME]``. A password stands in FIELDTWIN_MQTT_PASSWORD, never in a URL.
"""

from __future__ import annotations

import os
from ipaddress import ip_address
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from gateway.connections.listeners import TcpListener
from gateway.connections.os_connector import OsConnector
from gateway.core.clock import Clock
from gateway.core.endpoint import Endpoint
from gateway.core.errors import UsageError
from twin.system import System
from twin.thread import schema_of
from twin.thread_link import Carrier
from twin.thread_tcp import TcpDialler, TcpListening

EXPECTED = "tcp://127.0.0.1:PORT, tls://HOST:PORT?..., or mqtt://HOST/GROUP/NODE"
DEFAULT_HOST = "fieldtwin"
MQTT_PORT = 1883


async def plant_carrier(place: str, system: System, clock: Clock) -> tuple[Carrier, str]:
    """The plant's side, and where it is to be found: a free port is taken where the URL says 0. Raises `UsageError`."""
    if place.startswith("mqtt:"):
        return _mqtt(place, clock, system), place
    endpoint = _stream(place)
    if endpoint.scheme == "tcp" and not _is_loopback(endpoint.host):
        raise UsageError(
            "whoever reaches this port may command the plant", expected="a loopback address, or tls://", got=place,
            hint="tls://HOST:PORT?ca=FILE&cert=FILE&key=FILE asks for a certificate",
        )  # fmt: skip
    listening = await TcpListening.start(endpoint, TcpListener.open, [schema_of(system)])
    return listening, str(listening.bound)


def twin_carrier(place: str, system: System, clock: Clock) -> Carrier:
    """The digital twin's side. Raises `UsageError`."""
    if place.startswith("mqtt:"):
        return _mqtt(place, clock, None)
    return TcpDialler(_stream(place), OsConnector(), [schema_of(system)])


def _stream(place: str) -> Endpoint:
    endpoint = Endpoint.parse(place)
    if endpoint.scheme not in ("tcp", "tls"):
        raise UsageError("a thread cannot go there", expected=EXPECTED, got=place)
    return endpoint


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


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
    broker = Broker(url.hostname or "", url.port or MQTT_PORT, url.username, os.environ.get("FIELDTWIN_MQTT_PASSWORD"))
    if plant is None:
        HostApplication(group, node, host)  # names that are none are said at once
        return MqttCarrier(broker, lambda number: HostApplication(group, node, host), clock)
    schema, types = schema_of(plant), types_of(plant)
    EdgeNode(group, node, host, schema, types, 0)
    return MqttCarrier(broker, lambda number: EdgeNode(group, node, host, schema, types, number), clock)


def _split(place: str) -> tuple[Any, list[str]]:
    try:
        url = urlsplit(place)
        names = url.path.strip("/").split("/")
        port_is_fine = url.port is None or url.port > 0
    except ValueError as e:
        raise UsageError("no broker", expected=EXPECTED, got=place) from e
    if not url.hostname or len(names) != 2 or not all(names) or not port_is_fine or url.password is not None:
        raise UsageError("no broker, group and node", expected="mqtt://[USER@]HOST[:PORT]/GROUP/NODE", got=place)
    return url, names
