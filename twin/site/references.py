"""The error of a reference to a device that the system file does not declare, or declares with an error."""

from __future__ import annotations

from collections.abc import Iterable

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.error_collector import FollowingError
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.files.yaml_file import Key, YamlFile


def no_device(file: YamlFile, loc: tuple[Key, ...], name: str, others: Iterable[str] = ()) -> FileInvalid:
    """Return the error of a reference to the device `name`. `others` are further names that the reference accepts; the message
    suggests the nearest name.
    """
    declared = list(file.section("devices"))
    if name in declared:
        return FollowingError(f"the device {name!r} has an error", path=file.path)
    names = [*declared, *others]
    what = "device or program" if len(names) > len(declared) else "device"
    return file.error(loc, f"no {what} {name!r}", expected=", ".join(names), hint=did_you_mean(name, names))
