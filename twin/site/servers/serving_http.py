"""The servers of kind `http` in the `serve` section of a system file, resolved."""

from __future__ import annotations

from dataclasses import dataclass, replace
from ipaddress import ip_address
from pathlib import Path
from urllib.parse import SplitResult, urlsplit

from fieldtwin.gateway.core.files.yaml_file import Key, YamlFile
from fieldtwin.twin.site.serve_forms import HttpServeForm
from fieldtwin.twin.site.servers.loopback import is_loopback

URL = "http://HOST:PORT or https://HOST:PORT, such as http://127.0.0.1:8080"


@dataclass(frozen=True)
class HttpServeConfig:
    """The configuration of one HTTP server. Paths are absolute; None stands for no token or no certificate."""

    name: str
    host: str
    port: int
    view_token: Path | None = None
    operate_token: Path | None = None
    names: tuple[str, ...] = ()
    certificate: Path | None = None
    key: Path | None = None
    clients: int = 32
    kind: str = "http"

    @property
    def url(self) -> str:
        """Return the address at which the server listens; with port 0 the operating system chooses a free one."""
        return self.url_at(self.port)

    def url_at(self, port: int) -> str:
        """Return the URL of the server at a port, with an IPv6 address in brackets."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'http' if self.certificate is None else 'https'}://{host}:{port}"

    def on_free_port(self) -> HttpServeConfig:
        """Return the same server on a free port of its host."""
        return replace(self, port=0)


def resolve_http(file: YamlFile, name: str, form: HttpServeForm) -> HttpServeConfig:
    """Resolve and check one server. Raises `FileInvalid` with the place of the key that is wrong."""
    loc: tuple[Key, ...] = ("serve", name)
    try:
        parts = urlsplit(form.url)
        port = parts.port
    except ValueError:
        raise file.error((*loc, "url"), "not the address of an HTTP server", expected=URL, got=form.url) from None
    if parts.scheme not in ("http", "https") or not parts.hostname or port is None or _has_more(parts):
        raise file.error((*loc, "url"), "not the address of an HTTP server", expected=URL, got=form.url)
    _check_tls(file, loc, form, parts.scheme == "https")
    if not is_loopback(parts.hostname):
        _check_open_network(file, loc, form, parts)
    return HttpServeConfig(
        name=name,
        host=parts.hostname,
        port=port,
        view_token=_path(file, form.view_token),
        operate_token=_path(file, form.operate_token),
        names=tuple(form.names),
        certificate=_path(file, form.certificate),
        key=_path(file, form.key),
        clients=form.clients,
    )


def _check_tls(file: YamlFile, loc: tuple[Key, ...], form: HttpServeForm, is_https: bool) -> None:
    if is_https and form.certificate is None:
        raise file.error((*loc, "url"), "https needs a certificate", expected="`certificate: FILE`, and `key: FILE`")
    for name in ("certificate", "key"):
        if not is_https and getattr(form, name) is not None:
            raise file.error((*loc, name), f"http has no {name}", expected="an https:// url", got=form.url)


def _check_open_network(file: YamlFile, loc: tuple[Key, ...], form: HttpServeForm, parts: SplitResult) -> None:
    """Refuse a server that the network can reach, if that would show or give the plant to everyone."""
    url = (*loc, "url")
    if form.view_token is None and form.operate_token is None:
        raise file.error(
            url,
            "without a token a server listens on loopback only",
            expected="127.0.0.1 or ::1, or `view_token: FILE`",
            got=str(parts.hostname),
        )
    if parts.scheme == "http" and not form.insecure:
        raise file.error(
            url,
            "without TLS everyone on the network can read the token",
            expected="https with `certificate` and `key`, or `insecure: true`",
            got=form.url,
        )
    if _is_any_address(str(parts.hostname)) and not form.names:
        raise file.error(
            url,
            "clients cannot name this address, and the server accepts requests for its own names only",
            expected="`names: [gateway.example]`",
            got=str(parts.hostname),
        )


def _is_any_address(host: str) -> bool:
    try:
        return ip_address(host).is_unspecified
    except ValueError:
        return False


def _path(file: YamlFile, text: str | None) -> Path | None:
    return None if text is None else Path(file.path).resolve().parent / text


def _has_more(parts: SplitResult) -> bool:
    return parts.path not in ("", "/") or bool(parts.query or parts.fragment or parts.username or parts.password)
