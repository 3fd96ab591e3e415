"""The object dictionary of a node as its EDS or DCF describes it, in immutable form.

This is the only file of the gateway that imports the `canopen` package, whose reader turns text into objects. That
reader tolerates few errors and reports no line numbers. So the module `text` repairs the text first, the module `values`
reads the values, and this module translates the errors of the package. It does not communicate with a node.
"""

from __future__ import annotations

import configparser
import io
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PureWindowsPath
from types import MappingProxyType
from typing import TYPE_CHECKING

from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.input_file import read_input, reading
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.values import Scalar
from fieldtwin.gateway.protocols.canopen.cob_id import check_node
from fieldtwin.gateway.protocols.canopen.eds.datatypes import DataType
from fieldtwin.gateway.protocols.canopen.eds.text import EdsText, Section, decode_eds, read_eds_text
from fieldtwin.gateway.protocols.canopen.eds.values import read_limit, read_value

# The package imports python-can as well, which takes 50 ms of CPU time. So it is imported where a dictionary is parsed.
if TYPE_CHECKING:
    from canopen.objectdictionary import ODArray, ODRecord, ODVariable

MAX_EDS_BYTES = 8 * 1024 * 1024
"""A larger EDS or DCF file is treated as a mistake; the largest known one has 2 MB."""
MAX_DOMAIN_BYTES = 16 * 1024 * 1024
"""The largest size in bytes of a file that a DOMAIN object names as its content."""
_TYPE_AREA = range(0x1000)
"""Indices that define data types (7.4.1) and are not objects of the device."""


@dataclass(frozen=True, slots=True)
class DictionaryEntry:
    """One object (or sub-object) of the dictionary.

    `name` is ``Parent.Child`` for a sub-object. `type_code` is that of CiA 301 (see `datatypes.DataType`). `access` is
    ro, wo, rw, rwr, rww or const. `default` is the DCF's ParameterValue if it has one, else the DefaultValue, with
    $NODEID filled in if a node ID was given; None if the file has no readable value. `low` and `high` are inclusive
    limits of numbers, None if there is no limit. `configured` says that a DCF sets the object: `default` is then its
    ParameterValue, or None if that cannot be read.
    """

    index: int
    subindex: int
    name: str
    type_code: int
    access: str
    default: Scalar | None = None
    low: int | float | None = None
    high: int | float | None = None
    pdo_mappable: bool = False
    configured: bool = False

    @property
    def readable(self) -> bool:
        return self.access != "wo"

    @property
    def writable(self) -> bool:
        return self.access in ("rw", "wo", "rwr", "rww")


@dataclass(frozen=True, slots=True)
class ObjectDictionary:
    """The object dictionary of a device: all entries by (index, subindex), in order. `mended` lists the repairs that the file
    needed.
    """

    entries: Mapping[tuple[int, int], DictionaryEntry]
    vendor_name: str = ""
    vendor_number: int | None = None
    product_name: str = ""
    product_number: int | None = None
    revision_number: int | None = None
    node_id: int | None = None
    mended: tuple[str, ...] = ()
    path: str = ""

    def __iter__(self) -> Iterator[DictionaryEntry]:
        return iter(self.entries.values())

    def __len__(self) -> int:
        return len(self.entries)

    def get(self, index: int, subindex: int = 0) -> DictionaryEntry | None:
        """Return the entry, or None if the file does not have it."""
        return self.entries.get((index, subindex))

    def find(self, name: str) -> DictionaryEntry:
        """Return the entry with this name: the full name, or the sub-object's name alone if it is unique.

        If there is no such entry, raises `UsageError` with the most similar name.
        """
        exact = [entry for entry in self if entry.name == name]
        found = exact or [entry for entry in self if entry.name.endswith(f".{name}")]
        if len(found) == 1:
            return found[0]
        if found:
            several = ", ".join(entry.name for entry in found[:4])
            raise UsageError(f"{name!r} names several objects", got=several).at(self.path or "the EDS")
        hint = did_you_mean(name, [entry.name for entry in self])
        raise UsageError(f"no object is called {name!r}", hint=hint).at(self.path or "the EDS")


def load_dictionary(path: Path, node_id: int | None = None) -> ObjectDictionary:
    """Read an EDS or DCF file. Raises `FileInvalid` with file, line, section and key.

    A DOMAIN's DownloadFile (CiA 306, 4.7.3) is read from the folder of the DCF: its bytes are the value that the DCF sets.
    """
    with reading(path):
        raw = read_input(path, MAX_EDS_BYTES)
    text, assumed = decode_eds(raw, str(path))
    return parse_dictionary(text, node_id, path=str(path), mended=assumed, folder=path.parent)


