"""`fieldtwin opcua`: certificate and users of a server, and the errors of a run without them."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from secured_server import SYSTEM

from fieldtwin.cli.system.opcua_command import command
from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid, UsageError
from fieldtwin.northbound.opcua.access.files import check_files
from fieldtwin.northbound.opcua.access.trust import load_identity
from fieldtwin.northbound.opcua.access.users import OPERATE, VIEW, Account, Users
from fieldtwin.twin.site.servers.serving_opcua import OpcuaServeConfig
from fieldtwin.twin.site.system import load_system


@pytest.fixture
def site(tmp_path: Path) -> Path:
    path = tmp_path / "site.yaml"
    path.write_text(SYSTEM, encoding="utf-8")
    return path


def call(*words: object, stdin: str = "") -> Result:
    return CliRunner().invoke(command, [str(word) for word in words], input=stdin)


def error_of(*words: object, stdin: str = "") -> FieldtwinError:
    found = call(*words, stdin=stdin).exception
    assert isinstance(found, FieldtwinError)
    return found


def server_of(site: Path) -> OpcuaServeConfig:
    return load_system(str(site)).serving.opcua[0]


def test_a_certificate_and_users_are_what_a_run_needs(site: Path) -> None:
    folder = site.parent / "pki"
    with pytest.raises(FileInvalid, match=r"own\.der: .*does not exist \(`fieldtwin opcua certificate` creates it\)"):
        check_files(server_of(site), "site")
    assert call("certificate", site, "--host", "gateway.example", "--host", "192.0.2.7").exit_code == 0
    assert stat.S_IMODE((folder / "own.key").stat().st_mode) == 0o600
    load_identity(folder / "own.der", folder / "own.key", "urn:fieldtwin:site:scada")
    with pytest.raises(FileInvalid, match=r"users\.yaml: .*does not exist \(`fieldtwin opcua user` creates it\)"):
        check_files(server_of(site), "site")
    assert call("user", site, "anna", "--role", "operate", stdin="correct horse\n").exit_code == 0
    check_files(server_of(site), "site")
    with pytest.raises(FileInvalid, match="application URI; expected urn:fieldtwin:other:scada"):
        check_files(server_of(site), "other")


def test_an_existing_certificate_is_not_replaced(site: Path) -> None:
    assert call("certificate", site).exit_code == 0
    before = (site.parent / "pki/own.key").read_bytes()
    assert "the file exists already" in str(error_of("certificate", site))
    assert (site.parent / "pki/own.key").read_bytes() == before


def test_a_pem_file_name_gives_a_pem_certificate(site: Path) -> None:
    site.write_text(SYSTEM.replace("own.der", "own.pem"), encoding="utf-8")
    assert call("certificate", site).exit_code == 0
    assert (site.parent / "pki/own.pem").read_bytes().startswith(b"-----BEGIN CERTIFICATE-----")


def test_users_are_added_changed_and_removed(site: Path) -> None:
    path = site.parent / "pki/users.yaml"
    call("user", site, "anna", stdin="correct horse\n")
    assert Users.load(path).with_password("anna", "correct horse") == Account("anna", VIEW)
    call("user", site, "anna", "--role", "operate", stdin="battery staple\n")
    assert Users.load(path).with_password("anna", "battery staple") == Account("anna", OPERATE)
    call("certificate", site)
    assert call("user", site, "scada", "--certificate", site.parent / "pki/own.der").exit_code == 0
    assert Users.load(path).with_certificate((site.parent / "pki/own.der").read_bytes()) == Account("scada", VIEW)
    assert call("user", site, "anna", "--remove").exit_code == 0
    assert list(Users.load(path).forms) == ["scada"]


@pytest.mark.parametrize(
    ("words", "stdin", "error"),
    [
        (["anna"], "short\n", "the length of the password; expected 8 to 200 characters"),
        (["anna"], "", "the length of the password"),
        (["anna"], "x" * 201 + "\n", "the length of the password"),
        (["an na"], "correct horse\n", "not the name of a user"),
        (["anna", "--remove"], "", "no user 'anna'"),
        (["anna", "--server", "hmi"], "correct horse\n", "no OPC UA server 'hmi'; expected --server scada"),
    ],
)
def test_a_wrong_user_is_refused(site: Path, words: list[str], stdin: str, error: str) -> None:
    found = error_of("user", site, *words, stdin=stdin)
    assert isinstance(found, UsageError)
    assert error in str(found)
    assert not (site.parent / "pki/users.yaml").exists()


def test_a_server_without_security_has_no_users(site: Path) -> None:
    text = SYSTEM.partition(", security")[0] + "}}\n"
    site.write_text(text, encoding="utf-8")
    assert "this server has no `security`" in str(error_of("user", site, "anna", stdin="correct horse\n"))
