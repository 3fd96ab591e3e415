"""Compares a CANopen profile with the EDS that it names, so that a wrong object or type is reported before a run."""

from __future__ import annotations

import re
from pathlib import Path

from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.gateway.core.files.profile import DeviceProfile, Tag
from fieldtwin.gateway.core.files.yaml_file import load
from fieldtwin.gateway.devices.canopen_rpdo import BITS
from fieldtwin.gateway.protocols.canopen.eds.datatypes import DataType, size_of
from fieldtwin.gateway.protocols.canopen.eds.dictionary import DictionaryEntry, ObjectDictionary, load_dictionary

TAG_TYPES: dict[int, str] = {
    DataType.BOOLEAN: "bool",
    DataType.INTEGER8: "int8",
    DataType.INTEGER16: "int16",
    DataType.INTEGER32: "int32",
    DataType.INTEGER64: "int64",
    DataType.UNSIGNED8: "uint8",
    DataType.UNSIGNED16: "uint16",
    DataType.UNSIGNED32: "uint32",
    DataType.UNSIGNED64: "uint64",
    DataType.REAL32: "float32",
    DataType.REAL64: "float64",
    DataType.VISIBLE_STRING: "string",
    DataType.OCTET_STRING: "bytes",
}
"""The type of a tag for each data type of CiA 301 that a profile has."""
_REALS = (DataType.REAL32, DataType.REAL64)


def check_data_sheet(profile: DeviceProfile) -> None:
    """Check that the EDS has the object of each tag, with a data type of the tag's size.

    The sign of an integer is not compared, because many EDS files state it wrongly. Does nothing for a profile without an EDS,
    or if the file does not exist: the gateway does not need it. Raises `FileInvalid`, with the further errors as its `others`.
    """
    if profile.eds_path is None or not profile.eds_path.is_file():
        return
    dictionary = load_dictionary(profile.eds_path)
    wrong = [tag for tag in profile.tags.values() if not _agrees(tag, _entry(dictionary, tag))]
    if not wrong:
        return
    file, errors, name = load(Path(profile.path)), ErrorCollector(), profile.eds_path.name
    for tag in wrong:
        assert tag.object is not None
        index, subindex = tag.object
        number, entry = f"{index:04X}h:{subindex:02X}", _entry(dictionary, tag)
        loc = ("tags", _key(profile, tag.name))
        if entry is None:
            there = [f'"{e.index:04X}:{e.subindex:02X}"' for e in dictionary if e.index == index and e.subindex]
            error = file.error(
                (*loc, "object"),
                f"{name} has no object {number}",
                expected=", ".join(there[:8]) or f"an object of {name}",
            )
        else:
            error = file.error(
                (*loc, "type"),
                f"the type of {tag.name!r} does not fit {number} of {name}, which is {DataType(entry.type_code).name}",
                expected=_fitting(entry),
                got=tag.type,
            )
        errors.add(error)
    errors.raise_all()


def _entry(dictionary: ObjectDictionary, tag: Tag) -> DictionaryEntry | None:
    assert tag.object is not None
    return dictionary.get(*tag.object)


def _agrees(tag: Tag, entry: DictionaryEntry | None) -> bool:
    """Return whether the tag's type can hold the object. Types without a fixed size, such as texts, are not compared."""
    if entry is None:
        return False
    size = size_of(entry.type_code)
    if size is None or tag.type not in BITS:
        return True
    return 8 * size == BITS[tag.type] and tag.type.startswith("float") == (entry.type_code in _REALS)


def _fitting(entry: DictionaryEntry) -> str:
    """Return the type of a tag for the data type of an object, such as uint16 for UNSIGNED16."""
    kind = TAG_TYPES.get(entry.type_code, "")
    return kind if kind in BITS else "no tag of this object, because a profile has no such type"


def _key(profile: DeviceProfile, name: str) -> str:
    """Return the key of a tag in the profile's file: its name, or a range of names such as ``voltage_1..3``."""
    if name in profile.form.tags:
        return name
    stems = {key: re.sub(r"[0-9]+\.\.[0-9]+$", "", key) for key in profile.form.tags if ".." in key}
    return next(key for key, stem in stems.items() if re.fullmatch(re.escape(stem) + "[0-9]+", name))