def parse_dictionary(
    text: str,
    node_id: int | None = None,
    *,
    path: str = "",
    mended: tuple[str, ...] = (),
    folder: Path | None = None,
) -> ObjectDictionary:
    """Read the text of an EDS or DCF.

    $NODEID is replaced by `node_id`, or by the node ID of the DCF if `node_id` is None and the DCF states one. Files that the
    text names are read from `folder`, or not at all if `folder` is None.
    """
    from canopen.objectdictionary.eds import import_eds

    if node_id is not None:
        check_node(node_id)
    eds = read_eds_text(text, path)
    try:
        theirs = import_eds(io.StringIO(str(eds)), node_id)  # type: ignore[no-untyped-call]
    except (configparser.Error, ValueError, KeyError, OverflowError) as e:
        raise FileInvalid(f"not an EDS that can be used: {e}", path=path) from e
    values = _Values(eds, theirs.node_id)
    entries = _entries(theirs.values(), eds, values)
    entries.update(_downloads(entries, values, folder))
    information = theirs.device_information
    return ObjectDictionary(
        MappingProxyType(entries),
        vendor_name=information.vendor_name or "",
        vendor_number=information.vendor_number,
        product_name=information.product_name or "",
        product_number=information.product_number,
        revision_number=information.revision_number,
        node_id=theirs.node_id,
        mended=mended + eds.mended + tuple(dict.fromkeys(values.mended)),
        path=path,
    )


def _entries(
    objects: Iterable[ODVariable | ODArray | ODRecord], eds: EdsText, values: _Values
) -> dict[tuple[int, int], DictionaryEntry]:
    """Return every variable of the package's dictionary as an entry, in order of index and subindex."""
    from canopen.objectdictionary import ODArray, ODVariable

    entries: dict[tuple[int, int], DictionaryEntry] = {}
    for item in objects:
        if item.index in _TYPE_AREA:
            continue
        if isinstance(item, ODVariable):
            members = [values.entry(item, item.name)]
        else:
            members = [values.entry(var, f"{item.name}.{var.name}") for var in item.subindices.values()]
        compact = int(eds.sections[f"{item.index:04X}"].values.get("CompactSubObj", "0"), 0)
        if isinstance(item, ODArray) and compact:
            members = _expand(item, members, compact)
        entries.update({(entry.index, entry.subindex): entry for entry in members})
    return dict(sorted(entries.items()))


def _downloads(
    entries: Mapping[tuple[int, int], DictionaryEntry], values: _Values, folder: Path | None
) -> dict[tuple[int, int], DictionaryEntry]:
    """Return the entries of the DOMAINs that name a DownloadFile, with the content of the file as `default`.

    If a file cannot be read, `default` is None, and the reason is added to `mended`.
    """
    found: dict[tuple[int, int], DictionaryEntry] = {}
    for key, entry in entries.items():
        section = values.section(*key)
        name = section.values.get("DownloadFile", "")
        if not name or entry.type_code != DataType.DOMAIN:
            continue
        if folder is None:
            values.mended.append(f"[{section.name}] DownloadFile: not looked for")
            continue
        raw: bytes | None = None
        try:
            raw = read_input(folder / PureWindowsPath(name).name, MAX_DOMAIN_BYTES)
        except OSError as e:
            line = section.lines.get("DownloadFile", section.line)
            values.mended.append(f"[{section.name}] DownloadFile: cannot be read: {e.strerror or e} (line {line})")
        found[key] = replace(entry, default=raw, configured=True)
    return found


def _expand(array: ODArray, members: list[DictionaryEntry], count: int) -> list[DictionaryEntry]:
    """Return all entries of a compact array (CiA 306, 4.6.3.2.3). `canopen` creates only the first entry and the named ones."""
    known = {entry.subindex: entry for entry in members}
    template = known[1]
    known[0] = replace(known[0], access="ro", default=count)
    for sub in range(2, min(count, 254) + 1):
        known.setdefault(sub, replace(template, subindex=sub, name=f"{array.name}.{array.name}{sub}", configured=False))
    return list(known.values())


class _Values:
    """Reads the values in the sections of the file. `mended` lists the values that could not be read."""

    def __init__(self, eds: EdsText, node_id: int | None) -> None:
        self._sections = eds.sections
        self._node_id = node_id
        self.mended: list[str] = []

    def section(self, index: int, subindex: int) -> Section:
        """Return the section that describes a value: the section of the sub-object if there is one, else that of the object."""
        return self._sections.get(f"{index:04X}sub{subindex:X}") or self._sections[f"{index:04X}"]

    def entry(self, var: ODVariable, name: str) -> DictionaryEntry:
        """Return the dictionary entry for a variable of the `canopen` package."""
        section, kind = self.section(var.index, var.subindex), int(var.data_type or DataType.DOMAIN)
        configured = bool(section.values.get("ParameterValue", ""))
        default = self._value(section, "ParameterValue", kind) if configured else None
        if not configured:
            default = self._value(section, "DefaultValue", kind)
        low, high = self._limit(section, "LowLimit", kind), self._limit(section, "HighLimit", kind)
        if low is not None and high is not None and low > high:
            self.mended.append(f"[{section.name}] LowLimit: above HighLimit, both left out")
            low = high = None
        mapped = var.pdo_mappable
        return DictionaryEntry(
            var.index, var.subindex, name, kind, var.access_type, default, low, high, mapped, configured
        )

    def _value(self, section: Section, key: str, kind: int) -> Scalar | None:
        text = section.values.get(key, "")
        if not text:
            return None
        try:
            return read_value(kind, text, self._node_id)
        except (ValueError, OverflowError):
            self.mended.append(f"[{section.name}] {key}: not a value of data type {kind:04X}h: {text[:40]}")
            return None

    def _limit(self, section: Section, key: str, kind: int) -> int | float | None:
        text = section.values.get(key, "")
        try:
            return read_limit(kind, text)
        except (ValueError, OverflowError):
            self.mended.append(f"[{section.name}] {key}: not a number of its type, left out: {text[:40]}")
            return None
