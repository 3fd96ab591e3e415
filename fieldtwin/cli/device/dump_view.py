"""A dump on the terminal: the estimate, the progress and the result."""

from __future__ import annotations

from datetime import timedelta
from itertools import groupby, pairwise
from typing import Any

from rich.table import Table
from rich.text import Text

from fieldtwin.commissioning.dump.coverage import STATE_KEYS, STATE_NAMES
from fieldtwin.commissioning.dump.file import Dump
from fieldtwin.commissioning.dump.session import Estimate
from fieldtwin.gateway.core.errors import ModbusExceptionReply
from fieldtwin.gateway.core.files.profile import gap_text, resolve_gap

FUNCTION_NAMES = {
    1: "read coils", 2: "read discrete inputs", 3: "read holding registers", 4: "read input registers",
    7: "exception status", 8: "diagnostics (loopback)", 11: "event counter", 12: "event log", 17: "server id",
    43: "device identification",
}  # fmt: skip


LONG_S = 60.0
"""In seconds. The estimate of a dump that can take longer also states how to make the dump shorter."""


def estimate_text(estimate: Estimate, passes: int, rate: float) -> str:
    """Return one line that estimates a dump before anything is sent; for a long dump it also states how to make it shorter."""
    low, high = estimate.least_requests, estimate.most_requests
    requests = f"{low}" if low == high else f"{low} to {high}"
    text = f"{requests} requests, {_time(estimate.least_s)}"
    if _time(estimate.least_s) != _time(estimate.most_s):
        text += f" to {_time(estimate.most_s)}"
    text += f" at {rate:g} a second at most" if rate else ""
    text += f"; then {passes - 1} more passes" if passes > 1 else ""
    if estimate.budgets_s:
        text += f"; up to {_time(estimate.budgets_s)} more in unreadable ranges (--budget)"
    text += ". Ctrl-C stops; --resume continues"
    if estimate.most_s > LONG_S:
        text += f". It is shorter with {estimate.shorter}" + (", or with a higher --rate" if rate else "")
    return text


