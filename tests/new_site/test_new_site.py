"""`fieldtwin new`: each combination of choices gives a site whose files are right, and whose scenarios pass at once."""

from __future__ import annotations

import itertools
import json
import re
import shlex
from pathlib import Path
from typing import Any

import click
import pytest
import yaml
from click.testing import CliRunner, Result
from jsonschema import Draft202012Validator

from fieldtwin import installation
from fieldtwin.cli.main import cli
from fieldtwin.gateway.core.errors import FieldtwinError, UsageError
from fieldtwin.gateway.core.files.yaml_file import load
from fieldtwin.new_site.wishes import name_from
from fieldtwin.site.check import check_site
from fieldtwin.twin.site.data_files import data_root

PROFILES = sorted(path.stem for path in (data_root() / "profiles" / "devices").glob("*.yaml"))
CONTROLS = ("none", "python", "st", "own")
CIS = {"github": ".github/workflows/fieldtwin.yml", "gitlab": ".gitlab-ci.yml", "none": ""}
THREE_BUSES = ("tank=example", "meter=sunspec-inverter-103@tcp://192.0.2.7#3", "inclinometer-cia410")
HEADER = re.compile(r"# yaml-language-server: \$schema=(\S+)\n")

SWITCH = """\
device: mysite/switch
source: "page 3"
protocol: modbus
tags:
  closed: {at: 10001, type: bool}
"""


def new(*args: str | Path) -> Result:
    """Run `fieldtwin new` without a terminal. Errors of fieldtwin are raised."""
    done = CliRunner().invoke(cli, ["new", *map(str, args)], standalone_mode=False)
    if done.exception is not None:
        raise done.exception
    assert done.return_value == 0, done.output
    return done


def run_scenarios(folder: Path) -> Result:
    return CliRunner().invoke(cli, ["test", str(folder)], standalone_mode=False)


def devices(*texts: str) -> list[str]:
    return [word for text in texts for word in ("--device", text)]


def each_combination() -> list[Any]:
    """Return each combination of a profile and a control. Two of the four controls of each profile are long tests, because
    profile and control are written independently of each other.
    """
    return [
        pytest.param(profile, control, marks=[] if (row + column) % 4 < 2 else pytest.mark.long)
        for row, profile in enumerate(PROFILES)
        for column, control in enumerate(CONTROLS)
    ]


def assert_scenarios_pass(folder: Path, expected: int) -> None:
    found = check_site(folder)
    assert (found.errors, found.warnings) == ([], [])
    done = run_scenarios(folder)
    assert (done.exception, done.return_value) == (None, 0), done.output
    assert done.output.splitlines()[-1] == f"{expected} passed"


@pytest.mark.parametrize(("profile", "control"), each_combination())
def test_scenarios_of_a_new_site_pass_with_each_profile_and_control(tmp_path: Path, profile: str, control: str) -> None:
    folder = (
        tmp_path / f"{name_from(profile, 'site')}_{control}"
    )  # modules of programs need different names in one process
    new(folder, "--device", profile, "--control", control, "--ci", "none", "--no-compose")
    assert_scenarios_pass(folder, 2 if control in ("python", "st") else 1)


@pytest.mark.parametrize("control", CONTROLS)
def test_scenarios_of_a_site_with_three_buses_pass(tmp_path: Path, control: str) -> None:
    folder = tmp_path / f"three {control}"
    new(folder, *devices(*THREE_BUSES), "--control", control)
    assert_scenarios_pass(folder, 2 if control in ("python", "st") else 1)


@pytest.mark.parametrize(("control", "ci", "compose"), [*itertools.product(CONTROLS, CIS, (True, False))])
def test_files_of_each_combination(tmp_path: Path, control: str, ci: str, compose: bool) -> None:
    folder = tmp_path / "plant"
    told = new(
        folder, *devices(*THREE_BUSES), "--control", control, "--ci", ci, "--compose" if compose else "--no-compose"
    )
    assert check_site(folder).errors == []
    files = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    visible = {
        name for name in files if not name.startswith((".fieldtwin/", "__pycache__/"))
    }  # the check imports programs
    program = {"python": {"plant_control.py"}, "st": {"plant.st"}}.get(control, set())
    assert visible == {
        *(
            "plant.yaml",
            "plant.prototype.yaml",
            "silence.scenario.yaml",
            "README.md",
            ".gitignore",
            "profiles/tank.yaml",
        ),
        *program,
        *(["limits.scenario.yaml"] if program else []),
        *(["compose.yaml"] if compose else []),
        *([CIS[ci]] if CIS[ci] else []),
    }
    assert set(told.stdout.splitlines()) == {str(folder / name) for name in visible}
    readme = (folder / "README.md").read_text()
    assert {name for name in visible if f"`{name}`" in readme} == visible - {"README.md", ".gitignore"}
    if CIS[ci]:
        assert_ci_is_right(ci, (folder / CIS[ci]).read_text())
    if compose:
        assert_compose_is_right(yaml.safe_load((folder / "compose.yaml").read_text()), control)


