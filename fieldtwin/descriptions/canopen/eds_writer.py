"""Write a `NodeDescription` as an EDS or DCF (CiA 306-1, 4)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime

from fieldtwin.descriptions.canopen.node import DOMAIN, NodeDescription, NodeObject, NodeValue
from fieldtwin.descriptions.profile_text import printable
from fieldtwin.gateway.protocols.canopen.eds.text import BIT_RATES_KBIT

MANDATORY = (0x1000, 0x1001, 0x1018)
"""The objects that every node has (CiA 301, 7.5.2); they are in [MandatoryObjects]."""
MANUFACTURER = range(0x2000, 0x6000)
_DEVICE_KEYS = (
    *("VendorName", "VendorNumber", "ProductName", "ProductNumber", "RevisionNumber", "OrderCode"),
    *(f"BaudRate_{kbit}" for kbit in BIT_RATES_KBIT),
    *("SimpleBootUpMaster", "SimpleBootUpSlave", "Granularity", "DynamicChannelsSupported", "GroupMessaging"),
    *("NrOfRXPDO", "NrOfTXPDO", "LSS_Supported"),
)
_IN_HEX = ("VendorNumber", "ProductNumber", "RevisionNumber")
_TEXTS = ("VendorName", "ProductName", "OrderCode")


def write_eds(node: NodeDescription, name: str, written_ns: int, *, dcf: bool = False) -> bytes:
    """Return the text of an EDS, or of a DCF, in UTF-8; its lines end with CR LF.

    `name` is the name of the file, and `written_ns` its time in ns since 1970 (UTC).
    """
    sections = [
        ("FileInfo", _file_info(node, name, written_ns)),
        ("DeviceInfo", _device_info(node)),
        *([("DeviceComissioning", _commissioning(node))] if dcf else []),  # the standard's spelling
        ("DummyUsage", {f"Dummy{code:04X}": "0" for code in range(1, 8)}),
        ("Comments", {"Lines": "0"}),
        *_lists(node.objects),
    ]
    for each in node.objects:
        sections += _object(each, dcf=dcf)
    blocks = [
        "\r\n".join([f"[{title}]", *(f"{key}={value}" for key, value in keys.items())]) for title, keys in sections
    ]
    return ("\r\n\r\n".join(blocks) + "\r\n").encode("utf-8")


def _file_info(node: NodeDescription, name: str, written_ns: int) -> dict[str, str]:
    written = datetime.fromtimestamp(written_ns // 1_000_000_000, UTC)
    time, date = f"{written:%I:%M%p}", f"{written:%m-%d-%Y}"
    return {
        "FileName": printable(name),
        "FileVersion": "1",
        "FileRevision": "0",
        "EDSVersion": "4.0",
        "Description": printable(node.device.get("ProductName", "")),
        "CreationTime": time,
        "CreationDate": date,
        "CreatedBy": "fieldtwin",
        "ModificationTime": time,
        "ModificationDate": date,
        "ModifiedBy": "fieldtwin",
    }


def _device_info(node: NodeDescription) -> dict[str, str]:
    """Return the keys of [DeviceInfo]. A number that the description does not state is 0; PDOs are counted."""
    counts = {
        "NrOfRXPDO": _count(node.objects, range(0x1400, 0x1600)),
        "NrOfTXPDO": _count(node.objects, range(0x1800, 0x1A00)),
    }
    keys = {}
    for key in _DEVICE_KEYS:
        value = printable(node.device.get(key, "" if key in _TEXTS else "0"))
        if key in _IN_HEX:
            value = f"0x{int(value, 0):08X}"
        keys[key] = str(counts.get(key, value))
    return keys


def _count(objects: Iterable[NodeObject], area: range) -> int:
    return sum(each.index in area for each in objects)


def _commissioning(node: NodeDescription) -> dict[str, str]:
    return {
        "NodeID": "" if node.node_id is None else str(node.node_id),
        "NodeName": printable(node.node_name),
        "Baudrate": "" if node.bitrate_kbit is None else str(node.bitrate_kbit),
        "NetNumber": "1",
        "NetworkName": "",
        "CANopenManager": "0",
        "LSS_SerialNumber": "0",
    }


def _lists(objects: Sequence[NodeObject]) -> Iterator[tuple[str, Mapping[str, str]]]:
    """Yield the three lists of objects (CiA 306-1, 4.6.2)."""
    indexes = [each.index for each in objects]
    lists = {
        "MandatoryObjects": [i for i in indexes if i in MANDATORY],
        "OptionalObjects": [i for i in indexes if i not in MANDATORY and i not in MANUFACTURER],
        "ManufacturerObjects": [i for i in indexes if i in MANUFACTURER],
    }
    for title, listed in lists.items():
        numbered = {str(number): f"0x{index:04X}" for number, index in enumerate(listed, 1)}
        yield title, {"SupportedObjects": str(len(listed)), **numbered}


def _object(each: NodeObject, *, dcf: bool) -> Iterator[tuple[str, Mapping[str, str]]]:
    title = f"{each.index:04X}"
    if each.is_single:
        yield title, _value(each.values[0], each.code, dcf=dcf)
        return
    yield (
        title,
        {
            "ParameterName": printable(each.name),
            "ObjectType": f"0x{each.code:X}",
            "SubNumber": f"0x{len(each.values):X}",
        },
    )
    for value in each.values:
        yield f"{title}sub{value.subindex:X}", _value(value, 0x7, dcf=dcf)


def _value(value: NodeValue, code: int, *, dcf: bool) -> dict[str, str]:
    """Return the keys of a value; LowLimit, HighLimit and the keys outside CiA 306 only if the description states them."""
    keys = {
        "ParameterName": printable(value.name),
        "ObjectType": f"0x{DOMAIN if value.type_code == 0xF else code:X}",
        "DataType": f"0x{value.type_code:04X}",
        "AccessType": value.access,
        "LowLimit": value.low,
        "HighLimit": value.high,
        "DefaultValue": _one_line(value.default),
        "PDOMapping": str(int(value.mappable)),
        "ParameterValue": _one_line(value.configured) if dcf else "",
        "Factor": value.factor,
        "Unit": printable(value.unit),
        "Description": printable(value.remark),
    }
    return {key: text for key, text in keys.items() if text or key == "DefaultValue"}


def _one_line(text: str) -> str:
    return " ".join(text.splitlines())
