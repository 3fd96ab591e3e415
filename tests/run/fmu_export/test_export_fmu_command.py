"""The command line of `fieldtwin export fmu`, and `fieldtwin export` without a command, which converts a recording."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner
from fmu_tool import drive_site, export

from fieldtwin.cli.command_lines import variables_of, wrong_words
from fieldtwin.cli.main import cli
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.run.fmu_export.interface import _kind_of, interface_of
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.site.system import load_system

BUS = "(1795859405.100000) can0 181#0102\n"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--input", "sensor.levl"), "--input sensor.levl: no such number of an emulated device; expected DEVICE.TAG, such as "),
        (("--input", "sensor.levl"), "did you mean 'sensor.level'?"),
        (("-o", "plc.zip"), "expected a name that ends in .fmu; got plc.zip"),
        (("-o", "nowhere/plc.fmu"), "cannot be written: No such file or directory"),
    ],
)  # fmt: skip
def test_wrong_option_is_an_error_that_says_what_is_expected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: tuple[str, str], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    done = export(drive_site(tmp_path / "site"), tmp_path / "plc.fmu", *options)
    assert isinstance(done.exception, FieldtwinError)
    assert message in str(done.exception)
    assert not list(tmp_path.glob("*.fmu*"))


def test_an_existing_file_is_not_replaced(tmp_path: Path) -> None:
    out = tmp_path / "plc.fmu"
    out.write_bytes(b"an FMU of a different tool")
    done = export(drive_site(tmp_path / "site"), out)
    assert isinstance(done.exception, FieldtwinError)
    assert "the file exists already" in str(done.exception)
    assert out.read_bytes() == b"an FMU of a different tool"


def test_network_of_systems_is_no_fmu(tmp_path: Path) -> None:
    done = export("ocean_network", tmp_path / "x.fmu")
    assert isinstance(done.exception, FieldtwinError)


def test_json_lists_the_variables(tmp_path: Path) -> None:
    done = export(drive_site(tmp_path), tmp_path / "plc.fmu", "--input", "sensor.outflow", "--json")
    found = json.loads(done.stdout)
    assert found["inputs"] == ["set.sensor.outflow"]
    assert found["outputs"] == ["sensor.level", "sensor.outflow", "sensor.full", "pump.run", "fill.run"]


def test_numbers_that_programs_read_are_inputs_by_default(tmp_path: Path) -> None:
    system = load_system(str(drive_site(tmp_path)))
    interface = interface_of(system, load_prototype(system))
    assert [(port.name, port.source, port.unit) for port in interface.inputs] == [
        ("set.sensor.level", "sensor.level", "m")
    ]


def test_number_beyond_32_bits_is_a_real(tmp_path: Path) -> None:
    types = {
        "int16": "integer",
        "int32": "integer",
        "uint16": "integer",
        "uint32": "real",
        "int64": "real",
        "float32": "real",
    }
    tags = "".join(f"  {kind}: {{at: 'holding:{8 * at}', type: {kind}}}\n" for at, kind in enumerate(types))
    path = tmp_path / "device.yaml"
    path.write_text(f"device: test/kinds\nprotocol: modbus\nnumbering: sent\nsource: made for this test\ntags:\n{tags}")
    assert {name: _kind_of(tag) for name, tag in load_profile(path).tags.items()} == types


@pytest.mark.parametrize("words", [[], ["recording"]])
def test_recording_is_converted_without_the_name_of_the_command(tmp_path: Path, words: list[str]) -> None:
    (tmp_path / "bus.log").write_text(BUS)
    done = CliRunner().invoke(cli, ["export", *words, "--json", str(tmp_path / "bus.log"), str(tmp_path / "bus.csv")])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["records"] == 1


def test_environment_of_the_old_command_line_still_works(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "bus.log").write_text(BUS)
    monkeypatch.setenv("FIELDTWIN_EXPORT_FRAMING", "nonsense")
    done = CliRunner().invoke(cli, ["export", str(tmp_path / "bus.log"), str(tmp_path / "bus.csv")])
    assert "nonsense" in done.output
    assert "FIELDTWIN_EXPORT_FRAMING" in variables_of("export")


def test_command_lines_in_files_are_checked() -> None:
    assert not list(wrong_words(["export", "a.jsonl", "a.csv"]))
    assert not list(wrong_words(["export", "--json", "a.jsonl", "a.csv"]))
    assert not list(wrong_words(["export", "fmu", "tank", "--input", "sensor.level"]))
    [wrong] = wrong_words(["export", "fmu", "tank", "--inputs", "x"])
    assert wrong.message == "export has no option '--inputs'"
