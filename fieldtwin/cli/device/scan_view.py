"""The result of a scan, as tables and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from rich.table import Table
from rich.text import Text

from fieldtwin.commissioning.scan.canopen import CanScan
from fieldtwin.commissioning.scan.listening import describe
from fieldtwin.commissioning.scan.modbus import FoundUnit, ModbusScan
from fieldtwin.commissioning.scan.settings import name_of
from fieldtwin.console import stderr, stdout
from fieldtwin.gateway.core.errors import ModbusExceptionReply

MANY = 8
"""Units from this number on that give the same exception are shown in one row."""


def show_modbus(scan: ModbusScan) -> None:
    """Print a table of the units on stdout, and what else the scan found on stderr."""
    heard = scan.heard
    if heard is not None and heard.bytes:
        stderr.print(f"heard {heard.bytes} bytes, {heard.frames} whole frames", markup=False)
    if scan.verdict is not None:
        stderr.print(f"settings: {describe(scan.verdict)}", soft_wrap=True, markup=False)
    table = _table("unit", "settings", "answer", "after")
    if scan.alike is not None and scan.alike.one_device:
        one = scan.units[0]
        table.add_row("any", _settings(one), _answer(one), f"{one.answer.latency_ns / 1e6:.1f} ms")
    else:
        for group in _with_the_same_answer(scan.units):
            found, latencies = group[0], [f.answer.latency_ns / 1e6 for f in group]
            late = " (late: try a longer --timeout)" if found.answer.late else ""
            after = " to ".join(dict.fromkeys(f"{ms:.1f}" for ms in (min(latencies), max(latencies))))
            units = unit_ranges(sorted(f.answer.unit for f in group))
            table.add_row(units, _settings(found), _answer(found), f"{after} ms{late}")
    for unit in sorted(set(heard.live if heard is not None else []) - {f.answer.unit for f in scan.units}):
        at = name_of(scan.verdict.settings) if scan.verdict is not None else ""
        table.add_row(str(unit), at, Text("answers another client", "dim"), "")
    if table.row_count:
        stdout.print(table)
    for odd in scan.damaged:
        at = f" at {name_of(odd.settings)}" if odd.settings is not None else ""
        count = len(odd.units)
        who = f"unit {odd.units[0]}" if count == 1 else f"{count} units ({unit_ranges(odd.units)})"
        stderr.print(f"{who}{at}: {odd.advice}", soft_wrap=True, markup=False)
    if heard is not None and heard.silent:
        stderr.print(f"polled by another client, and silent: {unit_ranges(sorted(heard.silent))}", soft_wrap=True)
    if scan.behind_gateway:
        stderr.print(f"a gateway reports that {len(scan.behind_gateway)} units do not answer (exceptions 0A, 0B)")
    if scan.alike is not None:
        words = "one device that answers to every unit ID" if scan.alike.one_device else "perhaps one device"
        stderr.print(f"{words}: {scan.alike.why}", soft_wrap=True, markup=False)
    if scan.echo:
        stderr.print("this line echoes sent bytes: use --echo with the other commands")
    _end(scan.notes, scan.asked, "question", bool(table.row_count))


def _with_the_same_answer(units: Sequence[FoundUnit]) -> list[list[FoundUnit]]:
    """Return the units of each row: many units that give the same exception share one of the last rows, every other unit has
    its own.
    """
    groups: dict[tuple[object, ...], list[FoundUnit]] = {}
    for found in units:
        key = (found.answer.exception, found.settings, found.doubtful, found.answer.late)
        groups.setdefault(key if found.answer.exception else (found.answer.unit, *key), []).append(found)
    rows = [row for group in groups.values() for row in ([group] if len(group) >= MANY else [[f] for f in group])]
    return sorted(rows, key=lambda row: len(row) >= MANY)


def unit_ranges(units: Sequence[int]) -> str:
    """Return ascending unit IDs as text with ranges: ``1-9, 11, 17-247``."""
    spans: list[list[int]] = []
    for unit in units:
        if spans and spans[-1][-1] == unit - 1:
            spans[-1][1:] = [unit]
        else:
            spans.append([unit])
    return ", ".join("-".join(map(str, span)) for span in spans)


def modbus_json(scan: ModbusScan) -> dict[str, Any]:
    """Return the result of a Modbus scan as JSON data."""
    heard = scan.heard
    return {
        "endpoint": scan.url,
        "units": [
            {
                "unit": f.answer.unit,
                "settings": name_of(f.settings) if f.settings else None,
                "exception": f.answer.exception or None,
                "reply": f.answer.reply.hex(),
                "latency_ms": round(f.answer.latency_ns / 1e6, 3),
                "late": f.answer.late,
                "doubtful": f.doubtful,
            }
            for f in scan.units
        ],
        "one_device": scan.alike.one_device if scan.alike else False,
        "alike": asdict(scan.alike) if scan.alike else None,
        "damaged": [
            {"settings": name_of(o.settings) if o.settings else None, "unit": unit, "reply": o.pdu.hex() or None}
            for o in scan.damaged
            for unit in o.units
        ],
        "behind_gateway": sorted(scan.behind_gateway),
        "heard": {
            "bytes": heard.bytes,
            "frames": heard.frames,
            "share": round(heard.share, 4),
            "live": heard.live,
            "silent": heard.silent,
        }
        if heard is not None
        else None,
        "settings": {
            "settings": name_of(scan.verdict.settings),
            "others": [name_of(s) for s in scan.verdict.others],
            "sure": scan.verdict.sure,
            "why": scan.verdict.why,
        }
        if scan.verdict is not None
        else None,
        "echo": scan.echo,
        "asked": scan.asked,
        "took_s": round(scan.took_s, 3),
        "stopped": scan.stopped,
        "notes": scan.notes,
    }


def show_can(scan: CanScan) -> None:
    """Print the nodes, then the notes."""
    heard = scan.heard
    rate = f" at {scan.bitrate} bit/s" if scan.bitrate else ""
    stderr.print(f"listened for {scan.listened_s:.1f} s{rate}: {heard.frames} frames, {heard.errors} error frames")
    table = _table("node", "state", "SDO", "device type", "vendor", "product", "serial", "heard")
    table.columns[1].no_wrap = True  # a state is one word
    asked = {n.node: n for n in scan.nodes}
    for number in sorted(asked.keys() | {n for n, h in heard.nodes.items() if h.certain}):
        node, traffic = asked.get(number), heard.nodes.get(number)
        state = node.state if node is not None and node.state is not None else traffic.state if traffic else None
        identity = node.identity if node is not None else None
        parts = (identity.device_type, identity.vendor, identity.product, identity.serial) if identity else (None,) * 4
        sdo = "another master" if number in scan.blocked else "-" if node is None else "yes" if node.answers else "no"
        beat = f"heartbeat {traffic.period_s:.2g} s" if traffic and traffic.period_s else ""
        beat = beat or (
            f"{traffic.heartbeats + traffic.boot_ups} heartbeats" if traffic and traffic.state is not None else ""
        )
        words = state.name.lower().replace("_", "-") if state is not None else ""
        table.add_row(str(number), words, sdo, *("" if p is None else f"{p:X}h" for p in parts), beat)
    if table.row_count:
        stdout.print(table)
    for address in scan.unconfigured:
        stdout.print(f"without a node ID: vendor/product/revision/serial {address} (LSS)", markup=False, soft_wrap=True)
    likely = sorted(n for n, h in heard.nodes.items() if not h.certain)
    if likely:
        names = ", ".join(map(str, likely))
        stderr.print(f"seen only by PDO identifiers, which may belong to other nodes: nodes {names}", soft_wrap=True)
    if scan.blocked:
        names = ", ".join(map(str, scan.blocked))
        stderr.print(f"not asked, because another master uses SDO: nodes {names}", soft_wrap=True)
    for number, why in sorted(scan.conflicts.items()):
        stderr.print(f"node {number}: {why}", soft_wrap=True, markup=False)
    _end(scan.notes, scan.asked, "node", bool(table.row_count or scan.unconfigured))


def can_json(scan: CanScan) -> dict[str, Any]:
    """Return the result of a CANopen scan as JSON data."""
    heard = scan.heard
    return {
        "endpoint": scan.url,
        "bitrate": scan.bitrate or None,
        "interface": asdict(scan.facts) if scan.facts is not None else None,
        "nodes": [
            {
                "node": n.node,
                "state": n.state.name.lower() if n.state is not None else None,
                "answers": n.answers,
                "identity": asdict(n.identity) if n.identity is not None else None,
            }
            for n in scan.nodes
        ],
        "heard": {
            "frames": heard.frames,
            "errors": heard.errors,
            "nodes": {
                str(n): asdict(h)
                | {"state": h.state.name.lower() if h.state is not None else None, "certain": h.certain}
                for n, h in sorted(heard.nodes.items())
            },
            "sdo_masters": sorted(heard.sdo_masters),
            "nmt_commands": heard.nmt_commands,
            "syncs": heard.syncs,
        },
        "conflicts": {str(number): why for number, why in sorted(scan.conflicts.items())},
        "blocked": scan.blocked,
        "unconfigured": [list(a.parts) for a in scan.unconfigured],
        "listened_s": round(scan.listened_s, 3),
        "asked": scan.asked,
        "took_s": round(scan.took_s, 3),
        "stopped": scan.stopped,
        "notes": scan.notes,
    }


def _end(notes: list[str], asked: int, what: str, found: bool) -> None:
    for note in notes:
        stderr.print(note, soft_wrap=True, markup=False)
    sent = f"{asked} {what}{'s' * (asked != 1)} asked" if asked else "nothing was sent"
    stderr.print(sent if found else f"no device was found; {sent}")


def _table(*columns: str) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in columns:
        table.add_column(name, overflow="fold")
    return table


def _settings(found: FoundUnit) -> str:
    return name_of(found.settings) if found.settings is not None else ""


def _answer(found: FoundUnit) -> Text:
    code = found.answer.exception
    if code:
        name = ModbusExceptionReply.NAMES.get(code, "vendor specific")
        return Text(f"exception {code:02X}h, {name}" + (" (once)" if found.doubtful else ""))
    return Text("answers" + (" (once)" if found.doubtful else ""), "green")
