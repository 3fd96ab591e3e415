"""Coverage as tables of the HTML report: what was accessed, and always what was not."""

from __future__ import annotations

from collections import Counter

from fieldtwin.gateway.core.errors import ModbusExceptionReply
from fieldtwin.gateway.protocols.canopen.abort_codes import MEANINGS, meaning
from fieldtwin.reports.markup import Markup, el, join
from fieldtwin.reports.run.coverage import (
    DeviceCoverage,
    Place,
    aborts_missing,
    devices_covered,
    exceptions_missing,
)
from fieldtwin.results.model import Counts, Machine, Report

MOST_ROWS = 200
"""Rows of one table; the rest is counted."""


def coverage_section(report: Report, counts: Counts) -> Markup:
    """Return the section with everything that was counted."""
    parts: list[Markup] = []
    if report.system is not None:
        devices = devices_covered(report.system, counts)
        parts.append(el("h3", "Registers and objects"))
        parts += [_device(d) for d in devices]
    spoken = {b.endpoint.is_can for b in report.system.buses.values()} if report.system is not None else set()
    if False in spoken or counts.exceptions:
        missing, known = exceptions_missing(counts), len(ModbusExceptionReply.NAMES)
        parts.append(_codes("Modbus exception codes", counts.exceptions, _exception, missing, known))
    if True in spoken or counts.aborts:
        parts.append(_codes("SDO abort codes", counts.aborts, _abort, aborts_missing(counts), len(MEANINGS)))
    parts.append(_problems(counts))
    parts += [_transitions(machine, counts) for machine in report.machines]
    parts.append(_pairs(report, counts))
    return join(parts)


def _device(device: DeviceCoverage) -> Markup:
    read, able = device.share("read")
    written, writable = device.share("written")
    share = [_meter(read, able), f"{read} of {able} read"]
    if writable:
        share += [Markup(" &nbsp; "), _meter(written, writable), f"{written} of {writable} written"]
    missing = [p for p in device.places if p.missing]
    said = el("p", "Never: ", [_never(p) for p in missing[:40]], cls="small") if missing else Markup("")
    rows = [
        el(
            "tr", el("td", p.name), el("td", p.where, cls="mono"), _times(p.read, p.readable),
            _times(p.written, p.writable), el("td", str(p.refused) if p.refused else "", cls="num"),
        )
        for p in device.places[:MOST_ROWS]
    ]  # fmt: skip
    head = el(
        "tr", el("th", "tag"), el("th", "where"), *(el("th", t, cls="num") for t in ("read", "written", "failed"))
    )
    more = _more(len(device.places) - MOST_ROWS, "tags")
    others = [
        el("tr", el("td", where, cls="mono", colspan=2), el("td", str(n), cls="num")) for where, n in device.others
    ]
    table = el("table", el("thead", head), el("tbody", rows))
    beside = el("p", "Touched besides, by no name of the profile:", cls="small") if others else Markup("")
    rest = el("table", el("tbody", others[:MOST_ROWS])) if others else Markup("")
    return join(
        [
            el("h4", f"{device.device} ", el("span", device.profile, cls="none")), el("p", share, cls="small"), said,
            el("details", el("summary", f"{len(device.places)} tags"), el("div", table, cls="wide"), more, beside, rest),
        ]
    )  # fmt: skip


def _never(place: Place) -> Markup:
    return join([el("span", place.name, cls="missing"), f" ({' or '.join(place.missing)})  "])


def _times(count: int, able: bool) -> Markup:
    if not able:
        return el("td", "–" if not count else str(count), cls="num none")
    return el("td", str(count) if count else "never", cls="num" if count else "num missing")


def _meter(part: int, whole: int) -> Markup:
    return el("span", el("i", style=f"width:{100 * part // whole if whole else 0}%"), cls="meter")


def _exception(code: int) -> str:
    return f"{code:02X} {ModbusExceptionReply.NAMES.get(code, 'vendor specific')}"


def _abort(code: int) -> str:
    return f"{code:08X}h {meaning(code)}"


