"""The TLS context of a listening port (MODBUS/TCP Security, MBTLS; port 802).

Both sides present certificates: a client without a certificate of the trusted authority is not admitted (MBTLS R-08).
The role in its certificate, if any, is for the code that decides what the client may do. This module reads files and
opens no sockets.
"""

from __future__ import annotations

import ssl

from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Unreachable, UsageError

HANDSHAKE_LIMIT_S = 10.0
"""The time limit of a client's handshake in seconds."""


def check_files(endpoint: Endpoint) -> None:
    """Raise `UsageError` if the ``tls://`` endpoint of a listener does not name the required files."""
    missing = [name for name in ("cert", "ca") if not endpoint.param(name)]
    if missing:
        raise UsageError(
            "a TLS server needs a certificate and the authority of its clients' certificates",
            expected="cert=FILE&key=FILE&ca=FILE",
            got=f"no {' and no '.join(missing)}",
        )
    if endpoint.param("name"):
        raise UsageError("name= is only for clients", expected="cert=FILE&key=FILE&ca=FILE", got=str(endpoint))


def server_context(endpoint: Endpoint) -> ssl.SSLContext:
    """Return a context for TLS 1.2 or later from the endpoint's PEM files.

    ``cert`` and ``key`` are the server's own (one file may hold both), ``ca`` has the authorities whose clients are
    admitted. Raises `UsageError` as `check_files`, `Unreachable` for unusable files.
    """
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
