"""Waivers: accepted failures, each with an owner, a reason and an expiry date.

    waivers:
      - id: MB-013
        owner: A. Berg
        reason: the driver is replaced in May, ticket 4711
        expires: 2027-05-31

An ID is that of a case, or of an entry of the test-case list with all its cases; scenarios use their own IDs. Code that
processes results calls `Waivers.of`.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from fieldtwin.gateway.core.files.nearest import nearest
from fieldtwin.gateway.core.files.yaml_file import YamlFile, load, validate


class WaiverForm(BaseModel):
    """One waiver, in the form of a file of waivers."""

    model_config = ConfigDict(extra="forbid")

    id: Annotated[str, Field(min_length=1)]
    owner: Annotated[str, Field(min_length=1, pattern=r"\S")]
    """The person or team that is responsible for the failure."""
    reason: Annotated[str, Field(min_length=3)]
    expires: date


class WaiversForm(BaseModel):
    """A file of waivers."""

    model_config = ConfigDict(extra="forbid")

    waivers: list[WaiverForm]


@dataclass(frozen=True, slots=True)
class Waiver:
    """A waiver: `owner` accepts failures of `id` for `reason`, until the end of the day `expires`."""

    id: str
    owner: str
    reason: str
    expires: date

    def __str__(self) -> str:
        return f"{self.reason}; owner {self.owner}, until {self.expires}"

    def expired(self, today: date) -> bool:
        return today > self.expires


@dataclass(frozen=True, slots=True)
class Waivers:
    """The waivers of a file. `Waivers()` waives nothing."""

    entries: tuple[Waiver, ...] = ()

    def of(self, *ids: str) -> Waiver | None:
        """Return the waiver of the first of `ids` that has one."""
        for id in ids:
            for waiver in self.entries:
                if waiver.id == id:
                    return waiver
        return None


def load_waivers(path: Path, known: Collection[str]) -> Waivers:
    """Read a file. `known` are the existing IDs; an unknown ID, or one that occurs twice, raises `FileInvalid`."""
    return read_waivers(load(path), known)


def read_waivers(file: YamlFile, known: Collection[str]) -> Waivers:
    """Read waivers as `load_waivers`, from a file that is already loaded."""
    entries = validate(file, WaiversForm).waivers
    seen: set[str] = set()
    for at, entry in enumerate(entries):
        if entry.id not in known:
            near = nearest(entry.id, known)
            raise file.error(
                ("waivers", at, "id"), f"no case {entry.id!r}", expected=near[0] if near else "an id such as MB-013"
            )
        if entry.id in seen:
            raise file.error(("waivers", at, "id"), f"{entry.id!r} is waived twice")
        seen.add(entry.id)
    return Waivers(tuple(Waiver(e.id, e.owner, e.reason, e.expires) for e in entries))