def _codes(title: str, seen: Counter[tuple[str, int]], show: object, missing: list[int], known: int) -> Markup:
    assert callable(show)
    by_code: dict[int, list[str]] = {}
    for (device, code), n in sorted(seen.items(), key=lambda item: (item[0][1], item[0][0])):
        by_code.setdefault(code, []).append(f"{device} {n}x")
    chips = [el("span", f"{show(code)}: {', '.join(said[:8])}") for code, said in by_code.items()]
    gaps = [el("span", show(code), cls="none") for code in missing]
    return join(
        [
            el("h3", title),
            el("p", f"{known - len(missing)} of {known} of the standard seen.", cls="small"),
            el("div", chips or el("span", "none was seen", cls="none"), cls="chips"),
            el(
                "details",
                el("summary", f"{len(missing)} never seen"),
                el("div", gaps, cls="chips"),
                open=len(missing) <= len(ModbusExceptionReply.NAMES),
            )
            if missing
            else "",
        ]
    )


def _problems(counts: Counts) -> Markup:
    rows = [
        el("tr", el("td", device), el("td", problem), el("td", str(n), cls="num"))
        for (device, problem), n in sorted(counts.problems.items())
    ]
    if not rows:
        said = "Nothing: every request was answered as asked." if counts.services else "No frame was seen."
        return join([el("h3", "What went wrong on the wires"), el("p", said)])
    head = el("tr", el("th", "device"), el("th", "what"), el("th", "times", cls="num"))
    return join(
        [
            el("h3", "What went wrong on the wires"), el("table", el("thead", head), el("tbody", rows[:MOST_ROWS]), cls="grid"),
            _more(len(rows) - MOST_ROWS, "rows"),
        ]
    )  # fmt: skip


def _transitions(machine: Machine, counts: Counts) -> Markup:
    """Return the table of transitions from each state (row) to each state (column): how often, never, or not in the
    machine's table.
    """
    taken = {(a, b): n for (variable, a, b), n in counts.transitions.items() if variable == machine.variable}
    known = list(dict.fromkeys([*machine.states, *(s for pair in taken for s in pair)]))
    rows = []
    for source in known:
        cells = []
        for target in known:
            n, possible = taken.get((source, target), 0), (source, target) in machine.transitions
            if n and not possible:
                cells.append(el("td", f"{n}, not in its table", cls="failed"))
            elif possible:
                cells.append(el("td", str(n) if n else "never", cls="passed" if n else "missing"))
            else:
                cells.append(el("td", "–", cls="none"))
        rows.append(el("tr", el("th", source, scope="row"), cells))
    done = sum(pair in taken for pair in machine.transitions)
    head = el("tr", el("th", "from \\ to"), [el("th", s) for s in known])
    return join(
        [
            el("h3", f"Transitions of {machine.variable}"),
            el("p", _meter(done, len(machine.transitions)), f"{done} of {len(machine.transitions)} taken", cls="small"),
            el("div", el("table", el("thead", head), el("tbody", rows), cls="grid"), cls="wide"),
        ]
    )


def _pairs(report: Report, counts: Counts) -> Markup:
    """Return the table of faults that were active in each state."""
    faults = list(dict.fromkeys([*report.faults, *sorted(counts.faults)]))
    columns = [(m.variable, s) for m in report.machines for s in m.states]
    title = el("h3", "Faults in states")
    if not faults:
        return join([title, el("p", "No faults were injected.")])
    columns += [(v, s) for _, v, s in sorted(counts.pairs) if (v, s) not in columns]
    columns = list(dict.fromkeys(columns))
    rows = []
    for fault in faults[:MOST_ROWS]:
        cells = []
        for variable, state in columns:
            n = counts.pairs.get((fault, variable, state), 0)
            cells.append(el("td", str(n) if n else "never", cls="passed" if n else "missing"))
        total = counts.faults.get(fault, 0)
        times = el("td", str(total) if total else "never", cls="" if total else "missing")
        rows.append(el("tr", el("th", fault, scope="row"), times, cells))
    head = el(
        "tr", el("th", "fault"), el("th", "injected"), [el("th", f"{v.partition('.')[0]} {s}") for v, s in columns]
    )
    seen = sum((f, v, s) in counts.pairs for f in faults for v, s in columns)
    whole = len(faults) * len(columns)
    return join(
        [
            title, el("p", _meter(seen, whole), f"{seen} of {whole} pairs", cls="small"),
            el("div", el("table", el("thead", head), el("tbody", rows), cls="grid"), cls="wide"),
            _more(len(faults) - MOST_ROWS, "faults"),
        ]
    )  # fmt: skip


def _more(count: int, what: str) -> Markup:
    return el("p", f"and {count} more {what}", cls="small") if count > 0 else Markup("")
