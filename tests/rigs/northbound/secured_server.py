"""An OPC UA server with `security`, in a separate thread, and clients with certificates."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

from asyncua import Client, ua
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, load_pem_private_key

from fieldtwin.gateway.core.errors import Unreachable
from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.northbound.opcua.access.files import create_certificate
from fieldtwin.northbound.opcua.access.passwords import hash_of
from fieldtwin.northbound.opcua.access.users import UserForm, Users
from fieldtwin.northbound.opcua.server import OpcuaServer
from fieldtwin.northbound.samples import Sample
from fieldtwin.twin.site.servers.serving_opcua import application_uri
from fieldtwin.twin.site.system import load_system

SECURITY = "security: {certificate: pki/own.der, key: pki/own.key, trusted: pki/trusted, users: pki/users.yaml}"
SYSTEM = f"""\
fieldtwin: 1
system: site
buses: {{lan: {{url: "tcp://192.0.2.1:502"}}}}
devices: {{meter: {{profile: eastron-sdm630, bus: lan, unit: 1}}}}
serve: {{scada: {{kind: opcua, url: "opc.tcp://127.0.0.1:0", {SECURITY}}}}}
"""
PASSWORDS = {"anna": "correct horse", "bert": "battery staple"}
ROLES = {"anna": "operate", "bert": "view"}
TAG = "ns=2;s=meter.frequency"
CLIENT_URI = "urn:test:client"
SIGN, ENCRYPT = ua.MessageSecurityMode.Sign, ua.MessageSecurityMode.SignAndEncrypt


def make_certificate(
    folder: Path, name: str, *, uri: str = CLIENT_URI, days: int = 30, signer: str = "", is_authority: bool = False
) -> Path:
    """Write ``NAME.der`` and ``NAME.pem`` and return the first. With `signer`, that certificate's key signs it.

    It was valid from 60 days ago until in `days` days. Without `uri` it has no application URI.
    """
    key = rsa.generate_private_key(65537, 2048)
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
    issuer, signing = subject, key
    if signer:
        issuer = x509.load_der_x509_certificate((folder / f"{signer}.der").read_bytes()).subject
        signing = _key(folder / f"{signer}.pem")
    now = datetime.now(UTC)
    builder = (
        x509.CertificateBuilder(issuer, subject, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - timedelta(days=60))
        .not_valid_after(now + timedelta(days=days))
        .add_extension(x509.BasicConstraints(ca=is_authority, path_length=None), critical=True)
    )
    if uri:
        names = x509.SubjectAlternativeName([x509.UniformResourceIdentifier(uri)])
        builder = builder.add_extension(names, critical=False)
    path = folder / f"{name}.der"
    path.write_bytes(builder.sign(signing, hashes.SHA256()).public_bytes(Encoding.DER))
    path.with_suffix(".pem").write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    return path


def _key(path: Path) -> rsa.RSAPrivateKey:
    key = load_pem_private_key(path.read_bytes(), None)
    assert isinstance(key, rsa.RSAPrivateKey)
    return key


def write_users(path: Path, **certificates: str) -> None:
    """Write the users of `PASSWORDS`, and a user with a certificate for each SHA-256 of `certificates`."""
    forms = {name: UserForm(role=ROLES[name], password=hash_of(text)) for name, text in PASSWORDS.items()}
    forms |= {name: UserForm(role="view", certificate=digest) for name, digest in certificates.items()}
    Users(forms).save(path)


@contextmanager
def secured_server(folder: Path) -> Iterator[str]:
    """Run a server in `folder`, whose one good tag is `TAG` with the value 50. Yield its URL."""
    (folder / "site.yaml").write_text(SYSTEM, encoding="utf-8")
    system = load_system(str(folder / "site.yaml"))
    config = system.serving.opcua[0]
    assert config.security is not None
    create_certificate(config.security, application_uri("site", "scada"), ["127.0.0.1"], 30)
    write_users(config.security.users)
    ready, urls, loop = threading.Event(), [""], asyncio.new_event_loop()
    stop = asyncio.Event()

    async def serve() -> None:
        clock = WallClock()
        server = OpcuaServer(replace(config, port=0), system, clock, _no_gateway, folder / "rejected")
        try:
            await server.build()
            good = Sample(50.0, Quality.GOOD, Reason.NONE, clock.monotonic_ns())
            await server.publish(server.variables.inputs, [("meter.frequency", good)])
            await server.listen()
            urls[0] = server.status().listening or ""
        finally:
            ready.set()
        await stop.wait()
        await server.aclose()

    thread = threading.Thread(target=lambda: loop.run_until_complete(serve()), daemon=True)
    thread.start()
    assert ready.wait(120)
    try:
        yield urls[0]
    finally:
        loop.call_soon_threadsafe(stop.set)
        thread.join(30)
        loop.close()


async def _no_gateway(command: str, **args: object) -> None:
    raise Unreachable("this server has no gateway")


async def client_of(url: str, certificate: Path, mode: ua.MessageSecurityMode = ENCRYPT, user: str = "anna") -> Client:
    """Return a client that is not connected yet. Without `user` it is anonymous."""
    made = Client(url, timeout=20)
    made.application_uri = CLIENT_URI
    await made.set_security(
        SecurityPolicyBasic256Sha256, str(certificate), str(certificate.with_suffix(".pem")), mode=mode
    )
    if user:
        made.set_user(user)
        made.set_password(PASSWORDS.get(user, "unknown"))
    return made


@asynccontextmanager
async def unsecured_channel(url: str) -> AsyncIterator[Client]:
    """A client with an open channel without security, and without a session."""
    made = Client(url, timeout=20)
    await made.connect_socket()
    try:
        await made.send_hello()
        await made.open_secure_channel()
        yield made
    finally:
        made.disconnect_socket()
