"""The buses of a system as SVG: the controller on the left, a line for each bus, its devices below the line.

One file that uses no external font, page or script. It draws its own background and follows the reader's light or dark theme;
emulated parts are dashed. The functions return text and write no file.
"""

from __future__ import annotations

from fieldtwin.reports.drawing.themes import themed
from fieldtwin.reports.drawing.wiring import DrawnBus, Station, Wiring
from fieldtwin.reports.markup import Child, Markup, el

CHAR = 7.25
"""Width of a character of the 12 px monospace face, in px."""
LINE = 16.0
EDGE = 20.0
ROOM = 1000.0
"""Largest width of a row of devices in px; further devices are drawn in another row."""
LONGEST = 44
WIRE, LOGIC = 90, 34
"""Maximum number of characters of a text: LONGEST in a device's box, WIRE next to a bus, LOGIC in the controller's box. A tooltip
shows the whole text.
"""

LIGHT = {
    "ground": "#fff", "ink": "#17233a", "soft": "#55627a", "box": "#f3f6fb", "edge": "#9fb0cb", "logic": "#fff8e8",
    "logic-edge": "#d1b06b", "line": "#2b5597", "emulated": "#a8500f",
}  # fmt: skip
DARK = {
    "ground": "#14181f", "ink": "#e8edf6", "soft": "#a3b0c5", "box": "#1f2733", "edge": "#4b5d7b", "logic": "#2c2718",
    "logic-edge": "#85713b", "line": "#7fb0f5", "emulated": "#f0a763",
}  # fmt: skip
RULES = """
svg.wires { font: 12px "DejaVu Sans Mono", ui-monospace, SFMono-Regular, Menlo, Consolas, monospace }
.ground { fill: var(--ground) } text { fill: var(--ink); white-space: pre } .name { font-weight: 600 } .soft { fill: var(--soft) }
.box { fill: var(--box); stroke: var(--edge) } .logic { fill: var(--logic); stroke: var(--logic-edge) }
.line { fill: none; stroke: var(--line); stroke-width: 2.5 } .port { fill: var(--line) }
.emulated { stroke: var(--emulated); stroke-dasharray: 6 4 } .says { fill: var(--emulated) }
.halo { stroke: var(--ground); stroke-width: 5; paint-order: stroke }
"""
STYLE = Markup(f"\n{themed(RULES, LIGHT, DARK)}\n")


def svg(wires: Wiring) -> str:
    """Return the drawing of `wires`, with a final line feed."""
    controller, left_width, left_height = _controller(wires)
    left = EDGE + left_width
    parts: list[Markup] = []
    y, right = EDGE + 26.0, left
    for wire in wires.wires:
        drawn, width, height = _wire(wire, left, y)
        parts.append(drawn)
        right, y = max(right, left + width), y + height + 22.0
    bottom = max(y - 22.0, EDGE + 26.0 + left_height)
    title = f"{wires.system}: {'prototype' if wires.prototype else 'plant'}"
    legend = "dashed: emulated" if any(wire.stand_in for wire in wires.wires) else ""
    right = max(right, EDGE + CHAR * (len(title) + len(legend) + 4))
    height, width = bottom + EDGE, right + EDGE
    frame = el("rect", cls="box", x=EDGE, y=EDGE + 26.0, width=left_width, height=bottom - EDGE - 26.0, rx=8)
    heads = [_text(EDGE, EDGE + 8.0, title, "name"), _text(right - CHAR * len(legend), EDGE + 8.0, legend, "says")]
    return document(title, width, height, heads, frame, controller, parts)


def document(title: str, width: float, height: float, *parts: Child) -> str:
    """Return a drawing as a complete file, with background and styles, and each element on its own line."""
    whole = el(
        "svg",
        el("title", title),
        el("style", STYLE),
        el("rect", cls="ground", width="100%", height="100%"),
        parts,
        cls="wires", viewBox=f"0 0 {width:.0f} {height:.0f}", width=f"{width:.0f}", height=f"{height:.0f}",
        role="img", xmlns="http://www.w3.org/2000/svg",
    )  # fmt: skip
    return str(whole).replace("/><", "/>\n<").replace("</text><", "</text>\n<") + "\n"


def _text(x: float, y: float, words: str, cls: str = "", most: int = LONGEST) -> Markup:
    if not words:
        return Markup("")
    if len(words) <= most:
        return el("text", words, x=x, y=y, cls=cls or None)
    return el("text", el("title", words), words[: most - 1] + "…", x=x, y=y, cls=cls or None)


def _width(rows: list[tuple[str, str]], most: int = LONGEST) -> float:
    return max((min(len(words), most) for words, _ in rows), default=0) * CHAR


