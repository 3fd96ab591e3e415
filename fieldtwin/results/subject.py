"""The subject of a check: the device's identification, the user, the time, and the command line."""

from __future__ import annotations

import getpass
import platform
from dataclasses import asdict, dataclass, field
from typing import Any

from fieldtwin.__about__ import __version__


@dataclass(frozen=True, slots=True)
class Subject:
    """The subject of a check.

    `identity` is the identification that the device reports, name to text: vendor, product, serial number...
    `started` is ISO 8601 in UTC, `took_s` the duration of the whole check. `at_most` is the highest impact level that
    was allowed, `wrote` lists the registers, coils and objects that the user gave for writing.
    """

    protocol: str
    endpoint: str
    address: int
    identity: dict[str, str] = field(default_factory=dict)
    started: str = ""
    took_s: float = 0.0
    by: str = ""
    command: str = ""
    at_most: str = "read"
    wrote: tuple[str, ...] = ()
    timeout_s: float = 0.0
    host: str = field(default_factory=platform.node)
    fieldtwin: str = __version__

    @property
    def name(self) -> str:
        """Return the name of the tested device: ``unit 1 on tcp://127.0.0.1:502``."""
        return f"{'node' if self.protocol == 'canopen' else 'unit'} {self.address} on {self.endpoint}"

    def as_json(self) -> dict[str, Any]:
        return asdict(self) | {"wrote": list(self.wrote)}


def who() -> str:
    """Return the name of the logged-in user, empty if unknown."""
    try:
        return getpass.getuser()
    except (KeyError, OSError, ImportError):
        return ""
