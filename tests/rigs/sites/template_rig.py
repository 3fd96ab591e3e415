"""A packed test system, and manipulated versions of it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

from fieldtwin.run.template import ForeignParts
from fieldtwin.twin.site.system import load_system
from fieldtwin.twin.template.pack import TemplateExtras, collect, pack
from fieldtwin.twin.template.package import open_package, unpack
from fieldtwin.twin.template.template import Manifest

CHECKOUT = Path(__file__).resolve().parents[3]
SHIPPED = CHECKOUT / "profiles"
BLINKER = """
import helper
from fieldtwin.plc.program import Output, Program
from fieldtwin.gateway.core.image.image import TagKind

class Blinker(Program):
    def execute(self, scan):
        pass
"""


def own_system(folder: Path) -> Path:
    """A system without shipped files: profile, EDS, recording, control logic in Structured Text and Python."""
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
    """Give the system at `path` a Python program that leaves a marker when it is imported."""
    text = path.read_text().replace("programs:", "programs:\n    blink: {source: 'python: site_logic:Blinker'}")
    path.write_text(text)
    (path.parent / "helper.py").write_text(f"open({str(marker)!r}, 'w').close()\n")
    (path.parent / "site_logic.py").write_text(BLINKER.replace("Output, ", ""))


def packed(system: Path, target: Path, extras: TemplateExtras = TemplateExtras()) -> Manifest:  # noqa: B008
    loaded = load_system(str(system))
    return pack(loaded, collect(loaded, (), system.with_name(f"{system.stem}.prototype.yaml")), extras, "9.9", target)


def yes(template: ForeignParts) -> bool:
    return True


def no(template: ForeignParts) -> bool:
    return False


def fieldtwin(tmp_path: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run our command line without a terminal."""
    return subprocess.run(
        [sys.executable, "-m", "fieldtwin", *words],
        env={**os.environ, "PYTHONPATH": str(CHECKOUT), "FIELDTWIN_RUN": str(tmp_path / "r")},
        stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False, timeout=50,
    )  # fmt: skip


def reworked(source: Path, target: Path, change: Callable[[dict[str, bytes]], None]) -> Path:
    """Return the zip with changed contents; its manifest is adapted unless `change` edits the manifest."""
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


def add(name: str, data: bytes = b"x") -> Callable[[dict[str, bytes]], None]:
    return lambda files: files.update({name: data})
