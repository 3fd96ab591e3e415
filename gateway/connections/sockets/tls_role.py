"""The role extension of a certificate (MODBUS/TCP Security Protocol Specification, 8.4).

It is an X.509 extension with object identifier 1.3.6.1.4.1.50316.802.1 whose value is one UTF8String. The DER (X.690)
is decoded only as far as needed to find it, and no signature is verified. This module does no I/O.
"""

from __future__ import annotations

from collections.abc import Iterator

ROLE_OID = bytes.fromhex("2b 06 01 04 01 83 89 0c 86 22 01")

_SEQUENCE, _OID, _OCTET_STRING, _UTF8_STRING, _EXTENSIONS = 0x30, 0x06, 0x04, 0x0C, 0xA3


def role_in(certificate: bytes) -> str:
    """Return the role in a DER certificate; empty if it has none, or if the bytes are not a certificate."""
    for _, certificate_body in _elements(certificate, _SEQUENCE):
        for _, to_be_signed in _elements(certificate_body, _SEQUENCE):
            for _, wrapped in _elements(to_be_signed, _EXTENSIONS):
                for _, extensions in _elements(wrapped, _SEQUENCE):
                    for _, extension in _elements(extensions, _SEQUENCE):
                        parts = list(_elements(extension))
                        if parts and parts[0] == (_OID, ROLE_OID):
                            return _text(parts[-1])
    return ""


def _text(value: tuple[int, bytes]) -> str:
    tag, octets = value
    if tag == _OCTET_STRING:
        for _, text in _elements(octets, _UTF8_STRING):
            try:
                return text.decode("utf-8")
            except UnicodeDecodeError:
                return ""
    return ""


def _elements(data: bytes, wanted: int | None = None) -> Iterator[tuple[int, bytes]]:
    """Yield tag and content of each element in `data`, or of those tagged `wanted`; a damaged element ends the iteration."""
    at = 0
    while at + 2 <= len(data):
        tag, length = data[at], data[at + 1]
        at += 2
        if length & 0x80:
            size = length & 0x7F
            length = int.from_bytes(data[at : at + size], "big")
            at += size
        end = at + length
        if end > len(data):
            return
        if wanted is None or tag == wanted:
            yield tag, data[at:end]
        at = end
