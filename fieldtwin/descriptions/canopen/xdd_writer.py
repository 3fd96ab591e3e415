"""Write a `NodeDescription` as an XDD or XDC (CiA 311, namespace 1.0).

Each object states its properties. An object with a unit, a scale, names of values or a description also has a parameter in the
device profile, where alone CiA 311 has a place for them.
"""

from __future__ import annotations

from datetime import UTC, datetime
from xml.etree import ElementTree as ET

from fieldtwin.descriptions.canopen.eds_writer import MANDATORY, MANUFACTURER
from fieldtwin.descriptions.canopen.node import NodeDescription, NodeObject, NodeValue
from fieldtwin.descriptions.canopen.xdd_reader import FEATURES
from fieldtwin.gateway.protocols.canopen.eds.datatypes import DataType
from fieldtwin.gateway.protocols.canopen.eds.text import BIT_RATES_KBIT

NAMESPACE = "http://www.canopen.org/xml/1.0"
_SCHEMA_INSTANCE = "http://www.w3.org/2001/XMLSchema-instance"
_ACCESS = {
    "const": "const",
    "ro": "read",
    "wo": "write",
    "rw": "readWrite",
    "rwr": "readWriteInput",
    "rww": "readWriteOutput",
}
_TYPES = {
    DataType.BOOLEAN: "BOOL",
    DataType.INTEGER8: "SINT",
    DataType.INTEGER16: "INT",
    DataType.INTEGER32: "DINT",
    DataType.INTEGER64: "LINT",
    DataType.UNSIGNED8: "USINT",
    DataType.UNSIGNED16: "UINT",
    DataType.UNSIGNED32: "UDINT",
    DataType.UNSIGNED64: "ULINT",
    DataType.REAL32: "REAL",
    DataType.REAL64: "LREAL",
    DataType.VISIBLE_STRING: "STRING",
    DataType.UNICODE_STRING: "WSTRING",
    DataType.OCTET_STRING: "BITSTRING",
}


def write_xdd(node: NodeDescription, name: str, written_ns: int, *, xdc: bool = False) -> bytes:
    """Return the text of an XDD, or of an XDC with the values and the node ID that are configured, in UTF-8.

    `name` is the name of the file, and `written_ns` its time in ns since 1970 (UTC).
    """
    root = ET.Element(
        "ISO15745ProfileContainer",
        {
            "xmlns": NAMESPACE,
            "xmlns:xsi": _SCHEMA_INSTANCE,
            "xsi:schemaLocation": f"{NAMESPACE} CANopen.xsd",
        },
    )
    _device_profile(_body(root, "Device", name, written_ns), node)
    _network_profile(_body(root, "CommunicationNetwork", name, written_ns), node, xdc=xdc)
    ET.indent(root)
    text = ET.tostring(root, encoding="unicode")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n'.encode()


