"""The parts of a TLS listener except its sockets: its certificates, and the role in a client's certificate.

MODBUS/TCP Security Protocol Specification (MBTLS): TLS 1.2 or later, certificates on both sides, a role in an extension
of the client's certificate. This module reads files, but opens no socket and does not interpret function codes.
"""

from __future__ import annotations

import ssl

from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Unreachable, UsageError

ROLE_OID = "1.3.6.1.4.1.50316.802.1"
_UTF8_STRING, _OCTET_STRING, _BOOLEAN = 0x0C, 0x04, 0x01


def make_context(endpoint: Endpoint) -> ssl.SSLContext:
    """Return the server's TLS context from the endpoint's ``cert``, ``key`` and ``ca`` (PEM files).

    With ``ca`` only clients with a certificate of that authority are accepted, as MBTLS requires; without it, all clients are.
    Raises `UsageError` without ``cert`` and `Unreachable` for files that cannot be used.
    """
    where = str(endpoint)
    cert, key, ca = (endpoint.param(name) for name in ("cert", "key", "ca"))
    if not cert:
        raise UsageError("a TLS server needs a certificate", expected="cert=FILE&key=FILE, and ca=FILE", where=where)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(cert, key or None, password=lambda: "")  # otherwise OpenSSL prompts on the terminal
        if ca:
            context.load_verify_locations(cafile=ca)
            context.verify_mode = ssl.CERT_REQUIRED
    except ssl.SSLError as e:
        raise Unreachable(f"cannot use the TLS files: {e.reason or e}", where=where) from e
    except OSError as e:
        raise Unreachable(f"cannot read the TLS files: {e.strerror}", where=where) from e
    return context


def client_role(certificate: bytes | None) -> str:
    """Return the role in a client's certificate (DER); empty if it has none.

    The handshake has verified the certificate, so its bytes are valid. The extension is found by its object identifier.
    """
    identifier = _oid(ROLE_OID)
    place = (certificate or b"").find(identifier)
    if certificate is None or place < 0:
        return ""
    tag, value, rest = _element(certificate[place + len(identifier) :])
    if tag == _BOOLEAN:  # the extension is marked critical
        tag, value, rest = _element(rest)
    if tag != _OCTET_STRING:
        return ""
    tag, value, _ = _element(value)
    return value.decode("utf-8", "replace") if tag == _UTF8_STRING else ""


def _oid(dotted: str) -> bytes:
    """Return an object identifier in DER (X.690, 8.19), tag and length included."""
    first, second, *others = map(int, dotted.split("."))
    data = bytearray((40 * first + second,))
    for arc in others:
        septets = [arc & 0x7F]
        while arc := arc >> 7:
            septets.append(arc & 0x7F | 0x80)
        data += bytes(reversed(septets))
    return bytes((0x06, len(data))) + data


def _element(data: bytes) -> tuple[int, bytes, bytes]:
    """Return tag, content and remaining bytes of the first element in `data`; tag 0 if there is none."""
    if len(data) < 2:
        return 0, b"", b""
    size, at = data[1], 2
    if size & 0x80:
        at += size & 0x7F
        size = int.from_bytes(data[2:at], "big")
    return data[0], data[at : at + size], data[at + size :]
