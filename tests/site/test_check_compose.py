"""`fieldtwin check site` for compose files: each dangling reference of a service that runs fieldtwin, in one run."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from fieldtwin.cli import command_lines
from fieldtwin.cli.main import cli
from fieldtwin.site.check import check_site

CHECKOUT = Path(__file__).parents[2]
TUTORIALS = CHECKOUT / "docs" / "tutorials"


def new(folder: Path, *options: str) -> Path:
    done = CliRunner().invoke(cli, ["new", str(folder), "--yes", *options], standalone_mode=False)
    assert (done.exception, done.return_value) == (None, 0), done.output
    return folder


@pytest.fixture
def site(tmp_path: Path) -> Path:
    return new(tmp_path / "hall")


def errors_of(site: Path) -> list[str]:
    return [str(error).replace(f"{site}/", "") for error in check_site(site, (), command_lines).errors]


def change(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text, old
    path.write_text(text.replace(old, new))


def line(path: Path, part: str) -> int:
    return next(number for number, text in enumerate(path.read_text().splitlines(), 1) if part in text)


@pytest.mark.parametrize("control", ["python", "st", "none", "own"])
def test_a_new_site_of_each_kind_has_no_errors(tmp_path: Path, control: str) -> None:
    folder = new(tmp_path / "hall", "--control", control)
    assert errors_of(folder) == []
    assert check_site(folder, (), command_lines).files["compose.yaml"] == "compose"


@pytest.mark.long
def test_the_compose_file_of_the_checkout_has_no_errors() -> None:
    found = check_site(CHECKOUT, (), command_lines)
    assert found.files["docker-compose.yml"] == "compose"
    assert [error for error in found.errors if "compose" in error.path] == []


@pytest.mark.parametrize("page", ["pump-station", "own-controller"])
def test_the_compose_file_of_a_tutorial_names_only_files_that_the_reader_makes(tmp_path: Path, page: str) -> None:
    text = (TUTORIALS / f"{page}.md").read_text()
    (compose,) = re.findall(r"<!-- file: compose.yaml -->\n```yaml\n(.*?)```", text, re.DOTALL)
    folder = new(tmp_path / "hall")
    (folder / "compose.yaml").write_text(compose)
    missing = {re.sub(r"^.*no file '([^']*)'.*$", r"\1", error) for error in errors_of(folder)}
    name = {"pump-station": "station", "own-controller": "vessel"}[page]
    assert missing == {f"/site/{name}.yaml", f"/site/{name}.compose.yaml"}


def test_a_renamed_bus_is_reported_in_the_compose_file_too(site: Path) -> None:
    bus = re.findall(r"--listen=(\w+)=", (site / "compose.yaml").read_text())[0]
    for path in site.glob("hall*.yaml"):
        path.write_text(re.sub(rf"\b{bus}\b", "renamed", path.read_text()))
    (error,) = errors_of(site)
    assert error.startswith(f"compose.yaml:{line(site / 'compose.yaml', '--listen=')}:")
    assert f"no bus {bus!r} in hall.yaml; expected one of renamed" in error


def test_all_dangling_references_are_reported_in_one_run(site: Path) -> None:
    compose = site / "compose.yaml"
    change(compose, "- /site/hall.yaml", "- /site/hal.yaml")
    change(compose, "--control=0.0.0.0:7420", "--controll=0.0.0.0:7420")
    change(
        compose,
        "[run, /site/hall.yaml, --prototype, --field=field]",
        "[run, /sites/hall.yaml, --prototype, --field=feld, --for=soon]",
    )
    change(compose, "FIELDTWIN_RUN_TOKEN", "FIELDTWIN_RUN_TOKN")
    errors = errors_of(site)
    found = {int(error.split(":")[1]): error for error in errors}
    command = line(compose, "--field=feld")
    assert "did you mean 'hall.yaml'" in found[line(compose, "hal.yaml")]
    assert "emulate has no option '--controll'" in found[line(compose, "--controll")]
    assert "did you mean '--control'" in found[line(compose, "--controll")]
    assert "did you mean 'FIELDTWIN_RUN_TOKEN'" in found[line(compose, "RUN_TOKN")]
    said = " ".join(error for error in errors if error.startswith(f"compose.yaml:{command}:"))
    assert "'/sites/hall.yaml' is below no mounted folder" in said
    assert "no service 'feld' in this file" in said
    assert "--for" in said


def test_a_missing_prototype_file_is_reported_at_its_line(site: Path) -> None:
    compose = site / "compose.yaml"
    change(compose, "- --control=", "- --prototype-file=/site/hall.prototipe.yaml\n      - --control=")
    (error,) = errors_of(site)
    assert error.startswith(f"compose.yaml:{line(compose, 'prototipe')}:")
    assert "did you mean 'hall.prototype.yaml'" in error


def test_a_health_check_of_a_renamed_system_is_reported(site: Path) -> None:
    change(site / "hall.yaml", "system: hall", "system: plant")
    errors = errors_of(site)
    assert ["hall-field/field.sock" in error for error in errors] == [True, False, False], errors
    assert "expected plant-field/field.sock" in errors[0]
    assert "expected plant/gateway.sock or plant/plc.sock" in errors[1]
    assert ["/hall/gateway.sock" in errors[1], "/hall/plc.sock" in errors[2]] == [True, True]


def test_a_published_port_at_which_no_serve_section_listens_is_reported(site: Path) -> None:
    compose = site / "compose.yaml"
    system = (site / "hall.yaml").read_text()
    url = re.search(r'url: "tcp://127.0.0.1:1502"', system)
    assert url
    change(site / "hall.yaml", url[0], 'url: "tcp://0.0.0.0:1602"')
    change(compose, "--prototype, --field=field]", "--plant]\n    ports: ['127.0.0.1:1602:1602', '1603:1603']")
    errors = errors_of(site)
    assert ["listens at port 1603" in error and "one of 1602" in error for error in errors] == [True], errors

    change(site / "hall.yaml", "tcp://0.0.0.0:1602", "tcp://127.0.0.1:1602")
    first, _ = errors_of(site)
    assert "listens at port 1602" in first
    assert "127.0.0.1 is reached only from inside the container" in first


def test_anchors_and_merges_are_resolved(site: Path) -> None:
    compose = site / "compose.yaml"
    compose.write_text(
        "x-base: &base\n  image: registry.example/fieldtwin:1\n  volumes: ['.:/plant:ro']\n"
        "  command: [emulate, /plant/hall.yaml, --listen=nothing=tcp://0.0.0.0:1502]\n"
        "services:\n  first: {<<: *base}\n  second:\n    <<: *base\n    command: run /plant/hall.yaml --plant --frob\n"
    )
    errors = errors_of(site)
    assert ["no bus 'nothing'" in errors[0], "run has no option '--frob'" in errors[1]] == [True, True], errors
    assert [error.split(":")[1] for error in errors] == ["4", "9"]


def test_services_of_other_images_are_left_out(site: Path) -> None:
    with (site / "compose.yaml").open("a") as compose:
        compose.write("\n")
    text = (site / "compose.yaml").read_text()
    other = "services:\n  hmi:\n    image: example/fieldtwin-hmi\n    command: [run, /nothing.yaml, --frob]\n"
    (site / "compose.yaml").write_text(text.replace("services:\n", other))
    assert errors_of(site) == []


def test_a_value_with_an_unset_variable_is_not_checked(site: Path) -> None:
    change(site / "compose.yaml", "--field=field]", '--field=field, "--for=${HOW_LONG}"]')
    assert errors_of(site) == []


def test_the_command_reports_the_compose_file(site: Path) -> None:
    change(site / "compose.yaml", "--control=", "--controll=")
    command = [
        shutil.which("fieldtwin", path=str(Path(sys.executable).parent)) or "fieldtwin",
        "check",
        "site",
        str(site),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, "no option '--controll'" in done.stdout) == (1, True), done.stdout + done.stderr