def _body(root: ET.Element, kind: str, name: str, written_ns: int) -> ET.Element:
    """Add a profile with its header, and return its body."""
    profile = ET.SubElement(root, "ISO15745Profile")
    header = ET.SubElement(profile, "ProfileHeader")
    _texts(
        header,
        {
            "ProfileIdentification": f"CANopen {'device' if kind == 'Device' else 'communication network'} profile",
            "ProfileRevision": "1",
            "ProfileName": "",
            "ProfileSource": "",
            "ProfileClassID": kind,
        },
    )
    _texts(
        ET.SubElement(header, "ISO15745Reference"),
        {"ISO15745Part": "1", "ISO15745Edition": "1", "ProfileTechnology": "CANopen"},
    )
    written = datetime.fromtimestamp(written_ns // 1_000_000_000, UTC)
    return ET.SubElement(
        profile,
        "ProfileBody",
        {
            "xsi:type": f"ProfileBody_{kind}_CANopen",
            "formatName": "CANopen",
            "formatVersion": "1.0",
            "fileName": printable_xml(name),
            "fileCreator": "fieldtwin",
            "fileCreationDate": f"{written:%Y-%m-%d}",
            "fileCreationTime": f"{written:%H:%M:%SZ}",
            "fileVersion": "1",
            "supportedLanguages": "en",
        },
    )


def _device_profile(body: ET.Element, node: NodeDescription) -> None:
    device = node.device
    _texts(
        ET.SubElement(body, "DeviceIdentity"),
        {
            "vendorName": device.get("VendorName", ""),
            "vendorID": f"0x{int(device.get('VendorNumber', '0'), 0):08X}",
            "productName": device.get("ProductName", ""),
            "productID": f"0x{int(device.get('ProductNumber', '0'), 0):08X}",
            **({"orderNumber": device["OrderCode"]} if device.get("OrderCode") else {}),
        },
    )
    ET.SubElement(body, "DeviceManager")
    _capabilities(ET.SubElement(body, "DeviceFunction"), device.get("ProductName", ""))
    described = [value for value in node.values() if _has_parameter(value)]
    if described:
        listed = ET.SubElement(ET.SubElement(body, "ApplicationProcess"), "parameterList")
        for value in described:
            _parameter(listed, value)


def _capabilities(function: ET.Element, product: str) -> None:
    """Add the one characteristic that the schema of CiA 311 1.1 requires (A.1.3): the name of the product."""
    listed = ET.SubElement(ET.SubElement(function, "capabilities"), "characteristicsList")
    characteristic = ET.SubElement(listed, "characteristic")
    _label(ET.SubElement(characteristic, "characteristicName"), "Product name")
    _label(ET.SubElement(characteristic, "characteristicContent"), product)


def _has_parameter(value: NodeValue) -> bool:
    stated = value.unit or value.factor or value.offset or value.names or value.remark
    return bool(stated) and value.type_code in _TYPES


def _parameter(listed: ET.Element, value: NodeValue) -> None:
    """Add the parameter of a value: engineering value = raw value x multiplier + offset.

    The order of its elements is that of the schema (CiA 311 1.1, A.1.3).
    """
    attributes = {"uniqueID": _unique_id(value), "access": _ACCESS[value.access]}
    attributes |= {"multiplier": value.factor} if value.factor else {}
    attributes |= {"offset": value.offset} if value.offset else {}
    parameter = ET.SubElement(listed, "parameter", attributes)
    _label(parameter, value.name)
    if value.remark:
        ET.SubElement(parameter, "description", {"lang": "en"}).text = printable_xml(value.remark)
    ET.SubElement(parameter, _TYPES[DataType(value.type_code)])
    if value.default:
        ET.SubElement(parameter, "defaultValue", {"value": printable_xml(value.default)})
    if value.names:
        allowed = ET.SubElement(parameter, "allowedValues")
        for number, name in value.names:
            _label(ET.SubElement(allowed, "value", {"value": str(number)}), name)
    if value.unit:
        _label(ET.SubElement(parameter, "unit", {"multiplier": "1"}), value.unit)


def _label(parent: ET.Element, text: str) -> None:
    ET.SubElement(parent, "label", {"lang": "en"}).text = printable_xml(text)


def _unique_id(value: NodeValue) -> str:
    return f"UID_PARAM_{value.index:04X}{value.subindex:02X}"


def _network_profile(body: ET.Element, node: NodeDescription, *, xdc: bool) -> None:
    indexes = [each.index for each in node.objects]
    mandatory, manufacturer = sum(i in MANDATORY for i in indexes), sum(i in MANUFACTURER for i in indexes)
    counts = {
        "mandatoryObjects": str(mandatory),
        "optionalObjects": str(len(indexes) - mandatory - manufacturer),
        "manufacturerObjects": str(manufacturer),
    }
    layers = ET.SubElement(body, "ApplicationLayers")
    listed = ET.SubElement(layers, "CANopenObjectList", counts)
    for each in node.objects:
        _object(listed, each, xdc=xdc)
    dummies = ET.SubElement(layers, "dummyUsage")
    for code in range(1, 8):
        ET.SubElement(dummies, "dummy", {"entry": f"Dummy{code:04X}=0"})
    rates = [kbit for kbit in BIT_RATES_KBIT if node.device.get(f"BaudRate_{kbit}", "0") not in ("0", "")]
    if rates:
        physical = ET.SubElement(ET.SubElement(body, "TransportLayers"), "PhysicalLayer")
        rate = ET.SubElement(physical, "baudRate", {"defaultValue": f"{250 if 250 in rates else rates[0]} Kbps"})
        for kbit in rates:
            ET.SubElement(rate, "supportedBaudRate", {"value": f"{kbit} Kbps"})
    management = ET.SubElement(body, "NetworkManagement")
    ET.SubElement(management, "CANopenGeneralFeatures", _features(node))
    master = node.device.get("SimpleBootUpMaster", "0") not in ("0", "")
    ET.SubElement(management, "CANopenMasterFeatures", {"bootUpMaster": _truth(master)})
    if xdc:
        actual = "" if node.bitrate_kbit is None else f"{node.bitrate_kbit} Kbps"  # the attribute is required
        commissioning = {"nodeID": str(node.node_id or 1), "nodeName": printable_xml(node.node_name)}
        commissioning |= {"actualBaudRate": actual, "networkNumber": "1", "networkName": "", "CANopenManager": "false"}
        ET.SubElement(management, "deviceCommissioning", commissioning)


def _features(node: NodeDescription) -> dict[str, str]:
    numbers = ("granularity", "dynamicChannels")
    features = {}
    for key, attribute in FEATURES.items():
        text = node.device.get(key, "0") or "0"
        features[attribute] = text if attribute in numbers else _truth(text != "0")
    indexes = [each.index for each in node.objects]
    features["nrOfRxPDO"] = str(sum(i in range(0x1400, 0x1600) for i in indexes))
    features["nrOfTxPDO"] = str(sum(i in range(0x1800, 0x1A00) for i in indexes))
    return features


def _truth(value: bool) -> str:
    return "true" if value else "false"


def _object(listed: ET.Element, each: NodeObject, *, xdc: bool) -> None:
    attributes = {"index": f"{each.index:04X}", "name": printable_xml(each.name), "objectType": str(each.code)}
    if each.is_single:
        ET.SubElement(listed, "CANopenObject", attributes | _properties(each.values[0], xdc=xdc))
        return
    parent = ET.SubElement(listed, "CANopenObject", attributes | {"subNumber": str(len(each.values))})
    for value in each.values:
        code = "2" if value.type_code == DataType.DOMAIN else "7"
        own = {"subIndex": f"{value.subindex:02X}", "name": printable_xml(value.name), "objectType": code}
        ET.SubElement(parent, "CANopenSubObject", own | _properties(value, xdc=xdc))


def _properties(value: NodeValue, *, xdc: bool) -> dict[str, str]:
    stated = {
        "dataType": f"{value.type_code:04X}",
        "lowLimit": value.low,
        "highLimit": value.high,
        "accessType": value.access,
        "defaultValue": printable_xml(value.default),
        "PDOmapping": "optional" if value.mappable else "no",
        "actualValue": printable_xml(value.configured) if xdc else "",
        "uniqueIDRef": _unique_id(value) if _has_parameter(value) else "",
    }
    return {key: text for key, text in stated.items() if text}


def _texts(parent: ET.Element, texts: dict[str, str]) -> None:
    for name, text in texts.items():
        ET.SubElement(parent, name).text = printable_xml(text)


def printable_xml(text: str) -> str:
    """Return `text` without the characters that XML 1.0 cannot contain (2.2)."""
    return "".join(c for c in text if _allowed(ord(c)))


def _allowed(code: int) -> bool:
    return code in (0x9, 0xA, 0xD) or 0x20 <= code <= 0xD7FF or 0xE000 <= code <= 0xFFFD or code >= 0x10000
