"""`fieldtwin check site`: all errors of a site's files in one run, each at its place, and none that only follows from another."""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from fieldtwin.cli.main import main
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.site.check import check_site
from fieldtwin.twin.site.data_files import data_root

SHIPPED = data_root() / "profiles" / "systems"
Invoke = Callable[..., tuple[int, str, str]]


@pytest.fixture
def invoke(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Invoke:
    def call(*args: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["fieldtwin", *args])
        with pytest.raises(SystemExit) as ended:
            main()
        told = capsys.readouterr()
        return int(ended.value.code or 0), told.out, told.err

    return call


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A copy of all shipped systems with their prototypes, programs and scenarios."""
    return Path(shutil.copytree(SHIPPED, tmp_path / "site"))


def changed(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert len(re.findall(old, text, re.MULTILINE)) == 1, old
    path.write_text(re.sub(old, new, text, flags=re.MULTILINE))


def lines_of(errors: list[FileInvalid]) -> set[str]:
    return {f"{Path(error.path).name}:{error.line}" for error in errors}


def mentions(folder: Path, word: str, files: str) -> set[str]:
    """Return FILE:LINE of each line that contains the word outside comments and texts about the file."""
    found = set()
    for path in folder.glob(files):
        for number, line in enumerate(path.read_text().splitlines(), 1):
            said = line.split("#")[0]
            if re.search(rf"(?<![\w.-]){word}(?![\w-])", said) and not re.match(
                r"(about|scenario|requirements):", said
            ):
                found.add(f"{path.name}:{number}")
    return found


def test_shipped_systems_have_no_errors(site: Path) -> None:
    found = check_site(site)
    assert found.errors == []
    assert sorted(set(found.files.values())) == ["network", "prototype", "scenario", "system"]
    assert len(found.files) == len(list(site.glob("*.yaml")))


def test_each_reference_to_a_renamed_device_is_reported_in_one_run(site: Path) -> None:
    changed(site / "observatory.yaml", "^  ctd:", "  profiler:")
    errors = check_site(site).errors
    dangling = mentions(site, "ctd", "observatory*.yaml") | mentions(site, "ctd", "[clmn][ota]*-*.scenario.yaml")
    assert len(dangling) > 20
    assert dangling <= lines_of(errors)
    extra = lines_of(errors) - dangling
    assert extra == {f"{path}:{line(site / path, 'devices:')}" for path in PROTOTYPES}, "no entry for the new name"


def test_the_devices_that_a_simulation_may_use_do_not_include_the_missing_one(tmp_path: Path) -> None:
    for name in ("lab_vehicle.yaml", "lab_vehicle.prototype.yaml", "vehicle.st"):
        (tmp_path / name).write_text((SHIPPED / name).read_text())
    changed(tmp_path / "lab_vehicle.yaml", "^  drive:", "  motor:")
    (found,) = [error for error in check_site(tmp_path).errors if "no emulated device 'drive'" in str(error)]
    assert "expected steering, console, localiser" in str(found)


PROTOTYPES = ("observatory.prototype.yaml", "observatory.compose.yaml", "observatory.vcan.yaml")


def line(path: Path, text: str) -> int:
    return path.read_text().splitlines().index(text) + 1


def test_each_reference_to_a_removed_bus_is_reported(site: Path) -> None:
    changed(site / "observatory.yaml", "^  line1:", "  line2:")
    errors = check_site(site).errors
    dangling = mentions(site, "line1", "observatory*.yaml")
    assert dangling <= lines_of(errors)
    assert all("line1" in str(error) or "line2" in str(error) for error in errors), [str(e) for e in errors]


def test_each_reference_to_a_renamed_program_is_reported(site: Path) -> None:
    changed(site / "observatory.yaml", "^    relay:", "    relais:")
    errors = check_site(site).errors
    assert mentions(site, "relay", "[clmn][ota]*-*.scenario.yaml") <= lines_of(errors)
    assert all("relay." in error.message and "relais." in error.hint for error in errors), [str(e) for e in errors]


@pytest.mark.long
def test_each_reference_to_a_renamed_tag_of_a_profile_is_reported(site: Path) -> None:
    profile = (data_root() / "profiles" / "devices" / "ctd-reference.yaml").read_text()
    (site / "ctd-reference.yaml").write_text(re.sub(r"^  pressure:", "  depth:", profile, flags=re.MULTILINE))
    changed(site / "observatory.yaml", "profile: ctd-reference", "profile: ctd-reference.yaml")
    errors = check_site(site).errors
    assert mentions(site, r"ctd\.pressure", "[clmn][ota]*-*.scenario.yaml") <= lines_of(errors)
    assert all("pressure" in error.message for error in errors), [str(e) for e in errors]


def test_references_to_an_entry_with_an_error_are_not_reported(site: Path) -> None:
    changed(site / "observatory.yaml", "profile: ctd-reference", "profile: ctd-referense")
    errors = check_site(site).errors
    assert [error.hint for error in errors] == ["did you mean 'ctd-reference'?"]


def test_references_to_a_program_with_an_error_are_not_reported(site: Path) -> None:
    changed(site / "observatory.yaml", "fieldtwin.plc.relay:Relay", "fieldtwin.plc.relay:Realy")
    errors = check_site(site).errors
    assert len(errors) == 1
    assert "Realy" in str(errors[0])


def test_errors_of_separate_files_are_reported_together(site: Path) -> None:
    changed(site / "observatory.yaml", "node: 5\n", "node: 300\n")
    (site / "bad.scenario.yaml").write_text("scenario: x\nsystem: observatory.yaml\nsteps: [{pauze: 1s}]\n")
    (site / "worse.yaml").write_text("system: [\n")
    (site / "waivers.yaml").write_text("waivers: [{id: MB-013x, owner: me, reason: none, expires: 2030-01-01}]\n")
    (site / "lost.prototype.yaml").write_text("fieldtwin: 1\nprototype_of: observatori.yaml\nbuses: {}\ndevices: {}\n")
    found = {Path(error.path).name: str(error) for error in check_site(site).errors}
    assert set(found) >= {"observatory.yaml", "bad.scenario.yaml", "worse.yaml", "waivers.yaml", "lost.prototype.yaml"}
    assert "did you mean 'pause'" in found["bad.scenario.yaml"]
    assert "did you mean 'observatory.yaml'" in found["lost.prototype.yaml"]


def test_a_loader_reports_several_errors_at_once(invoke: Invoke, site: Path) -> None:
    changed(site / "observatory.yaml", "^  ctd:", "  profiler:")
    code, _, err = invoke("run", str(site / "observatory.yaml"), "--plant", "--for", "1s")
    assert code == 3
    assert mentions(site, "ctd", "observatory.yaml") == {
        f"observatory.yaml:{n}" for n in re.findall(r"yaml:(\d+):", err)
    }


def test_output_and_exit_codes(invoke: Invoke, site: Path, tmp_path: Path) -> None:
    code, out, _ = invoke("check", "site", str(site))
    assert (code, out) == (0, "no errors in 24 files: 9 scenarios, 8 prototypes, 6 systems, 1 network\n")
    changed(site / "observatory.yaml", "^  line1:", "  line2:")
    code, out, _ = invoke("check", "site", str(site))
    assert code == 1
    assert re.search(r"observatory.yaml:\d+:\d+: no bus 'line1'", out)
    assert out.endswith(" of 24 files\n")
    code, out, _ = invoke("check", "site", str(site), "--json")
    assert code == 1
    assert {"path", "line", "column", "message", "expected", "got", "hint"} == set(json.loads(out)["errors"][0])
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "compose.yaml").write_text("services: {}\n")
    code, _, err = invoke("check", "site", str(tmp_path / "other"))
    assert code == 2
    assert "no file of fieldtwin" in err


def test_a_name_that_a_program_does_not_publish_is_named_although_the_program_publishes_none(
    tmp_path: Path, invoke: Invoke
) -> None:
    site = Path(shutil.copytree(data_root() / "examples" / "own-plc", tmp_path / "site"))
    (site / "wrong.scenario.yaml").write_text(
        "scenario: wrong\nsystem: mooring.yaml\nsteps:\n  - expect: {that: 'sampling.period_s == 5'}\n"
    )
    (error,) = check_site(site).errors
    assert (error.line, "no tag or variable 'sampling.period_s'" in str(error)) == (4, True), error
    code, _, told = invoke("test", str(site / "wrong.scenario.yaml"))
    assert (code, "no tag or variable 'sampling.period_s'" in told) == (3, True), told
