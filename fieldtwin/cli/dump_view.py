"""What a person sees of a dump: what it will take, how far it is, what was found."""

from __future__ import annotations

from datetime import timedelta
from itertools import pairwise
from typing import Any

from rich.table import Table
from rich.text import Text

from fieldtwin.commissioning.dump_file import Dump
from fieldtwin.commissioning.dumping import Estimate
from gateway.core.errors import ModbusExceptionReply
from gateway.core.profile import gap_text, resolve_gap

FUNCTION_NAMES = {
    1: "read coils", 2: "read discrete inputs", 3: "read holding registers", 4: "read input registers",
    7: "exception status", 8: "diagnostics (loopback)", 11: "event counter", 12: "event log", 17: "server id",
    43: "device identification",
}  # fmt: skip


def estimate_text(estimate: Estimate, passes: int, rate: float) -> str:
    """One line before anything is sent."""
    low, high = estimate.least_requests, estimate.most_requests
    requests = f"{low}" if low == high else f"{low} to {high}"
    text = f"{requests} requests, {_time(estimate.least_s)}"
    if _time(estimate.least_s) != _time(estimate.most_s):
        text += f" to {_time(estimate.most_s)}"
    text += f" at {rate:g} a second at most" if rate else ""
    return text + (f"; then {passes - 1} passes more" if passes > 1 else "") + ". Ctrl-C stops; --resume goes on"


def _time(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds < 10 else str(timedelta(seconds=round(seconds)))


def summary(dump: Dump) -> list[Table | Text]:
    """The tables of a dump that is there."""
    shown: list[Table | Text] = []
    if dump.protocol == "modbus":
        shown += [_maps(dump), _functions(dump)]
    else:
        last = dump.passes[-1]
        shown.append(Text(f"{len(last.cells)} objects read, {len(set(last.refused) - set(last.cells))} refused"))
    if dump.latency:
        shown.append(_latency(dump.latency))
    shown += [Text(line) for line in notes(dump)]
    return shown


def notes(dump: Dump) -> list[str]:
    """What is worth saying besides, for people and the profile."""
    lines = []
    gaps = profile_gaps(dump)
    if gaps:
        lines.append("for a profile:  gaps: [" + ", ".join(f'"{g}"' for g in gaps) + "]")
    if (same := mirrored(dump)) is not None:
        lines.append(f"holding and input registers are the same at all {same} addresses that both have")
    lines += [f"{m['map']}: given up, {m['given_up']}" for m in dump.maps.values() if m.get("given_up")]
    if len(dump.passes) > 1:
        first, last = dump.passes[0], dump.passes[-1]
        changed = sum(first.cells.get(cell) != value for cell, value in last.cells.items())
        lines.append(
            f"{len(dump.passes)} passes; {changed} of {len(last.cells)} values differ from the first to the last"
        )
    return lines


def profile_gaps(dump: Dump) -> list[str]:
    """The ranges between readable registers that no read may go over, as a profile has them."""
    gaps = []
    for line in dump.maps.values():
        readable = [resolve_gap(text, "sent") for text in line.get("readable", [])]
        bad = [resolve_gap(text, "sent") for text in [*line.get("holes", []), *line.get("voids", [])]]
        for before, after in pairwise(readable):
            if after.address - before.end <= 125 and any(before.end <= b.address < after.address for b in bad):
                gap = type(before)(before.table, before.end, after.address - before.end)
                gaps.append(gap_text(gap))
    return gaps


def mirrored(dump: Dump) -> int | None:
    """How many addresses hold the same in both register tables, if all that both have do and something is in them."""
    cells = dump.passes[0].cells if dump.passes else {}
    both = [(v, cells[("input", a)]) for (t, a), v in cells.items() if t == "holding" and ("input", a) in cells]
    if len(both) < 8 or not any(any(v) for v, _ in both) or any(v != w for v, w in both):
        return None
    return len(both)


def _maps(dump: Dump) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("table", "readable", "refused", "longest read", "exceptions"):
        table.add_column(name, overflow="fold")
    for line in dump.maps.values():
        longest = str(line["max_read"]) if line["limit_proved"] else f"{line['max_read']} (or more)"
        if line.get("pairs"):
            longest += ", pairs only"
        codes = ", ".join(f"{code}h x {n}" for code, n in line.get("codes", {}).items())
        table.add_row(
            Text(str(line["map"])),
            Text(_spans(line["readable"]) or "nothing"),
            Text(_spans([*line["holes"], *(f"~{v}" for v in line["voids"])])),
            Text(longest if line["max_read"] else ""),
            Text(codes),
        )
    return table


def _spans(texts: list[str], most: int = 8) -> str:
    """Ranges without the table's name; ``~`` stands before what was asked here and there only."""
    short = sorted(texts, key=lambda t: int(t.partition(":")[2].partition(".")[0]))
    shown = [("~" if t.startswith("~") else "") + t.partition(":")[2] for t in short[:most]]
    return ", ".join(shown) + (f" and {len(texts) - most} more" if len(texts) > most else "")


def _functions(dump: Dump) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("function", "", "access"):
        table.add_column(name, overflow="fold")
    numbers = {"coil": 1, "discrete": 2, "holding": 3, "input": 4}
    for line in sorted(dump.maps.values(), key=lambda m: numbers[m["map"]]):
        number = numbers[line["map"]]
        code = max(line.get("codes", {"": 0}), key=lambda c: line["codes"][c], default="")
        access = "answers" if line["readable"] else f"refused with {code}h" if code else "no reply"
        table.add_row(f"{number:02X}h", FUNCTION_NAMES[number], access)
    for number, line in sorted(dump.functions.items()):
        table.add_row(f"{number:02X}h", FUNCTION_NAMES.get(number, ""), Text(_access(line)))
    return table


def _access(line: dict[str, Any]) -> str:
    if "hex" in line:
        raw = bytes.fromhex(line["hex"])
        text = raw.decode("ascii", errors="replace")
        shown = "".join(c if c.isprintable() and c.isascii() else "." for c in text)
        return f"answers {raw[:24].hex(' ')}" + (f"  {shown!r}" if sum(map(str.isalnum, shown)) >= 4 else "")
    if "code" in line:
        name = ModbusExceptionReply.NAMES.get(line["code"], "vendor specific")
        return f"refused with {line['code']:02X}h ({name})"
    return "no reply"


def _latency(latency: dict[str, Any]) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("latency", "answers", "least", "half", "95 %", "most", "from 10 us to 100 s"):
        table.add_column(name, justify="left" if name.startswith(("lat", "from")) else "right")
    for name, h in latency.items():
        ms = [f"{h[key] / 1000:.1f} ms" for key in ("least_us", "p50_us", "p95_us", "most_us")]
        table.add_row(name + ("h" if name != "SDO" else ""), str(h["count"]), *ms, _bars(h["buckets"]))
    return table


def _bars(buckets: list[tuple[int | None, int]], width: int = 35) -> str:
    """A histogram in `width` characters, two buckets each."""
    heights = [0] * (width + 1)
    for bound, count in buckets:
        place = width if bound is None else min(width, round((len(str(bound)) - 2) * 5 + _fifth(bound)))
        heights[place] += count
    most = max(heights) or 1
    marks = " ▁▂▃▄▅▆▇█"
    return "".join(marks[-(-8 * h // most)] for h in heights).rstrip()


def _fifth(bound: int) -> float:
    """Where in its decade a bound stands, 0 to 4."""
    lead = bound / 10.0 ** (len(str(bound)) - 1)
    return min(4.0, float(sum(lead >= step for step in (1.5, 2.4, 3.9, 6.2))))
