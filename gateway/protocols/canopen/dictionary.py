"""The object dictionary of a node as its EDS or DCF describes it, in our own frozen form.

The one file on this side that imports the `canopen` package, whose reader turns text into objects ($NODEID, limits,
types of its own making). It forgives little and names no line: `eds_text` mends before, and its errors end here.
Nothing here talks to a node.
"""

from __future__ import annotations

import configparser
import difflib
import io
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PureWindowsPath
from types import MappingProxyType

from canopen.objectdictionary import ODArray, ODRecord, ODVariable
from canopen.objectdictionary.eds import import_eds

from gateway.core.errors import FileInvalid, UsageError
from gateway.core.values import Scalar
from gateway.protocols.canopen.cob_id import check_node
from gateway.protocols.canopen.datatypes import DataType
from gateway.protocols.canopen.eds_text import EdsText, decode_eds, invalid, read_eds_text

_TYPE_AREA = range(0x1000)
"""Indices that define data types (7.4.1): no objects of the device."""


@dataclass(frozen=True, slots=True)
class DictionaryEntry:
    """One object (or sub-object) of the dictionary.

    `name` is ``Parent.Child`` for a sub-object. `type_code` is that of CiA 301 (see `datatypes.DataType`). `access` is
    ro, wo, rw, rwr, rww or const. `default` is the DCF's ParameterValue where it has one, else the DefaultValue, with
    $NODEID filled in when a node id was given; None when the file has none, or none that can be read. `low` and
    `high` are limits of integers, None where there is none. `configured` says that a DCF sets it: `default` is then its
    ParameterValue, None where that cannot be read.
    """

    index: int
    subindex: int
    name: str
    type_code: int
    access: str
    default: Scalar | None = None
    low: int | None = None
    high: int | None = None
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
    """All entries by (index, subindex), in order. `mended` says what the file had to be forgiven."""

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
        """The entry, or None where the file has none."""
        return self.entries.get((index, subindex))

    def find(self, name: str) -> DictionaryEntry:
        """The entry of that name, full or of the sub-object alone if that is unique. `UsageError` names the nearest."""
        exact = [entry for entry in self if entry.name == name]
        found = exact or [entry for entry in self if entry.name.endswith(f".{name}")]
        if len(found) == 1:
            return found[0]
        if found:
            several = ", ".join(entry.name for entry in found[:4])
            raise UsageError(f"{name!r} names several objects", got=several).at(self.path or "the EDS")
        near = difflib.get_close_matches(name, [entry.name for entry in self], n=1)
        hint = f"did you mean {near[0]!r}?" if near else ""
        raise UsageError(f"no object is called {name!r}", hint=hint).at(self.path or "the EDS")


def load_dictionary(path: Path, node_id: int | None = None) -> ObjectDictionary:
    """Read an EDS or DCF file. Raises `FileInvalid` with file, line, section and key.

    A DOMAIN's DownloadFile (CiA 306, 4.7.3) is read from the file's own folder: its bytes are what the DCF sets.
    """
    try:
        raw = path.read_bytes()
    except OSError as e:
        raise FileInvalid(f"cannot be read: {e.strerror or e}", path=str(path)) from e
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
    """Read the text of an EDS or DCF. `node_id` fills in $NODEID; without it the DCF's own, if it has one. Files that it
    names are looked for in `folder`; None: they are not read."""
    if node_id is not None:
        check_node(node_id)
    eds = read_eds_text(text, path)
    try:
        theirs = import_eds(io.StringIO(str(eds)), node_id)  # type: ignore[no-untyped-call]
    except (configparser.Error, ValueError, KeyError, OverflowError) as e:
        raise FileInvalid(f"not an EDS that can be used: {e}", path=path) from e
    entries = _entries(theirs.values(), eds)
    if folder is not None:
        entries.update(_downloads(entries, eds, folder, path))
    information = theirs.device_information
    return ObjectDictionary(
        MappingProxyType(entries),
        vendor_name=information.vendor_name or "",
        vendor_number=information.vendor_number,
        product_name=information.product_name or "",
        product_number=information.product_number,
        revision_number=information.revision_number,
        node_id=theirs.node_id,
        mended=mended + eds.mended,
        path=path,
    )


def _entries(
    objects: Iterable[ODVariable | ODArray | ODRecord], eds: EdsText
) -> dict[tuple[int, int], DictionaryEntry]:
    """Every variable of theirs as an entry of ours, in order of index and subindex."""
    entries: dict[tuple[int, int], DictionaryEntry] = {}
    for item in objects:
        if item.index in _TYPE_AREA:
            continue
        if isinstance(item, ODVariable):
            members = [_entry(item, item.name)]
        else:
            members = [_entry(var, f"{item.name}.{var.name}") for var in item.subindices.values()]
        compact = int(eds.sections[f"{item.index:04X}"].values.get("CompactSubObj", "0"), 0)
        if isinstance(item, ODArray) and compact:
            members = _expand(item, members, compact)
        entries.update({(entry.index, entry.subindex): entry for entry in members})
    return dict(sorted(entries.items()))


def _downloads(
    entries: Mapping[tuple[int, int], DictionaryEntry], eds: EdsText, folder: Path, path: str
) -> dict[tuple[int, int], DictionaryEntry]:
    """The DOMAINs that name a DownloadFile, set to its content."""
    found: dict[tuple[int, int], DictionaryEntry] = {}
    for key, entry in entries.items():
        index, sub = f"{entry.index:04X}", f"{entry.index:04X}sub{entry.subindex:X}"
        section = eds.sections.get(sub) or eds.sections[index]
        name = section.values.get("DownloadFile", "")
        if not name or entry.type_code != DataType.DOMAIN:
            continue
        try:
            raw = (folder / PureWindowsPath(name).name).read_bytes()
        except OSError as e:
            problem = f"cannot be read: {e.strerror or e}"
            raise invalid(problem, section, "DownloadFile", path, expected="a file beside this one", got=name) from e
        found[key] = replace(entry, default=raw, configured=True)
    return found


def _expand(array: ODArray, members: list[DictionaryEntry], count: int) -> list[DictionaryEntry]:
    """A compact array (CiA 306, 4.6.3.2.3) with all its entries; `canopen` makes the first and those with names."""
    known = {entry.subindex: entry for entry in members}
    template = known[1]
    known[0] = replace(known[0], access="ro", default=count)
    for sub in range(2, min(count, 254) + 1):
        known.setdefault(sub, replace(template, subindex=sub, name=f"{array.name}.{array.name}{sub}", configured=False))
    return list(known.values())


def _entry(var: ODVariable, name: str) -> DictionaryEntry:
    configured = bool(getattr(var, "value_raw", ""))
    default = var.value if configured else var.default
    if var.data_type == DataType.BOOLEAN and default is not None:
        default = bool(default)
    kind = DataType.DOMAIN if var.data_type is None else var.data_type
    return DictionaryEntry(
        var.index, var.subindex, name, kind, var.access_type, default, var.min, var.max, var.pdo_mappable, configured
    )
