"""Trusted and refused certificates, and the server's own certificate and key."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from hypothesis import given, settings
from hypothesis import strategies as st
from secured_server import CLIENT_URI, make_certificate

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.northbound.opcua.access.trust import MOST_REJECTED, NotTrusted, TrustedFolder, load_identity

NOW = datetime.now(UTC)


def code_of(folder: Path, sent: bytes, now: datetime = NOW) -> str:
    with pytest.raises(NotTrusted) as caught:
        TrustedFolder(folder).check(sent, now)
    return caught.value.code


@pytest.fixture
def trusted(tmp_path: Path) -> Path:
    folder = tmp_path / "trusted"
    folder.mkdir()
    return folder


def test_a_certificate_in_the_folder_is_trusted_in_its_time_only(tmp_path: Path, trusted: Path) -> None:
    sent = make_certificate(trusted, "hmi").read_bytes()
    assert TrustedFolder(trusted).check(sent, NOW) == sent
    assert code_of(trusted, sent, NOW + timedelta(days=31)) == "BadCertificateTimeInvalid"
    assert code_of(trusted, sent, NOW - timedelta(days=61)) == "BadCertificateTimeInvalid"
    assert code_of(trusted, make_certificate(tmp_path, "hmi").read_bytes()) == "BadCertificateUntrusted"


def test_an_authority_in_the_folder_makes_its_clients_trusted(tmp_path: Path, trusted: Path) -> None:
    make_certificate(tmp_path, "plant-ca", uri="", is_authority=True)
    sent = make_certificate(tmp_path, "hmi", signer="plant-ca").read_bytes()
    assert code_of(trusted, sent) == "BadCertificateUntrusted"
    (trusted / "ca.der").write_bytes((tmp_path / "plant-ca.der").read_bytes())
    assert TrustedFolder(trusted).check(sent, NOW) == sent
    chain = sent + (tmp_path / "plant-ca.der").read_bytes()
    assert TrustedFolder(trusted).check(chain, NOW) == sent
    make_certificate(tmp_path, "other-ca", uri="", is_authority=True)
    foreign = make_certificate(tmp_path, "tablet", signer="other-ca").read_bytes()
    assert code_of(trusted, foreign) == "BadCertificateUntrusted"


@pytest.mark.parametrize(("uri", "is_authority"), [(CLIENT_URI, True), ("", False)])
def test_a_trusted_client_cannot_make_other_clients_trusted(
    tmp_path: Path, trusted: Path, uri: str, is_authority: bool
) -> None:
    make_certificate(trusted, "client", uri=uri, is_authority=is_authority)
    sent = make_certificate(trusted, "friend", signer="client").read_bytes()
    (trusted / "friend.der").unlink()
    assert code_of(trusted, sent) == "BadCertificateUntrusted"


def test_a_damaged_file_in_the_folder_does_not_exclude_the_other_clients(trusted: Path) -> None:
    sent = make_certificate(trusted, "hmi").read_bytes()
    (trusted / "a.der").write_bytes(b"damaged")
    (trusted / "b.pem").write_bytes(b"-----BEGIN CERTIFICATE-----\n")
    assert TrustedFolder(trusted).check(sent, NOW) == sent


def test_refused_certificates_are_kept_up_to_a_limit(tmp_path: Path, trusted: Path) -> None:
    rejected = tmp_path / "rejected"
    folder = TrustedFolder(trusted, rejected)
    rejected.mkdir()
    sent = make_certificate(tmp_path, "a client").read_bytes()
    for n in range(MOST_REJECTED - 1):
        (rejected / f"{n}.der").write_bytes(b"")
    with pytest.raises(NotTrusted, match=r"to trust it, copy .*a_client-[0-9a-f]{16}\.der there"):
        folder.check(sent, NOW)
    with pytest.raises(NotTrusted, match=r"not in .*trusted: CN=hmi, SHA-256 [0-9a-f]{64}$"):
        folder.check(make_certificate(tmp_path, "hmi").read_bytes(), NOW)
    assert len(list(rejected.iterdir())) == MOST_REJECTED


@given(st.binary(max_size=300))
@settings(max_examples=300)
def test_any_bytes_in_place_of_a_certificate_are_refused(data: bytes) -> None:
    assert code_of(Path("/none"), data) == "BadCertificateInvalid"


def test_the_servers_certificate_needs_its_uri_and_its_key(tmp_path: Path) -> None:
    own = make_certificate(tmp_path, "own", uri="urn:fieldtwin:site:scada")
    key = own.with_suffix(".pem")
    assert load_identity(own, key, "urn:fieldtwin:site:scada").key.key_size == 2048
    with pytest.raises(
        FileInvalid, match=r"application URI; expected urn:fieldtwin:site:hmi; got urn:fieldtwin:site:scada"
    ):
        load_identity(own, key, "urn:fieldtwin:site:hmi")
    make_certificate(tmp_path, "other")
    with pytest.raises(FileInvalid, match="the key does not belong to the certificate"):
        load_identity(own, tmp_path / "other.pem", "urn:fieldtwin:site:scada")
    with pytest.raises(FileInvalid, match="not a private key"):
        load_identity(own, own, "urn:fieldtwin:site:scada")
    curve = ec.generate_private_key(ec.SECP256R1())
    key.write_bytes(curve.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    with pytest.raises(FileInvalid, match="the key does not belong to the certificate"):
        load_identity(own, key, "urn:fieldtwin:site:scada")
    with pytest.raises(FileInvalid, match="not a certificate"):
        load_identity(key, key, "urn:fieldtwin:site:scada")
