"""The buses of a system as lines of text, for a terminal or a pipe. It does not depend on the terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from fieldtwin.reports.drawing.wiring import DrawnBus, Logic, Server, Station, Wiring

Cells = tuple[str, ...]


def tree(wires: Wiring, columns: int = 1000) -> str:
    """Return a tree: the system, its buses with their devices, its programs, its servers.

    A line longer than `columns` characters is continued on the next line; it is broken between two entries.
    """
    branches: list[tuple[str, str, list[Cells]]] = [
        (wire.name, _wire_line(wire), [_station_cells(station) for station in wire.stations]) for wire in wires.wires
    ]
    if wires.programs:
        branches.append(("plc", "", [_logic_cells(logic) for logic in wires.programs]))
    if wires.servers:
        branches.append(("serve", "", [_server_cells(server) for server in wires.servers]))
    widest = max(len(name) for name, _, _ in branches)
    lines = [f"{wires.system} ({'prototype' if wires.prototype else 'plant'})"]
    for n, (name, told, leaves) in enumerate(branches):
        last = n == len(branches) - 1
        lines.append(f"{'└' if last else '├'}─ {name.ljust(widest)}  {told}".rstrip())
        lines += [("   " if last else "│  ") + leaf for leaf in _leaves(leaves, columns - 3)]
    return "\n".join(lines) + "\n"


def _leaves(rows: Sequence[Cells], columns: int) -> Iterator[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)] if rows else []
    for n, row in enumerate(rows):
        last = n == len(rows) - 1
        line = "└─ " if last else "├─ "
        for cell, width in zip(row, widths, strict=True):
            if not width or (not cell and len(line) + width >= columns):
                continue
            if len(line) + len(cell) > columns and cell is not row[0]:
                yield line.rstrip()
                line = "    " if last else "│   "
            line += cell.ljust(width) + "  "
        yield line.rstrip()


def _wire_line(wire: DrawnBus) -> str:
    place = f"{wire.endpoint}  →  {wire.stand_in}" if wire.stand_in else wire.endpoint
    return f"{place}, {wire.rate}" if wire.rate else place


def _station_cells(station: Station) -> Cells:
    told = [station.asked, f"writes {', '.join(station.writable)}" if station.writable else "", station.far]
    plays = f"= {station.plays}" if station.plays else ""
    return station.name, station.address, station.device, plays, "; ".join(filter(None, told))


def _logic_cells(logic: Logic) -> Cells:
    return logic.name, logic.source, logic.cycle, f"{logic.inputs} in, {logic.outputs} out"


def _server_cells(server: Server) -> Cells:
    return server.name, server.endpoint, server.offers
