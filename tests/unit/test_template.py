"""Digital templates: what is packed, that the same is packed the same, and that a stranger's harms nobody."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import stat
import struct
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fieldtwin.running.template_here import Stranger, system_file
from gateway.core.errors import FileInvalid, NotAllowed, Unreachable, UsageError
from twin import software
from twin.prototype_file import load_prototype
from twin.software import modules_hash, wheel_hash
from twin.system import System, load_system
from twin.template import MANIFEST, Manifest, check_path, parse_manifest
from twin.template_check import differences, examine
from twin.template_pack import Extras, collect, pack
from twin.template_package import FolderPackage, ZipPackage, open_package, unpack
from twin.template_reach import reach

CHECKOUT = Path(__file__).resolve().parents[2]
SHIPPED = CHECKOUT / "profiles"
BLINKER = """
import helper
from plc.program import Output, Program
from gateway.core.image import TagKind

class Blinker(Program):
    def execute(self, scan):
        pass
"""


def own_system(folder: Path) -> Path:
    """A system with nothing in it that is shipped: profile, EDS, recording, control logic in Structured Text and Python."""
    for sub in ("plant", "devices", "logic"):
        (folder / sub).mkdir(parents=True)
    profile = (SHIPPED / "devices" / "inclinometer-cia410.yaml").read_text()
    (folder / "devices" / "tilt.yaml").write_text(profile.replace("inclinometer-cia410.eds", "tilt.eds"))
    shutil.copy(SHIPPED / "devices" / "inclinometer-cia410.eds", folder / "devices" / "tilt.eds")
    shutil.copy(CHECKOUT / "recordings" / "incl.jsonl", folder / "plant" / "tilt.jsonl")
    (folder / "plant" / "logic").mkdir()
    (folder / "plant" / "logic" / "count.st").write_text(
        "PROGRAM Count\nVAR_INPUT tilt : LREAL; END_VAR\nVAR n : DINT; END_VAR\nn := n + 1;\nEND_PROGRAM\n"
    )
    (folder / "plant" / "dam.yaml").write_text(
        "fieldtwin: 1\nsystem: dam\nbuses:\n  can0: {url: 'can:socketcan/can0'}\ndevices:\n"
        "  tilt: {profile: ../devices/tilt.yaml, bus: can0, node: 5, start: true}\n"
        "plc:\n  programs:\n    count: {source: logic/count.st, inputs: {tilt: {tag: tilt.slope_long}}}\n"
    )
    (folder / "plant" / "dam.prototype.yaml").write_text(
        "prototype_of: dam.yaml\nbuses: {can0: {listen: 'can:fieldtwin/127.0.0.1:0'}}\n"
        "devices: {tilt: {recording: tilt.jsonl, at_end: loop}}\n"
    )
    return folder / "plant" / "dam.yaml"


def with_python(path: Path, marker: Path) -> None:
    """Let the system at `path` have a program in Python that leaves a marker when it is imported."""
    text = path.read_text().replace("programs:", "programs:\n    blink: {source: 'python: site_logic:Blinker'}")
    path.write_text(text)
    (path.parent / "helper.py").write_text(f"open({str(marker)!r}, 'w').close()\n")
    (path.parent / "site_logic.py").write_text(BLINKER.replace("Output, ", ""))


def packed(system: Path, target: Path, extras: Extras = Extras()) -> Manifest:  # noqa: B008
    loaded = load_system(str(system))
    return pack(loaded, collect(loaded, (), system.with_name(f"{system.stem}.prototype.yaml")), extras, "9.9", target)


@pytest.fixture
def dam(tmp_path: Path) -> Path:
    return own_system(tmp_path / "site")


def yes(template: Stranger) -> bool:
    return True


def no(template: Stranger) -> bool:
    return False


# -- packing --------------------------------------------------------------------------------------------------------------


def test_a_template_has_everything_that_its_system_names(dam: Path, tmp_path: Path) -> None:
    manual = tmp_path / "manual.pdf"
    manual.write_bytes(b"%PDF-")
    manifest = packed(dam, tmp_path / "T.zip", Extras({"technical-manual": (manual,)}))
    assert {(f.path, f.kind) for f in manifest.files} == {
        ("systems/dam.yaml", "system"), ("systems/dam.prototype.yaml", "prototype"), ("devices/tilt.yaml", "profile"),
        ("devices/tilt.eds", "eds"), ("systems/tilt.jsonl", "recording"), ("systems/logic/count.st", "program"),
        ("model.json", "model"), ("documents/technical-manual/manual.pdf", "document"),
    }  # fmt: skip
    assert manifest.software.modules_sha256 == modules_hash()
    assert manifest.code == ()


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


def test_from_a_template_alone_a_prototype_runs_on_a_machine_that_has_none_of_it(dam: Path, tmp_path: Path) -> None:
    packed(dam, tmp_path / "T.zip")
    shutil.rmtree(dam.parent.parent)
    empty = tmp_path / "empty"
    empty.mkdir()
    environment = {k: v for k, v in os.environ.items() if not k.startswith("FIELDTWIN")}
    environment |= {"PYTHONPATH": str(CHECKOUT), "FIELDTWIN_RUN": str(tmp_path / "r")}
    run = [sys.executable, "-m", "fieldtwin", "run", "../T.zip", "--prototype", "--virtual", "--for", "5s", "--json"]
    ended = subprocess.run(run, cwd=empty, env=environment, capture_output=True, text=True, check=False, timeout=50)
    assert ended.returncode == 0, ended.stderr
    summary = json.loads(ended.stdout)
    assert (summary["system"], summary["ok"]) == ("dam", True)


def test_the_shipped_observatory_makes_a_whole_template(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FIELDTWIN_RUN", str(tmp_path / "run"))
    packed(SHIPPED / "systems" / "observatory.yaml", tmp_path / "T.zip")
    assert Path(system_file(str(tmp_path / "T.zip"), no)).name == "observatory.yaml"


def test_what_is_on_this_computer_alone_is_refused(dam: Path, tmp_path: Path) -> None:
    outside = tmp_path / "tilt.yaml"
    shutil.copy(dam.parent.parent / "devices" / "tilt.yaml", outside)
    shutil.copy(dam.parent.parent / "devices" / "tilt.eds", tmp_path / "tilt.eds")
    dam.write_text(dam.read_text().replace("../devices/tilt.yaml", str(outside)))
    with pytest.raises(FileInvalid, match="a place on this computer alone"):
        packed(dam, tmp_path / "T.zip")
    dam.write_text(dam.read_text().replace(str(outside), "../../tilt.yaml"))
    with pytest.raises(FileInvalid, match="leads outside"):
        packed(dam, tmp_path / "T.zip")


def test_a_program_that_is_installed_elsewhere_cannot_be_packed(dam: Path, tmp_path: Path) -> None:
    text = dam.read_text().replace("programs:", "programs:\n    x: {source: 'python: antigravity:Program'}")
    dam.write_text(text)
    with pytest.raises(FileInvalid, match="installed on this computer"):
        packed(dam, tmp_path / "T.zip")
    assert "antigravity" not in sys.modules


def test_a_wheel_of_other_software_is_refused(dam: Path, tmp_path: Path) -> None:
    wheel = tmp_path / "fieldtwin-9.9-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("twin/__init__.py", "")
    with pytest.raises(FileInvalid, match="other software than is running here"):
        packed(dam, tmp_path / "T.zip", Extras(wheel=wheel))


def test_a_wheel_has_the_hash_of_what_it_installs(tmp_path: Path) -> None:
    wheel = tmp_path / "fieldtwin-9.9-py3-none-any.whl"
    (tmp_path / "x" / "plc" / "__pycache__").mkdir(parents=True)
    (tmp_path / "x" / "plc" / "a.py").write_text("a = 1\n")
    (tmp_path / "x" / "plc" / "__pycache__" / "a.pyc").write_text("left out")
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("fieldtwin/_data/profiles/x.yaml", "data is no module")
        archive.writestr("plc/a.py", "a = 1\n")
    assert wheel_hash(wheel) == ("9.9", modules_hash(tmp_path / "x"))


# -- code ------------------------------------------------------------------------------------------------------------------


def test_python_is_named_and_runs_after_a_yes_only(dam: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FIELDTWIN_RUN", str(tmp_path / "run"))
    marker = tmp_path / "it ran"
    with_python(dam, marker)
    manifest = packed(dam, tmp_path / "T.zip")
    assert manifest.code == ("systems/helper.py", "systems/site_logic.py")
    with pytest.raises(NotAllowed, match="nothing of this template was run"):
        system_file(str(tmp_path / "T.zip"), no)
    assert Path(system_file(str(tmp_path / "T.zip"), yes)).is_file()
    assert not marker.exists(), "asking, unpacking and examining run nothing"


def fieldtwin(tmp_path: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Our command line, without a terminal."""
    return subprocess.run(
        [sys.executable, "-m", "fieldtwin", *words],
        env={**os.environ, "PYTHONPATH": str(CHECKOUT), "FIELDTWIN_RUN": str(tmp_path / "r")},
        stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False, timeout=50,
    )  # fmt: skip


