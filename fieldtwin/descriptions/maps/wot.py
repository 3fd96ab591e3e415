"""W3C Thing Description 1.1 with the Modbus binding (JSON): the properties of a thing are the tags.

Source: W3C Recommendation "Web of Things (WoT) Thing Description 1.1", 5 December 2023, and the Modbus binding
(`fieldtwin.descriptions.maps.modbus_forms`). An export states ``modv:zeroBasedAddressing`` and both byte-order terms, so that no
default applies, and the content type's ``byteSeq`` and ``signed``, which Eclipse's node-wot reads in their place.
"""

from __future__ import annotations

import json
from typing import Any

from fieldtwin.descriptions.conversion import Exported, Imported, Loss, Settings, Source
from fieldtwin.descriptions.maps.documents import parse_json
from fieldtwin.descriptions.maps.modbus_form_reader import import_properties
from fieldtwin.descriptions.maps.modbus_forms import VOCABULARY, abilities, base_uri, properties
from fieldtwin.gateway.core.files.profile import DeviceProfile

CONTEXT = "https://www.w3.org/2022/wot/td/v1.1"
ABILITIES = abilities("a Thing Description", access=True)


def import_description(source: Source, settings: Settings) -> Imported:
    """Return the profile of one unit of a Thing Description. Settings: ``select``, ``numbering``."""
    document = parse_json(source)
    thing = document.mapping(document.data, (), "the Thing Description")
    if "properties" not in thing:
        raise document.error((), "the file has no `properties`", expected="a Thing Description (JSON)")
    return import_properties(document, (), thing, "a W3C Thing Description", settings, states_access=True)


def export_description(profile: DeviceProfile, settings: Settings) -> Exported:
    """Return a Thing Description. Settings: ``endpoint``, of Modbus TCP.

    A tag whose write is dangerous is read-only.
    """
    losses: list[Loss] = []
    base = base_uri(profile, settings.get("endpoint", ""), losses)
    found: dict[str, Any] = {}
    for name, tag, described in properties(profile, ABILITIES, base, losses):
        writable = tag.writable and not tag.danger
        if tag.writable and not writable:
            losses.append(Loss(f"tag {tag.name}", "write access", "its write is dangerous"))
            if not tag.readable:
                continue
        form = described["forms"][0]
        form["op"] = [*(["readproperty"] if tag.readable else []), *(["writeproperty"] if writable else [])]
        if not (tag.readable and writable):
            described["readOnly" if tag.readable else "writeOnly"] = True
        found[name] = described
    thing = {
        "@context": [CONTEXT, {"modv": VOCABULARY}],
        "title": profile.name,
        "securityDefinitions": {"nosec_sc": {"scheme": "nosec"}},
        "security": "nosec_sc",
        "properties": found,
    }
    return Exported((json.dumps(thing, indent=2, ensure_ascii=False) + "\n").encode(), tuple(losses))
