"""The digital template: everything needed to build a physical twin and to keep it running, as one package.

A package is a folder, or a zip of one. Its manifest (``template.json``) names every file with its kind, size and
SHA-256: the system file, profiles, EDS files, control logic, recordings, a description of the digital model, the
software's own hash, and documents. The same files give the same bytes: nothing in a package is dated.

This module defines the format only. It opens no file, runs nothing, and does not handle zips.
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import msgspec

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.statemachine import ACCEPTING, delta
from fieldtwin.twin.model.model import DigitalModel
from fieldtwin.twin.plant.declared import declared_variables
from fieldtwin.twin.plant.physical import EmbeddedControlSystem
from fieldtwin.twin.site.system import System
from fieldtwin.twin.template.detect import MANIFEST

VERSION = 1
MAX_FILES = 10_000
MAX_PATH = 240
MAX_NAME = 120
MAX_FILE_BYTES = 1 << 30
MAX_TOTAL_BYTES = 2 << 30
MAX_MANIFEST_BYTES = 8 << 20

Kind = Literal[
    "system", "prototype", "program", "profile", "eds", "dcf", "recording", "model", "software", "document"
]  # fmt: skip
DocumentKind = Literal["", "blueprint", "technical-manual", "bill-of-materials", "generic"]
CODE_SUFFIXES = (".py", ".pyw", ".pyc", ".so", ".pyd", ".dll", ".dylib", ".pth", ".fmu")
"""Suffixes of files that Python runs when a module is imported, or when the file is named as a simulation, and of FMUs, which
contain native code.
"""

_BAD_CHARACTER = re.compile(r'[\x00-\x1f\x7f\\:*?"<>|]')
_DEVICE_NAME = re.compile(r"(?i)^(con|prn|aux|nul|com[0-9]|lpt[0-9])(\.|$)")
_VERSION = re.compile(r"[0-9A-Za-z.+!_-]{1,64}")
_HASH = re.compile(r"[0-9a-f]{64}")


def is_code(path: str) -> bool:
    """Return whether the file can be run when it is imported or named as a simulation."""
    return path.lower().endswith(CODE_SUFFIXES)


class TemplateFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True, kw_only=True):
    """A file of the package: its path inside (with ``/``), kind, size and SHA-256."""

    path: str
    kind: Kind
    document: DocumentKind = ""
    bytes: int
    sha256: str

    @property
    def is_code(self) -> bool:
        """Return whether Python would run the file, whatever its stated kind is."""
        return is_code(self.path)


class Software(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True, kw_only=True):
    """The control software: its version, the hash of its modules (`fieldtwin.twin.template.software`), and the wheel in
    the package, if any."""

    name: str = "fieldtwin"
    version: str
    modules_sha256: str
    wheel: str = ""


class Manifest(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True, kw_only=True):
    """The content of ``template.json``. `system_file` and `prototype_file` are paths inside the package; a template may have no
    prototype.
    """

    version: int = msgspec.field(name="fieldtwin_template")
    system: str
    system_file: str
    prototype_file: str = ""
    software: Software
    files: tuple[TemplateFile, ...]

    def to_json(self) -> bytes:
        """Return the file's bytes, which are the same for equal manifests."""
        return msgspec.json.format(msgspec.json.encode(self), indent=1) + b"\n"

    @property
    def id(self) -> str:
        """Return the identity of this template: the SHA-256 of its manifest, 64 hexadecimal digits."""
        return hashlib.sha256(self.to_json()).hexdigest()

    def by_path(self) -> dict[str, TemplateFile]:
        """Return the files by path, in the manifest's order."""
        return {file.path: file for file in self.files}

    @property
    def code(self) -> tuple[str, ...]:
        """Return the files that Python would run.

        Unless the template is the user's own, the user must agree before they are run.
        """
        return tuple(file.path for file in self.files if file.is_code)


def parse_manifest(text: bytes, where: str) -> Manifest:
    """Read ``template.json``. Raises `FileInvalid` for a manifest that no valid package can have, before any file is read."""
    try:
        version = msgspec.json.decode(text).get("fieldtwin_template")
    except (msgspec.MsgspecError, AttributeError, RecursionError) as e:
        raise FileInvalid("not a manifest of a template", path=where, expected=MANIFEST, got=str(e)[:120]) from e
    if isinstance(version, int) and version > VERSION:
        raise FileInvalid(
            "the template was packed by a newer fieldtwin", path=where, expected=f"form {VERSION}", got=str(version)
        )
    try:
        manifest = msgspec.json.decode(text, type=Manifest)
    except msgspec.MsgspecError as e:
        raise FileInvalid(f"not a manifest of a template: {e}", path=where) from e
    _check(manifest, where)
    return manifest