def assert_ci_is_right(service: str, text: str) -> None:
    """The file has the form of the service, installs fieldtwin as installation.py says, and its commands exist."""
    file = yaml.safe_load(text)
    if service == "github":
        steps = file["jobs"]["scenarios"]["steps"]
        assert all(("uses" in step) != ("run" in step) for step in steps)
        commands = [step["run"] for step in steps if "run" in step]
    else:
        assert file["scenarios"]["artifacts"]["when"] == "always"
        commands = file["scenarios"]["script"]
    assert commands[0] == installation.install_command(source=installation.WHEEL)
    assert [line.split()[:2] for line in commands[1:]] == [["fieldtwin", "check"], ["fieldtwin", "test"]]
    for line in commands[1:]:
        assert_command_exists(shlex.split(line)[1:])


def assert_command_exists(words: list[str]) -> None:
    command = cli.get_command(click.Context(cli), words[0])
    assert command is not None, words
    command.make_context(words[0], words[1:])  # raises for unknown options


def assert_compose_is_right(file: dict, control: str) -> None:
    """The services run with known options and variables, without privileges, and wait for health."""
    own = control == "own"
    assert set(file["services"]) == ({"field"} if own else {"field", "controller"})
    for service in file["services"].values():
        assert service["read_only"] is True
        assert service["cap_drop"] == ["ALL"]
        assert service["image"] == "${FIELDTWIN_IMAGE:-fieldtwin}"
        assert service["volumes"] == [".:/site:ro"]
        assert ("ports" in service) == own
        name, *words = service["command"]
        assert words[0] == "/site/plant.yaml"
        assert_command_exists([name, *words])
        command = cli.get_command(click.Context(cli), name)
        assert command is not None
        variables = {f"FIELDTWIN_{name.upper()}_{(p.name or '').upper()}" for p in command.params}
        assert {v for v in service["environment"] if not v.startswith("FIELDTWIN_TEST_")} <= variables
    if not own:
        assert file["services"]["controller"]["depends_on"] == {"field": {"condition": "service_healthy"}}
        sockets = file["services"]["controller"]["healthcheck"]["test"][2:]
        assert [Path(socket).name for socket in sockets] == ["gateway.sock"] + ["plc.sock"] * (control != "none")


def test_the_first_line_of_each_file_names_a_schema_that_exists_and_fits(tmp_path: Path) -> None:
    folder = tmp_path / "plant"
    new(folder, *devices(*THREE_BUSES))
    kinds = [name for name, kind in check_site(folder).files.items() if kind != "compose"]
    assert len(kinds) == 5
    for name in kinds:
        path = folder / name
        header = HEADER.match(path.read_text())
        assert header, name
        schema = json.loads((path.parent / header[1]).read_text())
        assert list(Draft202012Validator(schema).iter_errors(json.loads(json.dumps(load(path).data)))) == []


# -- folders and names --------------------------------------------------------------------------------------------------


def test_a_folder_that_is_not_empty_is_refused_and_stays_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UsageError, match="not empty") as refused:
        new(tmp_path)
    assert "notes.txt" in refused.value.got
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "plant").write_text("")
    with pytest.raises(UsageError, match="not a folder"):
        new(tmp_path / "plant")


def test_an_empty_folder_and_a_new_repository_are_accepted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / ".git").mkdir()
    monkeypatch.chdir(tmp_path)
    new(".", "--name", "plant")
    assert (tmp_path / "plant.yaml").is_file()
    new("a/b/c")
    assert (tmp_path / "a/b/c/c.yaml").is_file()


