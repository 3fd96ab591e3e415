"""The site acceptance document: one HTML file to print and sign, without network access or scripts.

It is designed for paper: A4, readable in black and white, with all content visible.
"""

from __future__ import annotations

from pathlib import Path

from fieldtwin.reports.file import put
from fieldtwin.reports.markup import Markup, el, join, page
from fieldtwin.reports.site.document import Deviation, Device, Document, Piece, Source, Table, Weight
from fieldtwin.reports.site.style import STYLE

MOST_DEVIATIONS = 1000
HEADINGS = {"check": "Conformance check", "dump": "Dump", "comparison": "Comparison", "difference": "Difference"}
WORDS = {
    "deviation": "deviation", "open": "open point", "robustness": "robustness", "field problem": "known field problem",
    "waived": "waived",
}  # fmt: skip
NOTED: dict[Weight, str] = {"robustness": "robustness finding", "field problem": "known field problem"}
"""Findings that do not deviate from the standard, as counted in the result."""


def write_html(document: Document, path: Path) -> None:
    """Write the page. Raises `FileInvalid` if it cannot be written."""
    put(path, render_html(document))


def render_html(document: Document) -> str:
    """Return the whole page."""
    body = [
        _header(document),
        el("h2", "1 Devices"),
        _devices(document),
        el("h2", "2 Deviations and other findings"),
        _deviations(document),
        el("h2", "3 What was done"),
        [_device(device) for device in document.devices],
        el("h2", "4 Files"),
        el("p", "This document says what these files say, and no more.", cls="small"),
        _files(document),
        el("section", el("h2", "5 Signatures"), _signatures(document), cls="signatures"),
    ]
    return page(f"Site acceptance: {document.site}", Markup(STYLE), body)


def day(when: str) -> str:
    """Return ``2026-11-21 11:33 UTC`` for an ISO 8601 time."""
    if len(when) < 16 or when[10:11] != "T":
        return when
    return f"{when[:10]} {when[11:16]}" + (" UTC" if when.endswith(("+00:00", "Z")) else "")


def plural(count: int, word: str) -> str:
    """Return ``no deviation``, ``1 deviation``, ``2 deviations``."""
    return f"{count or 'no'} {word}{'' if count in (0, 1) else 's'}"


# -- head ------------------------------------------------------------------------------------------------------------------


def _header(document: Document) -> Markup:
    deviations, opened, waived = (document.count("deviation"), document.count("open"), document.count("waived"))
    said = [plural(deviations, "deviation"), plural(opened, "open point")]
    for weight in ("robustness", "field problem"):
        if count := document.count(weight):
            said.append(plural(count, NOTED[weight]))
    said += [f"{waived} waived"] if waived else []
    facts = [
        ("site", document.site),
        ("for", document.customer),
        ("carried out by", document.by),
        ("checked", _span(document)),
        ("prepared", day(document.prepared)),
        ("devices", str(len(document.devices))),
    ]
    result = el("div", el("b", "Result: "), ", ".join(said), cls=f"result {'bad' if deviations or opened else 'good'}")
    remarks = el("div", el("b", "Remarks: "), document.remarks, cls="remarks") if document.remarks else Markup("")
    return el("header", el("h1", "Site acceptance"), _facts(facts), result, remarks)


def _span(document: Document) -> str:
    """Return the time from the first to the last action."""
    times = sorted(piece.when for device in document.devices for piece in device.pieces if piece.when)
    if not times:
        return ""
    first, last = day(times[0]), day(times[-1])
    return first if first == last else f"{first} to {last}"


def _facts(facts: list[tuple[str, str]]) -> Markup:
    return el("dl", [join([el("dt", name), el("dd", text)]) for name, text in facts if text])


# -- tables ----------------------------------------------------------------------------------------------------------------


def _grid(columns: tuple[str, ...], rows: list[list[object]], widths: tuple[int, ...] = ()) -> Markup:
    """Return a table; `widths` in per cent."""
    cells = [[el("td", cell if isinstance(cell, Markup) else str(cell)) for cell in row] for row in rows]
    sized = el("colgroup", [el("col", style=f"width:{width}%") for width in widths]) if widths else Markup("")
    head = el("thead", el("tr", [el("th", name) for name in columns]))
    return el("table", sized, head, el("tbody", [el("tr", row) for row in cells]))


