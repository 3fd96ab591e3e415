"""TLS over TCP as a `ByteConnection` (MODBUS/TCP Security Protocol Specification, MBTLS below; port 802).

Both sides present certificates; the local one may carry a role, by which the server decides what the client may do.
Certificates and keys are files: an endpoint contains no secrets. This module must not depend on the protocol inside TLS.
"""

from __future__ import annotations

import asyncio
import ssl
from functools import partial
from typing import Self

from fieldtwin.gateway.connections.sockets.tcp import OPEN_TIMEOUT_S, TcpConnection
from fieldtwin.gateway.connections.sockets.tls_role import role_in
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Unreachable, UsageError


class TlsConnection(TcpConnection):
    """A `TcpConnection` inside TLS 1.2 or later.

    The endpoint's ``ca`` is a file of the trusted authorities (default: the system's). ``cert`` and ``key`` are the local
    certificate and key; one file may hold both. ``name`` is the name that the server's certificate must have (default: the host).
    The server is always verified. With TLS 1.3 the server may refuse the local certificate only after `open` has returned; the
    first read or write then raises the error.
    """

    def __init__(self, endpoint: Endpoint, max_pending: int = 1024) -> None:
        super().__init__(endpoint, max_pending)
        self.role = ""
        """The role in the local certificate (MBTLS 8.4), which was presented to the server; empty without a role."""

    @classmethod
    async def open(cls, endpoint: Endpoint, timeout_s: float = OPEN_TIMEOUT_S, max_pending: int = 1024) -> Self:
        """Connect and perform the handshake.

        Raises `Unreachable` in the cases of `TcpConnection.open`, and also if a file cannot be read, a certificate is refused, or
        the peer does not use TLS. Raises `UsageError` for a ``key`` without ``cert``.
        """
        connection = cls(endpoint, max_pending)
        make_context = partial(_context, endpoint)
        # In a thread, because the system's authorities are a few hundred files or one large file.
        context, connection.role = await asyncio.get_running_loop().run_in_executor(None, make_context)
        await connection._connect(timeout_s, context, endpoint.param("name") or endpoint.host)
        return connection

    @property
    def peer_role(self) -> str:
        """Return the role in the server's certificate (MBTLS 8.4), or an empty text if it names none."""
        certificate = self._ssl_object().getpeercert(binary_form=True)
        return role_in(certificate) if certificate else ""

    @property
    def version(self) -> str:
        """Return the TLS version in use, such as ``TLSv1.3``."""
        return self._ssl_object().version() or ""

    def _ssl_object(self) -> ssl.SSLObject:
        found = self._wire.transport.get_extra_info("ssl_object")
        assert isinstance(found, ssl.SSLObject)
        return found

    def _cannot_open(self, error: OSError) -> Unreachable:
        where = str(self.endpoint)
        if isinstance(error, ssl.SSLCertVerificationError):
            hint = "ca= is the trusted authority, name= the name in the server's certificate"
            return Unreachable(f"the server's certificate is refused: {error.verify_message}", where=where, hint=hint)
        if isinstance(error, ssl.SSLError):
            return Unreachable(f"no TLS with that server: {_reason(error)}", where=where)
        return super()._cannot_open(error)


def client_context(endpoint: Endpoint) -> ssl.SSLContext:
    """Return the context of a TLS client, with ``ca``, ``cert`` and ``key`` as in `TlsConnection`.

    Reads files. Raises `Unreachable` and `UsageError` as `TlsConnection.open` does.
    """
    return _context(endpoint)[0]


def _context(endpoint: Endpoint) -> tuple[ssl.SSLContext, str]:
    """Return the context for the handshake, and the role in the local certificate. Reads files."""
    where = str(endpoint)
    ca, certificate, key = (endpoint.param(name) for name in ("ca", "cert", "key"))
    if key and not certificate:
        raise UsageError("a key needs its certificate", expected="cert=FILE", where=where)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)  # verifies certificate and name
    context.minimum_version = ssl.TLSVersion.TLSv1_2  # MBTLS 6.2
    try:
        if ca:
            context.load_verify_locations(cafile=ca)
        else:
            context.load_default_certs()
        if not certificate:
            return context, ""
        context.load_cert_chain(certificate, key or None, password=_no_password)
        return context, role_in(_first_certificate(certificate))
    except ssl.SSLError as e:
        hint = "PEM files; the key must belong to the certificate and have no password"
        raise Unreachable(f"cannot use the TLS files: {_reason(e)}", where=where, hint=hint) from e
    except (OSError, ValueError) as e:
        name = getattr(e, "filename", None) or certificate or ca
        why = getattr(e, "strerror", None) or str(e)
        raise Unreachable(f"cannot read the TLS files: {why}", where=where, got=str(name)) from e


def _first_certificate(path: str) -> bytes:
    """Return the local certificate in DER: the first of the file; intermediate certificates may follow it."""
    begin, end = "-----BEGIN CERTIFICATE-----", "-----END CERTIFICATE-----"
    with open(path, encoding="ascii", errors="replace") as file:
        text = file.read()
    return ssl.PEM_cert_to_DER_cert(begin + text.partition(begin)[2].partition(end)[0] + end + "\n")


def _no_password() -> str:
    return ""  # otherwise OpenSSL asks on the terminal


def _reason(error: ssl.SSLError) -> str:
    return (error.reason or str(error)).replace("_", " ").lower()