def _check(manifest: Manifest, where: str) -> None:
    if manifest.version != VERSION:
        raise FileInvalid("the form of the template", path=where, expected=str(VERSION), got=str(manifest.version))
    if not _VERSION.fullmatch(manifest.software.version):
        raise FileInvalid(
            "the version of the software", path=where, expected="such as 1.2.3", got=manifest.software.version
        )
    if len(manifest.files) > MAX_FILES:
        raise FileInvalid("too many files", path=where, expected=f"at most {MAX_FILES}", got=str(len(manifest.files)))
    seen: set[str] = {MANIFEST}
    for file in manifest.files:
        check_path(file.path, where)
        if file.path.lower() in seen:
            raise FileInvalid(f"{file.path!r} is twice in the manifest", path=where)
        seen.add(file.path.lower())
        if not _HASH.fullmatch(file.sha256):
            raise FileInvalid(f"{file.path}: no SHA-256", path=where, expected="64 digits", got=file.sha256[:80])
        if not 0 <= file.bytes <= MAX_FILE_BYTES:
            raise FileInvalid(
                f"{file.path}: too large", path=where, expected=f"at most {MAX_FILE_BYTES}", got=str(file.bytes)
            )
        if (file.kind == "document") != bool(file.document):
            raise FileInvalid(f"{file.path}: `document` states the kind of a document", path=where)
    total = sum(file.bytes for file in manifest.files)
    if total > MAX_TOTAL_BYTES:
        raise FileInvalid("too large", path=where, expected=f"at most {MAX_TOTAL_BYTES} bytes", got=str(total))
    kinds = {file.path: file.kind for file in manifest.files}
    named = [
        (manifest.system_file, "system"),
        (manifest.prototype_file, "prototype"),
        (manifest.software.wheel, "software"),
    ]
    for path, kind in named:
        if (path or kind == "system") and kinds.get(path) != kind:
            raise FileInvalid(f"the {kind} file {path!r} is not among the files", path=where)


def check_path(path: str, where: str) -> None:
    """Refuse a path that could be written or read outside the package's folder, on any system. Raises `FileInvalid`."""
    parts = path.split("/")
    wrong = (
        "it is absolute" if path.startswith("/")
        else "it is empty, or has an empty part" if not all(parts)
        else "it leads out of the folder" if any(part in (".", "..") for part in parts)
        else "it is too long" if len(path.encode()) > MAX_PATH or max(len(p.encode()) for p in parts) > MAX_NAME
        else "it has characters that some systems do not support" if _BAD_CHARACTER.search(path)
        else "it ends in a dot or a space" if any(part[-1] in ". " for part in parts)
        else "it is the name of a device" if any(_DEVICE_NAME.match(part) for part in parts)
        else ""
    )  # fmt: skip
    if wrong:
        raise FileInvalid(
            f"a path that a template cannot have: {wrong}",
            path=where,
            expected="such as devices/ctd.yaml",
            got=ascii(path)[:120],
        )


# -- the paper's schemas ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Document:
    """The paper's Document: a description of the physical twin, or a document needed to build it. `path` is its path in
    the package.
    """

    path: str
    sha256: str
    kind: ClassVar[DocumentKind] = ""


class BluePrint(Document):
    """A construction document: a drawing, a wiring plan."""

    __slots__ = ()
    kind = "blueprint"


class TechnicalManual(Document):
    """A manufacturer's document about a device."""

    __slots__ = ()
    kind = "technical-manual"


class BillOfMaterials(Document):
    """The list of the parts of the physical twin."""

    __slots__ = ()
    kind = "bill-of-materials"


class Generic(Document):
    """A document of any other kind."""

    __slots__ = ()
    kind = "generic"


DOCUMENTS: dict[DocumentKind, type[Document]] = {
    cls.kind: cls for cls in (BluePrint, TechnicalManual, BillOfMaterials, Generic)
}


class DigitalTemplate:
    """The paper's DigitalTemplate: documents, the embedded control system, and its own digital model.

    `system` is the system of the package, loaded. Creating this object assembles the control logic, which imports
    Python programs: for an untrusted package, the caller must have asked the user before.
    """

    def __init__(self, manifest: Manifest, system: System) -> None:
        self.manifest = manifest
        self.documents = tuple(
            DOCUMENTS[file.document](file.path, file.sha256) for file in manifest.files if file.kind == "document"
        )
        self.ecs = EmbeddedControlSystem(system)
        self.digital_model = DigitalModel(declared_variables(system))


def describe_model(system: System) -> bytes:
    """Return the digital model as the package holds it (``model.json``): the state machine, and the declared variables.

    It is made from the system file, so that a template whose model does not match its system is detected.
    """
    model = DigitalModel(declared_variables(system))
    described: dict[str, Any] = {
        "digital_model": 1,
        "system": system.name,
        "initial": {"state": model.state.name, "period_s": model.period_s},
        "accepting": sorted(ACCEPTING),
        "on_command": [
            {"period_s": sign, "state": delta(example).name} for sign, example in (("> 0", 1), ("= 0", 0), ("< 0", -1))
        ],
        "variables": {name: variable.declared() for name, variable in model.variables.items()},
    }
    return json.dumps(described, indent=1, ensure_ascii=False).encode() + b"\n"
