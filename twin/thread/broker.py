"""A thread's broker as a URL: ``mqtt://[USER@]HOST[:1883]/GROUP/NODE[?host=NAME]``, where NAME is that of the host application,
or ``mqtts://`` with TLS (port 8883). With TLS, ``ca=FILE`` names the trusted authorities (default: the system's), and
``cert=FILE&key=FILE`` this side's certificate.

The password is in FIELDTWIN_MQTT_PASSWORD, or in the file that FIELDTWIN_MQTT_PASSWORD_FILE names, never in a URL.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlencode, urlsplit

from fieldtwin.gateway.connections.sockets.tls import client_context
from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.url_secrets import without_password
from fieldtwin.installation import install_hint
from fieldtwin.twin.site.system import System
from fieldtwin.twin.thread.link import Carrier
from fieldtwin.twin.thread.thread import schema_of

EXPECTED = "mqtt://[USER@]HOST[:PORT]/GROUP/NODE"
SCHEMES = ("mqtt:", "mqtts:")
DEFAULT_HOST = "fieldtwin"
PORTS = {"mqtt": 1883, "mqtts": 8883}
FILES = ("ca", "cert", "key")
PASSWORD = "FIELDTWIN_MQTT_PASSWORD"


def is_broker(place: str) -> bool:
    """Return whether the address `place` is the URL of a broker."""
    return place.startswith(SCHEMES)


def broker_carrier(place: str, clock: Clock, plant: System | None) -> Carrier:
    """Return the carrier of an edge node for `plant`, or of the host application if `plant` is None.

    Raises `UsageError` for an invalid URL, and `Unreachable` for unusable certificate files.
    """
    try:
        from fieldtwin.twin.thread.mqtt import Broker, MqttCarrier  # an extra
    except ModuleNotFoundError as e:
        raise UsageError("MQTT needs an extra", hint=install_hint("mqtt")) from e
    from fieldtwin.twin.thread.sparkplug import EdgeNode, HostApplication, types_of

    url, group, node, said = _split(place)
    host = said.pop("host", DEFAULT_HOST)
    port = url.port or PORTS[url.scheme]
    tls = None
    if url.scheme == "mqtts":
        tls = client_context(
            Endpoint.parse(
                f"tls://{url.netloc.rpartition('@')[2]}?{urlencode(said)}",
            )
        )
    broker = Broker(url.hostname, port, url.username, _password(), tls)
    if plant is None:
        HostApplication(group, node, host)  # raises at once for invalid names
        return MqttCarrier(broker, lambda number, began_ms: HostApplication(group, node, host, began_ms), clock)
    schema, types = schema_of(plant), types_of(plant)
    EdgeNode(group, node, host, schema, types, 0)
    return MqttCarrier(
        broker, lambda number, began_ms: EdgeNode(group, node, host, schema, types, number, began_ms), clock
    )


def _split(place: str) -> tuple[Any, str, str, dict[str, str]]:
    """Return the URL, group, node, and the remaining parameters."""
    try:
        url = urlsplit(place)
        names = url.path.strip("/").split("/")
        port_is_fine = url.port is None or url.port > 0
    except ValueError as e:
        raise UsageError("no broker", expected=EXPECTED, got=without_password(place)) from e
    if url.password is not None:
        hint = f"{PASSWORD} in the environment, or {PASSWORD}_FILE"
        raise UsageError(
            "every user of this computer can read a password in a URL", got=without_password(place), hint=hint
        )
    if not url.hostname or len(names) != 2 or not all(names) or not port_is_fine:
        raise UsageError("no broker, group and node", expected=EXPECTED, got=place)
    said = dict(parse_qsl(url.query))
    known = ("host", *(FILES if url.scheme == "mqtts" else ()))
    if unknown := [name for name in said if name not in known]:
        hint = "certificates need mqtts://" if unknown[0] in FILES else ""
        raise UsageError(f"{unknown[0]}= is not a setting of a broker", expected=", ".join(known), got=place, hint=hint)
    return url, names[0], names[1], said


def _password() -> str | None:
    """Return the broker's password from the environment, or from the file that the environment names."""
    path = os.environ.get(f"{PASSWORD}_FILE")
    if not path:
        return os.environ.get(PASSWORD)
    try:
        return Path(path).read_text(encoding="utf-8").splitlines()[0].strip()
    except (OSError, UnicodeDecodeError, IndexError) as e:
        why = getattr(e, "strerror", None) or "the file is empty"
        raise UsageError(f"the broker's password: {why}", got=f"{PASSWORD}_FILE={path}") from e
