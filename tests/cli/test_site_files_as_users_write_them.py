"""Site files and options as users write them: names of values, several mistakes at a time, durations without a unit."""

from __future__ import annotations

from pathlib import Path

import click
import pytest
from click.testing import CliRunner
from template_rig import fieldtwin

from fieldtwin.cli.options import Duration
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.site.system import load_system

PROFILE = """
device: test/fan
source: "made for this test"
protocol: modbus
tags:
  mode: {at: "holding:0", access: rw, values: {0: OFF, 1: SLOW, 2: FAST}}
  level: {at: "holding:1"}
"""
SYSTEM = """
fieldtwin: 1
system: fan
buses:
  lan: {url: "tcp://127.0.0.1:1502"}
devices:
  fan: {profile: fan.yaml, bus: lan, unit: 1, writable: [mode], safe: {mode: OFF}}
plc:
  cycle_ms: 100
  programs:
    p: {source: "fan.st", inputs: {level: {tag: fan.level}}, outputs: {mode: fan.mode}}
"""
PROGRAM = """
PROGRAM p
VAR_INPUT level : UINT; END_VAR
VAR_OUTPUT mode : UINT; END_VAR
mode := 1;
END_PROGRAM
"""
PROTOTYPE = """
prototype_of: fan_system.yaml
buses: {lan: {listen: "tcp://127.0.0.1:0"}}
devices:
  fan: {model: profile, values: {level: 3, mode: FAST}}
"""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    (tmp_path / "fan.yaml").write_text(PROFILE)
    (tmp_path / "fan.st").write_text(PROGRAM)
    (tmp_path / "fan_system.yaml").write_text(SYSTEM)
    (tmp_path / "fan_system.prototype.yaml").write_text(PROTOTYPE)
    return tmp_path / "fan_system.yaml"


def test_a_safe_value_may_be_the_name_that_the_profile_gives_it(site: Path) -> None:
    """Defect: `safe: {mode: OFF}` was refused with "Input should be a valid integer", although the profile names 0 OFF."""
    assert load_system(str(site)).devices["fan"].safe == {"mode": 0}


def test_an_unknown_name_of_a_safe_value_lists_the_names(site: Path) -> None:
    site.write_text(SYSTEM.replace("mode: OFF", "mode: OF"))
    with pytest.raises(FileInvalid, match=r"expected a number or OFF or SLOW or FAST; got 'OF' \(did you mean 'OFF'"):
        load_system(str(site))


def test_a_safe_value_of_a_coil_may_be_false(site: Path) -> None:
    """Defect: `safe: {run: false}` was refused with "Input should be a valid integer; got False"."""
    profile = site.parent / "fan.yaml"
    profile.write_text(profile.read_text().rstrip() + '\n  run: {at: "coil:0", type: bool, access: rw}\n')
    site.write_text(SYSTEM.replace("mode: OFF", "run: false").replace("writable: [", "writable: [run, "))
    safe = load_system(str(site)).devices["fan"].safe
    assert safe == {"run": 0}
    assert type(safe["run"]) is int


def test_true_is_not_a_safe_value_of_a_number(site: Path) -> None:
    site.write_text(SYSTEM.replace("mode: OFF", "mode: true"))
    with pytest.raises(FileInvalid, match="expected a number or OFF or SLOW or FAST; got true"):
        load_system(str(site))


def test_an_input_without_its_keys_names_the_keys(site: Path) -> None:
    """Defect: `inputs: {level: fan.level}` was refused with "Input should be a valid dictionary or instance of InputForm"."""
    text = SYSTEM.replace("inputs: {level: {tag: fan.level}}", "inputs: {level: fan.level}")
    assert text != SYSTEM
    site.write_text(text)
    with pytest.raises(FileInvalid, match=r"level; expected the keys tag, if_bad; got 'fan.level'"):
        load_system(str(site))


def test_a_value_that_fits_no_type_names_all_of_them(site: Path) -> None:
    site.write_text(SYSTEM.replace("mode: OFF", "mode: [OFF]"))
    with pytest.raises(FileInvalid, match="expected true or false or a whole number or a number or text; got "):
        load_system(str(site))


def test_a_prototype_of_another_system_names_the_key(site: Path) -> None:
    """Defect: `prototype_of: fan_system` was refused with "this is another system's prototype"."""
    prototype = site.with_name("fan_system.prototype.yaml")
    prototype.write_text(PROTOTYPE.replace("fan_system.yaml", "fan_system"))
    with pytest.raises(FileInvalid, match=r"`prototype_of` names a different system file; expected fan_system.yaml"):
        load_prototype(load_system(str(site)))


def test_a_device_of_a_prototype_may_start_with_a_named_value(site: Path) -> None:
    done = fieldtwin(site.parent, "simulate", str(site), "--for", "2s")
    assert done.returncode == 0, done.stderr


def test_every_mistake_of_a_file_is_shown_with_its_line(site: Path) -> None:
    """Defect: only the first mistake was shown, with "1 more" after it."""
    text = (
        SYSTEM.replace("url:", "timeoutms: 3, url:")
        .replace("writable", "writeable")
        .replace("cycle_ms: 100", "cycle_ms: x")
    )
    site.write_text(text)
    done = fieldtwin(site.parent, "run", str(site), "--plant", "--for", "1s")
    lines = done.stderr.strip().splitlines()
    assert done.returncode == 3
    assert ["unknown key 'timeoutms'" in lines[0], "unknown key 'writeable'" in lines[1], "cycle_ms" in lines[2]] == [
        True
    ] * 3
    assert all(str(site.name) in line for line in lines)
    assert len(lines) == 3, "a value that fits no branch of a union is one mistake"


@click.command()
@click.option("--timeout", type=Duration(), default="1s")
def command(timeout: float) -> None:
    click.echo(f"{timeout:g}")


@pytest.mark.parametrize(
    ("given", "seconds"), [("500ms", "0.5"), ("20s", "20"), ("2m", "120"), ("2min", "120"), ("1h", "3600"), ("0", "0")]
)
def test_a_duration_has_a_unit(given: str, seconds: str) -> None:
    assert CliRunner().invoke(command, ["--timeout", given]).output.strip() == seconds


def test_a_duration_without_a_unit_is_refused() -> None:
    """Defect: `--timeout 500` meant 500 seconds, without a message."""
    done = CliRunner().invoke(command, ["--timeout", "500"])
    assert done.exit_code == 2
    assert "'500' has no unit: write 500ms, 500s, 500m or 500h" in done.output
