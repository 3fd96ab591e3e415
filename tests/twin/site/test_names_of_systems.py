"""Messages if a system, its prototype or a recording is not what the user expected."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.recording import RecordingReader
from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.site.data_files import data_root, find
from fieldtwin.twin.site.system import load_system


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("plant.yaml", r"there is no file 'plant.yaml'; expected a system's file, or one of .*observatory"),
        ("sites/plant", "there is no file 'sites/plant'"),
        ("pipe.yaml", "'pipe.yaml' is not a regular file; expected a system's file"),
        ("mysite", r"no system 'mysite'.*did you mean 'mysite.yaml'\?"),
        ("obsrvatory", r"no system 'obsrvatory'.*did you mean 'observatory'\?"),
    ],
)
def test_a_missing_system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, told: str) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mysite.yaml").write_text("fieldtwin: 1\n")
    os.mkfifo(tmp_path / "pipe.yaml")
    with pytest.raises(UsageError, match=told):
        find("systems", name)


def test_missing_profile_of_a_site_lists_the_profiles_in_its_folder(tmp_path: Path) -> None:
    """Defect: the message listed all shipped profiles, and none of the site."""
    (tmp_path / "profiles").mkdir()
    for name in ("analyser", "pump"):
        (tmp_path / "profiles" / f"{name}.yaml").write_text(f"device: test/{name}\n")
    told = r"there is no file 'profiles/pumpe.yaml'; expected .*, or one of profiles/analyser.yaml, profiles/pump.yaml \(did you"
    with pytest.raises(UsageError, match=told):
        find("devices", "profiles/pumpe.yaml", beside=tmp_path / "site.yaml")


def test_a_site_without_a_prototype_reports_the_remedy(tmp_path: Path) -> None:
    shutil.copy(data_root() / "profiles" / "systems" / "observatory.yaml", tmp_path / "mysite.yaml")
    with pytest.raises(
        FileInvalid, match=r"mysite.prototype.yaml: there is no prototype file of mysite.yaml.*--prototype-file"
    ):
        load_prototype(load_system(str(tmp_path / "mysite.yaml")))


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ('{"fieldtwin_dump":1}\n', "but a dump: fieldtwin infer"),
        ('{"started":"2026"}\n', "raw traffic: fieldtwin import"),
    ],
)
def test_a_file_of_a_different_command_is_named(tmp_path: Path, line: str, told: str) -> None:
    (tmp_path / "given.jsonl").write_text(line)
    with pytest.raises(FileInvalid, match=told):
        RecordingReader(tmp_path / "given.jsonl")


def test_a_virtual_run_that_cannot_begin_is_an_error_of_the_file() -> None:
    options = VirtualOptions(system="observatory", duration_s=1.0, recordings={"ctd": "nowhere.jsonl"})
    with pytest.raises(FileInvalid, match=r"nowhere.jsonl"):
        VirtualRun(options).run()


def test_a_folder_with_one_system_file_names_that_system(tmp_path: Path) -> None:
    shipped = data_root() / "profiles" / "systems"
    for name in ("observatory.yaml", "observatory.prototype.yaml", "ctd-silent.scenario.yaml"):
        shutil.copy(shipped / name, tmp_path / name)
    (tmp_path / "compose.yaml").write_text("services: {}\n")
    assert find("systems", str(tmp_path)) == tmp_path / "observatory.yaml"
    assert load_system(str(tmp_path)).name == "observatory"


def test_a_folder_with_several_system_files_lists_them(tmp_path: Path) -> None:
    for name in ("east.yaml", "west.yml"):
        (tmp_path / name).write_text("fieldtwin: 1\nsystem: east\n")
    with pytest.raises(UsageError, match=r"this folder has 2 system files; expected .*east.yaml or .*west.yml"):
        find("systems", str(tmp_path))


def test_a_folder_without_a_system_file_says_what_is_expected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "observatory").mkdir()
    with pytest.raises(UsageError, match=r"no system file in this folder; expected .*fieldtwin new"):
        find("systems", ".")
    assert find("systems", "observatory").is_file(), "a bare name still refers to the shipped system"
