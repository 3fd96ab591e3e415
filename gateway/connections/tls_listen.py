"""The server's side of TLS: what a listening port needs besides sockets (MODBUS/TCP Security, MBTLS; port 802).

Both sides show certificates, ours included: a client without one of the authority that we trust does not get in (MBTLS
R-08). Its role, where its certificate names one, is for whoever decides what it may do. Reads files; opens no socket.
"""

from __future__ import annotations

import ssl

from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Unreachable, UsageError

HANDSHAKE_LIMIT_S = 10.0
"""A client that has not shaken hands by then is not going to."""


def check_files(endpoint: Endpoint) -> None:
    """Raises `UsageError` where a ``tls://`` endpoint to listen on does not name the files that it takes."""
    missing = [name for name in ("cert", "ca") if not endpoint.param(name)]
    if missing:
        raise UsageError(
            "a TLS server shows a certificate and asks for the clients'",
            expected="cert=FILE&key=FILE&ca=FILE",
            got=f"no {' and no '.join(missing)}",
        )
    if endpoint.param("name"):
        raise UsageError("name= is for who connects", expected="cert=FILE&key=FILE&ca=FILE", got=str(endpoint))


def server_context(endpoint: Endpoint) -> ssl.SSLContext:
    """TLS 1.2 or later, from the endpoint's PEM files: ``cert`` and ``key`` are ours (one file may hold both), ``ca`` the
    authorities whose clients are let in. Raises `UsageError` as `check_files`, `Unreachable` for files of no use."""
    check_files(endpoint)
    where = str(endpoint)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.verify_mode = ssl.CERT_REQUIRED
    try:
        context.load_cert_chain(endpoint.param("cert"), endpoint.param("key") or None, password=lambda: "")
        context.load_verify_locations(cafile=endpoint.param("ca"))
    except ssl.SSLError as e:
        hint = "PEM files; the key must belong to the certificate and have no password"
        raise Unreachable(f"cannot use the TLS files: {e.reason or e}", where=where, hint=hint) from e
    except OSError as e:
        raise Unreachable(f"cannot read the TLS files: {e.strerror}", where=where) from e
    return context
