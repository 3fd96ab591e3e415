"""The choices for a new site: devices, control, CI and Compose. This module parses the text of options and answers.

This module opens no file and no connection.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from fieldtwin.gateway.core.errors import UsageError

EXAMPLE = "example"
"""The profile name that stands for the example tank of `fieldtwin new`."""
MOST_DEVICES = 64
"""Largest number of devices of a new site."""
LONGEST_NAME = 40
"""Largest number of characters of a system's or a device's name."""
_DEVICE = re.compile(r"(?:(?P<name>\w+)=)?(?P<profile>[^@#]+)(?:@(?P<endpoint>[^#]+))?(?:#(?P<address>\d+))?")
_NAME = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")


class Control(StrEnum):
    """The kind of program that the user wants to control the devices."""

    NONE = "none"
    PYTHON = "python"
    ST = "st"
    OWN = "own"


class Ci(StrEnum):
    """The service that tests the site after each change."""

    GITHUB = "github"
    GITLAB = "gitlab"
    NONE = "none"


@dataclass(frozen=True, slots=True)
class DeviceWish:
    """A device as the user names it.

    `profile` is the name of a shipped profile or the path of a file. `profile_text` is the text of a draft without a file.
    `name`, `endpoint` and `address` (unit ID or node ID) are empty or None if `fieldtwin new` has to choose them.
    """

    profile: str
    name: str = ""
    endpoint: str = ""
    address: int | None = None
    profile_text: str = ""


@dataclass(frozen=True, slots=True)
class Wishes:
    """All choices for a new site. `title` is the folder's name, `system` the name of the system."""

    title: str
    system: str
    devices: tuple[DeviceWish, ...]
    control: Control
    ci: Ci
    compose: bool


def parse_device(text: str) -> DeviceWish:
    """Read ``[NAME=]PROFILE[@ENDPOINT][#ADDRESS]``. Raises `UsageError`."""
    match = _DEVICE.fullmatch(text.strip())
    if match is None:
        raise UsageError(
            f"cannot read the device {text!r}",
            expected="[NAME=]PROFILE[@ENDPOINT][#ADDRESS], such as meter=eastron-sdm630@rtu:/dev/ttyUSB0#5",
        )
    name = match["name"] or ""
    if name:
        check_name(name, "the device's name")
    address = int(match["address"]) if match["address"] else None
    return DeviceWish(match["profile"].strip(), name, match["endpoint"] or "", address)


def check_name(name: str, what: str) -> str:
    """Return `name` if it can be a name in the system file and in a program. Raises `UsageError`."""
    if not _NAME.fullmatch(name) or len(name) > LONGEST_NAME:
        raise UsageError(
            f"{what} cannot be used in programs",
            expected=f"lower case letters, digits and single underscores, a letter first, at most {LONGEST_NAME} characters",
            got=repr(name),
            hint=f"{name_from(name, 'device')!r} is possible",
        )
    return name


def name_from(text: str, default: str) -> str:
    """Return a name made of the letters and digits of `text`: ``My Plant (north)`` becomes ``my_plant_north``."""
    name = re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")
    if not name:
        return default
    return name[:LONGEST_NAME].strip("_") if name[0].isalpha() else f"{default}_{name}"[:LONGEST_NAME].strip("_")


def title_of(folder: Path) -> str:
    """Return the name of the folder for headings, without control characters."""
    return "".join(c for c in folder.absolute().name if c.isprintable()) or "site"
