"""An untrusted template causes no harm: wrong hashes, paths outside, links, bombs, damage."""

from __future__ import annotations

import hashlib
import json
import os
import stat
import struct
import zipfile
from pathlib import Path

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from template_rig import add, own_system, packed, reworked, unpack_zip, yes

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.run.template import system_file
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.site.system import System, load_system
from fieldtwin.twin.template.check import examine
from fieldtwin.twin.template.detect import MANIFEST
from fieldtwin.twin.template.package import FolderPackage, open_package
from fieldtwin.twin.template.template import check_path, parse_manifest


@pytest.fixture
def dam(tmp_path: Path) -> Path:
    return own_system(tmp_path / "site")


@pytest.fixture
def good(dam: Path, tmp_path: Path) -> Path:
    packed(dam, tmp_path / "good.zip")
    return tmp_path / "good.zip"


def test_a_wrong_hash_names_file_expected_and_got(good: Path, tmp_path: Path) -> None:
    def change(files: dict[str, bytes]) -> None:
        files["devices/tilt.yaml"] = files["devices/tilt.yaml"].replace(b"16", b"61", 1)

    bad = reworked(good, tmp_path / "bad.zip", change)
    with pytest.raises(FileInvalid, match=r"devices/tilt\.yaml: the file has changed since it was packed") as caught:
        unpack_zip(bad, tmp_path / "out")
    with open_package(good) as package:
        assert caught.value.expected.endswith(package.manifest.by_path()["devices/tilt.yaml"].sha256)
    assert len(caught.value.got) == 64
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bad.zip", "good.zip", "site"], "nothing is left of it"


def test_a_wrong_hash_is_found_in_a_zip_of_which_a_good_copy_ran_before(
    good: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FIELDTWIN_RUN", str(tmp_path / "run"))
    assert system_file(str(good), yes) == system_file(str(good), yes)

    def change(files: dict[str, bytes]) -> None:
        files["devices/tilt.yaml"] = files["devices/tilt.yaml"].replace(b"16", b"61", 1)

    with pytest.raises(FileInvalid, match=r"devices/tilt\.yaml: the file has changed since it was packed"):
        system_file(str(reworked(good, tmp_path / "bad.zip", change)), yes)


@pytest.mark.parametrize(
    "name",
    ["../evil", "/etc/evil", "a/../../evil", "a\\..\\evil", "C:evil", "a//b", "a/./b", "NUL", "aux.txt", "x ", "\x7f"],
)
def test_a_path_outside_is_refused_in_the_zip_and_in_the_manifest(good: Path, tmp_path: Path, name: str) -> None:
    with pytest.raises(FileInvalid):
        unpack_zip(reworked(good, tmp_path / "bad.zip", add(name)), tmp_path / "deep" / "er" / "out")
    with pytest.raises(FileInvalid, match="a path that a template cannot have"):
        check_path(name, "here")
    assert not list(tmp_path.rglob("*evil*"))


@given(path=st.text(max_size=40))
@example(path="..")
@example(path="a/..")
def test_a_path_that_passes_stays_inside(path: str) -> None:
    try:
        check_path(path, "here")
    except FileInvalid:
        return
    top = Path("/somewhere/deep")
    assert Path(os.path.normpath(top / path)).is_relative_to(top)
    assert os.path.normpath(top / path) != str(top)


def test_files_that_the_manifest_does_not_name_are_refused(good: Path, tmp_path: Path) -> None:
    with pytest.raises(FileInvalid, match=r"'systems/plc\.py' is not in the manifest"):
        unpack_zip(reworked(good, tmp_path / "bad.zip", add("systems/plc.py")), tmp_path / "out")
    with pytest.raises(FileInvalid, match=r"'model\.json' is missing"):
        unpack_zip(reworked(good, tmp_path / "bad.zip", lambda f: f.pop("model.json") and None), tmp_path / "out")


def test_links_are_refused(good: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(good, "a") as archive:
        link = zipfile.ZipInfo("systems/link")
        link.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(link, "/etc/passwd")
    with pytest.raises(FileInvalid, match="not a regular file"), open_package(good):
        pass
    folder = tmp_path / "folder"
    own = own_system(tmp_path / "again")
    packed(own, folder)
    (folder / "model.json").unlink()
    (folder / "model.json").symlink_to("/etc/passwd")
    with pytest.raises(FileInvalid, match="not a regular file"):
        FolderPackage(folder)


def test_a_file_packed_too_tightly_is_refused_before_it_is_unpacked(good: Path, tmp_path: Path) -> None:
    zeros = bytes(3 << 20)

    def change(files: dict[str, bytes]) -> None:
        manifest = json.loads(files[MANIFEST])
        manifest["files"].append(
            {
                "path": "recordings/z.jsonl",
                "kind": "recording",
                "bytes": len(zeros),
                "sha256": hashlib.sha256(zeros).hexdigest(),
            }
        )
        files[MANIFEST] = json.dumps(manifest).encode()
        files["recordings/z.jsonl"] = zeros

    with pytest.raises(FileInvalid, match="compression ratio is too high"):
        unpack_zip(reworked(good, tmp_path / "bad.zip", change), tmp_path / "out")


@pytest.mark.parametrize("key", ["bytes", "count"])
def test_sizes_and_counts_are_bounded_before_memory_is_spent(good: Path, tmp_path: Path, key: str) -> None:
    def change(files: dict[str, bytes]) -> None:
        manifest = json.loads(files[MANIFEST])
        if key == "bytes":
            manifest["files"][0]["bytes"] = 1 << 40
        else:
            one = manifest["files"][0]
            manifest["files"] += [{**one, "path": f"x{i}"} for i in range(10_001)]
        files[MANIFEST] = json.dumps(manifest).encode()

    with (
        pytest.raises(FileInvalid, match=r"too large|too many"),
        open_package(reworked(good, tmp_path / "bad.zip", change)),
    ):
        pass


def test_a_directory_of_millions_of_entries_is_not_even_read(good: Path, tmp_path: Path) -> None:
    data = bytearray(good.read_bytes())
    at = data.rfind(b"PK\x05\x06")
    struct.pack_into("<L", data, at + 12, 0x7FFF_FFFF)
    (tmp_path / "bad.zip").write_bytes(data)
    with pytest.raises(FileInvalid, match="too many files"), open_package(tmp_path / "bad.zip"):
        pass


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"fieldtwin_template": 2}, "packed by a newer fieldtwin"),
        ({"fieldtwin_template": 0}, "the form of the template"),
        ({"surprise": 1}, "surprise"),
        ({"system_file": "model.json"}, "the system file 'model.json' is not among the files"),
        ({"files": "all"}, "not a manifest of a template"),
        ({"software": {"version": "1\x1b[2J", "modules_sha256": "0"}}, r"the version of the software.* got 1\\x1b\[2J"),
    ],
)
def test_an_invalid_manifest_is_refused(good: Path, tmp_path: Path, change: dict[str, object], says: str) -> None:
    with open_package(good) as package:
        text = package.manifest.to_json()
    with pytest.raises(FileInvalid, match=says):
        parse_manifest(json.dumps({**json.loads(text), **change}).encode(), "here")


