"""Writes an FMU: the system as a template, the description of its variables, and pythonfmu, whose binary loads Python.

pythonfmu (MIT) is in the extra `fmi`. Its binary has FMI 2.0, for Linux on x86-64.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import msgspec

from fieldtwin.__about__ import __version__
from fieldtwin.emulators.simulation.fmu.description import describe
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.installation import install_hint
from fieldtwin.run.fmu_export.interface import FmuInterface, interface_of
from fieldtwin.twin.prototype.file import Prototype
from fieldtwin.twin.site.system import System
from fieldtwin.twin.template.pack import TemplateExtras, collect, pack

TEMPLATE = "system.zip"
INTERFACE = "interface.json"
BUILD_LIMIT_S = 120.0
"""The time that pythonfmu may take to write an FMU, in seconds."""
_PLATFORM = "binaries/linux64/"
_EPOCH = (1980, 1, 1, 0, 0, 0)
"""The time of all files in the FMU: equal contents give an equal file. It is the earliest time that a zip can have."""
_SLAVE = Path(__file__).with_name("slave.py")


class Description(msgspec.Struct, frozen=True):
    """The file `INTERFACE` in the resources of the FMU. `python` is the Python that runs the prototype."""

    identifier: str
    guid: str
    text: str
    version: str
    python: str
    seed: int
    interface: FmuInterface


@dataclass(frozen=True, slots=True)
class ExportOptions:
    """The options of an export. `inputs` are the DEVICE.TAG that become inputs, `python` the Python that has fieldtwin."""

    inputs: tuple[str, ...] = ()
    seed: int | None = None
    python: str = sys.executable
    profiles: tuple[Path, ...] = ()


def export_fmu(system: System, prototype: Prototype, out: Path, options: ExportOptions) -> FmuInterface:
    """Write the FMU of a prototype to `out`, and return its variables.

    Raises `UsageError` without the extra `fmi` and for wrong options, and `FileInvalid` if a file cannot be packed or `out`
    exists already.
    """
    if find_spec("pythonfmu") is None:
        raise UsageError("the export of FMUs needs an extra", hint=install_hint("fmi"))
    if out.suffix.lower() != ".fmu":
        raise UsageError("the file of the FMU", expected="a name that ends in .fmu", got=str(out))
    if out.exists():
        raise FileInvalid("the file exists already", path=str(out), hint="choose another name with --out")
    interface = interface_of(system, prototype, options.inputs)
    with tempfile.TemporaryDirectory(prefix="ft-export-") as place:
        folder = Path(place)
        collected = collect(system, options.profiles, prototype.path)
        manifest = pack(system, collected, TemplateExtras(), __version__, folder / TEMPLATE)
        description = Description(
            re.sub(r"\W", "_", f"fieldtwin_{system.name}", flags=re.ASCII),
            "",
            f"fieldtwin {__version__}: the prototype of {system.name} with gateway and PLC, in virtual time",
            __version__,
            options.python,
            prototype.seed if options.seed is None else options.seed,
            interface,
        )
        identity = hashlib.sha256(msgspec.json.encode([manifest.id, description])).hexdigest()
        described = msgspec.json.encode(msgspec.structs.replace(description, guid=identity[:32]))
        (folder / INTERFACE).write_bytes(msgspec.json.format(described, indent=1))
        built = _build(folder, [folder / TEMPLATE, folder / INTERFACE])
        _write(built, out)
    describe(out)  # checks the description against the schema of FMI
    return interface


def _build(folder: Path, files: Sequence[Path]) -> Path:
    """Return the FMU that pythonfmu builds in a separate process, because it imports the class and changes the import path."""
    # Two FMUs in one process of a tool share a module of the same name, so the name depends on the contents.
    version = hashlib.sha256(_SLAVE.read_bytes()).hexdigest()[:8]
    script = folder / f"fieldtwin_slave_{version}.py"
    shutil.copyfile(_SLAVE, script)
    out = folder / "built.fmu"
    argv = [sys.executable, "-m", "pythonfmu", "build", "-f", str(script), "-d", str(out), *map(str, files)]
    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(
            argv, cwd=folder, env=environment, capture_output=True, text=True, timeout=BUILD_LIMIT_S, check=False
        )
    except subprocess.TimeoutExpired as e:
        raise UsageError("pythonfmu does not end", expected=f"an FMU within {BUILD_LIMIT_S:g} s") from e
    if done.returncode != 0 or not out.is_file():
        raise UsageError(f"pythonfmu has failed: {(done.stderr.strip().splitlines() or ['no message'])[-1][:500]}")
    return out


def _write(built: Path, out: Path) -> None:
    """Write the FMU without the binary for Windows, where fieldtwin does not run; all files get the same time."""
    part = out.with_name(out.name + ".part")
    try:
        with zipfile.ZipFile(built) as source, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as target:
            for name in sorted(source.namelist()):
                if not name.startswith("binaries/") or name.startswith(_PLATFORM):
                    entry = zipfile.ZipInfo(name, _EPOCH)
                    entry.compress_type = zipfile.ZIP_DEFLATED
                    entry.external_attr = 0o644 << 16
                    target.writestr(entry, source.read(name))
        part.replace(out)
    except OSError as e:
        part.unlink(missing_ok=True)
        raise FileInvalid(f"cannot be written: {e.strerror or e}", path=str(out)) from e