def test_without_a_terminal_the_answer_is_no_and_trust_says_yes(dam: Path, tmp_path: Path) -> None:
    marker = tmp_path / "it ran"
    with_python(dam, marker)
    packed(dam, tmp_path / "T.zip")
    checked = fieldtwin(tmp_path, "template", "check", str(tmp_path / "T.zip"))
    assert (checked.returncode, marker.exists()) == (0, False), checked.stderr
    assert "its control logic was not looked at" in checked.stderr
    run = ["run", str(tmp_path / "T.zip"), "--prototype", "--virtual", "--for", "1s"]
    refused = fieldtwin(tmp_path, *run)
    assert "control logic in Python: systems/helper.py, systems/site_logic.py" in refused.stderr
    assert (refused.returncode, marker.exists()) == (2, False), refused.stderr
    trusted = fieldtwin(tmp_path, *run, "--trust")
    assert (trusted.returncode, marker.exists()) == (0, True), trusted.stderr


def test_a_simulation_in_python_is_packed_and_asked_about_as_well(dam: Path, tmp_path: Path) -> None:
    """What emulates a device is the stranger's program, too."""
    (dam.parent / "hill.py").write_text(
        "import slope\n\nclass Hill:\n    def step(self, t_s, dt_s, inputs):\n        return {}\n"
    )
    (dam.parent / "slope.py").write_text("STEEP = 1\n")
    prototype = dam.with_name("dam.prototype.yaml")
    prototype.write_text(
        prototype.read_text().replace("{recording: tilt.jsonl, at_end: loop}", "{simulation: hill}")
        + "simulations: {hill: {python: 'hill.py:Hill'}}\n"
    )
    manifest = packed(dam, tmp_path / "T.zip")
    assert manifest.code == ("systems/hill.py", "systems/slope.py")
    with pytest.raises(NotAllowed):
        system_file(str(tmp_path / "T.zip"), no)


