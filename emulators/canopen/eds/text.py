"""The INI layer of an electronic data sheet (CiA 306-1, 4.2): sections of ``key=value`` lines, each with its line number.

It tolerates common defects of real files (indentation, empty values, case, line ends, encodings, free text in sections
that describe no object). It is strict where a guess could be wrong: an object that is described twice, a key with two
values, a line of an object that is not ``key=value``. The gateway's reader tolerates the same defects (decision 0001)
but shares no code with this one. This module does not interpret the objects that the sections describe.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from fieldtwin.emulators.canopen.eds.codec import parse_number
from fieldtwin.gateway.core.errors import FileInvalid

_OBJECT = re.compile(r"[0-9a-f]{4}(sub[0-9a-f]{1,2}|name|value)?", re.IGNORECASE)
"""Names of the sections that describe objects."""

MAX_LINES = 500_000
"""The largest number of lines, which is more than any device needs (65,536 objects). It limits the time to read a file that is
not a data sheet.
"""


@dataclass(frozen=True, slots=True)
class Note:
    """A correction made while reading a file, and its line."""

    line: int
    text: str

    def __str__(self) -> str:
        return f"line {self.line}: {self.text}" if self.line else self.text


@dataclass(slots=True)
class Section:
    """One section. Keys are lower case; an empty value counts as absent."""

    name: str
    line: int
    path: str
    values: dict[str, tuple[str, int]] = field(default_factory=dict)
    notes: list[Note] = field(default_factory=list)
    """The corrections, shared by all sections of one file."""

    def text(self, key: str, default: str = "") -> str:
        """Return the value of `key`, or `default` if it is absent or empty."""
        return self.values.get(key.lower(), ("", 0))[0] or default

    def number(self, key: str, default: int | None = None) -> int:
        """Return the integer value of `key`. Raises `FileInvalid` if it is not a number, or absent without a default."""
        text, line = self.values.get(key.lower(), ("", self.line))
        if not text:
            if default is None:
                raise self.error(f"[{self.name}] has no {key}", key, expected="a number")
            if key.lower() in self.values:
                self.note(f"{key} of [{self.name}] is empty, taken as {default}", key)
            return default
        try:
            return parse_number(text)
        except ValueError:
            raise FileInvalid(
                f"{key} of [{self.name}] is not a number", path=self.path, line=line, expected="a number", got=text
            ) from None

    def count(self, key: str) -> int:
        """Return the integer value of an informative `key`; a value that cannot be read is noted and counts as 0."""
        try:
            return self.number(key, 0)
        except FileInvalid:
            self.note(f"{key} of [{self.name}] is not a number, left out", key)
            return 0

    def note(self, text: str, key: str = "") -> None:
        """Note a correction at `key` or in the whole section; a repeated note is dropped."""
        note = Note(self.values.get(key.lower(), ("", self.line))[1], text)
        if note not in self.notes:
            self.notes.append(note)

    def error(self, message: str, key: str = "", *, expected: str = "", got: str = "") -> FileInvalid:
        """Return an error that points at `key`, or at the section if the key is absent."""
        line = self.values.get(key.lower(), ("", self.line))[1]
        return FileInvalid(message, path=self.path, line=line, expected=expected, got=got)


def decode_file(raw: bytes, notes: list[Note] | None = None) -> str:
    """Return the text of a data sheet: decoded as UTF-8 or UTF-16 if valid, else as Windows-1252, which most tools write."""
    notes = [] if notes is None else notes
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        notes.append(Note(0, "the file is in UTF-16"))
        return raw.decode("utf-16", "replace")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as e:
        notes.append(Note(raw.count(b"\n", 0, e.start) + 1, "not UTF-8, taken as Windows-1252"))
        return raw.decode("cp1252", "replace")


def parse_sections(text: str, path: str = "", notes: list[Note] | None = None) -> dict[str, Section]:
    """Return sections by lower-case name, in the file's order. Raises `FileInvalid` with the line; adds to `notes`."""
    notes = [] if notes is None else notes
    sections: dict[str, Section] = {}
    current: Section | None = None
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    if len(lines) > MAX_LINES:
        raise FileInvalid("the file is too long", path=path, expected=f"at most {MAX_LINES} lines", got=str(len(lines)))
    for number, line in enumerate(lines, start=1):
        line = line.strip()
        if not line or line[0] in ";#":
            continue
        if line.startswith("["):
            name = line[1:].partition("]")[0].strip()
            if not name or "]" not in line:
                raise FileInvalid("a broken section header", path=path, line=number, expected="[name]", got=line)
            if name.lower() in sections:
                if _OBJECT.fullmatch(name):
                    raise FileInvalid(f"section [{name}] is given twice", path=path, line=number)
                notes.append(Note(number, f"[{name}] is given twice; the last one is used"))
            current = sections[name.lower()] = Section(name, number, path, notes=notes)
            continue
        key, equals, value = line.partition("=")
        if not equals and current is not None and not _OBJECT.fullmatch(current.name):
            continue  # free text, for example in a section of comments
        if not equals or current is None:
            expected = "[section]" if current is None else "key=value"
            where = f" in [{current.name}]" if current else ""
            raise FileInvalid(
                f"not a line of a data sheet{where}", path=path, line=number, expected=expected, got=line[:60]
            )
        key = key.strip().lower()
        bare = _without_comment(value).strip()
        if key in current.values:
            if current.values[key][0] != bare and _OBJECT.fullmatch(current.name):
                raise FileInvalid(f"{key} is given twice in [{current.name}]", path=path, line=number)
            notes.append(Note(number, f"{key} of [{current.name}] is given twice; the last one is used"))
        if bare != value.strip():
            notes.append(Note(number, f"a comment after the value of {key} in [{current.name}] is left out"))
        current.values[key] = (bare, number)
    return sections


def _without_comment(value: str) -> str:
    """Remove a comment after a value. Real files have them, although the standard wants comments on separate lines."""
    for mark in (" ;", "\t;"):
        value = value.partition(mark)[0]
    return value
