"""Build an Asset Interfaces Description from the properties of W3C's Modbus binding, as objects of the BaSyx Python SDK."""

from __future__ import annotations

import re
import uuid
from collections.abc import Iterable, Mapping
from typing import Any

from basyx.aas import model
from basyx.aas.model import datatypes

from fieldtwin.descriptions.aas import terms
from fieldtwin.descriptions.aas.interface import Interface

MAX_ID_SHORT = 128
"""The largest number of characters of an idShort (AAS Part 1, NameType)."""

_FLAGS = ("modv_zeroBasedAddressing", "modv_mostSignificantByte", "modv_mostSignificantWord")


def identifier(*parts: str) -> str:
    """Return a URN that is the same for the same parts: a UUID of version 5 (RFC 9562, 5.5)."""
    return uuid.uuid5(uuid.NAMESPACE_URL, "/".join(("fieldtwin", *parts))).urn


def reference(value: str) -> model.ExternalReference:
    """Return a reference to a definition outside of the shell."""
    return model.ExternalReference((model.Key(model.KeyTypes.GLOBAL_REFERENCE, value),))


def interfaces_submodel(id_: str, interfaces: Iterable[Interface]) -> model.Submodel:
    """Return the submodel AssetInterfacesDescription with these interfaces."""
    return model.Submodel(
        id_,
        [_interface(id_, each) for each in interfaces],
        id_short="AssetInterfacesDescription",
        semantic_id=reference(terms.SUBMODEL),
        administration=model.AdministrativeInformation(version="1", revision="1"),
    )


def collection(id_short: str, value: Iterable[model.SubmodelElement], semantic_id: str = "") -> Any:
    """Return a SubmodelElementCollection with the semantic ID of its name in `terms`, unless `semantic_id` states another."""
    return model.SubmodelElementCollection(
        id_short, value, semantic_id=reference(semantic_id or terms.OF_ELEMENT[id_short])
    )


def _interface(submodel: str, interface: Interface) -> Any:
    definitions = [_definition(n, *each) for n, each in enumerate(interface.properties.items(), 1)]
    interaction = collection("InteractionMetadata", [collection("properties", definitions)])
    interaction.supplemental_semantic_id.append(reference(terms.INTERACTION))
    return model.SubmodelElementCollection(
        interface.id_short,
        [_property("title", interface.title), _endpoint(submodel, interface), interaction],
        semantic_id=reference(terms.INTERFACE),
        supplemental_semantic_id=[reference(terms.MODBUS_INTERFACE), reference(terms.THING)],
    )


def _endpoint(submodel: str, interface: Interface) -> Any:
    path = (interface.id_short, "EndpointMetadata", "securityDefinitions", "nosec_sc")
    keys = [model.Key(model.KeyTypes.SUBMODEL, submodel)]
    keys += [model.Key(model.KeyTypes.SUBMODEL_ELEMENT_COLLECTION, name) for name in path]
    scheme = collection("nosec_sc", [_property("scheme", "nosec")], terms.NO_SECURITY)
    to_scheme = model.ReferenceElement(None, model.ModelReference(tuple(keys), model.SubmodelElementCollection))
    security = model.SubmodelElementList(
        "security", model.ReferenceElement, [to_scheme], semantic_id=reference(terms.OF_ELEMENT["security"])
    )
    return collection(
        "EndpointMetadata",
        [
            _property("base", interface.base),
            _property("contentType", "application/octet-stream"),
            security,
            collection("securityDefinitions", [scheme]),
        ],
    )


def _definition(n: int, name: str, schema: Mapping[str, Any]) -> Any:
    """Return the definition of the property `name`, the n-th of its interface."""
    [form] = schema["forms"]
    fits = re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) is not None and 2 <= len(name) <= MAX_ID_SHORT
    elements: list[Any] = [] if fits else [_property("key", name)]
    elements += [_property(key, schema[key]) for key in ("type", "unit") if key in schema]
    if "minimum" in schema:
        elements.append(_range(schema))
    elements.append(collection("forms", [_property(key.replace(":", "_"), value) for key, value in form.items()]))
    text = schema.get("description")
    return model.SubmodelElementCollection(
        name if fits else f"Property{n}",
        elements,
        description=model.MultiLanguageTextType({"en": text}) if text else None,
        semantic_id=reference(terms.PROPERTY),
        supplemental_semantic_id=[reference(terms.PROPERTY_NAME)],
    )


def _property(key: str, value: Any) -> model.Property:
    kind: Any = datatypes.Boolean if key in _FLAGS else datatypes.Integer if key == "modv_timeout" else datatypes.String
    return model.Property(key, kind, value, semantic_id=reference(terms.OF_ELEMENT[key]))


def _range(schema: Mapping[str, Any]) -> model.Range:
    whole = schema["type"] == "integer" and all(isinstance(schema[key], int) for key in ("minimum", "maximum"))
    kind: Any = datatypes.Integer if whole else datatypes.Double
    low, high = (kind(schema[key]) for key in ("minimum", "maximum"))
    return model.Range("min_max", kind, low, high, semantic_id=reference(terms.OF_ELEMENT["min_max"]))