def _time(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds < 10 else str(timedelta(seconds=round(seconds)))


def summary(dump: Dump) -> list[Table | Text]:
    """Return the tables and texts that describe a finished dump."""
    shown: list[Table | Text] = []
    if dump.protocol == "modbus":
        shown += [_maps(dump), _functions(dump)]
    else:
        shown.append(Text(_objects(dump)))
        if indexes := object_indexes(dump):
            shown.append(Text(f"readable: {', '.join(indexes)}"))
    if dump.latency:
        shown.append(_latency(dump.latency))
    shown += [Text(line) for line in notes(dump)]
    return shown


def notes(dump: Dump) -> list[str]:
    """Return notes about a dump for the user, including the gaps to copy into a profile."""
    lines: list[str] = []
    gaps = profile_gaps(dump)
    if gaps:
        lines.append("for a profile:  gaps: [" + ", ".join(f'"{g}"' for g in gaps) + "]")
    if (same := mirrored(dump)) is not None:
        lines.append(f"holding and input registers are equal at all {same} common addresses")
    lines += [f"{m['map']}: not every address was read: {m['stopped']}" for m in dump.maps.values() if m.get("stopped")]
    lines += [text for m in dump.maps.values() if (text := _lengths_text(m))]
    if dump.unknown[0]:
        lines.append(unknown_text(dump))
    if len(dump.passes) > 1:
        first, last = dump.passes[0], dump.passes[-1]
        changed = sum(first.cells.get(cell) != value for cell, value in last.cells.items())
        lines.append(
            f"{len(dump.passes)} passes; {changed} of {len(last.cells)} values differ from the first to the last"
        )
        lines += [
            f"pass {n + 1}: {p.failed} reads returned no values" for n, p in enumerate(dump.passes) if n and p.failed
        ]
    return lines


def unknown_text(dump: Dump) -> str:
    """Return one line about what the dump leaves unknown."""
    unknown, asked_for = dump.unknown
    what = "addresses" if dump.protocol == "modbus" else "objects"
    where = [text for m in dump.maps.values() for text in m.get("unknown", [])]
    shown = f": {', '.join(where[:6])}" + (f" and {len(where) - 6} more" if len(where) > 6 else "") if where else ""
    return f"unknown: {unknown} of {asked_for} {what} (no reply, no valid reply, or not asked){shown}"


def _lengths_text(line: dict[str, Any]) -> str:
    """Return a sentence about the limits of a sampled dump of a register table; "" for a dump without such limits."""
    if line["map"] not in ("holding", "input") or line.get("function_refused") or not line.get("sampled"):
        return ""
    missing = [n for n in (1, 2) if n not in line.get("lengths", [])]
    if not missing:
        return ""
    texts = " and ".join("single registers" if n == 1 else "pairs" for n in missing)
    return f"{line['map']}: {texts} were not asked for everywhere: blocks that accept only these lengths may be missing"


def _objects(dump: Dump) -> str:
    """Return as text how many objects are in each state."""
    if (line := dump.maps.get("objects")) is None:
        last = dump.passes[-1]
        return f"{len(last.cells)} objects read, {len(set(last.refused) - set(last.cells))} refused"
    counts = line["counts"]
    parts = [f"{counts[key]} {name}" for key, name in zip(STATE_KEYS[2:], STATE_NAMES[2:], strict=True) if counts[key]]
    parts += [f"{counts['not_asked']} not asked"] if counts["not_asked"] else []
    return ", ".join([f"{counts['readable']} objects read", *parts])


def object_indexes(dump: Dump) -> list[str]:
    """Return the indexes of a CANopen node's readable objects: ``1000h``, or ``1008h..100Ah`` for consecutive ones."""
    found = sorted({int(index) for index, _ in (dump.passes[0].cells if dump.passes else ())})
    texts = []
    for _, group in groupby(enumerate(found), key=lambda placed: placed[1] - placed[0]):
        run = [index for _, index in group]
        texts.append(f"{run[0]:04X}h" + (f"..{run[-1]:04X}h" if len(run) > 1 else ""))
    return texts


def profile_gaps(dump: Dump) -> list[str]:
    """Return the ranges between readable registers that a read must not include, as a profile writes them (`gaps`)."""
    gaps = []
    for line in dump.maps.values():
        readable = [resolve_gap(text, "sent") for text in line.get("readable", [])]
        for before, after in pairwise(readable):
            if 0 < after.address - before.end <= 125:
                gaps.append(gap_text(type(before)(before.table, before.end, after.address - before.end)))
    return gaps


def mirrored(dump: Dump) -> int | None:
    """Return how many addresses both register tables have, if all their values are equal and not all 0; else None.

    Fewer than 8 common addresses also give None.
    """
    cells = dump.passes[0].cells if dump.passes else {}
    both = [(v, cells[("input", a)]) for (t, a), v in cells.items() if t == "holding" and ("input", a) in cells]
    if len(both) < 8 or not any(any(v) for v, _ in both) or any(v != w for v, w in both):
        return None
    return len(both)


def _maps(dump: Dump) -> Table:
    table = Table(box=None, pad_edge=False, show_header=False)
    for overflow in ("fold", "fold", "fold"):
        table.add_column(overflow=overflow)
    for line in dump.maps.values():
        rows = state_rows(line)
        if line["max_read"]:
            rows.append(("longest read", longest_text(line)))
        for i, (what, text) in enumerate(rows):
            table.add_row(Text("" if i else str(line["map"]), "bold"), what, Text(text))
    return table


def longest_text(line: dict[str, Any]) -> str:
    """Return the longest read that the device accepted, and whether it refused a longer one."""
    text = str(line["max_read"]) if line["limit_proved"] else f"{line['max_read']} or more"
    return text + (", pairs only" if line.get("pairs") else "")


def state_rows(line: dict[str, Any]) -> list[tuple[str, str]]:
    """Return ``(state, where)`` for each state of addresses; for a sampled range, also the number of samples."""
    rows = []
    for key, name in ((key, STATE_NAMES[STATE_KEYS.index(key)]) for key in (*STATE_KEYS[1:], STATE_KEYS[0])):
        sampled = [s for s in line.get("sampled", []) if key in (s["state"], "not_asked")]
        texts = {text: short(text) for text in line.get(key, [])}
        for s in sampled:
            count = s["asked"] if key != "not_asked" else s["addresses"] - s["asked"]
            texts[s["range"]] = f"{count} of {short(s['range'])}"
        if not texts:
            continue
        where = [texts[t] for t in sorted(texts, key=lambda t: int(short(t).partition(".")[0]))]
        text = ", ".join(where[:8]) + (f" and {len(where) - 8} more" if len(where) > 8 else "")
        if key == "refused" and line.get("codes"):
            text += " (" + ", ".join(f"exception {code}h x {n}" for code, n in line["codes"].items()) + ")"
        rows.append((name, text))
    if line.get("function_refused"):
        rows.append(("function", "refused with exception 01h"))
    return rows


def short(text: str) -> str:
    """Return a range such as ``holding:0..9`` without the table's name."""
    return text.partition(":")[2]


def _functions(dump: Dump) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("function", "", "access"):
        table.add_column(name, overflow="fold")
    numbers = {"coil": 1, "discrete": 2, "holding": 3, "input": 4}
    for line in sorted(dump.maps.values(), key=lambda m: numbers[m["map"]]):
        number = numbers[line["map"]]
        access = _table_access(line)
        table.add_row(f"{number:02X}h", FUNCTION_NAMES[number], access)
    for number, line in sorted(dump.functions.items()):
        table.add_row(f"{number:02X}h", FUNCTION_NAMES.get(number, ""), Text(_access(line)))
    return table


def _table_access(line: dict[str, Any]) -> str:
    """Return as text whether the device answers the function that reads a table."""
    if line["readable"]:
        return "answers"
    if line["codes"]:
        code = max(line["codes"], key=lambda c: line["codes"][c])
        return f"every answer was refusal {code}h"
    if line["invalid"]:
        return "no valid reply"
    return "no reply" if line["silent"] or line["sampled"] else "not asked"


def _access(line: dict[str, Any]) -> str:
    if "hex" in line:
        raw = bytes.fromhex(line["hex"])
        text = raw.decode("ascii", errors="replace")
        shown = "".join(c if c.isprintable() and c.isascii() else "." for c in text)
        return f"answers {raw[:24].hex(' ')}" + (f"  {shown!r}" if sum(map(str.isalnum, shown)) >= 4 else "")
    if "code" in line:
        name = ModbusExceptionReply.NAMES.get(line["code"], "vendor specific")
        return f"refused with {line['code']:02X}h ({name})"
    return "no valid reply" if "invalid" in line else "no reply"


def _latency(latency: dict[str, Any]) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("latency", "answers", "least", "half", "95 %", "most", "from 10 us to 100 s"):
        table.add_column(name, justify="left" if name.startswith(("lat", "from")) else "right")
    for name, h in latency.items():
        ms = [f"{h[key] / 1000:.1f} ms" for key in ("least_us", "p50_us", "p95_us", "most_us")]
        table.add_row(name + ("h" if name != "SDO" else ""), str(h["count"]), *ms, _bars(h["buckets"]))
    return table


def _bars(buckets: list[tuple[int | None, int]], width: int = 35) -> str:
    """Return a histogram as a line of block characters, each for two buckets; the one at position `width` is for all larger
    values.
    """
    heights = [0] * (width + 1)
    for bound, count in buckets:
        place = width if bound is None else min(width, round((len(str(bound)) - 2) * 5 + _fifth(bound)))
        heights[place] += count
    most = max(heights) or 1
    marks = " ▁▂▃▄▅▆▇█"
    return "".join(marks[-(-8 * h // most)] for h in heights).rstrip()


def _fifth(bound: int) -> float:
    """Return in which fifth of its decade a bound lies, 0 to 4, on a logarithmic scale."""
    lead = bound / 10.0 ** (len(str(bound)) - 1)
    return min(4.0, float(sum(lead >= step for step in (1.5, 2.4, 3.9, 6.2))))
