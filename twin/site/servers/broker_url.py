"""The URL of an MQTT broker: ``mqtt://[USER@]HOST[:1883]``, or ``mqtts://`` with TLS (port 8883).

With TLS, ``ca=FILE`` names the trusted authorities (default: the system's), and ``cert=FILE&key=FILE`` the local certificate.
A URL contains no password. This module does not connect.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from urllib.parse import parse_qsl, urlsplit

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.url_secrets import without_password

PORTS = {"mqtt": 1883, "mqtts": 8883}
FILES = ("ca", "cert", "key")
PASSWORD = "FIELDTWIN_MQTT_PASSWORD"


@dataclass(frozen=True)
class BrokerUrl:
    """Address of a broker and the name of the user. `files` are the TLS files by parameter, `path` the parts of the path."""

    host: str
    port: int
    user: str | None = None
    tls: bool = False
    files: Mapping[str, str] = field(default_factory=dict)
    path: tuple[str, ...] = ()
    more: Mapping[str, str] = field(default_factory=dict)
    """The other parameters that the caller knows."""

    @property
    def address(self) -> str:
        """Return HOST:PORT, with an IPv6 address in brackets."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"

    def __str__(self) -> str:
        return f"{'mqtts' if self.tls else 'mqtt'}://{self.address}"


def parse_broker_url(text: str, expected: str, known: tuple[str, ...] = ()) -> BrokerUrl:
    """Return the parts of a URL. `known` are the parameters that it may have in addition to those of TLS.

    Raises `UsageError` with `expected` for text that is not such a URL, an unknown parameter, or a password.
    """
    try:
        url = urlsplit(text)
        port = url.port
    except ValueError as e:
        raise UsageError("not the URL of a broker", expected=expected, got=without_password(text)) from e
    if url.password is not None:
        hint = f"{PASSWORD} in the environment, or {PASSWORD}_FILE"
        raise UsageError(
            "every user of this computer can read a password in a URL", got=without_password(text), hint=hint
        )
    if url.scheme not in PORTS or not url.hostname or port == 0:
        raise UsageError("not the URL of a broker", expected=expected, got=text)
    tls = url.scheme == "mqtts"
    said = dict(parse_qsl(url.query))
    allowed = (*known, *(FILES if tls else ()))
    if unknown := [name for name in said if name not in allowed]:
        hint = "certificates need mqtts://" if unknown[0] in FILES else ""
        raise UsageError(
            f"{unknown[0]}= is not a setting of a broker", expected=", ".join(allowed) or "none", got=text, hint=hint
        )
    return BrokerUrl(
        url.hostname,
        port or PORTS[url.scheme],
        url.username,
        tls,
        {name: said[name] for name in FILES if name in said},
        tuple(url.path.strip("/").split("/")) if url.path.strip("/") else (),
        {name: said[name] for name in known if name in said},
    )
