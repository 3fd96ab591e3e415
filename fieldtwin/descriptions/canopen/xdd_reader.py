"""Read an XDD or XDC (CiA 311) as a `NodeDescription`.

An object states its properties itself, or names a parameter of the device profile that does (`uniqueIDRef`). The statements of
the object have precedence. Real files use both, in namespaces 1.0 and 1.1 and without one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from fieldtwin.descriptions.canopen.node import ARRAY, DOMAIN, RECORD, VAR, NodeDescription, NodeObject, NodeValue
from fieldtwin.descriptions.conversion import Loss
from fieldtwin.descriptions.xml_tree import Element, read_xml
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.protocols.canopen.eds.datatypes import DataType
from fieldtwin.gateway.protocols.canopen.eds.values import read_limit, read_value

MAX_VALUES = 100_000
"""The most values of a description; the object dictionary of a real node has some thousand."""
_ANY_NODE = 1
_TYPES = {
    "BOOL": DataType.BOOLEAN,
    "SINT": DataType.INTEGER8,
    "INT": DataType.INTEGER16,
    "DINT": DataType.INTEGER32,
    "LINT": DataType.INTEGER64,
    "CHAR": DataType.UNSIGNED8,
    "BYTE": DataType.UNSIGNED8,
    "USINT": DataType.UNSIGNED8,
    "WORD": DataType.UNSIGNED16,
    "UINT": DataType.UNSIGNED16,
    "DWORD": DataType.UNSIGNED32,
    "UDINT": DataType.UNSIGNED32,
    "LWORD": DataType.UNSIGNED64,
    "ULINT": DataType.UNSIGNED64,
    "REAL": DataType.REAL32,
    "LREAL": DataType.REAL64,
    "STRING": DataType.VISIBLE_STRING,
    "WSTRING": DataType.UNICODE_STRING,
    "BITSTRING": DataType.OCTET_STRING,
}
"""The data types of parameters (CiA 311, 7.3; names of IEC 61131-3)."""
_ACCESS = {
    "const": "const",
    "read": "ro",
    "write": "wo",
    "readWrite": "rw",
    "readWriteInput": "rwr",
    "readWriteOutput": "rww",
}
_NOT_READ = {
    "dataTypeList": "the composed data types",
    "functionTypeList": "the function types",
    "functionInstanceList": "the functions",
    "templateList": "the templates",
    "parameterGroupList": "the groups of parameters",
    "indicatorList": "the indicators",
}
_NO_PARAMETER = Element("parameter", {}, 0)
_TRUE = ("true", "1")


@dataclass(slots=True)
class _Reading:
    """The parameters of a file, and the repairs so far, while its objects are read."""

    path: str
    parameters: Mapping[str, Element]
    repairs: list[str]

    def repaired(self, element: Element, text: str) -> None:
        self.repairs.append(f"line {element.line}: {text}")


def read_xdd(data: bytes, path: Path) -> tuple[NodeDescription, tuple[str, ...], tuple[Loss, ...]]:
    """Return the description in an XDD or XDC, the repairs that it needed, and the parts of the file that were not read.

    Raises `FileInvalid` with line and column.
    """
    root = read_xml(data, str(path))
    listed = root.first("CANopenObjectList")
    if listed is None:
        raise FileInvalid(
            "no CANopen objects in this file",
            path=str(path),
            line=root.line,
            expected="<CANopenObjectList> of an XDD or XDC",
        )
    parameters = {each.get("uniqueID"): each for each in root.all("parameter") if each.get("uniqueID")}
    reading = _Reading(str(path), parameters, [])
    objects: dict[int, NodeObject] = {}
    for element in listed.children:
        if element.name != "CANopenObject":
            continue
        found = _object(element, reading)
        if found is not None and found.index in objects:
            raise FileInvalid(f"the object {found.index:04X}h occurs twice", path=str(path), line=element.line)
        if found is not None:
            objects[found.index] = found
    if not objects:
        raise FileInvalid(
            "no CANopen objects in this file", path=str(path), line=listed.line, expected="<CANopenObject>"
        )
    if sum(len(each.values) for each in objects.values()) > MAX_VALUES:
        raise FileInvalid("too many objects", path=str(path), line=listed.line, expected=f"at most {MAX_VALUES} values")
    commissioning = root.first("deviceCommissioning") or _NO_PARAMETER
    described = NodeDescription(
        tuple(objects[index] for index in sorted(objects)),
        _device(root, objects),
        _in_range(commissioning.get("nodeID"), 1, 127),
        _in_range(commissioning.get("actualBaudRate").split(" ")[0], 10, 1000),
        commissioning.get("nodeName"),
    )
    return described, tuple(reading.repairs), tuple(_parts_lost(root))


def _parts_lost(root: Element) -> Iterator[Loss]:
    for key, what in _NOT_READ.items():
        part = root.first(key)
        if part is not None and part.children:
            yield Loss(f"line {part.line}", what, "an object dictionary has no place for them")


def _object(element: Element, reading: _Reading) -> NodeObject | None:
    """Return an object; None for the definition of a data type, and for an object without a usable value."""
    index = _hex(element, "index", 0xFFFF, reading)
    parameter = reading.parameters.get(element.get("uniqueIDRef"), _NO_PARAMETER)
    name = element.get("name") or _label(parameter) or f"{index:04X}h"
    code = _code(element, reading)
    if index < 0x1000 or code not in (VAR, ARRAY, RECORD, DOMAIN):
        return None
    if code in (VAR, DOMAIN):
        single = _value(element, index, 0, name, reading)
        return NodeObject(index, name, code, (single,)) if single is not None else None
    values: dict[int, NodeValue] = {}
    for sub in element.children:
        if sub.name != "CANopenSubObject":
            continue
        subindex = _hex(sub, "subIndex", 0xFF, reading)
        own = reading.parameters.get(sub.get("uniqueIDRef"), _NO_PARAMETER)
        value = _value(sub, index, subindex, sub.get("name") or _label(own) or f"{name} {subindex}", reading)
        if subindex in values:
            raise FileInvalid(f"{index:04X}h:{subindex:02X} occurs twice", path=reading.path, line=sub.line)
        if value is not None:
            values[subindex] = value
    if not values:
        reading.repaired(element, f"{index:04X}h has no sub-objects: left out")
        return None
    return NodeObject(index, name, code, tuple(values[subindex] for subindex in sorted(values)))


def _code(element: Element, reading: _Reading) -> int:
    text = element.get("objectType") or "7"
    try:
        return int(text, 0)
    except ValueError:
        raise FileInvalid(
            "objectType cannot be read", path=reading.path, line=element.line, expected="2, 7, 8 or 9", got=repr(text)
        ) from None


def _hex(element: Element, key: str, most: int, reading: _Reading) -> int:
    """Return a required attribute of hexadecimal digits."""
    text = element.get(key)
    try:
        value = int(text.lower().removeprefix("0x"), 16)
    except ValueError:
        value = -1
    if not 0 <= value <= most:
        raise FileInvalid(
            f"{key} of <{element.name}>",
            path=reading.path,
            line=element.line,
            expected="hexadecimal digits",
            got=repr(text),
        )
    return value


def _value(element: Element, index: int, subindex: int, name: str, reading: _Reading) -> NodeValue | None:
    """Return the value that an object or sub-object describes; None if it has no known data type."""
    parameter = reading.parameters.get(element.get("uniqueIDRef"), _NO_PARAMETER)
    kind = _data_type(element, parameter, reading)
    if kind is None:
        reading.repaired(element, f"{index:04X}h:{subindex:02X} has no basic data type: left out")
        return None
    limits = parameter.first("range") or _NO_PARAMETER
    unit = parameter.child("unit") or _NO_PARAMETER

    def stated(key: str, otherwise: str) -> str:
        return _checked(kind, element.get(key) or otherwise, f"{key} of {index:04X}h:{subindex:02X}", element, reading)

    low = stated("lowLimit", _attribute(limits, "minValue"))
    high = stated("highLimit", _attribute(limits, "maxValue"))
    if not _ordered(kind, low, high):
        reading.repaired(element, f"the limits of {index:04X}h:{subindex:02X} are not in order: both left out")
        low = high = ""
    return NodeValue(
        index,
        subindex,
        name,
        kind,
        _access(element, parameter, reading),
        default=stated("defaultValue", _attribute(parameter, "defaultValue")),
        low=low,
        high=high,
        mappable=element.get("PDOmapping").lower() not in ("", "no"),
        configured=stated("actualValue", _attribute(parameter, "actualValue")),
        unit=_label(unit),
        factor=_scaling(parameter, unit, "multiplier", "1"),
        remark=(parameter.child("description") or _NO_PARAMETER).text.strip(),
        offset=_scaling(parameter, unit, "offset", "0"),
        names=_names(parameter),
    )


def _data_type(element: Element, parameter: Element, reading: _Reading) -> int | None:
    """Return the type code; 0Fh for an object of code DOMAIN, None for a type that is not a basic data type."""
    if _code(element, reading) == DOMAIN:
        return int(DataType.DOMAIN)
    if element.get("dataType"):
        code = _hex(element, "dataType", 0xFFFF, reading)
        return code if code in set(DataType) else None
    return next((int(_TYPES[each.name]) for each in parameter.children if each.name in _TYPES), None)


def _access(element: Element, parameter: Element, reading: _Reading) -> str:
    text = element.get("accessType").lower()
    if text in _ACCESS.values():
        return text
    if text:
        reading.repaired(element, f"accessType {text[:20]!r} is unknown: read as rw")
        return "rw"
    if not parameter.get("access"):
        return "rw" if parameter is _NO_PARAMETER else "ro"  # CiA 311: a parameter without `access` is read-only
    return _ACCESS.get(parameter.get("access"), "ro")


def _checked(kind: int, text: str, what: str, element: Element, reading: _Reading) -> str:
    """Return the text of a value or limit; empty, with a repair, if it is not one of its type."""
    try:
        read_value(kind, text, _ANY_NODE)
    except (ValueError, OverflowError):
        if text:
            reading.repaired(element, f"{what}: {text[:40]!r} is not a value of its type: left out")
        return ""
    return text


def _ordered(kind: int, low: str, high: str) -> bool:
    try:
        first, last = read_limit(kind, low), read_limit(kind, high)
    except (ValueError, OverflowError):
        return False
    return first is None or last is None or first <= last


def _attribute(parent: Element, name: str) -> str:
    return (parent.child(name) or _NO_PARAMETER).get("value")


def _label(element: Element) -> str:
    """Return the English label of a parameter or unit, else its first label."""
    labels = [each for each in element.children if each.name == "label"]
    english = [each for each in labels if each.get("lang").startswith("en")]
    return " ".join((english or labels or [_NO_PARAMETER])[0].text.split())


def _scaling(parameter: Element, unit: Element, key: str, neutral: str) -> str:
    """Return `multiplier` or `offset`, of the parameter or of its unit; empty if it is neutral."""
    text = parameter.get(key) or unit.get(key)
    return "" if text in ("", neutral, f"{neutral}.0") else text


def _names(parameter: Element) -> tuple[tuple[int, str], ...]:
    """Return the labels of the allowed values of a parameter."""
    allowed = parameter.child("allowedValues") or _NO_PARAMETER
    found = {}
    for each in allowed.children:
        number = _in_range(each.get("value"), -(1 << 63), (1 << 64) - 1)
        if each.name == "value" and number is not None and _label(each):
            found[number] = _label(each)
    return tuple(found.items())


def _in_range(text: str, low: int, high: int) -> int | None:
    try:
        value = int(text, 0)
    except ValueError:
        return None
    return value if low <= value <= high else None


def _device(root: Element, objects: Mapping[int, NodeObject]) -> dict[str, str]:
    """Return what the file states of the device, as keys of [DeviceInfo] of an EDS."""
    general, master = root.first("CANopenGeneralFeatures"), root.first("CANopenMasterFeatures")
    stated = {
        "VendorName": root.text_of("vendorName"),
        "ProductName": root.text_of("productName"),
        "OrderCode": root.text_of("orderNumber"),
        "VendorNumber": _number(root.text_of("vendorID")),
        "ProductNumber": _number(root.text_of("productID")),
        "RevisionNumber": _revision(objects),
    }
    for key, attribute in FEATURES.items():
        text = (general or _NO_PARAMETER).get(attribute)
        stated[key] = "1" if text in _TRUE else _number(text)
    stated["SimpleBootUpMaster"] = "1" if (master or _NO_PARAMETER).get("bootUpMaster") in _TRUE else "0"
    for each in root.all("supportedBaudRate"):
        kbit, _, unit = each.get("value").partition(" ")
        if unit == "Kbps" and kbit.isdecimal():
            stated[f"BaudRate_{kbit}"] = "1"
    return {key: text for key, text in stated.items() if text}


FEATURES = {
    "SimpleBootUpSlave": "bootUpSlave",
    "Granularity": "granularity",
    "DynamicChannelsSupported": "dynamicChannels",
    "GroupMessaging": "groupMessaging",
    "LSS_Supported": "layerSettingServiceSlave",
}
"""Keys of [DeviceInfo], and the attributes of <CANopenGeneralFeatures> with the same meaning."""


def _number(text: str) -> str:
    """Return a number as text; a hexadecimal one may lack its 0x. Empty if the text is not a number."""
    for base in (0, 16):
        try:
            value = int(text, base)
        except ValueError:
            continue
        return str(value) if 0 <= value <= 0xFFFFFFFF else ""
    return ""


def _revision(objects: Mapping[int, NodeObject]) -> str:
    values = objects[0x1018].values if 0x1018 in objects else ()
    return next((_number(v.default) for v in values if v.subindex == 3), "")
