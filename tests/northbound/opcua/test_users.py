"""The file of users of an OPC UA server, and the hashes of passwords."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid
from fieldtwin.northbound.opcua.access.passwords import hash_of, is_hash, matches, unmatchable_hash
from fieldtwin.northbound.opcua.access.users import OPERATE, VIEW, Account, UserForm, Users, thumbprint

HASH = hash_of("correct horse")


def test_a_password_has_a_new_hash_each_time_and_matches_only_itself() -> None:
    again = hash_of("correct horse")
    assert again != HASH
    assert matches("correct horse", again)
    assert not matches("correct house", again)


@pytest.mark.parametrize(
    "text",
    [
        "", "correct horse", "scrypt$1$8$1$aa$bb", HASH.replace("scrypt", "md5"), HASH.replace("$16384$", "$16383$"),
        HASH.replace("$16384$", "$1048576$"), HASH.replace("$8$", "$64$"), HASH[:-2], HASH + "zz",
    ],
)  # fmt: skip
def test_a_text_that_is_not_a_hash_of_bounded_cost_is_not_accepted(text: str) -> None:
    assert not is_hash(text)


@given(st.text(max_size=200))
@settings(max_examples=300)
def test_any_text_is_a_hash_or_is_refused(text: str) -> None:
    assert not is_hash(text)
    assert not is_hash(f"scrypt${text}")


def test_a_file_keeps_its_users_and_only_its_owner_can_read_it(tmp_path: Path) -> None:
    path = tmp_path / "users.yaml"
    digest = thumbprint(b"certificate")
    made = Users({"anna": UserForm(role="operate", password=HASH), "scada": UserForm(role="view", certificate=digest)})
    made.save(path)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert "correct horse" not in path.read_text(encoding="utf-8")
    users = Users.load(path)
    assert users.with_password("anna", "correct horse") == Account("anna", OPERATE)
    assert users.with_certificate(b"certificate") == Account("scada", VIEW)
    for name, password in (("anna", "wrong"), ("anna", ""), ("carl", ""), ("scada", ""), ("scada", "correct horse")):
        assert users.with_password(name, password) is None
    assert users.with_certificate(b"other") is None


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("users: {anna: {role: admin, password: x}}", r":1:16.*view or operate"),
        ("users: {anna: {role: view}}", r":1:9.*without password and certificate"),
        ("users: {anna: {role: view, password: secret}}", r":1:28.*not the hash of a password"),
        (
            "users: {anna: {role: view, certificate: AB}}",
            r":1:28.*not the SHA-256 of a certificate; expected 64 hex digits",
        ),
        ("users: {'a b': {role: view, password: x}}", r"a b"),
        ("user: {}", r"unknown key 'user'"),
        ("", r"users\.yaml"),
    ],
)
def test_an_error_of_the_file_states_its_place(tmp_path: Path, text: str, error: str) -> None:
    path = tmp_path / "users.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(FileInvalid, match=error):
        Users.load(path)


@given(st.binary(max_size=200))
@settings(max_examples=300)
def test_any_content_of_the_file_is_read_or_refused_with_an_error_of_ours(
    tmp_path_factory: pytest.TempPathFactory, data: bytes
) -> None:
    path = tmp_path_factory.getbasetemp() / "any-users.yaml"
    path.write_bytes(data)
    with pytest.raises(FieldtwinError):
        Users.load(path)


def test_a_file_that_cannot_be_read_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid, match="No such file"):
        Users.load(tmp_path / "none.yaml")


def test_the_hash_for_an_unknown_user_costs_as_much_as_the_hash_of_a_password() -> None:
    costs, again = unmatchable_hash().split("$")[:4], unmatchable_hash()
    assert costs == HASH.split("$")[:4]
    assert is_hash(again)
    assert again != unmatchable_hash()
    assert not matches("", again)
