"""The files of a server's `security`: check them before a run starts, and create a self-signed certificate."""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence
from ipaddress import ip_address
from pathlib import Path

from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.northbound.opcua.access.users import Users
from fieldtwin.twin.site.servers.serving_opcua import OpcuaSecurity, OpcuaServeConfig, application_uri


def check_files(server: OpcuaServeConfig, system: str) -> None:
    """Raise `FileInvalid` if a file of the server's `security` is missing or not valid. A certificate may have expired."""
    security = server.security
    if security is None:
        return
    for path in (security.certificate, security.key, security.trusted, security.users):
        if not path.exists():
            command = "user" if path == security.users else "certificate"
            raise FileInvalid(
                f"the server {server.name!r} needs this file or folder, which does not exist", path=str(path),
                hint=f"`fieldtwin opcua {command}` creates it",
            )  # fmt: skip
    from fieldtwin.northbound.opcua.access.trust import load_identity

    load_identity(security.certificate, security.key, application_uri(system, server.name))
    Users.load(security.users)


def create_certificate(security: OpcuaSecurity, uri: str, hosts: Sequence[str], days: int) -> None:
    """Write a new RSA key of 2048 bits, a self-signed certificate for it, and the folder of trusted certificates.

    `hosts` are the DNS names and IP addresses of the server, in addition to the name of this computer. Raises `FileInvalid`
    if a file exists already or cannot be written.
    """
    from asyncua.crypto.cert_gen import (
        dump_private_key_as_pem,
        generate_private_key,
        generate_self_signed_app_certificate,
    )
    from cryptography.hazmat.primitives.serialization import Encoding
    from cryptography.x509 import DNSName, GeneralName, IPAddress, UniformResourceIdentifier
    from cryptography.x509.oid import ExtendedKeyUsageOID

    for path in (security.certificate, security.key):
        if path.exists():
            raise FileInvalid("the file exists already", path=str(path), hint="remove it to create a new one")
    names: list[GeneralName] = [UniformResourceIdentifier(uri)]
    for host in dict.fromkeys([*hosts, socket.gethostname()]):
        try:
            names.append(IPAddress(ip_address(host)))
        except ValueError:
            names.append(DNSName(host))
    key = generate_private_key()
    usage = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
    try:
        made = generate_self_signed_app_certificate(key, uri, {"organizationName": "fieldtwin"}, names, usage, days)
    except ValueError as e:
        raise UsageError(f"cannot create the certificate: {e}", expected="host names in ASCII") from e
    coding = Encoding.PEM if security.certificate.suffix.lower() == ".pem" else Encoding.DER
    _write(security.key, dump_private_key_as_pem(key), 0o600)
    _write(security.certificate, made.public_bytes(coding), 0o644)
    try:
        security.trusted.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise FileInvalid(f"cannot create the folder: {e.strerror or e}", path=str(security.trusted)) from e


def _write(path: Path, data: bytes, mode: int) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(data)
    except OSError as e:
        raise FileInvalid(f"cannot write the file: {e.strerror or e}", path=str(path)) from e
