"""Flows of Node-RED (JSON) with the nodes of node-red-contrib-modbus: requests become registers, and registers become a flow.

A request states a unit ID, a function code, an address as sent (from 0) and a quantity, and nothing about types. An import
therefore has one tag for each register or bit. An export reads blocks of registers and decodes them in function nodes.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from fieldtwin.descriptions.conversion import Exported, Imported, Loss, Settings, Source
from fieldtwin.descriptions.maps.documents import Document, Loc, parse_json
from fieldtwin.descriptions.maps.drafting import TABLE_OF_FUNCTION, Draft, choose
from fieldtwin.descriptions.maps.rendering import Abilities, exported, stated_endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.profile import BIT_TABLES, DeviceProfile, Table, Tag

ABILITIES = Abilities(
    "Node-RED",
    keeps={"offset", "bits", "sentinels"},
    types={"int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64", "string", "bcd16", "bcd32"},
)

RATE_S = 5
"""The polling period of an export in seconds. A profile has none."""
MAX_QUANTITY = 2000
"""The largest quantity of a request (AP 6.1: bits)."""

_TABLES: dict[str, Table] = {
    "Coil": "coil", "Input": "discrete", "HoldingRegister": "holding", "InputRegister": "input", "MCoils": "coil",
    "MHoldingRegisters": "holding",
}  # fmt: skip
_DATA_TYPES = {table: name for name, table in reversed(_TABLES.items())}
_REQUESTS = ("modbus-read", "modbus-getter", "modbus-write")
_KEYS = ("fc", "unitid", "address", "quantity")
_READERS = {
    "int16": "readInt16BE(0)", "uint16": "readUInt16BE(0)", "int32": "readInt32BE(0)", "uint32": "readUInt32BE(0)",
    "int64": "readBigInt64BE(0)", "uint64": "readBigUInt64BE(0)", "float32": "readFloatBE(0)", "float64": "readDoubleBE(0)",
}  # fmt: skip


@dataclass(frozen=True)
class _Request:
    """A request of a flow. `client` is the name of its connection."""

    loc: Loc
    name: str
    client: str
    unit: int
    table: Table
    address: int
    quantity: int
    writes: bool


def import_description(source: Source, settings: Settings) -> Imported:
    """Return the registers that a flow requests from one device. The setting ``select`` selects it: client, unit ID or both."""
    document = parse_json(source)
    data = document.data
    if isinstance(data, dict) and "flows" in data:  # as the runtime's API returns them
        data = data["flows"]
    nodes = document.entries(data, (), "the flow")
    by_id = {str(node.get("id")): node for _, node in nodes}
    losses: list[Loss] = []
    found = list(_requests(document, nodes, by_id, losses))
    devices = list(dict.fromkeys((each.client, each.unit) for each in found))
    index = choose(devices, settings.get("select", ""), document.path)
    client, unit = devices[index]
    draft = Draft(document, client, "a flow of Node-RED", settings)
    draft.factory(unit=unit)
    draft.losses += losses
    for node in by_id.values():
        if node.get("type") == "modbus-client" and _client_name(node) == client:
            _import_client(node, draft)
    for each in found:
        if (each.client, each.unit) == devices[index]:
            _import_request(each, draft)
    draft.lose(
        "all tags", "types, byte orders and scales", "a flow requests registers; `infer` finds types in recorded values"
    )
    return draft.imported()


def _client_name(node: Mapping[str, Any]) -> str:
    if name := str(node.get("name") or "").strip():
        return name
    serial = node.get("clienttype") not in (None, "tcp")
    return str(node.get("serialPort" if serial else "tcpHost") or node.get("id") or "client")


def _import_client(node: Mapping[str, Any], draft: Draft) -> None:
    if node.get("clienttype") in ("serial", "simpleser"):
        parity = {"none": "N", "even": "E", "odd": "O"}.get(str(node.get("serialParity", "none")), "")
        frame = f"{node.get('serialDatabits', 8)}{parity}{node.get('serialStopbits', 1)}"
        rate = str(node.get("serialBaudrate", ""))
        if re.fullmatch(r"[78][NEO][12]", frame) and re.fullmatch(r"[1-9][0-9]{1,6}", rate):
            draft.factory(baudrate=int(rate), frame=frame)
        else:
            draft.lose("modbus-client", "settings of the serial line", f"a profile cannot state {rate} {frame}")
    draft.note("modbus-client", "address of the device", "an endpoint belongs in the system file")


def _requests(
    document: Document, nodes: list[tuple[Loc, dict[str, Any]]], by_id: Mapping[str, dict[str, Any]], losses: list[Loss]
) -> Iterator[_Request]:
    for loc, node in nodes:
        kind, name = node.get("type"), str(node.get("name") or "").strip()
        client = by_id.get(str(node.get("server")), {})
        label = f"node {name or node.get('id')}"
        if kind in _REQUESTS:
            stated = {"unitid": node.get("unitid"), "address": node.get("adr"), "quantity": node.get("quantity")}
            data_type = str(node.get("dataType"))
            if data_type not in _TABLES:
                losses.append(
                    Loss(label, "the request", f"its data type {data_type!r} is not one of {', '.join(_TABLES)}")
                )
                continue
            yield _request(document, loc, name, client, stated, _TABLES[data_type], kind == "modbus-write")
        elif kind == "modbus-flex-sequencer":
            for at, each in document.entries(node.get("sequences"), (*loc, "sequences"), "`sequences`"):
                inner = str(each.get("name") or name)
                yield _flexible(document, at, inner, client, each | {"fc": str(each.get("fc", "")).removeprefix("FC")})
        elif kind in ("modbus-flex-getter", "modbus-flex-write"):
            payloads = list(_payloads(str(node.get("id")), nodes))
            for at, inner, payload in payloads:
                yield _flexible(document, at, inner or name, client, payload)
            if not payloads:
                losses.append(Loss(label, "the requests", "the flow computes them; only literal messages are read"))
        if node.get("useIOFile"):
            losses.append(Loss(label, "names and types of an IO file", "the flow only has the path of that file"))


def _payloads(target: str, nodes: list[tuple[Loc, dict[str, Any]]]) -> Iterator[tuple[Loc, str, dict[str, Any]]]:
    """Yield the literal messages that inject and function nodes send directly to the node `target`."""
    for loc, node in nodes:
        wires = node.get("wires")
        outputs = (
            [each for output in wires if isinstance(output, list) for each in output] if isinstance(wires, list) else []
        )
        if target not in outputs:
            continue
        text = str(node.get("payload") or "") if node.get("type") == "inject" else str(node.get("func") or "")
        for literal in re.findall(r"\{[^{}]{1,2000}\}", text[:100_000]):
            pairs = re.findall(r"""['"]?(fc|unitid|address|quantity)['"]?\s*:\s*['"]?(\d{1,6})['"]?\s*[,}]""", literal)
            payload: dict[str, Any] = dict(pairs)
            if {"fc", "address"} <= set(payload):
                yield loc, str(node.get("name") or "").strip(), payload


def _flexible(
    document: Document, loc: Loc, name: str, client: Mapping[str, Any], payload: Mapping[str, Any]
) -> _Request:
    code = document.integer(payload.get("fc"), (*loc, "fc"), "the function code", 1, 16)
    if code not in TABLE_OF_FUNCTION:
        raise document.error((*loc, "fc"), "the function code", expected="1 to 6, 15 or 16", got=str(code))
    return _request(document, loc, name, client, payload, TABLE_OF_FUNCTION[code], code in (5, 6, 15, 16))


def _request(
    document: Document,
    loc: Loc,
    name: str,
    client: Mapping[str, Any],
    stated: Mapping[str, Any],
    table: Table,
    writes: bool,
) -> _Request:
    unit = stated.get("unitid")
    if unit in (None, ""):
        unit = client.get("unit_id") or 1
    return _Request(
        loc,
        name,
        _client_name(client),
        document.integer(unit, (*loc, "unitid"), "the unit ID", 0, 255),
        table,
        document.integer(stated.get("address"), (*loc, "adr"), "the address", 0, 65535),
        document.integer(stated.get("quantity") or 1, (*loc, "quantity"), "the quantity", 1, MAX_QUANTITY),
        writes,
    )


def _import_request(request: _Request, draft: Draft) -> None:
    for i in range(request.quantity):
        address = request.address + i
        name = f"{request.table}_{address}"
        fields: dict[str, Any] = {"access": "wo" if request.writes else None}
        if request.name:
            fields["description"] = request.name if request.quantity == 1 else f"{request.name}, {i}"
        draft.add(request.loc, name, request.table, address, **fields)


def export_description(profile: DeviceProfile, settings: Settings) -> Exported:
    """Return a flow that reads the tags of a profile and sends messages with their values. Settings: ``endpoint``.

    Each block of adjacent registers has a read node and a function node. The message's payload holds the values by the names of
    the tags. A value that the device does not have, such as a sentinel of SunSpec, is null.
    """
    losses: list[Loss] = []
    found, serial = stated_endpoint(profile, settings.get("endpoint", ""), losses)
    if found.scheme == "udp":
        raise UsageError(f"{found.scheme}: cannot be exported", expected="tcp:, rtu+tcp:, rtu: or ascii: for Node-RED")
    tab, client = _id(profile, "tab"), _id(profile, "client")
    parity = {"N": "none", "E": "even", "O": "odd"}[serial.parity]
    nodes: list[dict[str, Any]] = [
        {"id": tab, "type": "tab", "label": profile.name, "disabled": False, "info": "written by fieldtwin from a profile"},
        {
            "id": client, "type": "modbus-client", "name": profile.name, "bufferCommands": True, "stateLogEnabled": False,
            "clienttype": "serial" if found.is_serial else "tcp", "queueLogEnabled": False, "failureLogEnabled": True,
            "tcpHost": found.host or "127.0.0.1", "tcpPort": str(found.port or 502),
            "tcpType": "RTU-BUFFERED" if found.scheme == "rtu+tcp" else "DEFAULT", "serialPort": found.path or "/dev/ttyUSB",
            "serialType": "ASCII" if found.scheme == "ascii" else "RTU-BUFFERD", "serialBaudrate": str(serial.baudrate),
            "serialDatabits": str(serial.data_bits), "serialStopbits": str(serial.stop_bits), "serialParity": parity,
            "serialConnectionDelay": "100", "serialAsciiResponseStartDelimiter": "0x3A", "unit_id": profile.form.factory.unit,
            "commandDelay": max(1, profile.form.timing.spacing_ms), "clientTimeout": profile.form.timing.timeout_ms or 1000,
            "reconnectOnTimeout": True, "reconnectTimeout": 2000, "parallelUnitIdsAllowed": True,
        },
    ]  # fmt: skip
    for i, block in enumerate(_blocks(profile, list(exported(profile, ABILITIES, losses)))):
        nodes += _block_nodes(profile, block, i, tab, client)
    return Exported((json.dumps(nodes, indent=2, ensure_ascii=False) + "\n").encode(), tuple(losses))


def _id(profile: DeviceProfile, what: str) -> str:
    """Return an identifier of 16 hexadecimal digits, which is the same for the same profile."""
    return hashlib.sha256(f"{profile.name} {what}".encode()).hexdigest()[:16]


def _blocks(profile: DeviceProfile, tags: list[Tag]) -> list[list[Tag]]:
    """Return the tags in blocks of adjacent registers that one request may read."""
    blocks: list[list[Tag]] = []
    for tag in sorted(tags, key=lambda t: (t.registers.table, t.registers.address)):
        at = tag.registers
        most = MAX_QUANTITY if at.table in BIT_TABLES else profile.form.limits.read_registers
        if blocks:
            first, last = blocks[-1][0].registers, max(blocks[-1], key=lambda t: t.registers.end).registers
            if first.table == at.table and at.address <= last.end and max(at.end, last.end) - first.address <= most:
                blocks[-1].append(tag)
                continue
        blocks.append([tag])
    return blocks


def _block_nodes(profile: DeviceProfile, block: list[Tag], i: int, tab: str, client: str) -> list[dict[str, Any]]:
    first, end = block[0].registers, max(tag.registers.end for tag in block)
    names = block[0].name if len(block) == 1 else f"{block[0].name} to {block[-1].name}"
    read, decode = _id(profile, f"read {i}"), _id(profile, f"decode {i}")
    return [
        {
            "id": read, "type": "modbus-read", "z": tab, "name": names, "topic": names, "showStatusActivities": False,
            "logIOActivities": False, "showErrors": True, "showWarnings": True, "unitid": str(profile.form.factory.unit),
            "dataType": _DATA_TYPES[first.table], "adr": str(first.address), "quantity": str(end - first.address),
            "rate": str(RATE_S), "rateUnit": "s", "delayOnStart": False, "startDelayTime": "", "server": client,
            "useIOFile": False, "ioFile": "", "useIOForPayload": False, "emptyMsgOnFail": False, "x": 200,
            "y": 60 + 60 * i, "wires": [[decode], []],
        },
        {
            "id": decode, "type": "function", "z": tab, "name": f"decode {names}", "func": _decoder(block), "outputs": 1,
            "noerr": 0, "initialize": "", "finalize": "", "libs": [], "x": 480, "y": 60 + 60 * i, "wires": [[]],
        },
    ]  # fmt: skip


def _decoder(block: list[Tag]) -> str:
    """Return the JavaScript of a function node that turns the registers of a block into values."""
    first = block[0].registers
    if first.table in BIT_TABLES:
        pairs = [
            f"  {json.dumps(tag.name)}: Boolean(msg.payload[{tag.registers.address - first.address}])" for tag in block
        ]
        return "msg.payload = {\n" + ",\n".join(pairs) + "\n};\nreturn msg;"
    lines = [
        "const words = msg.payload;",
        "const bytes = (at, count, order) => {",
        "  let pairs = words.slice(at, at + count).map(word => [word >> 8 & 255, word & 255]);",
        "  if (order === 'BADC' || order === 'DCBA') pairs = pairs.map(pair => pair.reverse());",
        "  if (order === 'CDAB' || order === 'DCBA') pairs.reverse();",
        "  return Buffer.from(pairs.flat());",
        "};",
        "const missing = (buffer, raw) => raw.some(each => BigInt('0x' + buffer.toString('hex')) === each);",
        "const values = {};",
        "let b;",
    ]
    for tag in block:
        lines += _tag_lines(tag, tag.registers.address - first.address)
    return "\n".join([*lines, "msg.payload = values;", "return msg;"])


def _tag_lines(tag: Tag, at: int) -> Iterator[str]:
    count, order = tag.registers.count, tag.order
    if tag.type == "string":  # the registers of a text keep their sequence
        order = "BADC" if order in ("BADC", "DCBA") else "ABCD"
    yield f"b = bytes({at}, {count}, '{order}');"
    if tag.bits is not None:
        low, high = tag.bits
        number = f"(b.readUInt16BE(0) >> {low} & {(1 << (high - low + 1)) - 1})"
    elif tag.type == "string":
        number = r"b.toString('latin1').split('\0')[0].replace(/[^\x00-\x7f]/g, '\ufffd').trimEnd()"
    elif tag.type.startswith("bcd"):
        number = "(/^[0-9]+$/.test(b.toString('hex')) ? Number(b.toString('hex')) : NaN)"
    else:
        number = f"Number(b.{_READERS[tag.type]})"
    if tag.type != "string":
        number += f" * {tag.scale!r}" if tag.scale != 1 else ""
        number += f" + {tag.offset!r}" if tag.offset else ""
    if tag.sentinels:
        raw = ", ".join(f"{each}n" for each in tag.sentinels)
        number = f"missing(b, [{raw}]) ? null : {number}"
    yield f"values[{json.dumps(tag.name)}] = {number};"