@pytest.mark.parametrize("name", ["lab_vehicle", "silage_tractor"])
def test_every_shipped_system_makes_a_whole_template(name: str, tmp_path: Path) -> None:
    manifest = packed(SHIPPED / "systems" / f"{name}.yaml", tmp_path / "T")
    assert examine(tmp_path / "T", manifest).name == name


def test_left_over_byte_code_in_a_folder_counts_as_code(dam: Path, tmp_path: Path) -> None:
    packed(dam, tmp_path / "T")
    (tmp_path / "T" / "systems" / "__pycache__").mkdir()
    (tmp_path / "T" / "systems" / "__pycache__" / "plc.cpython-311.pyc").write_bytes(b"")
    assert FolderPackage(tmp_path / "T").code == ("systems/__pycache__/plc.cpython-311.pyc",)


def test_a_program_that_says_that_it_is_a_document_is_asked_about_all_the_same(dam: Path, tmp_path: Path) -> None:
    with_python(dam, tmp_path / "it ran")
    packed(dam, tmp_path / "T.zip")

    def change(files: dict[str, bytes]) -> None:
        manifest = json.loads(files[MANIFEST])
        for file in manifest["files"]:
            if file["path"].endswith(".py"):
                file |= {"kind": "document", "document": "generic"}
        files[MANIFEST] = json.dumps(manifest).encode()

    sly = reworked(tmp_path / "T.zip", tmp_path / "sly.zip", change)
    with pytest.raises(NotAllowed):
        system_file(str(sly), no)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("{listen: 'can:fieldtwin/127.0.0.1:0'}", "plant", "it opens can:socketcan/can0, as the plant does (bus can0)"),
        ("fieldtwin/127.0.0.1:0", "socketcan/can0", "it sends on can:socketcan/can0, an interface of this computer (bus can0)"),
        ("127.0.0.1", "0.0.0.0", "it listens on 0.0.0.0, where others can reach it (bus can0)"),
        ("127.0.0.1", "127.evil.example", "it listens on 127.evil.example, where others can reach it (bus can0)"),
    ],
)  # fmt: skip
def test_a_prototype_that_does_not_keep_to_itself_is_asked_about(
    dam: Path, tmp_path: Path, old: str, new: str, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FIELDTWIN_RUN", str(tmp_path / "run"))
    prototype = dam.with_name("dam.prototype.yaml")
    prototype.write_text(prototype.read_text().replace(old, new))
    packed(dam, tmp_path / "T")
    told: list[Stranger] = []

    def asked(template: Stranger) -> bool:
        told.append(template)
        return False

    inside = str(tmp_path / "T" / "systems" / "dam.yaml")
    for name in (str(tmp_path / "T"), inside):
        with pytest.raises(NotAllowed):
            system_file(name, asked)
        assert told.pop().reach == (says,)
        assert system_file(name, asked, virtual=True) == inside, "where nothing is opened there is nothing to ask"
        assert system_file(name, asked, plant=True) == inside
    assert system_file(str(dam), asked) == str(dam), "one's own files are no stranger's"


def test_links_and_servers_of_a_prototype_are_told_of(dam: Path, tmp_path: Path) -> None:
    text = (SHIPPED / "systems" / "observatory.yaml").read_text().replace("tcp://127.0.0.1:1502", "tcp://0.0.0.0:1502")
    (tmp_path / "observatory.yaml").write_text(text)
    shutil.copy(SHIPPED / "systems" / "relay.st", tmp_path)
    prototype = (SHIPPED / "systems" / "observatory.prototype.yaml").read_text()
    prototype = prototype.replace("pty:line1", "pty:/home/ada/bin/python").replace(
        'far: "tcp://127.0.0.1:0"', 'far: "tcp://[::]:7"'
    )
    (tmp_path / "observatory.prototype.yaml").write_text(prototype)
    system = load_system(str(tmp_path / "observatory.yaml"))
    assert [said.split(" (")[0] for said in reach(system, load_prototype(system))] == [
        "it makes a link at /home/ada/bin/python, outside of its run directory",
        "it listens on ::, where others can reach it",
        "it listens on 0.0.0.0, where others can reach it",
    ]
    shipped = load_system("observatory")
    assert reach(shipped, load_prototype(shipped)) == ()


def test_without_a_terminal_no_port_is_opened_and_it_is_said_which_one(dam: Path, tmp_path: Path) -> None:
    prototype = dam.with_name("dam.prototype.yaml")
    prototype.write_text(prototype.read_text().replace("{listen: 'can:fieldtwin/127.0.0.1:0'}", "plant"))
    packed(dam, tmp_path / "T.zip")
    refused = fieldtwin(tmp_path, "run", str(tmp_path / "T.zip"), "--prototype", "--for", "1s")
    assert refused.returncode == 2
    assert "T.zip does not keep to itself as a prototype:\n  it opens can:socketcan/can0" in refused.stderr
    assert "nothing of this template was run" in refused.stderr


# -- strangers' templates -------------------------------------------------------------------------------------------------


def reworked(source: Path, target: Path, change: Callable[[dict[str, bytes]], None]) -> Path:
    """The zip with other contents, its manifest made to fit where `change` leaves the manifest alone."""
    with zipfile.ZipFile(source) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    change(files)
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return target


def unpack_zip(path: Path, target: Path) -> None:
    with open_package(path) as package:
        unpack(package, target)


@pytest.fixture
def good(dam: Path, tmp_path: Path) -> Path:
    packed(dam, tmp_path / "good.zip")
    return tmp_path / "good.zip"


def test_a_wrong_hash_names_file_expected_and_got(good: Path, tmp_path: Path) -> None:
    def change(files: dict[str, bytes]) -> None:
        files["devices/tilt.yaml"] = files["devices/tilt.yaml"].replace(b"16", b"61", 1)

    bad = reworked(good, tmp_path / "bad.zip", change)
    with pytest.raises(FileInvalid, match=r"devices/tilt\.yaml: not what was packed") as caught:
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

    with pytest.raises(FileInvalid, match=r"devices/tilt\.yaml: not what was packed"):
        system_file(str(reworked(good, tmp_path / "bad.zip", change)), yes)


def add(name: str, data: bytes = b"x") -> Callable[[dict[str, bytes]], None]:
    return lambda files: files.update({name: data})


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
    with pytest.raises(FileInvalid, match="no plain file"), open_package(good):
        pass
    folder = tmp_path / "folder"
    own = own_system(tmp_path / "again")
    packed(own, folder)
    (folder / "model.json").unlink()
    (folder / "model.json").symlink_to("/etc/passwd")
    with pytest.raises(FileInvalid, match="no plain file"):
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

    with pytest.raises(FileInvalid, match="packed too tightly"):
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
        ({"files": "all"}, "no manifest of a template"),
        ({"software": {"version": "1\x1b[2J", "modules_sha256": "0"}}, r"the version of the software.* got 1\\x1b\[2J"),
    ],
)
def test_a_manifest_that_is_none_is_refused(good: Path, tmp_path: Path, change: dict[str, object], says: str) -> None:
    with open_package(good) as package:
        text = package.manifest.to_json()
    with pytest.raises(FileInvalid, match=says):
        parse_manifest(json.dumps({**json.loads(text), **change}).encode(), "here")


