"""Digital templates: their content, reproducible packing, and comparison."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from template_rig import CHECKOUT, SHIPPED, fieldtwin, no, own_system, packed, reworked, unpack_zip

from fieldtwin.gateway.core.errors import FileInvalid, Unreachable, UsageError
from fieldtwin.run.template import system_file
from fieldtwin.twin.template import software
from fieldtwin.twin.template.check import differences, examine, software_difference
from fieldtwin.twin.template.detect import MANIFEST
from fieldtwin.twin.template.pack import TemplateExtras
from fieldtwin.twin.template.package import Content, FolderPackage, ZipPackage, open_package
from fieldtwin.twin.template.software import modules_hash, wheel_hash


@pytest.fixture
def dam(tmp_path: Path) -> Path:
    return own_system(tmp_path / "site")


@pytest.fixture
def good(dam: Path, tmp_path: Path) -> Path:
    packed(dam, tmp_path / "good.zip")
    return tmp_path / "good.zip"


def test_a_template_has_everything_that_its_system_names(dam: Path, tmp_path: Path) -> None:
    manual = tmp_path / "manual.pdf"
    manual.write_bytes(b"%PDF-")
    manifest = packed(dam, tmp_path / "T.zip", TemplateExtras({"technical-manual": (manual,)}))
    assert {(f.path, f.kind) for f in manifest.files} == {
        ("systems/dam.yaml", "system"), ("systems/dam.prototype.yaml", "prototype"), ("devices/tilt.yaml", "profile"),
        ("devices/tilt.eds", "eds"), ("systems/tilt.jsonl", "recording"), ("systems/logic/count.st", "program"),
        ("model.json", "model"), ("documents/technical-manual/manual.pdf", "document"),
    }  # fmt: skip
    assert manifest.software.modules_sha256 == modules_hash()
    assert manifest.code == ()


def test_all_files_of_a_program_in_a_folder_are_packed(dam: Path, tmp_path: Path) -> None:
    (dam.parent / "logic" / "types").mkdir()
    (dam.parent / "logic" / "types" / "level.st").write_text("TYPE Level : INT; END_TYPE")
    dam.write_text(dam.read_text().replace("logic/count.st", "logic"))
    paths = {file.path for file in packed(dam, tmp_path / "T.zip").files}
    assert {"systems/logic/count.st", "systems/logic/types/level.st"} <= paths


def test_the_system_file_is_packed_byte_for_byte(dam: Path, tmp_path: Path) -> None:
    """Prose, row 2: plant, prototype and template have one configuration."""
    packed(dam, tmp_path / "T.zip")
    with zipfile.ZipFile(tmp_path / "T.zip") as archive:
        assert archive.read("systems/dam.yaml") == dam.read_bytes()


def test_the_same_files_give_the_same_bytes_whenever_and_in_whatever_order(dam: Path, tmp_path: Path) -> None:
    first = packed(dam, tmp_path / "a.zip")
    os.utime(dam, (1, 1))
    dam.chmod(0o600)
    second = packed(dam, tmp_path / "b.zip")
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()
    assert first.id == second.id
    packed(dam, tmp_path / "folder")
    assert (tmp_path / "folder" / MANIFEST).read_bytes() == first.to_json()


def test_from_a_template_alone_a_prototype_runs_on_a_machine_without_its_files(dam: Path, tmp_path: Path) -> None:
    packed(dam, tmp_path / "T.zip")
    shutil.rmtree(dam.parent.parent)
    empty = tmp_path / "empty"
    empty.mkdir()
    environment = {k: v for k, v in os.environ.items() if not k.startswith("FIELDTWIN")}
    environment |= {"PYTHONPATH": str(CHECKOUT), "FIELDTWIN_RUN": str(tmp_path / "r")}
    run = [sys.executable, "-m", "fieldtwin", "simulate", "../T.zip", "--for", "5s", "--json"]
    ended = subprocess.run(run, cwd=empty, env=environment, capture_output=True, text=True, check=False, timeout=50)
    assert ended.returncode == 0, ended.stderr
    summary = json.loads(ended.stdout)
    assert (summary["system"], summary["ok"]) == ("dam", True)


def test_the_shipped_observatory_makes_a_whole_template(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FIELDTWIN_RUN", str(tmp_path / "run"))
    packed(SHIPPED / "systems" / "observatory.yaml", tmp_path / "T.zip")
    assert Path(system_file(str(tmp_path / "T.zip"), no)).name == "observatory.yaml"


def test_files_that_exist_only_on_this_computer_are_refused(dam: Path, tmp_path: Path) -> None:
    outside = tmp_path / "tilt.yaml"
    shutil.copy(dam.parent.parent / "devices" / "tilt.yaml", outside)
    shutil.copy(dam.parent.parent / "devices" / "tilt.eds", tmp_path / "tilt.eds")
    dam.write_text(dam.read_text().replace("../devices/tilt.yaml", str(outside)))
    with pytest.raises(FileInvalid, match="a path of this computer"):
        packed(dam, tmp_path / "T.zip")
    dam.write_text(dam.read_text().replace(str(outside), "../../tilt.yaml"))
    with pytest.raises(FileInvalid, match="leads out of the folder"):
        packed(dam, tmp_path / "T.zip")


def test_a_program_installed_elsewhere_cannot_be_packed(dam: Path, tmp_path: Path) -> None:
    text = dam.read_text().replace("programs:", "programs:\n    x: {source: 'python: antigravity:Program'}")
    dam.write_text(text)
    with pytest.raises(FileInvalid, match="installed on this computer"):
        packed(dam, tmp_path / "T.zip")
    assert "antigravity" not in sys.modules


def test_a_wheel_of_other_software_is_refused(dam: Path, tmp_path: Path) -> None:
    wheel = tmp_path / "fieldtwin-9.9-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("fieldtwin/twin/__init__.py", "")
    with pytest.raises(FileInvalid, match="different software from the running one"):
        packed(dam, tmp_path / "T.zip", TemplateExtras(wheel=wheel))


def test_a_wheel_has_the_hash_of_the_installed_files(tmp_path: Path) -> None:
    wheel = tmp_path / "fieldtwin-9.9-py3-none-any.whl"
    (tmp_path / "x" / "fieldtwin" / "plc" / "__pycache__").mkdir(parents=True)
    (tmp_path / "x" / "fieldtwin" / "plc" / "a.py").write_text("a = 1\n")
    (tmp_path / "x" / "fieldtwin" / "plc" / "__pycache__" / "a.pyc").write_text("left out")
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("fieldtwin/_data/profiles/x.yaml", "data is no module")
        archive.writestr("fieldtwin/plc/a.py", "a = 1\n")
    assert wheel_hash(wheel) == ("9.9", modules_hash(tmp_path / "x"))


def test_pack_unpack_and_pack_again_are_the_same(good: Path, tmp_path: Path) -> None:
    unpack_zip(good, tmp_path / "out")
    assert packed(tmp_path / "out" / "systems" / "dam.yaml", tmp_path / "again.zip")
    assert (tmp_path / "again.zip").read_bytes() == good.read_bytes()


def test_a_folder_in_use_is_not_changed(good: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").touch()
    with pytest.raises(UsageError, match="the folder is not empty"):
        unpack_zip(good, tmp_path / "out")


def test_a_full_disk_is_reported_before_anything_is_written(
    good: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage(tmp_path)._replace(free=10)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    with pytest.raises(Unreachable, match="the disk is too full"):
        unpack_zip(good, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_two_templates_are_compared_file_by_file(dam: Path, tmp_path: Path) -> None:
    before = packed(dam, tmp_path / "a.zip")
    dam.write_text(dam.read_text() + "# more\n")
    (dam.parent / "tilt.jsonl").rename(dam.parent / "other.jsonl")
    prototype = dam.with_name("dam.prototype.yaml")
    prototype.write_text(prototype.read_text().replace("tilt.jsonl", "other.jsonl"))
    after = packed(dam, tmp_path / "b.zip")
    a, b = contents(tmp_path / "a.zip"), contents(tmp_path / "b.zip")
    assert [(d.what, d.path) for d in differences(a, b)] == [
        ("changed", "systems/dam.prototype.yaml"), ("changed", "systems/dam.yaml"), ("added", "systems/other.jsonl"),
        ("removed", "systems/tilt.jsonl"),
    ]  # fmt: skip
    assert differences(a, a) == []
    assert software_difference(before.software, after.software) == []


def contents(path: Path) -> dict[str, Content]:
    with open_package(path, edited=True) as package:
        return package.contents()


@pytest.mark.long
def test_diff_compares_an_edited_folder_with_the_template_that_it_was_unpacked_from(good: Path, tmp_path: Path) -> None:
    """Defect: `template diff` refused a folder as soon as one of its files was edited, although users want to compare edited
    folders."""
    folder = tmp_path / "work"
    unpack_zip(good, folder)
    assert fieldtwin(tmp_path, "template", "diff", str(good), str(folder)).returncode == 0
    system = folder / "systems/dam.yaml"
    system.write_text(system.read_text() + "# edited on site\n")
    (folder / "systems/tilt.jsonl").unlink()
    (folder / "notes.txt").write_text("read me\n")
    (folder / "systems/logic/__pycache__").mkdir()
    (folder / "systems/logic/__pycache__/count.pyc").write_bytes(b"cache")
    done = fieldtwin(tmp_path, "template", "diff", str(good), str(folder), "--json")
    assert [(d["what"], d["path"], d["kind"]) for d in json.loads(done.stdout)] == [
        ("added", "notes.txt", ""), ("changed", "systems/dam.yaml", "system"), ("removed", "systems/tilt.jsonl", "recording"),
    ]  # fmt: skip
    assert done.returncode == 1
    shown = fieldtwin(tmp_path, "template", "diff", str(good), str(folder))
    assert "+# edited on site" in shown.stdout
    assert "+read me" in shown.stdout


def test_an_edited_folder_is_still_refused_where_a_template_runs(good: Path, tmp_path: Path) -> None:
    folder = tmp_path / "work"
    unpack_zip(good, folder)
    system = folder / "systems/dam.yaml"
    system.write_text(system.read_text() + "# edited on site\n")
    done = fieldtwin(tmp_path, "template", "check", str(folder))
    assert done.returncode == 3
    assert "`fieldtwin template diff` shows what was edited; pack the template again" in " ".join(done.stderr.split())


def test_diff_does_not_follow_links_out_of_a_folder(good: Path, tmp_path: Path) -> None:
    folder = tmp_path / "work"
    unpack_zip(good, folder)
    (tmp_path / "secret.txt").write_text("secret")
    (folder / "link.txt").symlink_to(tmp_path / "secret.txt")
    done = fieldtwin(tmp_path, "template", "diff", str(good), str(folder))
    assert (done.returncode, done.stdout) == (3, "")
    assert "a template has no links" in done.stderr


def test_the_zip_lists_its_sources(good: Path) -> None:
    with ZipPackage(good) as package:
        assert json.loads(package.text("model.json"))["initial"] == {"state": "STANDBY", "period_s": 0}


@pytest.mark.parametrize("first", [True, False])
def test_a_damaged_template_is_not_equal_to_a_whole_one(dam: Path, tmp_path: Path, first: bool) -> None:
    """Its manifest is the same: only its bytes differ."""
    packed(dam, tmp_path / "T.zip")

    def change(files: dict[str, bytes]) -> None:
        files["devices/tilt.yaml"] = files["devices/tilt.yaml"].replace(b"slope", b"slopf", 1)

    bad = reworked(tmp_path / "T.zip", tmp_path / "bad.zip", change)
    both = [str(bad), str(tmp_path / "T.zip")]
    done = fieldtwin(tmp_path, "template", "diff", *(both if first else both[::-1]))
    assert (done.returncode, done.stdout) == (3, "")
    assert "bad.zip: devices/tilt.yaml: the file has changed since it was packed" in done.stderr


@pytest.mark.parametrize(
    "place", ["fieldtwin/plc/backdoor.py", "backdoor.py", "backdoor.pth", "fieldtwin/plc/scan.pyc"]
)
def test_the_wheel_in_a_template_is_the_software_that_its_manifest_names(dam: Path, tmp_path: Path, place: str) -> None:
    """In an untrusted template: the hash of the file only proves that it is the file that was packed."""
    wheel = tmp_path / "fieldtwin-9.9-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for parent, _, files in os.walk(CHECKOUT / "fieldtwin", followlinks=True):
            for path in (Path(parent, file) for file in files):
                if path.parent.name != "__pycache__":
                    archive.write(path, path.relative_to(CHECKOUT).as_posix())
    packed(dam, tmp_path / "T", TemplateExtras(wheel=wheel))
    manifest = FolderPackage(tmp_path / "T").manifest
    assert examine(tmp_path / "T", manifest).name == "dam"
    inside = tmp_path / "T" / manifest.software.wheel
    with zipfile.ZipFile(inside, "a") as archive:
        archive.writestr(place, "open('/tmp/x', 'w')\n")
    with pytest.raises(FileInvalid, match=r"is not the software that the manifest names.*expected 9\.9, modules"):
        examine(tmp_path / "T", manifest, shown=Path("T.zip"))
    inside.write_bytes(b"no wheel")
    with pytest.raises(FileInvalid, match="cannot read the wheel"):
        examine(tmp_path / "T", manifest)


def test_a_wheel_that_is_a_bomb_is_refused_before_it_is_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(software, "MAX_WHEEL_BYTES", 1 << 20)
    wheel = tmp_path / "fieldtwin-9.9-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED) as archive:
        for n in range(17):
            archive.writestr(f"fieldtwin/plc/{n}.py", bytes(1 << 20))
    with pytest.raises(FileInvalid, match="too large for a module"):
        wheel_hash(wheel)
    with wheel.open("ab") as file:
        file.truncate((1 << 20) + 1)
    with pytest.raises(FileInvalid, match="too large for a wheel of fieldtwin"):
        wheel_hash(wheel)