def _devices(document: Document) -> Markup:
    rows: list[list[object]] = []
    for device in document.devices:
        done = [f"{HEADINGS[p.kind].lower()}: {p.verdict}" for p in device.pieces]
        found = sum(v.weight == "deviation" for p in device.pieces for v in p.deviations)
        rows.append(
            [
                str(device.number),
                join([[el("b", device.label), el("br")] if device.label else None, _where(device)]),
                device.type or "does not say",
                device.revision or "-",
                device.serial or Markup('<span class="blank"></span>'),
                join([[text, el("br")] for text in done]),
                str(found) if found else "none",
            ]
        )
    columns = ("no.", "device", "type", "revision", "serial number", "done", "deviations")
    return _grid(columns, rows, (5, 22, 19, 12, 14, 19, 9))


def _where(device: Device) -> Markup:
    return join([device.name, el("br"), el("span", device.endpoint, cls="mono")])


def _deviations(document: Document) -> Markup:
    found = document.deviations
    if not found:
        return el("p", "None. What was not checked stands in part 3.")
    rows = [
        _deviation(number, device, deviation)
        for number, (device, _, deviation) in enumerate(found[:MOST_DEVIATIONS], 1)
    ]
    columns = ("no.", "device", "what", "expected", "found", "weight", "decision")
    table = _grid(columns, rows, (5, 9, 22, 18, 24, 10, 12))
    more = len(found) - MOST_DEVIATIONS
    said = (
        "Decision: A accepted, C to be corrected, N not applicable; initials and date. A deviation contradicts what the "
        "standard or the reference requires. Robustness findings and known field problems contradict no clause."
    )
    return el(
        "div", el("p", said, cls="small"), table, el("p", f"and {more} more") if more > 0 else "", cls="deviations"
    )


def _deviation(number: int, device: Device, deviation: Deviation) -> list[object]:
    where = el("span", f"{deviation.where} ", cls="mono") if deviation.where else Markup("")
    source = join([el("br"), el("span", deviation.source, cls="small")]) if deviation.source else Markup("")
    who = f"{device.number}" + (f" {device.label}" if device.label else f" {device.name}")
    return [
        str(number), who, join([where, deviation.what, source]), deviation.expected, deviation.found,
        el("span", WORDS[deviation.weight], cls=f"weight {deviation.weight.split()[0]}"),
        Markup("&nbsp;") if deviation.weight == "waived" else Markup("☐ A &nbsp; ☐ C &nbsp; ☐ N"),
    ]  # fmt: skip


# -- actions -----------------------------------------------------------------------------------------------------------


def _device(device: Device) -> Markup:
    title = f"{device.number} {device.label or device.name}" + (f", {device.name}" if device.label else "")
    facts = [("at", device.endpoint), *sorted(device.identity.items()), ("serial number, as told", device.serial_said)]
    return el("section", el("h3", title), _facts(facts), [_piece(piece) for piece in device.pieces], cls="device")


def _piece(piece: Piece) -> Markup:
    good = piece.verdict in ("passed", "whole", "sampled", "met")
    said = el("span", piece.verdict, cls=f"verdict {'good' if good else 'bad'}")
    facts = [("when", day(piece.when)), ("by", piece.by), ("found", piece.summary), *piece.facts]
    return el(
        "div", el("h4", HEADINGS[piece.kind], ": ", said), _facts(facts), [_table(t) for t in piece.tables if t.rows]
    )


def _table(table: Table) -> Markup:
    rows: list[list[object]] = [list(row) for row in table.rows]
    more = el("p", f"and {table.left_out} more", cls="small") if table.left_out else ""
    return el(
        "div", el("h5", f"{table.title} ({len(rows) + table.left_out})"), _grid(table.columns, rows), more, cls="part"
    )


# -- files and signatures ------------------------------------------------------------------------------------------------------


def _files(document: Document) -> Markup:
    rows = [_file(source) for source in document.sources]
    return _grid(("file", "what", "when, by whom", "SHA-256"), rows, (22, 14, 22, 42))


def _file(source: Source) -> list[object]:
    when = day(source.when) + (f", {source.by}" if source.by else "")
    name = join([source.name, el("br"), el("span", f"{source.size} bytes", cls="small")])
    return [name, HEADINGS[source.kind], when, el("span", source.sha256, cls="mono")]


def _signatures(document: Document) -> Markup:
    roles = [("Carried out by", document.by), ("For the operator", document.customer), ("Witness", "")]
    boxes = [
        el(
            "div",
            el("div", cls="line"),
            el("b", role),
            el("div", name or Markup("&nbsp;")),
            el("div", "name, place, date, signature", cls="small"),
            cls="box",
        )
        for role, name in roles
    ]
    return el("div", boxes, cls="boxes")
