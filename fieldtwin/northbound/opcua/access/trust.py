"""Certificates: those of the clients that a server trusts, and the server's own.

A client is trusted if its certificate is in the folder of trusted certificates, or if the certificate of an authority in that
folder has signed it (OPC 10000-4, 6.1.3). The folder is read for each new channel, so that a change needs no restart.
Certificate revocation lists are not read: remove the certificate of the client, or of its authority.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.rsa import RSAPrivateKey, RSAPublicKey
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid
from fieldtwin.gateway.core.files.input_file import read_input, reading
from fieldtwin.northbound.opcua.access.users import thumbprint

MOST_FILES = 1000
MOST_BYTES = 64 * 1024
"""The largest size of a file of a certificate or key in bytes."""
KEY_BITS = (2048, 4096)
"""The smallest and largest size of a key of the policy Basic256Sha256 (OPC 10000-7, 6.6.165)."""
MOST_REJECTED = 16
"""The largest number of refused certificates that are kept."""
_SUFFIXES = (".der", ".pem", ".crt", ".cer")
_PEM = b"-----BEGIN"


class NotTrusted(FieldtwinError):
    """A certificate is refused. `code` is the name of the status code that the client gets."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


@dataclass(frozen=True)
class Identity:
    """The server's own certificate and key."""

    certificate: x509.Certificate
    key: RSAPrivateKey


def load_identity(certificate: Path, key: Path, uri: str) -> Identity:
    """Read the server's certificate and key. Raises `FileInvalid` if they do not fit each other or the application URI `uri`."""
    own = load_certificate(certificate)
    if uri not in uris_of(own):
        raise FileInvalid(
            "the certificate does not have the server's application URI", path=str(certificate), expected=uri,
            got=", ".join(uris_of(own)) or "none", hint="`fieldtwin opcua certificate` creates one",
        )  # fmt: skip
    with reading(key):
        data = read_input(key, MOST_BYTES)
    try:
        private = load_pem_private_key(data, None)
    except (ValueError, TypeError) as e:
        raise FileInvalid("not a private key", path=str(key), expected="PEM without a password") from e
    if not isinstance(private, RSAPrivateKey) or private.public_key() != own.public_key():
        raise FileInvalid("the key does not belong to the certificate", path=str(key), expected="its RSA key")
    return Identity(own, private)


def load_certificate(path: Path) -> x509.Certificate:
    """Read a certificate, DER or PEM. Raises `FileInvalid`."""
    with reading(path):
        data = read_input(path, MOST_BYTES)
    try:
        return x509.load_pem_x509_certificate(data) if _PEM in data else x509.load_der_x509_certificate(data)
    except ValueError as e:
        raise FileInvalid("not a certificate", path=str(path), expected="an X.509 certificate, DER or PEM") from e


def uris_of(certificate: x509.Certificate) -> list[str]:
    """Return the URIs in the subject alternative name, of which the first is the application URI (OPC 10000-6, 6.2.2)."""
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except (x509.ExtensionNotFound, ValueError):
        return []
    return names.get_values_for_type(x509.UniformResourceIdentifier)


class TrustedFolder:
    """The certificates of the clients that a server trusts. `rejected` is the folder that keeps those that it refused."""

    def __init__(self, folder: Path, rejected: Path | None = None) -> None:
        self._folder = folder
        self._rejected = rejected

    def check(self, sent: bytes, now: datetime) -> bytes:
        """Return the client's certificate (DER), the first of those that it sent. Raises `NotTrusted` and keeps a copy."""
        own = _first(sent)
        try:
            certificate = x509.load_der_x509_certificate(own)
            key = certificate.public_key()
        except (ValueError, TypeError) as e:
            raise NotTrusted("BadCertificateInvalid", "the client's certificate cannot be read") from e
        shown = f"{certificate.subject.rfc4514_string()[:100]}, SHA-256 {thumbprint(own)}"
        if not isinstance(key, RSAPublicKey) or not KEY_BITS[0] <= key.key_size <= KEY_BITS[1]:
            raise NotTrusted("BadCertificatePolicyCheckFailed", f"not an RSA key of 2048 to 4096 bits: {shown}")
        if not any(_vouches(each, certificate, now) for each in self._certificates()):
            place = self._keep(own, certificate)
            raise NotTrusted("BadCertificateUntrusted", f"not in {self._folder}: {shown}{place}")
        if not certificate.not_valid_before_utc <= now <= certificate.not_valid_after_utc:
            until = f"{certificate.not_valid_before_utc:%Y-%m-%d} to {certificate.not_valid_after_utc:%Y-%m-%d}"
            raise NotTrusted("BadCertificateTimeInvalid", f"the certificate is valid from {until}: {shown}")
        return own

    def _certificates(self) -> Iterator[x509.Certificate]:
        try:
            paths = sorted(p for p in self._folder.iterdir() if p.suffix.lower() in _SUFFIXES)[:MOST_FILES]
        except OSError:
            return
        for path in paths:
            with suppress(FileInvalid):  # one damaged file does not exclude the other clients
                yield load_certificate(path)

    def _keep(self, data: bytes, certificate: x509.Certificate) -> str:
        """Write a refused certificate to the folder of rejected ones. Return the part of the message that states its file."""
        if self._rejected is None or len(data) > MOST_BYTES:
            return ""
        names = certificate.subject.get_attributes_for_oid(x509.NameOID.COMMON_NAME)
        name = re.sub(r"[^A-Za-z0-9_-]+", "_", str(names[0].value) if names else "client")[:40]
        path = self._rejected / f"{name}-{thumbprint(data)[:16]}.der"
        try:
            self._rejected.mkdir(mode=0o700, exist_ok=True)
            if not path.exists() and len(list(self._rejected.iterdir())) >= MOST_REJECTED:
                return ""
            path.write_bytes(data)
        except OSError:
            return ""
        return f"; to trust it, copy {path} there"


def _first(sent: bytes) -> bytes:
    """Return the first of concatenated DER certificates (OPC 10000-6, 6.2.6); `sent` itself if it has no valid length."""
    if len(sent) < 4 or sent[0] != 0x30:
        return sent
    if sent[1] < 0x80:
        return sent[: 2 + sent[1]]
    digits = sent[1] & 0x7F
    return sent[: 2 + digits + int.from_bytes(sent[2 : 2 + digits])]


def _vouches(trusted: x509.Certificate, certificate: x509.Certificate, now: datetime) -> bool:
    """Return whether a trusted certificate is that of the client, or of an authority that has signed it."""
    if trusted == certificate:
        return True
    try:
        is_authority = trusted.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
        if (
            not is_authority
            or uris_of(trusted)
            or not trusted.not_valid_before_utc <= now <= trusted.not_valid_after_utc
        ):
            return False  # a certificate with an application URI is that of a client, even if it states something else
        certificate.verify_directly_issued_by(trusted)
    except (x509.ExtensionNotFound, InvalidSignature, ValueError, TypeError):
        return False
    return True