def _lines(x: float, y: float, rows: list[tuple[str, str]], most: int = LONGEST) -> list[Markup]:
    """Return a text element for each (text, CSS class) of `rows`, below each other; the base line of the first one is at `y`."""
    return [_text(x, y + n * LINE, words, cls, most) for n, (words, cls) in enumerate(rows)]


def _controller(wires: Wiring) -> tuple[list[Markup], float, float]:
    """Return the content of the box on the left, and its width and smallest height: the gateway, its PLC, its servers."""
    logic: list[tuple[str, str]] = [("PLC", "name")]
    for program in wires.programs:
        logic += [
            (program.name, "name"), (program.source, ""), (f"{program.cycle}; {program.inputs} in, {program.outputs} out", "soft")
        ]  # fmt: skip
    served: list[tuple[str, str]] = []
    for server in wires.servers:
        served += [(f"serves {server.name}", "name"), (server.endpoint, ""), (server.offers, "soft")]
    width = max(_width(logic, LOGIC) + 20, _width(served, LOGIC)) + 24
    top = EDGE + 26.0
    x = EDGE + 12
    parts = [_text(x, top + 22, "gateway", "name")]
    tall = len(logic) * LINE + 14
    parts.append(el("rect", cls="logic", x=x, y=top + 34, width=width - 24, height=tall, rx=6))
    parts += _lines(x + 10, top + 34 + 19, logic, LOGIC)
    parts += _lines(x, top + 34 + tall + 26, served, LOGIC)
    return parts, width, 34 + tall + (26 + len(served) * LINE if served else 0) + 6


def _wire(wire: DrawnBus, left: float, top: float) -> tuple[Markup, float, float]:
    """Return a bus that starts at the controller's edge at `left`: the drawing, its width from there, its height."""
    dashed = " emulated" if wire.stand_in else ""
    head = [(f"{wire.name}  {wire.kind}" + (f", {wire.rate}" if wire.rate else ""), "name"), (wire.endpoint, "")]
    if wire.stand_in:
        head.append((f"→ {wire.stand_in}", "says"))
    rows = [_rows(station) for station in wire.stations]
    wide = max(map(_width, rows), default=0.0) + 20
    tall = max((len(row) for row in rows), default=0) * LINE + 12
    x0 = left + 40
    columns = max(1, min(len(rows) or 1, int((ROOM - x0) // (wide + 16))))
    parts = _lines(x0, top + 12, head, WIRE)
    y = top + 12 + (len(head) - 1) * LINE + 14
    first, step = y, 22 + tall + 16
    deepest = first
    for row in range(-(-len(rows) // columns)):
        here = rows[row * columns : (row + 1) * columns]
        deepest = y = first + row * step
        end = x0 + (len(here) - 1) * (wide + 16) + wide / 2
        start = left if row == 0 else left + 18
        parts.append(el("path", cls="line" + dashed, d=f"M{start:.1f},{y:.1f} H{end:.1f}"))
        for n, texts in enumerate(here):
            parts += _box(x0 + n * (wide + 16), y, wide, tall, texts, dashed)
    if deepest > first:
        parts.append(el("path", cls="line" + dashed, d=f"M{left + 18:.1f},{first:.1f} V{deepest:.1f}"))
    if not rows:
        parts.append(el("path", cls="line" + dashed, d=f"M{left:.1f},{y:.1f} H{x0 + 40:.1f}"))
    parts.append(el("circle", cls="port", cx=left, cy=first, r=5))
    width = max(40 + columns * (wide + 16) - 16, 40 + _width(head, WIRE))
    return el("g", parts), width, deepest - top + (22 + tall if rows else 10)


def _rows(station: Station) -> list[tuple[str, str]]:
    rows = [
        (station.name, "name"),
        (station.device, ""),
        (", ".join(filter(None, (station.address, station.asked))), "soft"),
    ]
    if station.writable:
        rows.append((f"written: {', '.join(station.writable)}", "soft"))
    if station.far:
        rows.append((f"⇅ {station.far}", "soft"))
    if station.plays:
        rows.append((f"= {station.plays}", "says"))
    return rows


def _box(x: float, y: float, width: float, tall: float, rows: list[tuple[str, str]], dashed: str) -> list[Markup]:
    """Return the box of a device below the bus line at `y`, and the line that connects it to the bus."""
    return [
        el("path", cls="line" + dashed, d=f"M{x + width / 2:.1f},{y:.1f} V{y + 22:.1f}"),
        el("rect", cls="box" + dashed, x=x, y=y + 22, width=width, height=tall, rx=6),
        *_lines(x + 10, y + 22 + 18, rows),
    ]