@given(
    text=st.binary(max_size=200)
    | st.recursive(st.none() | st.integers() | st.text(), st.lists).map(msgspec.json.encode)
)
def test_any_bytes_are_a_manifest_or_give_a_clear_error(text: bytes) -> None:
    with pytest.raises(FileInvalid):
        parse_manifest(text, "here")


@given(cut=st.integers(0, 20_000), flips=st.lists(st.tuples(st.integers(0, 20_000), st.integers(1, 255)), max_size=4))
@example(cut=0, flips=[(29, 35)])  # the length of the manifest's local header: zipfile raises EOFError
def test_a_damaged_zip_is_refused_or_equals_the_packed_content(
    tmp_path_factory: pytest.TempPathFactory, cut: int, flips: list[tuple[int, int]]
) -> None:
    place = tmp_path_factory.getbasetemp()
    source = place / "undamaged.zip"
    if not source.exists():
        packed(own_system(place / "damage"), source)
    data = bytearray(source.read_bytes())
    for at, mask in flips:
        data[at % len(data)] ^= mask
    if cut < len(data) and not flips:
        del data[cut:]
    (place / "damaged.zip").write_bytes(data)
    try:
        with open_package(place / "damaged.zip") as package:
            package.verify()
            assert set(package.manifest.by_path()) >= {"systems/dam.yaml"}
    except FileInvalid:
        pass


def test_a_template_that_depends_on_files_of_this_computer_is_incomplete(dam: Path, tmp_path: Path) -> None:
    dam.write_text(dam.read_text().replace("../devices/tilt.yaml", "inclinometer-cia410"))
    manifest = packed(dam, tmp_path / "T")
    assert examine(tmp_path / "T", manifest).name == "dam"
    (tmp_path / "T" / "devices" / "inclinometer-cia410.yaml").unlink()
    lean = msgspec.structs.replace(
        manifest, files=tuple(f for f in manifest.files if f.path != "devices/inclinometer-cia410.yaml")
    )
    with pytest.raises(FileInvalid, match=r"devices/inclinometer-cia410.yaml is not in the template"):
        examine(tmp_path / "T", lean)


def test_another_model_than_the_systems_is_found(dam: Path, tmp_path: Path) -> None:
    manifest = packed(dam, tmp_path / "T")
    (tmp_path / "T" / "model.json").write_text("{}")
    with pytest.raises(FileInvalid, match="not the digital model of its system"):
        examine(tmp_path / "T", manifest)


def test_a_template_uses_its_own_files_whatever_else_exists(
    dam: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A bare name in a template is not looked up in FIELDTWIN_PROFILES, in the working directory, or among the shipped files."""
    dam.write_text(dam.read_text().replace("../devices/tilt.yaml", "inclinometer-cia410"))
    packed(dam, tmp_path / "T")
    other = tmp_path / "other" / "devices"
    other.mkdir(parents=True)
    (other / "inclinometer-cia410.yaml").write_text("device: x/other\nsource: x\nprotocol: modbus\n")
    monkeypatch.setenv("FIELDTWIN_PROFILES", str(other.parent))
    monkeypatch.chdir(other)
    system: System = load_system(str(tmp_path / "T" / "systems" / "dam.yaml"))
    assert system.devices["tilt"].profile.path == str(tmp_path / "T" / "devices" / "inclinometer-cia410.yaml")
    assert load_prototype(system).devices["tilt"].recording == tmp_path / "T" / "systems" / "tilt.jsonl"
