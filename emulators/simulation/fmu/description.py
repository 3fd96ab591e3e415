"""The description of an FMU: the variables and properties in its ``modelDescription.xml``. No code of the FMU is run.

FMI 2.0.4 and FMI 3.0.1 (fmi-standard.org), section 2.2 (2.0) and 2.4 (3.0). The package fmpy is the extra `fmi`.
"""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.installation import install_hint

MAX_FILES = 10_000
MAX_UNPACKED_BYTES = 1 << 30
MAX_DESCRIPTION_BYTES = 64 << 20
_DESCRIPTION = "modelDescription.xml"
_SUFFIXES_2 = {"Real": "Real", "Integer": "Integer", "Boolean": "Boolean", "Enumeration": "Integer"}
_SUFFIXES_3 = {
    **{name: name for name in ("Float64", "Float32", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32")},
    **{name: name for name in ("Int64", "UInt64", "Boolean")},
    "Enumeration": "Int64",
}


@dataclass(frozen=True, slots=True)
class FmuVariable:
    """A variable of an FMU. `suffix` names the FMI functions that set and get it; empty if it is an array, text or binary."""

    name: str
    reference: int
    suffix: str
    causality: str
    initial: str

    @property
    def is_whole(self) -> bool:
        """Return whether its values are integers, or 0 and 1."""
        return self.suffix not in ("Real", "Float64", "Float32")

    @property
    def has_start(self) -> bool:
        """Return whether a value may be set before the initialization (FMI 2.0.4, 2.2.7, and 3.0.1, 2.4.7.5)."""
        return self.causality in ("parameter", "structuralParameter", "input") or self.initial in ("exact", "approx")


@dataclass(frozen=True, slots=True)
class FmuDescription:
    """An FMU for co-simulation with a binary for this platform. `fmi` is the major version of the standard."""

    path: Path
    fmi: int
    identifier: str
    token: str
    fixed_step_s: float | None
    """FMI 3.0: the communication step must be a multiple of this (`fixedInternalStepSize`), if it is given."""
    variables: dict[str, FmuVariable] = field(default_factory=dict)


def describe(path: Path) -> FmuDescription:
    """Return the description of an FMU.

    Raises `FileInvalid` for a file that is not an FMU, has no co-simulation or has no binary for this platform, and
    `UsageError` without the extra `fmi`.
    """
    try:
        status = path.stat()
    except OSError as e:
        raise FileInvalid(f"cannot be read: {e.strerror or e}", path=str(path), expected="an FMU") from e
    return _described(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=16)
def _described(path: Path, modified_ns: int, size: int) -> FmuDescription:
    """Return the description; the same state of a file is read once."""
    fmpy = _fmpy()
    names = _files(path)
    try:
        with path.open("rb") as stream:  # given a path, FMPy leaves the file open after an error
            said = fmpy.read_model_description(stream)
    except Exception as e:  # FMPy raises plain exceptions, and those of its XML parser
        reason = " ".join(str(e).split())[:300]
        raise FileInvalid(f"{_DESCRIPTION} is invalid: {reason}", path=str(path), expected="FMI 2.0 or 3.0") from e
    fmi = int(said.fmiVersion[0])
    if fmi not in (2, 3):
        raise FileInvalid(
            "this version of FMI is not supported", path=str(path), expected="FMI 2.0 or 3.0", got=said.fmiVersion
        )
    if said.coSimulation is None:
        raise FileInvalid(
            "the FMU has no co-simulation",
            path=str(path),
            expected="an FMU that brings its solver (CoSimulation)",
            got="model exchange only" if said.modelExchange is not None else "scheduled execution only",
            hint="export it again as a co-simulation FMU",
        )
    identifier = said.coSimulation.modelIdentifier
    platform = fmpy.platform if fmi == 2 else fmpy.platform_tuple
    binary = f"binaries/{platform}/{identifier}{fmpy.sharedLibraryExtension}"
    if binary not in names:
        others = sorted({name.split("/")[1] for name in names if name.startswith("binaries/") and name.count("/") > 1})
        raise FileInvalid(
            "the FMU has no binary for this computer",
            path=str(path),
            expected=binary,
            got=", ".join(others) or "no binaries",
            hint="export it again for this platform",
        )
    fixed = said.coSimulation.fixedInternalStepSize if fmi == 3 else None
    fixed_step_s = None if fixed is None else float(fixed)  # the schema has checked that it is a number
    variables = {variable.name: _variable(variable, fmi) for variable in said.modelVariables}
    return FmuDescription(path, fmi, identifier, said.guid, fixed_step_s, variables)


def _fmpy() -> Any:
    try:
        import fmpy
    except ModuleNotFoundError as e:
        raise UsageError("FMUs need an extra", hint=install_hint("fmi")) from e
    return fmpy


def _files(path: Path) -> set[str]:
    """Return the names of the files in the FMU. Raises `FileInvalid` if it is not a zip, or larger than the limits."""
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
    except (OSError, zipfile.BadZipFile, NotImplementedError, ValueError) as e:
        raise FileInvalid("not an FMU", path=str(path), expected="a zip file with a modelDescription.xml") from e
    sizes = {entry.filename: entry.file_size for entry in entries}
    if _DESCRIPTION not in sizes:
        raise FileInvalid("not an FMU", path=str(path), expected="a zip file with a modelDescription.xml")
    if len(entries) > MAX_FILES or sum(sizes.values()) > MAX_UNPACKED_BYTES:
        expected = f"at most {MAX_FILES} files and {MAX_UNPACKED_BYTES >> 20} MB unpacked"
        raise FileInvalid("the FMU is too large", path=str(path), expected=expected)
    if sizes[_DESCRIPTION] > MAX_DESCRIPTION_BYTES:
        expected = f"at most {MAX_DESCRIPTION_BYTES >> 20} MB"
        raise FileInvalid(f"{_DESCRIPTION} is too large", path=str(path), expected=expected)
    return set(sizes)


def _variable(said: Any, fmi: int) -> FmuVariable:
    suffixes = _SUFFIXES_2 if fmi == 2 else _SUFFIXES_3
    is_scalar = not said.dimensions
    suffix = suffixes.get(said.type, "") if is_scalar else ""
    return FmuVariable(said.name, said.valueReference, suffix, said.causality or "local", said.initial or "")


def unpack(path: Path, folder: Path) -> None:
    """Unpack an FMU that `describe` has accepted into `folder`. Raises `FileInvalid`."""
    try:
        with zipfile.ZipFile(path) as archive:
            archive.extractall(folder)  # removes absolute paths and ".." from the names
    except (OSError, zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, ValueError) as e:
        raise FileInvalid(f"cannot be unpacked: {str(e) or type(e).__name__}", path=str(path)) from e
