"""Check the text of a device profile as the commands will: YAML, the schema, and the checks of the profile loader."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.gateway.core.files.profile_file import resolve
from fieldtwin.gateway.core.files.yaml_file import parse
from fieldtwin.studio.live.observed import place

MOST_TAGS = 500


@dataclass(frozen=True)
class DraftError:
    """An error of a profile. `line` and `column` count from 1; they are 0 if the error has no place."""

    line: int
    column: int
    message: str


@dataclass(frozen=True)
class DraftTag:
    """A tag of a valid profile, as the editor lists it."""

    name: str
    at: str
    type: str
    unit: str


@dataclass(frozen=True)
class CheckedDraft:
    """The errors of a profile, in the order of lines; without errors its device, tags and factory address."""

    errors: list[DraftError]
    device: str = ""
    tags: tuple[DraftTag, ...] = ()
    tags_left_out: int = 0


def check_draft(text: str, folder: Path, name: str) -> CheckedDraft:
    """Return the errors of a profile. The result of a profile without errors describes its device. References to other files
    are relative to `folder`."""
    try:
        profile = resolve(parse(text, str(folder / name)))
    except FileInvalid as e:
        errors = [DraftError(found.line, found.column, _words(found)) for found in (e, *e.others)]
        return CheckedDraft(sorted(errors, key=lambda error: (error.line, error.column)))
    tags = tuple(_tag(tag) for tag in profile.tags.values())
    return CheckedDraft([], profile.name, tags[:MOST_TAGS], max(0, len(tags) - MOST_TAGS))


def _words(error: FileInvalid) -> str:
    return str(error).removeprefix(f"{error.where}: ")


def _tag(tag: Tag) -> DraftTag:
    return DraftTag(tag.name, place(tag), tag.type, tag.unit)
