"""The variable of one tag, with its unit, range and names of values (OPC 10000-8)."""

from __future__ import annotations

from asyncua import ua

from fieldtwin.northbound.data_types import INTEGERS
from fieldtwin.northbound.opcua.node_writer import HAS_COMPONENT, NodeWriter
from fieldtwin.northbound.opcua.units import UNECE_URI, unit_id

Words = tuple[tuple[int, str], ...]
VALUE_AS_TEXT = "ValueAsText"


async def add_tag(
    nodes: NodeWriter, parent: ua.NodeId, identifier: str, name: str, data_type: str, *, unit: str = "",
    limits: tuple[float, float] | None = None, words: Words = (), reference: ua.NodeId = HAS_COMPONENT,
) -> bool:  # fmt: skip
    """Add the variable of a tag with this identifier and browse name below `parent`.

    `limits` are its EURange, `words` the names of its values. Return whether it has a property `ValueAsText`, which the caller
    keeps up to date.
    """
    is_enumeration = bool(words) and data_type in INTEGERS
    is_two_state = data_type == "Boolean" and {number for number, _ in words} == {0, 1}
    kind = _kind(bool(unit), limits is not None, data_type, is_enumeration=is_enumeration, is_two_state=is_two_state)
    node = nodes.id(identifier)
    await nodes.variable(parent, node, ua.QualifiedName(name, nodes.own), data_type, kind, reference)
    if is_enumeration:
        values = [ua.EnumValueType(Value=number, DisplayName=ua.LocalizedText(word)) for number, word in words]
        listed = ua.Variant(values, ua.VariantType.ExtensionObject)
        await nodes.property(node, ua.QualifiedName("EnumValues"), listed, "EnumValueType")
        await nodes.text(node, ua.QualifiedName(VALUE_AS_TEXT), "", "LocalizedText")
    elif is_two_state:
        names = dict(words)
        await nodes.text(node, ua.QualifiedName("FalseState"), names[0], "LocalizedText")
        await nodes.text(node, ua.QualifiedName("TrueState"), names[1], "LocalizedText")
    if unit:
        described = ua.EUInformation(
            NamespaceUri=UNECE_URI,
            UnitId=unit_id(unit),
            DisplayName=ua.LocalizedText(unit),
            Description=ua.LocalizedText(unit),
        )
        shown = ua.Variant(described, ua.VariantType.ExtensionObject)
        await nodes.property(node, ua.QualifiedName("EngineeringUnits"), shown, "EUInformation")
    if limits is not None:
        span = ua.Variant(ua.Range(Low=float(limits[0]), High=float(limits[1])), ua.VariantType.ExtensionObject)
        await nodes.property(node, ua.QualifiedName("EURange"), span, "Range")
    return is_enumeration


def _kind(has_unit: bool, has_range: bool, data_type: str, *, is_enumeration: bool, is_two_state: bool) -> int:
    """Return the variable type that has exactly the properties of the tag (OPC 10000-8, 5.3)."""
    if is_enumeration:
        return int(ua.ObjectIds.MultiStateValueDiscreteType)
    if is_two_state:
        return int(ua.ObjectIds.TwoStateDiscreteType)
    if data_type in ("String", "ByteString", "Boolean") or not (has_unit or has_range):
        return int(ua.ObjectIds.BaseDataVariableType)
    if has_unit and has_range:
        return int(ua.ObjectIds.AnalogUnitRangeType)
    return int(ua.ObjectIds.AnalogUnitType if has_unit else ua.ObjectIds.AnalogItemType)
