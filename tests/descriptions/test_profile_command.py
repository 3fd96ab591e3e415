"""`fieldtwin profile`: its files and output, and the inputs that it refuses."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from fieldtwin.cli.main import cli
from fieldtwin.descriptions.formats import FORMATS
from fieldtwin.gateway.core.errors import CheckFailed, FieldtwinError, FileInvalid, UsageError
from fieldtwin.gateway.core.files.profile_file import load_profile

PLAIN = """
device: acme/plain
source: a test
protocol: modbus
tags:
  level: {at: 'holding:5', type: int16}
"""


def run(*words: str | Path) -> Result:
    return CliRunner().invoke(cli, ["profile", *map(str, words)], standalone_mode=False)


def error_of(*words: str | Path) -> FieldtwinError:
    error = run(*words).exception
    assert isinstance(error, FieldtwinError)
    return error


@pytest.fixture
def sheet(tmp_path: Path) -> Path:
    assert run("export", "eds", "drive-cia402", "-o", tmp_path / "drive.eds").exception is None
    return tmp_path / "drive.eds"


def test_each_format_has_what_its_row_promises() -> None:
    for name, row in FORMATS.items():
        module = import_module(row.module)
        assert name == row.name
        assert hasattr(module, "import_description") == row.imports, name
        assert hasattr(module, "export_description") == row.exports, name
        assert bool(row.one_way) == (not (row.imports and row.exports)), name


def test_the_formats_are_listed() -> None:
    listed = json.loads(run("formats", "--json").stdout)
    assert [row["name"] for row in listed] == list(FORMATS)
    assert all(name in run("formats").stdout for name in FORMATS)


def test_an_import_writes_the_profile_and_its_eds(sheet: Path, tmp_path: Path) -> None:
    folder = tmp_path / "devices"
    folder.mkdir()
    done = run("import", "eds", sheet, "-o", folder / "drive.yaml", "--set", "device=acme/drive")
    assert done.exception is None
    profile = load_profile(folder / "drive.yaml")
    assert profile.name == "acme/drive"
    assert (folder / "drive.eds").read_bytes() == sheet.read_bytes()
    again = error_of("import", "eds", sheet, "-o", folder / "drive.yaml")
    assert isinstance(again, FileInvalid)
    (folder / "drive.eds").write_text("another", encoding="utf-8")
    other = error_of("import", "eds", sheet, "-o", folder / "other.yaml")
    assert "with another content" in str(other)
    assert not (folder / "other.yaml").exists()


def test_without_out_the_profile_is_printed(sheet: Path) -> None:
    done = run("import", "eds", sheet)
    assert "statusword: {object: '6041:00', type: uint16}" in done.stdout
    assert "needs drive.eds in its folder" in done.stderr


def test_losses_are_printed_and_in_json(tmp_path: Path) -> None:
    out = tmp_path / "d.eds"
    assert "lost: the names of its values (tag mode, tag mode_display):" in run("export", "eds", "drive-cia402").stderr
    found = json.loads(run("export", "eds", "drive-cia402", "-o", out, "--json").stdout)
    assert found["file"] == str(out)
    assert {
        "place": "tag target_torque",
        "what": "`danger`",
        "why": "the format has no place for it",
        "note": False,
    } in found["losses"]


def test_with_strict_a_loss_is_an_error_and_nothing_is_written(tmp_path: Path) -> None:
    error = error_of("export", "eds", "drive-cia402", "-o", tmp_path / "d.eds", "--strict")
    assert isinstance(error, CheckFailed)
    assert error.exit_code == 1
    assert not (tmp_path / "d.eds").exists()


def test_strict_accepts_an_import_without_losses(sheet: Path) -> None:
    assert run("import", "eds", sheet, "--strict", "--set", "objects=pdo").exception is None


def test_strict_permits_parts_that_are_only_listed(tmp_path: Path) -> None:
    (tmp_path / "plain.yaml").write_text(PLAIN, encoding="utf-8")
    words = ("home-assistant", tmp_path / "plain.yaml", "--set", "endpoint=tcp://192.0.2.7", "--strict")
    assert run("export", *words).exception is None
    assert run("export", *words, "-o", tmp_path / "map.yaml").exception is None
    done = run("import", "home-assistant", tmp_path / "map.yaml", "--strict")
    assert done.exception is None
    assert "not converted: address of the hub" in done.stderr


def test_source_of_a_profile_is_no_loss(tmp_path: Path) -> None:
    out = tmp_path / "d.eds"
    found = json.loads(run("export", "eds", "drive-cia402", "-o", out, "--json").stdout)["losses"]
    assert [loss["note"] for loss in found if loss["what"] == "`source`"] == [True]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("export", "esd", "drive-cia402"), "did you mean 'eds'?"),
        (("export", "eds", "drive-cia402", "--set", "node=3"), "eds has no setting 'node'"),
        (("export", "eds", "drive-cia402", "--set", "node"), "expected NAME=VALUE"),
        (("import", "eds", "missing.eds"), "missing.eds: cannot be read: No such file or directory"),
        (("import", "eds", "/dev/null"), "not a regular file"),
    ],
)
def test_a_wrong_call_is_refused(words: tuple[str, ...], message: str) -> None:
    error = error_of(*words)
    assert isinstance(error, UsageError | FileInvalid)
    assert message in str(error)
