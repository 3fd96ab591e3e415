"""A thread's broker as a URL: ``mqtt://[USER@]HOST[:1883]/GROUP/NODE[?host=NAME]``, where NAME is that of the host application,
or ``mqtts://`` with TLS (port 8883). With TLS, ``ca=FILE`` names the trusted authorities (default: the system's), and
``cert=FILE&key=FILE`` this side's certificate.

The password is in FIELDTWIN_MQTT_PASSWORD, or in the file that FIELDTWIN_MQTT_PASSWORD_FILE names, never in a URL.
"""

from __future__ import annotations

from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.installation import install_hint
from fieldtwin.twin.site.servers.broker_url import parse_broker_url
from fieldtwin.twin.site.system import System
from fieldtwin.twin.thread.link import Carrier
from fieldtwin.twin.thread.thread import schema_of

EXPECTED = "mqtt://[USER@]HOST[:PORT]/GROUP/NODE"
SCHEMES = ("mqtt:", "mqtts:")
DEFAULT_HOST = "fieldtwin"


def is_broker(place: str) -> bool:
    """Return whether the address `place` is the URL of a broker."""
    return place.startswith(SCHEMES)


def broker_carrier(place: str, clock: Clock, plant: System | None) -> Carrier:
    """Return the carrier of an edge node for `plant`, or of the host application if `plant` is None.

    Raises `UsageError` for an invalid URL, and `Unreachable` for unusable certificate files.
    """
    try:
        from fieldtwin.twin.thread.mqtt.session import broker_at  # an extra
    except ModuleNotFoundError as e:
        raise UsageError("MQTT needs an extra", hint=install_hint("mqtt")) from e
    from fieldtwin.twin.thread.mqtt_carrier import MqttCarrier
    from fieldtwin.twin.thread.sparkplug import EdgeNode, HostApplication, types_of

    url = parse_broker_url(place, EXPECTED, ("host",))
    if len(url.path) != 2 or not all(url.path):
        raise UsageError("no broker, group and node", expected=EXPECTED, got=place)
    (group, node), host = url.path, url.more.get("host", DEFAULT_HOST)
    broker = broker_at(url)
    if plant is None:
        HostApplication(group, node, host)  # raises at once for invalid names
        return MqttCarrier(broker, lambda number, began_ms: HostApplication(group, node, host, began_ms), clock)
    schema, types = schema_of(plant), types_of(plant)
    EdgeNode(group, node, host, schema, types, 0)
    return MqttCarrier(
        broker, lambda number, began_ms: EdgeNode(group, node, host, schema, types, number, began_ms), clock
    )
