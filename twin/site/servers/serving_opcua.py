"""The servers of kind `opcua` in the `serve` section of a system file, resolved."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import SplitResult, urlsplit

from fieldtwin.gateway.core.files.yaml_file import Key, YamlFile
from fieldtwin.twin.site.serve_forms import OpcuaSecurityForm, OpcuaServeForm
from fieldtwin.twin.site.servers.loopback import is_loopback

SCHEME = "opc.tcp"
URL = f"{SCHEME}://HOST:PORT, such as {SCHEME}://127.0.0.1:4840"


@dataclass(frozen=True)
class OpcuaSecurity:
    """The files of a server that admits only authenticated users over signed channels of trusted clients."""

    certificate: Path
    key: Path
    trusted: Path
    users: Path


@dataclass(frozen=True)
class OpcuaServeConfig:
    """The configuration of one OPC UA server. It reads the process image every `every_ms` milliseconds.

    Without `security` every client is an anonymous user, and `host` is a loopback address.
    """

    name: str
    host: str
    port: int
    every_ms: int = 100
    clients: int = 16
    kind: str = "opcua"
    security: OpcuaSecurity | None = None

    @property
    def url(self) -> str:
        """Return the address at which the server listens; with port 0 the operating system chooses a free one."""
        return url_of(self.host, self.port)

    def on_free_port(self) -> OpcuaServeConfig:
        """Return the same server on a free port of its host."""
        return replace(self, port=0)


def url_of(host: str, port: int) -> str:
    """Return the URL of an OPC UA server, with an IPv6 address in brackets."""
    return f"{SCHEME}://{f'[{host}]' if ':' in host else host}:{port}"


def application_uri(system: str, server: str) -> str:
    """Return the application URI of a server, which its certificate has to contain (OPC 10000-6, 6.2.2)."""
    return f"urn:fieldtwin:{system}:{server}"


def resolve_opcua(file: YamlFile, name: str, form: OpcuaServeForm) -> OpcuaServeConfig:
    """Resolve and check one server. Raises `FileInvalid` with the place of its URL."""
    loc: tuple[Key, ...] = ("serve", name, "url")
    try:
        parts = urlsplit(form.url)
        port = parts.port
    except ValueError:
        raise file.error(loc, "not the address of an OPC UA server", expected=URL, got=form.url) from None
    if parts.scheme != SCHEME or not parts.hostname or port is None or _has_more(parts):
        raise file.error(loc, "not the address of an OPC UA server", expected=URL, got=form.url)
    if form.security is None and not is_loopback(parts.hostname):
        raise file.error(
            loc,
            "an OPC UA server without `security` listens on loopback only, because it does not authenticate its clients",
            expected="127.0.0.1 or ::1",
            got=parts.hostname,
            hint="add `security` with certificates and users, or reach the server through an SSH tunnel",
        )
    security = _security(file, form.security) if form.security is not None else None
    return OpcuaServeConfig(name, parts.hostname, port, form.every_ms, form.clients, security=security)


def _security(file: YamlFile, form: OpcuaSecurityForm) -> OpcuaSecurity:
    folder = Path(file.path).absolute().parent
    return OpcuaSecurity(
        certificate=folder / form.certificate,
        key=folder / form.key,
        trusted=folder / form.trusted,
        users=folder / form.users,
    )


def _has_more(parts: SplitResult) -> bool:
    return parts.path not in ("", "/") or bool(parts.query or parts.fragment or parts.username or parts.password)
