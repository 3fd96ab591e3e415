"""A certification authority for one test run: created by openssl on demand, removed with the directory."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from pathlib import Path

ROLE = "1.3.6.1.4.1.50316.802.1"


@dataclass(frozen=True)
class Pki:
    """Files of one authority and the certificates it signed; each name gives NAME.pem (certificate) and NAME.key."""

    directory: Path

    def path(self, name: str) -> str:
        return str(self.directory / name)

    @property
    def ca(self) -> str:
        return self.path("ca.pem")

    def cert(self, name: str) -> str:
        return self.path(f"{name}.pem")

    def key(self, name: str) -> str:
        return self.path(f"{name}.key")

    def issue(self, name: str, alternative_name: str = "", role: str = "") -> None:
        """Create a certificate for NAME, signed by the authority, with a role if one is given."""
        extensions = [f"subjectAltName={alternative_name or 'DNS:' + name}"]
        if role:
            extensions.append(f"{ROLE}=ASN1:UTF8String:{role}")
        (self.directory / f"{name}.ext").write_text("\n".join(extensions) + "\n")
        _openssl(
            *("req", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"),
            *("-keyout", self.key(name), "-out", self.path(f"{name}.csr"), "-subj", f"/CN={name}"),
        )
        _openssl(
            *("x509", "-req", "-in", self.path(f"{name}.csr"), "-CA", self.ca, "-CAkey", self.path("ca.key")),
            *("-CAcreateserial", "-days", "2", "-extfile", self.path(f"{name}.ext"), "-out", self.cert(name)),
        )


def make_pki(directory: Path) -> Pki:
    """Create an authority in `directory` that has signed a server (127.0.0.1) and a client with role Operator."""
    pki = Pki(directory)
    _openssl(
        *("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "2"),
        *("-keyout", pki.path("ca.key"), "-out", pki.ca, "-subj", "/CN=test authority"),
    )
    pki.issue("server", "IP:127.0.0.1", role="Server of tests")
    pki.issue("client", role="Operator")
    return pki


def _openssl(*arguments: str) -> None:
    subprocess.run(["openssl", *arguments], check=True, capture_output=True, timeout=20)
