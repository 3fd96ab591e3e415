"""Where a server for agents listens over HTTP, and how it is protected."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.twin.site.servers.loopback import is_loopback


@dataclass(frozen=True)
class HttpPlace:
    """The address, the token of the agents, and the PEM files for HTTPS. `names` are other names of this computer.

    Raises `UsageError` for a server without a token, and for one beyond loopback without TLS.
    """

    host: str
    port: int
    token: str = field(repr=False)
    names: tuple[str, ...] = ()
    certificate: Path | None = None
    key: Path | None = None

    def __post_init__(self) -> None:
        if not self.token:
            raise UsageError("agents that connect over HTTP need a token", expected="--token @FILE")
        if not is_loopback(self.host) and self.certificate is None:
            raise UsageError(
                "without TLS everyone on the network can read the token",
                expected="--certificate and --key",
                got=f"--listen {self.host}",
            )


def parsed_address(text: str) -> tuple[str, int]:
    """Return host and port of ``HOST:PORT``; port 0 chooses a free one. Raises `UsageError`."""
    host, _, port = text.rpartition(":")
    if not host or not port.isascii() or not port.isdigit() or int(port) > 65_535:
        raise UsageError("--listen", expected="HOST:PORT, such as 127.0.0.1:8090", got=text)
    return host.strip("[]"), int(port)
