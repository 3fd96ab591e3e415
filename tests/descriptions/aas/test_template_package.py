"""A template in an AASX package: its bytes return, other SDKs read the shell, and a damaged package is refused."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path

import pytest
from aas_core3 import jsonization, verification
from click.testing import CliRunner, Result

from fieldtwin.cli.main import cli
from fieldtwin.gateway.core.errors import FileInvalid


def run(*words: str | Path) -> Result:
    return CliRunner().invoke(cli, [str(word) for word in words], standalone_mode=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a template, and the package that carries it."""
    folder = tmp_path_factory.mktemp("package")
    assert run("template", "pack", "observatory", "-o", folder / "t.zip").exception is None
    done = run("template", "to-aasx", folder / "t.zip", "-o", folder / "t.aasx")
    assert done.exception is None, done.stderr
    assert "lost: the interface (device ctd, device inclinometer): the description has Modbus TCP only" in done.stderr
    return folder


def test_template_returns_with_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "back.zip"
    assert run("template", "from-aasx", folder / "t.aasx", "-o", out).exception is None
    assert out.read_bytes() == (folder / "t.zip").read_bytes()
    again = run("template", "from-aasx", folder / "t.aasx", "-o", out).exception
    assert isinstance(again, FileInvalid)
    assert "already exists" in str(again)


def test_independent_reader_accepts_the_shell_of_the_package(folder: Path) -> None:
    with zipfile.ZipFile(folder / "t.aasx") as package:
        environment = jsonization.environment_from_jsonable(json.loads(package.read("aasx/data.json")))
    assert [str(error.cause) for error in verification.verify(environment)] == []
    names = {submodel.id_short for submodel in environment.submodels or []}
    assert names == {"TemplateIdentification", "DigitalTemplate", "AssetInterfacesDescription"}


def test_parts_that_relationships_name_exist(folder: Path) -> None:
    with zipfile.ZipFile(folder / "t.aasx") as package:
        names = set(package.namelist())
        assert "/aasx/files/template_observatory.zip" in package.read("aasx/_rels/data.json.rels").decode()
    assert "aasx/files/template_observatory.zip" in names


def test_interfaces_of_the_package_are_imported_as_profiles(folder: Path) -> None:
    done = run("profile", "import", "aid", folder / "t.aasx", "--json")
    assert done.exception is None
    assert "link_state" in json.loads(done.stdout)["profile"]


def changed(package: Path, name: str, data: bytes) -> bytes:
    """Return the package with the content of one part replaced."""
    out = io.BytesIO()
    with zipfile.ZipFile(package) as old, zipfile.ZipFile(out, "w") as new:
        for each in old.namelist():
            new.writestr(each, data if each == name else old.read(each))
    return out.getvalue()


@pytest.mark.parametrize(
    ("part", "content", "message"),
    [
        ("aasx/files/template_observatory.zip", b"PK", "the template is damaged"),
        ("aasx/data.json", b"<a/>", "not a file of Asset Administration Shells"),
        ("aasx/data.json", b"{" * 100_000, "not a file of Asset Administration Shells"),
    ],
)
def test_damaged_package_is_refused(folder: Path, tmp_path: Path, part: str, content: bytes, message: str) -> None:
    (tmp_path / "bad.aasx").write_bytes(changed(folder / "t.aasx", part, content))
    error = run("template", "from-aasx", tmp_path / "bad.aasx", "-o", tmp_path / "back.zip").exception
    assert isinstance(error, FileInvalid)
    assert message in str(error)
    assert not (tmp_path / "back.zip").exists()


def test_shell_without_a_template_is_refused(tmp_path: Path) -> None:
    assert run("profile", "export", "aid", "eastron-sdm630", "-o", tmp_path / "m.json").exception is None
    error = run("template", "from-aasx", tmp_path / "m.json", "-o", tmp_path / "back.zip").exception
    assert isinstance(error, FileInvalid)
    assert "the package carries no template" in str(error)
