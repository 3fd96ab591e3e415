"""Parts of a template that are programs or open local resources are named, and the user is asked before they run."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from template_rig import SHIPPED, fieldtwin, no, own_system, packed, reworked, with_python, yes

from fieldtwin.gateway.core.errors import NotAllowed
from fieldtwin.run.template import ForeignParts, system_file
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.site.system import load_system
from fieldtwin.twin.template.check import examine
from fieldtwin.twin.template.detect import MANIFEST
from fieldtwin.twin.template.package import FolderPackage
from fieldtwin.twin.template.reach import reach


@pytest.fixture
def dam(tmp_path: Path) -> Path:
    return own_system(tmp_path / "site")


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


@pytest.mark.long
def test_without_a_terminal_the_answer_is_no_and_trust_answers_yes(dam: Path, tmp_path: Path) -> None:
    marker = tmp_path / "it ran"
    with_python(dam, marker)
    packed(dam, tmp_path / "T.zip")
    checked = fieldtwin(tmp_path, "template", "check", str(tmp_path / "T.zip"))
    assert (checked.returncode, marker.exists()) == (0, False), checked.stderr
    assert "its control logic was not checked" in checked.stderr
    run = ["simulate", str(tmp_path / "T.zip"), "--for", "1s"]
    refused = fieldtwin(tmp_path, *run)
    assert "control logic in Python: systems/helper.py, systems/site_logic.py" in refused.stderr
    assert (refused.returncode, marker.exists()) == (2, False), refused.stderr
    trusted = fieldtwin(tmp_path, *run, "--trust")
    assert (trusted.returncode, marker.exists()) == (0, True), trusted.stderr


def test_a_simulation_in_python_is_packed_and_asked_about_as_well(dam: Path, tmp_path: Path) -> None:
    """The code that emulates a device also belongs to the template's author."""
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


def test_a_program_declared_as_a_document_is_asked_about_nevertheless(dam: Path, tmp_path: Path) -> None:
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
        ("127.0.0.1", "0.0.0.0", "it listens on 0.0.0.0, where other computers can reach it (bus can0)"),
        ("127.0.0.1", "127.evil.example", "it listens on 127.evil.example, where other computers can reach it (bus can0)"),
    ],
)  # fmt: skip
def test_a_prototype_that_does_not_keep_to_itself_is_asked_about(
    dam: Path, tmp_path: Path, old: str, new: str, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FIELDTWIN_RUN", str(tmp_path / "run"))
    prototype = dam.with_name("dam.prototype.yaml")
    prototype.write_text(prototype.read_text().replace(old, new))
    packed(dam, tmp_path / "T")
    told: list[ForeignParts] = []

    def asked(template: ForeignParts) -> bool:
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


def test_links_and_servers_of_a_prototype_are_reported(dam: Path, tmp_path: Path) -> None:
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
        "it listens on ::, where other computers can reach it",
        "it listens on 0.0.0.0, where other computers can reach it",
    ]
    shipped = load_system("observatory")
    assert reach(shipped, load_prototype(shipped)) == ()


def test_without_a_terminal_no_port_is_opened_and_the_message_names_it(dam: Path, tmp_path: Path) -> None:
    prototype = dam.with_name("dam.prototype.yaml")
    prototype.write_text(prototype.read_text().replace("{listen: 'can:fieldtwin/127.0.0.1:0'}", "plant"))
    packed(dam, tmp_path / "T.zip")
    refused = fieldtwin(tmp_path, "run", str(tmp_path / "T.zip"), "--prototype", "--for", "1s")
    assert refused.returncode == 2
    assert "T.zip affects more than its run directory as a prototype:\n  it opens can:socketcan/can0" in refused.stderr
    assert "nothing of this template was run" in refused.stderr
