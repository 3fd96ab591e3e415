"""The file of an OPC UA server's users: their roles, and the hashes of their passwords or certificates.

    users:
      anna: {role: operate, password: scrypt$16384$8$1$...}
      historian: {role: view, certificate: 3f1c...}

`fieldtwin opcua user` writes it. A certificate is named by the SHA-256 of its DER bytes, in hex. This module does not need the
OPC UA library.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.input_file import read_input, reading
from fieldtwin.gateway.core.files.yaml_file import YamlFile, parse, validate
from fieldtwin.northbound.opcua.access.passwords import is_hash, matches, unmatchable_hash

Role = Literal["view", "operate"]
VIEW: Role = "view"
OPERATE: Role = "operate"
ROLES: tuple[Role, ...] = (VIEW, OPERATE)
"""The roles: `view` may read, `operate` may also write."""
MOST_BYTES = 1024 * 1024
MOST_USERS = 1000
NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_.@-]{0,47}$"
_HEAD = "# The users of an OPC UA server; `fieldtwin opcua user` writes this file.\n"


class UserForm(BaseModel):
    """One user, with a password, a certificate or both."""

    model_config = ConfigDict(extra="forbid", strict=True)

    role: Role
    password: str = ""
    certificate: str = ""


class UsersForm(BaseModel):
    """A file of users."""

    model_config = ConfigDict(extra="forbid", strict=True)

    users: dict[Annotated[str, Field(pattern=NAME_PATTERN)], UserForm] = Field(max_length=MOST_USERS)


@dataclass(frozen=True)
class Account:
    """An authenticated user."""

    name: str
    role: Role

    @property
    def may_write(self) -> bool:
        """Return whether the user may write tags."""
        return self.role == OPERATE


class Users:
    """The users of a file."""

    def __init__(self, forms: dict[str, UserForm] | None = None) -> None:
        self.forms = dict(forms or {})

    @classmethod
    def load(cls, path: Path) -> Users:
        """Read a file of users. Raises `FileInvalid` with the place of an error."""
        with reading(path):
            data = read_input(path, MOST_BYTES)
        try:
            file = parse(data.decode(), str(path))
        except UnicodeDecodeError as e:
            raise FileInvalid("the file is not text in UTF-8", path=str(path)) from e
        forms = validate(file, UsersForm).users
        for name, form in forms.items():
            _check(file, name, form)
        return cls(forms)

    def save(self, path: Path) -> None:
        """Write the file, readable for its owner only. Raises `FileInvalid` if it cannot be written."""
        forms = {name: form.model_dump(exclude_defaults=True) for name, form in self.forms.items()}
        text = _HEAD + yaml.safe_dump({"users": forms}, sort_keys=False, width=200)
        part = path.with_name(f".{path.name}.part")
        try:
            part.unlink(missing_ok=True)
            with open(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as file:
                file.write(text)
            part.replace(path)
        except OSError as e:
            raise FileInvalid(f"cannot write the file: {e.strerror or e}", path=str(path)) from e

    def with_password(self, name: str, password: str) -> Account | None:
        """Return the user with this name and password. An unknown name takes as long as a wrong password."""
        form = self.forms.get(name)
        stored = form.password if form is not None and form.password else _UNKNOWN
        is_right = matches(password, stored)
        return Account(name, form.role) if form is not None and form.password and is_right else None

    def with_certificate(self, certificate: bytes) -> Account | None:
        """Return the user with this certificate (DER), whose possession of the key was already proved."""
        digest = thumbprint(certificate)
        for name, form in self.forms.items():
            if form.certificate and hmac.compare_digest(form.certificate, digest):
                return Account(name, form.role)
        return None


def thumbprint(certificate: bytes) -> str:
    """Return the SHA-256 of a certificate (DER) in hex."""
    return hashlib.sha256(certificate).hexdigest()


def _check(file: YamlFile, name: str, form: UserForm) -> None:
    loc = ("users", name)
    hint = "`fieldtwin opcua user` writes this file"
    if not form.password and not form.certificate:
        raise file.error(loc, "a user without password and certificate", expected="one of both", hint=hint)
    if form.password and not is_hash(form.password):
        raise file.error((*loc, "password"), "not the hash of a password", expected="scrypt$N$R$P$SALT$KEY", hint=hint)
    if form.certificate and not re.fullmatch(r"[0-9a-f]{64}", form.certificate):
        raise file.error(
            (*loc, "certificate"), "not the SHA-256 of a certificate", expected="64 hex digits in lower case", hint=hint
        )


_UNKNOWN = unmatchable_hash()
