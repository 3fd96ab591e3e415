"""The address of a thread as a URL: ``tcp://127.0.0.1:PORT`` on one computer;
``tls://HOST:PORT?ca=FILE&cert=FILE&key=FILE`` between two (the plant listens, its twin connects, and both present a
certificate); a broker with Sparkplug B (`fieldtwin.twin.thread.broker`); or the modems of the system: ``modem:`` or
``modem:DEVICE`` on the plant, which delegates its mailboxes to the thread, and ``modem:[DEVICE@]tcp://HOST:PORT``, the remote
modem, at its twin.
"""

from __future__ import annotations

from ipaddress import ip_address

from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.connections.sockets.listeners import TcpListener
from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.connection import Connector
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.url_secrets import without_password
from fieldtwin.gateway.devices.config import BusConfig, DeviceConfig
from fieldtwin.twin.site.system import System
from fieldtwin.twin.thread.broker import broker_carrier, is_broker
from fieldtwin.twin.thread.link import Carrier
from fieldtwin.twin.thread.tcp import TcpDialler, TcpListening
from fieldtwin.twin.thread.thread import schema_of

EXPECTED = "tcp://127.0.0.1:PORT, tls://HOST:PORT?..., mqtt://HOST/GROUP/NODE, mqtts://..., or modem:"
MODEM = "modem:"
MODEM_POLL_MS = 200


def delegated_transmitter(place: str, system: System) -> str:
    """Return the transmitter whose mailboxes the plant delegates to a thread at `place`; empty for other carriers.

    Raises `UsageError` if there is no transmitter, or if several and none is named.
    """
    return _transmitter(place.removeprefix(MODEM), system) if place.startswith(MODEM) else ""


def _transmitter(name: str, system: System) -> str:
    there = [d.name for d in system.devices.values() if d.profile.inbox is not None]
    if name and name not in there:
        raise UsageError(
            f"{name!r} is not a transmitter of {system.name}", expected=", ".join(there) or "no device has one"
        )
    if not name and len(there) != 1:
        raise UsageError(
            "which transmitter?", expected=" or ".join(MODEM + n for n in there) or "a system with a transmitter"
        )
    return name or there[0]


async def plant_carrier(
    place: str, system: System, clock: Clock, connector: Connector | None = None
) -> tuple[Carrier, str]:
    """Return the carrier of the plant's side, and its address.

    Port 0 in the URL chooses a free port. `connector` opens the bus of a modem. Raises `UsageError`.
    """
    if device := delegated_transmitter(place, system):
        bus = system.buses[system.devices[device].bus]
        return _modem(system, device, bus.endpoint, connector or OsConnector(), clock), place
    if is_broker(place):
        return broker_carrier(place, clock, system), place
    endpoint = _stream(place)
    if endpoint.scheme == "tcp" and not _is_loopback(endpoint.host):
        raise UsageError(
            "every client that reaches this port may command the plant", expected="a loopback address, or tls://",
            got=without_password(place), hint="tls://HOST:PORT?ca=FILE&cert=FILE&key=FILE asks for a certificate",
        )  # fmt: skip
    listening = await TcpListening.start(endpoint, TcpListener.open, [schema_of(system)])
    return listening, str(listening.bound)


def twin_carrier(place: str, system: System, clock: Clock) -> Carrier:
    """Return the carrier of the digital twin's side. Raises `UsageError`."""
    if place.startswith(MODEM):
        name, _, far = place.removeprefix(MODEM).rpartition("@")
        if not far.startswith("tcp:"):
            raise UsageError(
                "the endpoint of the topside modem is missing",
                expected="modem:[DEVICE@]tcp://HOST:PORT",
                got=without_password(place),
            )
        return _modem(system, _transmitter(name, system), Endpoint.parse(far), OsConnector(), clock)
    if is_broker(place):
        return broker_carrier(place, clock, None)
    return TcpDialler(_stream(place), OsConnector(), [schema_of(system)])


def _stream(place: str) -> Endpoint:
    endpoint = Endpoint.parse(place)
    if endpoint.scheme not in ("tcp", "tls"):
        raise UsageError("a thread cannot use this endpoint", expected=EXPECTED, got=without_password(place))
    return endpoint


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def _modem(system: System, device: str, endpoint: Endpoint, connector: Connector, clock: Clock) -> Carrier:
    """Return the carrier for the mailboxes of `device`'s modem, or of its peer, at `endpoint`."""
    from fieldtwin.twin.thread.modem import ModemCarrier

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
