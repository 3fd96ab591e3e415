"""The fields of CANopen frames: the meaning of the identifier, and the bytes of its service (CiA 301). The module does no I/O."""

from __future__ import annotations

from collections.abc import Mapping

from fieldtwin.capture.decoding.exchange import SECRET, TouchedSpan
from fieldtwin.capture.decoding.fields import FieldReader, FieldSpan
from fieldtwin.capture.decoding.node_map import NodeMap, Pdo
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.protocols.canopen import cob_id
from fieldtwin.gateway.protocols.canopen.emcy import parse_emcy
from fieldtwin.gateway.protocols.canopen.nmt.states import NmtCommand, NmtState
from fieldtwin.gateway.protocols.canopen.sdo.abort_codes import meaning

_COMMANDS = {int(c): c.name.lower().replace("_", " ") for c in NmtCommand}
_STATES = {int(s): s.name.lower().replace("_", "-") for s in NmtState} | {0: "boot-up"}
_REGISTER_BITS = (
    "generic",
    "current",
    "voltage",
    "temperature",
    "communication",
    "profile specific",
    "reserved",
    "manufacturer",
)
_SDO = "CiA 301, 7.2.4.3"
_ABORT = 4
"""The command specifier of an abort, the same for client and server."""


def canopen_fields(frame: CanFrame, nodes: Mapping[int, NodeMap] | None = None) -> list[FieldSpan]:
    """Return the fields of a frame. `nodes` holds the known nodes of the bus by node ID."""
    nodes = nodes or {}
    reader = FieldReader(frame.data)
    number, node = frame.can_id, frame.can_id & 0x7F
    pdo = next((n.pdos[number] for n in nodes.values() if number in n.pdos), None)
    if frame.error or frame.extended or frame.remote:
        kind = "error frame" if frame.error else "29-bit identifier" if frame.extended else "remote frame"
        _identifier(reader, number, f"{kind}, not a message of CANopen")
    elif pdo is not None:
        _identifier(reader, number, f"{pdo.name} of {_called(nodes, pdo.node)}")
        _pdo(reader, pdo, nodes.get(pdo.node))
    elif number in _SINGLE:
        _identifier(reader, number, _SINGLE[number])
        _single(reader, number, nodes)
    elif node and number & 0x780 in _BY_NODE:
        _identifier(reader, number, f"{_BY_NODE[number & 0x780]} of {_called(nodes, node)}")
        _of_node(reader, number & 0x780, nodes.get(node))
    elif node and 0x180 <= number < 0x580:
        sends = bool(number & 0x80)
        name = f"{'TPDO' if sends else 'RPDO'}{number // 0x100 - (not sends)}"
        _identifier(reader, number, f"{name} of {_called(nodes, node)}")
        _pdo(reader, Pdo(node, name, sends, None), None)
    else:
        _identifier(reader, number, "not an identifier of CANopen")
    reader.rest("data", lambda raw: raw.hex(" "))
    return reader.spans


_SINGLE = {
    cob_id.NMT: "NMT: commands of the master to the nodes",
    cob_id.SYNC: "SYNC: the common clock of synchronous PDOs",
    cob_id.TIME: "TIME: the time of day",
    cob_id.LSS_REQUEST: "LSS request of the master",
    cob_id.LSS_REPLY: "LSS reply of a node",
}
_BY_NODE = {
    cob_id.EMCY_BASE: "EMCY: an error message",
    cob_id.SDO_RESPONSE_BASE: "SDO reply",
    cob_id.SDO_REQUEST_BASE: "SDO request to the server",
    cob_id.HEARTBEAT_BASE: "heartbeat or boot-up",
}


def _identifier(reader: FieldReader, number: int, text: str) -> None:
    note = "The identifier tells the service and the node (CiA 301, 7.3.3)."
    reader.spans.append(FieldSpan(0, 0, "COB-ID", f"{number:03X}h: {text}", note))


def _called(nodes: Mapping[int, NodeMap], node: int) -> str:
    return f"{nodes[node].name} (node {node})" if node in nodes else f"node {node}"