def test_nothing_is_left_if_a_file_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The folder of the third file is a link to nowhere, so it cannot be made."""
    from fieldtwin.new_site.writing import write_site

    with pytest.raises(UsageError, match="cannot write"):
        write_site(tmp_path / "new" / "plant", {"a.yaml": "1", "b/c.yaml": "2", "b/c.yaml/d.yaml": "3"})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("folder", "system"),
    [("My Plant (north)", "my_plant_north"), ("7th hall", "site_7th_hall"), ("Zürich", "z_rich"), ("水", "site")],
)
def test_a_folder_with_any_name(tmp_path: Path, folder: str, system: str) -> None:
    new(tmp_path / folder, "--control", "st")
    assert (tmp_path / folder / f"{system}.yaml").is_file()
    assert (tmp_path / folder / "README.md").read_text().startswith(f"# {folder}\n")
    assert_scenarios_pass(tmp_path / folder, 2)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--device", "eastron-sdm63"], "did you mean 'eastron-sdm630'"),
        (["--device", "./gone.yaml"], "there is no file"),
        (["--device", "A=example"], "'a' is possible"),
        (["--device", "a=example", "--device", "a=example"], "two devices are called 'a'"),
        (["--device", "example#0"], "1 to 247"),
        (["--device", "example#248"], "1 to 247"),
        (["--device", "inclinometer-cia410#128"], "1 to 127"),
        (["--device", "example#4", "--device", "example#4"], "two devices on line1 have the unit ID 4"),
        (["--device", "example@can:socketcan/can0"], "cannot be at this endpoint"),
        (["--device", "inclinometer-cia410@tcp://h"], "cannot be at this endpoint"),
        (["--device", "example@tls://h"], "certificates"),
        (["--device", "example@nonsense"], "cannot read endpoint"),
        (["--device", "@"], "cannot read the device"),
        (["--device", "example@rtu:/dev/ttyS0?baudrate=9600", "--device", "example@rtu:/dev/ttyS0?baudrate=300"], "two settings"),
        (["--name", "My Plant"], "'my_plant' is possible"),
        (["--scan", "tcp://h#x"], "cannot read the addresses"),
    ],
)  # fmt: skip
def test_wrong_choices_are_refused_and_leave_nothing(tmp_path: Path, args: list[str], message: str) -> None:
    with pytest.raises(FieldtwinError) as refused:
        new(tmp_path / "plant", *args)
    assert message in str(refused.value)
    assert list(tmp_path.iterdir()) == []


# -- devices -------------------------------------------------------------------------------------------------------------


def test_devices_with_one_endpoint_share_a_bus_and_get_different_addresses(tmp_path: Path) -> None:
    new(
        tmp_path / "plant",
        *devices("example#2", "example", "example", "eastron-sdm630@rtu:/dev/ttyUSB0", "range-sensor"),
    )
    system = load(tmp_path / "plant" / "plant.yaml").data
    assert [(d["bus"], d["unit"]) for d in system["devices"].values()] == [
        *(("line1", 2), ("line1", 1), ("line1", 3), ("line1", 4)),
        ("line2", 1),  # its serial settings are different
    ]
    assert {bus["url"] for bus in system["buses"].values()} == {
        "rtu:/dev/ttyUSB0?baudrate=9600&frame=8N1",
        "rtu:/dev/ttyUSB1?baudrate=19200&frame=8E1",
    }


def test_a_profile_of_the_user_is_copied_with_its_data_sheet(tmp_path: Path) -> None:
    shipped = data_root() / "profiles" / "devices"
    mine = tmp_path / "mine"
    mine.mkdir()
    for suffix in (".yaml", ".eds"):
        (mine / f"drive{suffix}").write_bytes(
            (shipped / f"io-cia401{suffix}").read_bytes().replace(b"io-cia401.eds", b"drive.eds")
        )
    new(tmp_path / "plant", "--device", f"drive={mine / 'drive.yaml'}", "--control", "st")
    (mine / "drive.yaml").unlink()
    (mine / "drive.eds").unlink()
    assert (tmp_path / "plant" / "profiles" / "drive.eds").is_file()
    assert_scenarios_pass(tmp_path / "plant", 2)


@pytest.mark.parametrize("control", ["python", "st"])
def test_a_device_with_bits_only(tmp_path: Path, control: str) -> None:
    (tmp_path / "switch.yaml").write_text(SWITCH)
    folder = tmp_path / f"bits_{control}"
    new(folder, "--device", f"di={tmp_path / 'switch.yaml'}", "--control", control)
    assert_scenarios_pass(folder, 2)


def test_a_device_without_a_number_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.yaml").write_text(SWITCH.replace("10001, type: bool", "40001, type: string, registers: 4"))
    with pytest.raises(UsageError, match="number that a program can watch"):
        new(tmp_path / "plant", "--device", str(tmp_path / "text.yaml"))


def test_a_dangerous_or_permanent_setting_is_never_an_output(tmp_path: Path) -> None:
    """The example's pump and sampling periods are commanded; drives and setup registers of shipped devices are not."""
    folder = tmp_path / "plant"
    new(folder, *devices(*PROFILES, "example"))
    outputs = set(load(folder / "plant.yaml").data["plc"]["programs"]["control"]["outputs"].values())
    assert outputs == {
        "tank.pump_speed",
        *(f"{name}.sample_period_s" for name in ("ctd_reference", "current_meter", "oxygen_optode")),
    }


def test_a_limit_of_a_measuring_device_is_not_an_output(tmp_path: Path) -> None:
    """The gas analyser warns below `methane_limit`. It is writable, polled and has a range, but it is not a setpoint."""
    (tmp_path / "gas.yaml").write_text(
        "device: mysite/gas\nprotocol: modbus\nsource: invented\ntags:\n"
        "  methane: {at: 30001, type: uint16, scale: 0.1, unit: '%'}\n"
        "  methane_limit: {at: 40001, type: uint16, scale: 0.1, unit: '%', access: rw, range: [0, 100]}\n"
    )
    new(tmp_path / "plant", "--device", str(tmp_path / "gas.yaml"))
    assert "writable" not in (tmp_path / "plant" / "plant.yaml").read_text()


def test_a_scale_factor_is_not_the_supervised_value(tmp_path: Path) -> None:
    new(tmp_path / "solar", "--device", "sunspec-inverter-103", "--control", "st")
    assert "_sf :" not in (tmp_path / "solar" / "solar.st").read_text()
