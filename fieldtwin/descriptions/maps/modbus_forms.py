"""Properties and forms of the W3C's Modbus binding, which Thing Descriptions and the AAS's interface descriptions share.

A property has the schema of a value, and forms that name its registers: the URI ``modbus+tcp://HOST:PORT/UNIT/ADDRESS?quantity=N``
and terms such as ``modv:entity``. Source: W3C, WoT Modbus Binding, editor's draft (vocabulary https://www.w3.org/2019/wot/modbus#).
This module writes them from tags; `fieldtwin.descriptions.maps.modbus_form_reader` reads them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from fieldtwin.descriptions.conversion import Loss
from fieldtwin.descriptions.maps.rendering import Abilities, descriptions, exported, shorten, stated_endpoint
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.profile import INTEGER_RANGES, DeviceProfile, Table, Tag

VOCABULARY = "https://www.w3.org/2019/wot/modbus#"
ENTITIES: dict[Table, str] = {
    "coil": "Coil", "discrete": "DiscreteInput", "holding": "HoldingRegister", "input": "InputRegister",
}  # fmt: skip
READ_FUNCTIONS: dict[Table, str] = {
    "coil": "readCoil", "discrete": "readDiscreteInput", "holding": "readHoldingRegisters", "input": "readInputRegisters",
}  # fmt: skip
TYPES = {
    "bool": "xsd:boolean", "int16": "xsd:short", "uint16": "xsd:unsignedShort", "int32": "xsd:int", "uint32": "xsd:unsignedInt",
    "int64": "xsd:long", "uint64": "xsd:unsignedLong", "float32": "xsd:float", "float64": "xsd:double", "string": "xsd:string",
}  # fmt: skip
BYTE_SEQUENCES = {
    "ABCD": "BIG_ENDIAN", "CDAB": "LITTLE_ENDIAN_BYTE_SWAP", "BADC": "BIG_ENDIAN_BYTE_SWAP", "DCBA": "LITTLE_ENDIAN",
}  # fmt: skip
"""The parameter ``byteSeq`` of the content type, by which Eclipse's node-wot decodes registers."""


def abilities(name: str, *, access: bool) -> Abilities:
    """Return the properties of a tag that a property of this binding holds. `access` states whether the format names it."""
    keeps = {"unit", "range", "description", "offset", *(["access"] if access else [])}
    return Abilities(name, keeps, set(TYPES), write_only=access)


def base_uri(profile: DeviceProfile, endpoint: str, losses: list[Loss]) -> str:
    """Return the URI of the device's unit, with a slash at its end.

    Without `endpoint` it has a placeholder, listed as a loss. Raises `UsageError` for an endpoint other than Modbus TCP, because
    the binding has no other.
    """
    found, _ = stated_endpoint(profile, endpoint, losses)
    if found.scheme != "tcp":
        raise UsageError(f"{endpoint} cannot be exported", expected="tcp: (the binding has Modbus TCP only)")
    return unit_uri(found, profile.form.factory.unit)


def unit_uri(endpoint: Endpoint, unit: int) -> str:
    """Return the URI of a unit ID at an endpoint of Modbus TCP, with a slash at its end."""
    return f"modbus+tcp://{endpoint.host}:{endpoint.port}/{unit}/"


def properties(
    profile: DeviceProfile, able: Abilities, base: str, losses: list[Loss]
) -> Iterator[tuple[str, Tag, dict[str, Any]]]:
    """Yield the name, the tag and the property of each tag that the format can hold, and add what it loses to `losses`.

    A schema has no scale. A tag with a scale or an offset becomes a raw value, named ``NAME_raw``, whose description states how
    to convert it.
    """
    texts = descriptions(profile)
    timeout = profile.form.timing.timeout_ms
    for tag in exported(profile, able, losses):
        remark = texts.get(tag.name.removesuffix("_raw"), {}).get("description", "")
        if (tag.scale, tag.offset) != (1, 0):
            name = f"{tag.name.removesuffix('_raw')}_raw"
            if name != tag.name and name in profile.tags:
                losses.append(
                    Loss(f"tag {tag.name}", "the tag", f"its raw value would be {name}, which is a different tag")
                )
                continue
            tag, how = _raw(tag, name, losses)
            remark = ". ".join(filter(None, (remark, how)))
        found = _schema(tag)
        if remark:
            found["description"] = remark
        yield tag.name, tag, found | {"forms": [_form(tag, base, timeout)]}


def _raw(tag: Tag, name: str, losses: list[Loss]) -> tuple[Tag, str]:
    """Return a tag of the raw value, called `name`, and the sentence that states how to convert it."""
    how = f"Raw value: multiply it by {shorten(tag.scale)}" if tag.scale != 1 else "Raw value"
    how += f", then add {shorten(tag.offset)}" if tag.offset else ""
    how += f", to get {tag.unit}" if tag.unit else ""
    place = f"tag {tag.name}"
    losses.append(Loss(place, "scale and offset", f"a schema has none; exported as {name}, with a description"))
    if tag.range is not None:
        losses.append(Loss(place, "permitted range", "the exported value is raw"))
    if tag.unit:
        losses.append(Loss(place, "unit of measurement", "the exported value is raw"))
    return replace(tag, name=name, scale=1.0, offset=0.0, unit="", range=None), how


def _schema(tag: Tag) -> dict[str, Any]:
    """Return the schema of a value, with its JSON type, unit and limits."""
    if tag.type == "bool":
        return {"type": "boolean"}
    if tag.type == "string":
        return {"type": "string"}
    schema: dict[str, Any] = {"type": "integer" if tag.type in INTEGER_RANGES else "number"}
    if tag.unit:
        schema["unit"] = tag.unit
    if tag.range is not None:
        schema["minimum"], schema["maximum"] = (shorten(limit) for limit in tag.range)
    return schema


def _form(tag: Tag, base: str, timeout_ms: int | None) -> dict[str, Any]:
    at = tag.registers
    order = _effective_order(tag)
    size = at.count if tag.type == "bool" else 2 * at.count
    content = f"application/octet-stream;length={size}"
    if tag.type != "bool":
        content += f";byteSeq={BYTE_SEQUENCES[order]}"
    if tag.type in INTEGER_RANGES:
        content += f";signed={'false' if tag.type.startswith('u') else 'true'}"
    form: dict[str, Any] = {
        "href": f"{base}{at.address}?quantity={at.count}",
        "contentType": content,
        "modv:entity": ENTITIES[at.table],
        "modv:type": TYPES[tag.type],
        "modv:zeroBasedAddressing": True,
    }
    if tag.type != "bool":
        form["modv:mostSignificantByte"] = order in ("ABCD", "CDAB")
        form["modv:mostSignificantWord"] = order in ("ABCD", "BADC")
    if timeout_ms:
        form["modv:timeout"] = timeout_ms
    return form


def _effective_order(tag: Tag) -> str:
    """Return the order of a tag. Within one register, and in a text, only the order of the two bytes counts."""
    if tag.registers.count > 1 and tag.type != "string":
        return tag.order
    return "BADC" if tag.order in ("BADC", "DCBA") else "ABCD"