def _single(reader: FieldReader, number: int, nodes: Mapping[int, NodeMap]) -> None:
    if number == cob_id.NMT:
        reader.take(
            1,
            "command",
            lambda raw: f"{raw[0]:02X}h {_COMMANDS.get(raw[0], 'unknown')}",
            "NMT service (CiA 301, 7.2.8.3.1).",
        )
        reader.take(
            1,
            "node ID",
            lambda raw: _called(nodes, raw[0]) if raw[0] else "0 (all nodes)",
            "The node that obeys (CiA 301, 7.2.8.3.1).",
        )
    elif number == cob_id.SYNC:
        reader.take(1, "counter", lambda raw: str(raw[0]), "An optional counter (CiA 301, 7.2.5).")
    elif number == cob_id.TIME:
        reader.take(4, "milliseconds", lambda raw: str(_little(raw) & 0x0FFFFFFF), "Since midnight (CiA 301, 7.2.6).")
        reader.take(2, "days", lambda raw: str(_little(raw)), "Since 1 January 1984 (CiA 301, 7.2.6).")
    else:
        reader.take(1, "command specifier", lambda raw: f"{raw[0]:02X}h", "LSS service (CiA 305).")


def _of_node(reader: FieldReader, base: int, node: NodeMap | None) -> None:
    if base == cob_id.EMCY_BASE:
        reader.take(
            2,
            "error code",
            lambda raw: f"{_little(raw):04X}h {parse_emcy(raw).meaning}",
            "0000h means that an error is gone (CiA 301, 7.2.7.1).",
        )
        reader.take(1, "error register", lambda raw: _register(raw[0]), "Object 1001h (CiA 301, 7.5.2.2).")
        reader.rest("manufacturer's data", lambda raw: raw.hex(" "), "The data sheet explains it (CiA 301, 7.2.7.3).")
    elif base == cob_id.HEARTBEAT_BASE:
        reader.take(1, "state", _state, "Bit 7 toggles in node guarding (CiA 301, 7.2.8.3.2).")
    else:
        _sdo(reader, base == cob_id.SDO_RESPONSE_BASE, node)


def _register(value: int) -> str:
    named = [name for bit, name in enumerate(_REGISTER_BITS) if value >> bit & 1]
    return f"{value:02X}h {', '.join(named) or 'no error'}"


def _state(raw: bytes) -> str:
    toggled = ", toggle bit 1" if raw[0] & 0x80 else ""
    return f"{raw[0]:02X}h {_STATES.get(raw[0] & 0x7F, 'unknown state')}{toggled}"


# -- SDO ------------------------------------------------------------------------------------------------------------------


def _sdo(reader: FieldReader, reply: bool, node: NodeMap | None) -> None:
    if not reader.data:
        return
    first = reader.data[0]
    kind = first >> 5
    name = (_REPLIES if reply else _REQUESTS).get(kind, "unknown")
    note = f"Command specifier {kind} (bits 7 to 5), further bits {first & 0x1F:05b}; in a block it numbers the segment ({_SDO})."
    is_download = kind == (3 if reply else 1)
    is_upload = kind == 2
    if kind == _ABORT:
        reader.take(1, "command", f"{first:02X}h abort", note)
        _multiplexer(reader, node)
        reader.take(
            4, "abort code", lambda raw: f"{_little(raw):08X}h {meaning(_little(raw))}", f"The reason ({_SDO}.17)."
        )
    elif is_upload or is_download:
        carries = is_upload if reply else is_download
        reader.take(1, "command", f"{first:02X}h {name}{_transfer_bits(first) if carries else ''}", note)
        index, subindex = _multiplexer(reader, node)
        if carries:
            _content(reader, first, node, index, subindex)
        else:
            reader.rest("reserved", lambda raw: raw.hex(" "), f"Not used ({_SDO}).")
    elif kind == 0:
        unused, last = first >> 1 & 7, ", the last" if first & 1 else ""
        reader.take(1, "command", f"{first:02X}h {name}{last}, toggle bit {first >> 4 & 1}", note)
        reader.take(
            min(7 - unused, reader.left), "segment", lambda raw: _segment(raw, node), f"Data of the object ({_SDO})."
        )
        reader.rest("unused", lambda raw: raw.hex(" "), f"{unused} bytes have no data ({_SDO}).")
    elif kind in (5, 6):
        _block(reader, first, note, upload=(kind == 6) == reply, reply=reply, node=node)
    else:
        reader.take(1, "command", f"{first:02X}h {name}, toggle bit {first >> 4 & 1}", note)
        reader.rest("reserved", lambda raw: raw.hex(" "), f"Not used ({_SDO}).")


_REQUESTS = {0: "download of a segment", 1: "download (write)", 2: "upload (read)", 3: "upload of a segment"}
_REPLIES = {0: "segment of an upload", 1: "segment accepted", 2: "upload (read)", 3: "download accepted"}


def _transfer_bits(first: int) -> str:
    if not first & 2:
        return ", in segments" + (", size given" if first & 1 else "")
    return f", expedited, {4 - (first >> 2 & 3)} bytes" if first & 1 else ", expedited, size not given"


