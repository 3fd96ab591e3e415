"""A dump as a piece of the document: readable and refused ranges, response times, and the device's identification."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fieldtwin.commissioning.dump.file import Dump, load_dump
from fieldtwin.conformance.devices.checked import shown
from fieldtwin.conformance.devices.modbus.session import objects_in
from fieldtwin.reports.site.document import SERIAL, Deviation, DocumentPiece, Table

IDENTITY = {(0x1008, 0): "name", (0x1009, 0): "hardware", (0x100A, 0): "software"}
NUMBERS = {
    (0x1000, 0): "device type", (0x1018, 1): "vendor id", (0x1018, 2): "product code", (0x1018, 3): "revision",
    (0x1018, 4): SERIAL,
}  # fmt: skip


def dump_piece(path: Path) -> DocumentPiece:
    """Read a dump. Raises `FileInvalid` like `load_dump`."""
    dump = load_dump(path)
    header = dump.header
    cells = sum(len(each.cells) for each in dump.passes)
    deviations = (
        []
        if dump.ended
        else [Deviation("open", "the dump did not end", "a whole dump", "it was interrupted", path.name)]
    )
    unknown, asked_for = dump.unknown
    if unknown:
        where = [text for found in dump.maps.values() for text in found.get("unknown", [])]
        got = f"{unknown} of {asked_for} unknown: no reply, no valid reply, or not asked"
        got += f" ({_spans(where)})" if where else ""
        deviations.append(Deviation("open", "some results are missing", "an answer everywhere", got, path.name))
    facts = [
        ("ranges", ", ".join(map(str, header["ranges"])) or "all tags of the profile or EDS"),
        ("profile", str(header.get("profile") or "none")),
        ("times through", str(len(dump.passes))),
        ("values", str(cells)),
    ]
    if dump.not_asked:
        facts.append(("not asked", f"{dump.not_asked} of {asked_for} addresses; their neighbours were"))
    return DocumentPiece(
        "dump", dump.protocol, int(header.get("address", 0)), str(header.get("endpoint", "")), str(header.get("started", "")),
        str(header.get("by", "")), _verdict(dump), f"{cells} values in {len(dump.passes)} passes",
        identity(dump), tuple(facts), tuple(deviations), _tables(dump), str(header.get("command", "")),
    )  # fmt: skip


def _verdict(dump: Dump) -> str:
    """Return the verdict: ``whole`` only if the dump is complete and every address gave a definite answer.

    ``sampled``: the dump left out addresses between others with the same answer.
    """
    if not dump.ended:
        return "broken off"
    if dump.is_mostly_unknown:
        return "mostly unknown"
    if dump.unknown[0]:
        return "partly unknown"
    return "sampled" if dump.not_asked else "whole"


def identity(dump: Dump) -> dict[str, str]:
    """Return the device's identification: a CANopen node's objects, a Modbus device's answers to functions 2B/0E and 11."""
    said: dict[str, str] = {}
    if dump.header.get("profile"):
        said["profile"] = str(dump.header["profile"])
    for each in dump.passes:
        for key, name in NUMBERS.items():
            if (raw := each.cells.get(key)) is not None:
                number = int.from_bytes(raw, "little")
                said[name] = f"{number:08X}h" if name == "device type" else f"{number} ({number:08X}h)"
        for key, name in IDENTITY.items():
            if (raw := each.cells.get(key)) is not None and (text := shown(raw)):
                said[name] = text
    if raw := _raw(dump, 0x2B):
        said |= objects_in(b"\x2b" + raw)
    if raw := _raw(dump, 0x11):
        said["server id"] = shown(raw) or raw.hex(" ").upper()
    return said


def _raw(dump: Dump, function: int) -> bytes:
    """Return the data of the device's answer to the Modbus function `function`; empty if there was no answer."""
    try:
        return bytes.fromhex(dump.functions.get(function, {}).get("hex", ""))
    except (TypeError, ValueError):
        return b""


def _tables(dump: Dump) -> tuple[Table, ...]:
    names = ("readable", "refused", "silent", "invalid", "not_asked")
    maps = tuple(
        (name, *(_places(found, key) for key in names), _longest(found))
        for name, found in sorted(dump.maps.items())
        if name != "objects"
    )
    objects = tuple(
        (str(found["counts"][key]) for key in names) for name, found in dump.maps.items() if name == "objects"
    )
    latency = tuple((name, *_latency(found)) for name, found in sorted(dump.latency.items()))
    heads = ("readable", "refused", "no reply", "invalid reply", "not asked")
    return (
        Table("Readable ranges", ("table", *heads, "longest read"), maps),
        *(Table("Objects", heads, (tuple(row),)) for row in objects),
        Table("Response times", ("function", "requests", "median", "95 %", "slowest"), latency),
    )


def _spans(texts: Any, most: int = 8) -> str:
    if not isinstance(texts, list) or not texts:
        return "none"
    return ", ".join(map(str, texts[:most])) + (f" and {len(texts) - most} more" if len(texts) > most else "")


def _places(found: dict[str, Any], key: str) -> str:
    """Return the ranges in which every address has the state `key`; for a sampled range, how many addresses have it."""
    sampled = [
        f"{s['asked'] if key != 'not_asked' else s['addresses'] - s['asked']} of {s['range']}"
        for s in found.get("sampled", [])
        if key in (s["state"], "not_asked")
    ]
    return _spans([*found.get(key, []), *sampled])


def _longest(found: dict[str, Any]) -> str:
    """Return the size of the longest accepted read, with "or more" if the device refused no longer one."""
    if not found.get("max_read"):
        return ""
    return str(found["max_read"]) if found.get("limit_proved") else f"{found['max_read']} or more"


def _latency(found: Any) -> tuple[str, str, str, str]:
    if not isinstance(found, dict):
        return "", "", "", ""

    def ms(name: str) -> str:
        value = found.get(name)
        return f"{value / 1000:.1f} ms" if isinstance(value, int | float) else ""

    return str(found.get("count", "")), ms("p50_us"), ms("p95_us"), ms("most_us")