@given(
    text=st.binary(max_size=200)
    | st.recursive(st.none() | st.integers() | st.text(), st.lists).map(msgspec.json.encode)
)
def test_no_bytes_are_a_manifest_or_else_a_clear_error(text: bytes) -> None:
    with pytest.raises(FileInvalid):
        parse_manifest(text, "here")


@given(cut=st.integers(0, 20_000), flips=st.lists(st.tuples(st.integers(0, 20_000), st.integers(1, 255)), max_size=4))
def test_a_damaged_zip_is_refused_or_is_what_was_packed(
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


def test_a_template_that_counts_on_what_this_computer_has_is_not_whole(dam: Path, tmp_path: Path) -> None:
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


def test_a_template_means_its_own_files_whatever_else_there_is(
    dam: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A bare name in a template is not looked up in FIELDTWIN_PROFILES, here, or among what is shipped."""
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


# -- unpacking, comparing ---------------------------------------------------------------------------------------------


def test_pack_unpack_and_pack_again_are_the_same(good: Path, tmp_path: Path) -> None:
    unpack_zip(good, tmp_path / "out")
    assert packed(tmp_path / "out" / "systems" / "dam.yaml", tmp_path / "again.zip")
    assert (tmp_path / "again.zip").read_bytes() == good.read_bytes()


def test_a_folder_in_use_is_left_alone(good: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").touch()
    with pytest.raises(UsageError, match="the folder is not empty"):
        unpack_zip(good, tmp_path / "out")


def test_a_full_disk_is_said_before_anything_is_written(
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
    assert [(d.what, d.path) for d in differences(before, after)] == [
        ("changed", "systems/dam.prototype.yaml"), ("changed", "systems/dam.yaml"), ("added", "systems/other.jsonl"),
        ("removed", "systems/tilt.jsonl"),
    ]  # fmt: skip
    assert differences(before, before) == []


def test_the_zip_says_what_it_is_made_of(good: Path) -> None:
    with ZipPackage(good) as package:
        assert json.loads(package.text("model.json"))["initial"] == {"state": "STANDBY", "period_s": 0}


# -- what is in it is what it says ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("first", [True, False])
def test_a_damaged_template_is_not_equal_to_a_whole_one(dam: Path, tmp_path: Path, first: bool) -> None:
    """Its manifest is the same: only its bytes say so."""
    packed(dam, tmp_path / "T.zip")

    def change(files: dict[str, bytes]) -> None:
        files["devices/tilt.yaml"] = files["devices/tilt.yaml"].replace(b"slope", b"slopf", 1)

    bad = reworked(tmp_path / "T.zip", tmp_path / "bad.zip", change)
    both = [str(bad), str(tmp_path / "T.zip")]
    done = fieldtwin(tmp_path, "template", "diff", *(both if first else both[::-1]))
    assert (done.returncode, done.stdout) == (3, "")
    assert "bad.zip: devices/tilt.yaml: not what was packed" in done.stderr


def test_the_wheel_in_a_template_is_the_software_that_its_manifest_names(dam: Path, tmp_path: Path) -> None:
    """Of a stranger's: the hash of the file says that it is the file that was packed, and no more."""
    wheel = tmp_path / "fieldtwin-9.9-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for name in ("emulators", "fieldtwin", "gateway", "plc", "twin"):
            for path in (CHECKOUT / name).rglob("*.py"):
                archive.write(path, path.relative_to(CHECKOUT).as_posix())
            for path in (CHECKOUT / name).rglob("*.*"):
                if path.suffix not in (".py", ".pyc"):
                    archive.write(path, path.relative_to(CHECKOUT).as_posix())
    packed(dam, tmp_path / "T", Extras(wheel=wheel))
    manifest = FolderPackage(tmp_path / "T").manifest
    assert examine(tmp_path / "T", manifest).name == "dam"
    inside = tmp_path / "T" / manifest.software.wheel
    with zipfile.ZipFile(inside, "a") as archive:
        archive.writestr("plc/backdoor.py", "open('/tmp/x', 'w')\n")
    with pytest.raises(FileInvalid, match=r"other software than the manifest says.*expected 9\.9, modules"):
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
            archive.writestr(f"plc/{n}.py", bytes(1 << 20))
    with pytest.raises(FileInvalid, match="too large for a module"):
        wheel_hash(wheel)
    with wheel.open("ab") as file:
        file.truncate((1 << 20) + 1)
    with pytest.raises(FileInvalid, match="too large for a wheel of ours"):
        wheel_hash(wheel)