def _multiplexer(reader: FieldReader, node: NodeMap | None) -> tuple[int, int]:
    following = reader.data[3:4]
    subindex = following[0] if following else 0
    index = _little(reader.data[1:3])
    named = node.named(index, subindex).partition(" ")[2] if node and following else ""
    reader.take(
        2, "index", lambda raw: f"{_little(raw):04X}h {named}".rstrip(), f"The object, low byte first ({_SDO})."
    )
    reader.take(1, "subindex", lambda raw: f"{raw[0]:02X}h", f"The entry of the object ({_SDO}).")
    return index, subindex


def _content(reader: FieldReader, first: int, node: NodeMap | None, index: int, subindex: int) -> None:
    if not first & 2:
        reader.take(
            4,
            "size",
            lambda raw: f"{_little(raw)} bytes" if first & 1 else "not given",
            f"The size of the object ({_SDO}).",
        )
        return
    used = 4 - (first >> 2 & 3) if first & 1 else 4

    def show(raw: bytes) -> str:
        return node.said(index, subindex, raw, 0) if node else f"{raw.hex(' ')} ({_little(raw)})"

    reader.take(min(used, reader.left), "data", show, f"The value, low byte first ({_SDO}).")
    reader.rest("unused", lambda raw: raw.hex(" "), f"{4 - used} bytes have no data ({_SDO}).")


def _segment(raw: bytes, node: NodeMap | None) -> str:
    return SECRET if node and node.tags.has_secrets else raw.hex(" ")


def _block(reader: FieldReader, first: int, note: str, *, upload: bool, reply: bool, node: NodeMap | None) -> None:
    sends = upload == reply  # this side sends the object's data
    step = first & 1 if sends else first & 3
    way = "upload" if upload else "download"
    names = {0: "begin", 1: "end", 2: "acknowledgement", 3: "start"}
    reader.take(1, "command", f"{first:02X}h block {way}, {names[step]}", note)
    if step == 0:
        _multiplexer(reader, node)
        if sends:
            given = bool(first & 2)
            reader.take(
                4,
                "size",
                lambda raw: f"{_little(raw)} bytes" if given else "not given",
                f"The size of the object ({_SDO}).",
            )
        else:
            reader.take(
                1, "block size", lambda raw: f"{raw[0]} segments", f"Segments before an acknowledgement ({_SDO})."
            )
    elif step == 1 and sends:
        reader.take(2, "CRC", lambda raw: f"{_little(raw):04X}h", f"Check sum of the whole object ({_SDO}.16).")
    elif step == 2:
        reader.take(1, "last segment", lambda raw: str(raw[0]), f"The last segment that arrived in order ({_SDO}).")
        reader.take(1, "block size", lambda raw: f"{raw[0]} segments", f"Segments of the next block ({_SDO}).")
    reader.rest("reserved", lambda raw: raw.hex(" "), f"Not used ({_SDO}).")


# -- PDO ------------------------------------------------------------------------------------------------------------------


def _pdo(reader: FieldReader, pdo: Pdo, node: NodeMap | None) -> None:
    if pdo.mapping is None or node is None:
        reader.rest("data", lambda raw: raw.hex(" "), "The mapping of this PDO is not known (CiA 301, 7.2.2).")
        return
    mapping = pdo.mapping
    if len(reader.data) < mapping.length:
        short = f"{len(reader.data)} bytes; the mapping has {mapping.length}"
        reader.rest("too short", short, "A PDO that is too short is not used (CiA 301, 7.2.2).")
        return
    values = mapping.unpack(reader.data)
    at, taken, names, texts = 0, 0, [], []
    for entry, raw in zip(mapping.entries, values, strict=True):
        at += entry.bits
        names.append(node.named(entry.index, entry.subindex))
        texts.append(_mapped(node, entry.index, entry.subindex, raw))
        if at % 8 == 0:
            note = f"{at - 8 * taken} bits by the mapping (CiA 301, 7.5.2.36 and 7.5.2.38)."
            reader.take(at // 8 - taken, ", ".join(names), ", ".join(texts), note)
            taken, names, texts = at // 8, [], []
    if names:
        reader.take(
            mapping.length - taken, ", ".join(names), ", ".join(texts), "The last byte is not full (CiA 301, 7.2.2)."
        )
    reader.rest("not mapped", lambda raw: raw.hex(" "), "Bytes after the mapped objects are ignored (CiA 301, 7.2.2).")


def _mapped(node: NodeMap, index: int, subindex: int, raw: bytes) -> str:
    if node.tags.secrets((TouchedSpan("read", "object", index, 1, subindex),)):
        return SECRET
    return node.said(index, subindex, raw, 0)


def _little(raw: bytes) -> int:
    return int.from_bytes(raw, "little")
