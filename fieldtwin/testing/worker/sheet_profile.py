"""Write a device profile for an EDS or DCF, so that a test can name the data sheet of a CANopen node as its device."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import yaml

from fieldtwin.commissioning.access.address import tag_of_entry
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.profile import INTEGER_RANGES
from fieldtwin.gateway.protocols.canopen.eds.dictionary import DictionaryEntry, load_dictionary

SHEETS = (".eds", ".dcf")
_NUMBERS = (*INTEGER_RANGES, "float32", "float64")


def write_profile(sheet: Path, folder: Path) -> Path:
    """Write a profile with a tag for each number of the data sheet into `folder`; return its path.

    The name of a tag is the name of its object in lower case, with ``_`` for each run of other characters. If several
    objects have this name, index and subindex are appended. The node ID is the one that a DCF commissions, else 1.
    Raises `FileInvalid` for a data sheet that cannot be used.
    """
    dictionary = load_dictionary(sheet)
    numbers = [(entry, tag) for entry in dictionary if (tag := tag_of_entry(entry)).type in _NUMBERS]
    if not numbers:
        raise FileInvalid("the data sheet has no object that holds a number", path=str(sheet))
    plain = Counter(_word(entry.name) for entry, _ in numbers)
    tags = {}
    for entry, tag in numbers:
        word = _word(entry.name)
        name = word if plain[word] == 1 else f"{word}_{entry.index:04x}_{entry.subindex:02x}"
        tags[name] = {"object": _object(entry), "type": tag.type, "access": tag.access}
    profile = {
        "device": f"eds/{_word(sheet.stem).replace('_', '-')}",
        "source": sheet.name,
        "protocol": "canopen",
        "factory": {"node": dictionary.node_id or 1},
        "eds": str(sheet.resolve()),
        "tags": tags,
    }
    written = folder / f"eds-{sheet.stem}.yaml"  # not the name of a shipped profile, which brings a recording
    written.write_text(yaml.safe_dump(profile, sort_keys=False), encoding="utf-8")
    return written


def _word(name: str) -> str:
    """Return `name` as the name of a tag."""
    word = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    return word if word[:1].isalpha() else f"object_{word}".rstrip("_")


def _object(entry: DictionaryEntry) -> str:
    return f"{entry.index:04X}:{entry.subindex:02X}"
