"""Collect the tags that a reader finds in a file of a different program, and build the form of a profile from them.

Addresses are those that are sent, from 0. Names become names of tags; the original name is kept as the tag's description.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from fieldtwin.descriptions.conversion import Imported, Loss, Settings
from fieldtwin.descriptions.maps.documents import Document, Loc
from fieldtwin.descriptions.profile_text import printable
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.files.profile import BIT_TABLES, REGISTERS_OF, Table
from fieldtwin.gateway.core.files.profile_schema import Factory, ProfileForm, TagForm

MAX_TAGS = 10_000
"""The largest number of tags that one file may describe."""

TABLE_OF_FUNCTION: dict[int, Table] = {
    1: "coil", 5: "coil", 15: "coil", 2: "discrete", 3: "holding", 6: "holding", 16: "holding", 4: "input",
}  # fmt: skip
"""The table that each Modbus function reads or writes (AP 6)."""


class Draft:
    """The profile of one device, while its tags are found."""

    def __init__(self, document: Document, name: str, format_name: str, settings: Settings) -> None:
        """Begin a profile with the name that the setting ``device`` states, otherwise with a name made from `name`.

        Raises `UsageError` if the setting is not MAKER/TYPE.
        """
        self.losses: list[Loss] = []
        self._document = document
        self._device = settings.get("device") or f"imported/{slug(name).replace('_', '-') or 'device'}"
        if not re.fullmatch(r"[a-z0-9-]+/[a-z0-9.-]+", self._device):
            raise UsageError(
                "cannot use --set device", expected="MAKER/TYPE in lower case, such as acme/t-1000", got=self._device
            )
        self._format = format_name
        self._tags: dict[str, TagForm] = {}
        self._factory: dict[str, Any] = {}

    def factory(self, **settings: int | str) -> None:
        """Set the unit ID, and the baud rate and frame of a serial line."""
        self._factory.update(settings)

    def serial(
        self,
        loc: Loc,
        stated: Mapping[str, Any],
        keys: Sequence[str] = ("baudrate", "bytesize", "parity", "stopbits"),
        usual_rate: int = 9600,
    ) -> None:
        """Set baud rate and frame of a serial line, which `stated` has under these `keys`. The usual frame is 8N1."""
        document = self._document
        baudrate, data, parity, stop = keys
        rate = document.integer(stated.get(baudrate, usual_rate), (*loc, baudrate), f"`{baudrate}`", 1, 10_000_000)
        bits = document.integer(stated.get(data, 8), (*loc, data), f"`{data}`", 7, 8)
        stops = document.integer(stated.get(stop, 1), (*loc, stop), f"`{stop}`", 1, 2)
        letter = document.choice(str(stated.get(parity) or "N")[:1].upper(), (*loc, parity), f"`{parity}`", "NEO")
        self.factory(baudrate=rate, frame=f"{bits}{letter}{stops}")

    def lose(self, place: str, what: str, why: str) -> None:
        """Add a loss, unless the same loss of the same place is listed already."""
        self._list(Loss(place, what, why))

    def note(self, place: str, what: str, why: str) -> None:
        """Add a loss that is only a note (`Loss.note`), unless the same one is listed already."""
        self._list(Loss(place, what, why, note=True))

    def _list(self, loss: Loss) -> None:
        if loss not in self.losses:
            self.losses.append(loss)

    def add(self, loc: Loc, name: str, table: Table, address: int, **fields: Any) -> str:
        """Add a tag and return its name. `fields` are keys of `TagForm`; those that are None are left out.

        A tag that reads and writes the same value as a tag of the same name is joined with it. Raises `FileInvalid` for a value
        that exceeds its table, and if there are more than `MAX_TAGS` tags.
        """
        kind = "bool" if table in BIT_TABLES else fields.get("type") or "uint16"
        count = fields.get("registers") or REGISTERS_OF.get(kind, 1)
        if address + count > 65536:
            raise self._document.error(
                loc, f"{name!r} exceeds the table", expected="registers from 0 to 65535", got=f"{address} x {count}"
            )
        fields["type"] = None if kind == "uint16" else kind
        kept = {key: value for key, value in fields.items() if value is not None}
        form = TagForm(at=f"{table}:{address}", **kept)
        key = slug(name) or f"{table}_{address}"
        if key != name and "description" not in kept:
            form = form.model_copy(update={"description": printable(name)})
        if (present := self._tags.get(key)) is not None:
            if _same_value(present, form):
                self._tags[key] = _joined(present, form)
                return key
            key = next(f"{key}_{i}" for i in range(2, MAX_TAGS + 2) if f"{key}_{i}" not in self._tags)
        if len(self._tags) >= MAX_TAGS:
            raise self._document.error(loc, "the file describes too many tags", expected=f"at most {MAX_TAGS}")
        self._tags[key] = form
        return key

    def imported(self) -> Imported:
        """Return the profile and the losses. Raises `FileInvalid` if no tag was found."""
        if not self._tags:
            why = next((loss for loss in self.losses if not loss.note), None)
            raise FileInvalid(
                "the file describes no register that a profile can hold",
                path=self._document.path,
                hint=f"{why.place}: {why.what}: {why.why}" if why else "",
            )
        form = ProfileForm(
            device=self._device,
            source=f"imported from {self._format}",
            protocol="modbus",
            factory=Factory(**self._factory),
            numbering="sent",
            tags=self._tags,
        )
        return Imported(form, tuple(self.losses))


def _same_value(a: TagForm, b: TagForm) -> bool:
    return all(getattr(a, key) == getattr(b, key) for key in ("at", "type", "order", "bits", "registers"))


def _joined(a: TagForm, b: TagForm) -> TagForm:
    """Return a tag with the access of both. The scale and the description of the tag that can be read remain."""
    first, second = (b, a) if a.access == "wo" else (a, b)
    access = first.access if first.access == second.access else "rw"
    return first.model_copy(update={"access": access})


def slug(name: str) -> str:
    """Return a name of a tag made from `name`: lower case, digits and underscores, with a letter first; or an empty text."""
    if re.fullmatch(r"[a-z][a-z0-9_]*", name):
        return name
    spaced = re.sub(r"(?<=[a-z0-9]{2})(?=[A-Z])", "_", name)  # tankLevel; but not kWh
    plain = re.sub(r"[^a-z0-9]+", "_", spaced.lower()).strip("_")
    return f"t_{plain}" if plain[:1].isdigit() else plain


def choose(found: Sequence[tuple[str, int]], wanted: str, path: str) -> int:
    """Return the index of the device that the user wants. `found` holds the name and the unit ID of each device.

    `wanted` is a name, a unit ID or ``NAME/UNIT``. Raises `UsageError` if the file has several devices and `wanted` is empty or
    does not select exactly one of them, and `FileInvalid` if the file has no device.
    """
    if not found:
        raise FileInvalid("the file describes no Modbus device", path=path)
    labels = [f"{name}/{unit}" for name, unit in found]
    if not wanted and len(found) == 1:
        return 0
    hits = [i for i, (name, unit) in enumerate(found) if wanted in (name, str(unit), labels[i])]
    if len(hits) == 1:
        return hits[0]
    many = f"the file describes {len(found)} devices" if not wanted else f"no single device is {wanted!r}"
    raise UsageError(
        f"{path}: {many}",
        expected="one of " + ", ".join(labels[:40]) + (" and more" if len(labels) > 40 else ""),
        hint=did_you_mean(wanted, labels) or "select it with --set select=NAME, UNIT or NAME/UNIT",
    )
