"""Convert an Asset Interfaces Description (IDTA 02017) to the terms of a Thing Description, which it follows.

Versions 1.0 and 1.1 are read. The element names of both are those of the Thing Description, with ``modv_`` for ``modv:``.
Elements are found by their idShorts, because published files state different versions in the semantic IDs.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from basyx.aas import model

from fieldtwin.descriptions.aas import terms

MAX_DEPTH = 16
"""The largest depth of nested collections that is read."""


def modbus_interfaces(objects: Iterable[Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the idShort of each Modbus interface, and the interface as the content of a Thing Description."""
    for submodel in objects:
        if isinstance(submodel, model.Submodel) and _is_description(submodel):
            for element in submodel.submodel_element:
                if isinstance(element, model.SubmodelElementCollection):
                    thing = _thing(_plain(element))
                    if str(thing["base"]).startswith("modbus"):
                        yield str(element.id_short), thing


def _is_description(submodel: model.Submodel) -> bool:
    keys = submodel.semantic_id.key if submodel.semantic_id else ()
    return any(key.value.startswith(terms.SUBMODEL_PREFIX) for key in keys) or str(submodel.id_short).startswith(
        "AssetInterfacesDescription"
    )


def _plain(element: Any, depth: int = 0) -> Any:
    """Return an element as data: a collection as a dictionary by idShort, a list as a list, a range as minimum and maximum."""
    if isinstance(element, model.SubmodelElementCollection):
        if depth >= MAX_DEPTH:
            return {}
        found = {str(each.id_short): _plain(each, depth + 1) for each in element.value}
        text = dict(element.description or {})
        if text:
            found.setdefault("description", text.get("en") or next(iter(text.values())))
        return found
    if isinstance(element, model.SubmodelElementList):
        return [_plain(each, depth + 1) for each in element.value] if depth < MAX_DEPTH else []
    if isinstance(element, model.Range):
        return {"minimum": element.min, "maximum": element.max}
    return element.value if isinstance(element, model.Property) else None


def _thing(interface: dict[str, Any]) -> dict[str, Any]:
    endpoint = _mapping(interface.get("EndpointMetadata"))
    common = {key: endpoint[key] for key in endpoint if key.startswith("modv_") or key == "contentType"}
    interaction = _mapping(interface.get("InteractionMetadata"))
    found: dict[str, Any] = {}
    for name, value in _mapping(interaction.get("properties")).items():
        schema = _mapping(value)
        found[str(schema.get("key") or name)] = _property(schema, common)
    return {
        "title": interface.get("title"),
        "base": endpoint.get("base") or "",
        "properties": found,
        "actions": _mapping(interaction.get("actions")),
        "events": _mapping(interaction.get("events")),
    }


def _property(schema: dict[str, Any], common: dict[str, Any]) -> dict[str, Any]:
    """Return a property in the terms of a Thing Description; `common` are terms that each form has unless it states them."""
    found: dict[str, Any] = {
        key: schema[key]
        for key in ("type", "unit", "title", "description", "const", "enum", "default")
        if key in schema
    }
    if found.get("type") == "float":  # the AID's word for JSON's number
        found["type"] = "number"
    limits = _mapping(schema.get("min_max"))
    found |= {key: value for key, value in limits.items() if value is not None}
    stated = schema.get("forms")
    forms = stated if isinstance(stated, list) else [stated]
    found["forms"] = [_form(common | _mapping(form)) for form in forms if form]
    return found


def _form(form: dict[str, Any]) -> dict[str, Any]:
    return {key: {"true": True, "false": False}.get(str(value).lower(), value) for key, value in form.items()}


def _mapping(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}
