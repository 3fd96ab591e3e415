"""The input and the results of the conversion of a device description.

The profile is the source: each format is converted from a profile or to it. No conversion
prints or writes files; `fieldtwin.cli.device.profile_command` does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.profile_schema import ProfileForm

MAX_DESCRIPTION_BYTES = 16 * 1024 * 1024
"""The largest size in bytes of a description that is imported."""


@dataclass(frozen=True, slots=True)
class Loss:
    """One part of the input that the result does not have.

    `place` names the part of the input, such as ``tag speed`` or ``object 2000h:01``. `what` is the lost property, and `why` the
    reason, as a clause. Losses with equal `what` and `why` are printed together. A `note` names something that the result never
    has and a user does not miss there, such as the address of the device in a profile. It is listed, and ``--strict`` permits it.
    """

    place: str
    what: str
    why: str
    note: bool = False


@dataclass(frozen=True, slots=True)
class Source:
    """A file to import: its path, for messages and for names, and its content, at most `MAX_DESCRIPTION_BYTES` bytes.

    `modified_ns` is the time of its last change, in ns since 1970: the date of a file that is made from it.
    """

    path: Path
    data: bytes
    modified_ns: int = 0


@dataclass(frozen=True, slots=True)
class Imported:
    """The profile of a description.

    `files` are the files that belong into the folder of the profile, by name: the EDS of a CANopen profile. `repairs` are
    errors of the description that were corrected, each a line.
    """

    profile: ProfileForm
    losses: tuple[Loss, ...] = ()
    files: Mapping[str, bytes] = field(default_factory=dict)
    repairs: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Exported:
    """The content of a description that was made from a profile."""

    content: bytes
    losses: tuple[Loss, ...] = ()


Settings = Mapping[str, str]
"""The settings of one conversion: the values of ``--set KEY=VALUE``. Each key is one of the format's."""
Importer = Callable[[Source, Settings], Imported]
Exporter = Callable[[DeviceProfile, Settings], Exported]


def require_protocol(profile: DeviceProfile, protocol: str, title: str) -> None:
    """Raise `UsageError` if the profile is not of `protocol` (``modbus`` or ``canopen``). `title` names the format."""
    if profile.protocol != protocol:
        raise UsageError(
            f"{profile.name} is a {profile.protocol} device", expected=f"a {protocol} device for {title}"
        ).at(profile.path)


def whole_setting(settings: Settings, key: str, low: int, high: int) -> int | None:
    """Return a setting as a number from `low` to `high`; None if it is not set. Raises `UsageError`."""
    text = settings.get(key)
    if text is None:
        return None
    try:
        value = int(text, 0)
    except ValueError:
        value = low - 1
    if not low <= value <= high:
        raise UsageError(f"cannot use --set {key}={text}", expected=f"a number from {low} to {high}")
    return value


def losses_of_keys(profile: DeviceProfile, keys: Mapping[str, str]) -> Iterable[Loss]:
    """Yield a loss for each of the profile's `keys` that the file sets; the values of `keys` are the reasons.

    ``source`` is only a note, because each profile has it and it describes the profile, not the device.
    """
    stated = profile.form.model_dump(exclude_defaults=True)
    for key, why in keys.items():
        if stated.get(key):
            yield Loss("the profile", f"`{key}`", why, note=key == "source")
