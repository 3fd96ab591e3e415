"""Names of tags from names of objects, and the types that objects and tags have in common."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

from fieldtwin.gateway.devices.data_sheet import TAG_TYPES
from fieldtwin.gateway.protocols.canopen.eds.datatypes import DataType

TYPE_CODES = {tag_type: int(code) for code, tag_type in TAG_TYPES.items()}
"""The data type of CiA 301 for each type of a tag."""
MOST_LETTERS = 60


def type_name(code: int) -> str:
    """Return the name of a data type code of CiA 301, such as INTEGER24, or its number."""
    return next((kind.name for kind in DataType if kind == code), f"{code:04X}h")


def tag_names(objects: Sequence[tuple[int, int, str, str]]) -> list[str]:
    """Return a tag name for each (index, subindex, name of the object, name of the value), all different.

    A value has its own name if no other value has it, else with the name of its object, else also with index and subindex.
    """
    own = [_slug(value) for _, _, _, value in objects]
    longer = [_slug(f"{parent} {value}") if value != parent else _slug(value) for _, _, parent, value in objects]
    of_own, of_longer = Counter(own), Counter(longer)
    names, taken = [], set()
    for (index, subindex, _, _), short, long in zip(objects, own, longer, strict=True):
        name = short if short and of_own[short] == 1 else long if long and of_longer[long] == 1 else ""
        if not name or name in taken:
            name = f"{long or 'object'}_{index:04x}_{subindex:02x}"
        taken.add(name)
        names.append(name)
    return names


def _slug(text: str) -> str:
    """Return `text` as a tag name: lower case, digits and underscores, at most `MOST_LETTERS`; empty if nothing is left."""
    spaced = re.sub(r"([a-z0-9])([A-Z])", r"\1_\2", text)
    words = re.sub(r"[^a-z0-9]+", "_", spaced.lower()).strip("_")[:MOST_LETTERS].strip("_")
    return f"n{words}" if words[:1].isdigit() else words
