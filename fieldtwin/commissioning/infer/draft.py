"""Write a draft profile from inferred registers: valid for the profile reader, with the doubts as comments.

The draft must never sound more certain than the inference: guesses are marked, and a value of unknown type is drafted
register by register. Every register and bit that could be read has a tag, so that an emulator of the draft answers as the
device does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

from fieldtwin.commissioning.dump.coverage import STATE_KEYS, STATE_NAMES
from fieldtwin.commissioning.dump.file import Dump
from fieldtwin.commissioning.infer.fields import Interpretation, Level
from fieldtwin.commissioning.infer.infer import BIT_TABLES, Inference, Series
from fieldtwin.commissioning.infer.joint import toggled_bits
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.files.profile import DeviceProfile, RegisterRange, gap_text
from fieldtwin.gateway.core.files.profile_file import resolve
from fieldtwin.gateway.core.files.yaml_file import parse

MOST_BITS = 4000
_WRITABLE = "# to write: add `access: rw` to the tag, and 5, 6 or 16 to the functions"
FUNCTIONS = {"coil": 1, "discrete": 2, "holding": 3, "input": 4}


def draft_profile(inference: Inference, dumps: Sequence[Dump], name: str = "") -> str:
    """Return the YAML of a profile named ``draft/NAME``. Every tag's line states its certainty and the reason."""
    series, unit = inference.series, int(dumps[0].header["address"])
    slug = "".join(c if c.isalnum() and c.isascii() else "-" for c in name.lower()).strip("-") or f"unit-{unit}"
    lines = [
        "# Drafted by `fieldtwin infer`: the probable types of the registers. Check them in the manual, name tags, add units.",
        f"# {series.passes} passes over {series.span_s:.0f} s, {_day(series.times_s[0])}. "
        "certain: nothing else fits; likely: at least 80 %; guess: at least 50 %; unknown: less.",
        *_states(dumps),
        f"device: draft/{slug}",
        f'source: "drafted by fieldtwin infer from {len(dumps)} dump{"s" if len(dumps) > 1 else ""}"',
        "protocol: modbus",
        _factory(dumps[0].header, unit),
        "numbering: sent",
        *_limits(dumps, series),
    ]
    tags = [line for r in inference.readings for line in _tag(r)]
    bits, more_bits = _bits(series)
    if more_bits:
        lines.append(f"# left out: {more_bits} bits; an emulator of this draft refuses them")
    lines += ["tags:", *tags, *bits] if tags or bits else ["tags: {}"]
    return "\n".join(lines) + "\n"


def _factory(header: Mapping[str, Any], unit: int) -> str:
    """Return the line with the unit ID and, for a serial line, the settings with which the dump reached the device.

    If the passes come from a recording, the line has only the unit ID, because a recording does not state its endpoint.
    """
    endpoint = Endpoint.parse(header["endpoint"]) if "endpoint" in header else None
    stated = dict(endpoint.params) if endpoint is not None and endpoint.is_serial else {}
    settings = [f"{key}: {stated[key]}" for key in ("baudrate", "frame") if key in stated]
    return f"factory: {{{', '.join([*settings, f'unit: {unit}'])}}}"


def checked(text: str, path: Path) -> DeviceProfile:
    """Load the draft with the profile reader. Raises `FileInvalid` if the reader refuses it."""
    return resolve(parse(text, str(path)))


def tag_name(reading: Interpretation) -> str:
    """Return a preliminary name such as ``input_12``, for the user to replace."""
    return f"{reading.table}_{reading.address}"


def doubts(reading: Interpretation) -> str:
    """Return one line with the certainty of a reading, its alternatives, its values, and other remarks."""
    parts = [f"{reading.level}" if reading.level is Level.CERTAIN else f"{reading.level} ({_percent(reading)})"]
    if reading.level is Level.UNKNOWN:
        parts = [f"unknown, perhaps {reading.type} {reading.order} ({_percent(reading)})"]
    if reading.sign_open:
        parts.append(f"or {reading.type[1:]}, no sign was seen")
    if reading.level is not Level.CERTAIN:
        if reading.capped and reading.moves:
            parts.append(reading.capped)
        if reading.rivals and reading.rivals[0][3] >= 0.005:
            kind, address, order, share = reading.rivals[0]
            where = f" from {address} on" if address != reading.address else ""
            parts.append(f"else {kind} {order}{where} ({100 * share:.0f} %)")
    parts += reading.marks
    parts.append(_seen(reading))
    parts += reading.notes
    return "; ".join(p for p in parts if p)


def _percent(reading: Interpretation) -> str:
    return f"{min(99, int(100 * reading.probability))} %"


def _seen(reading: Interpretation) -> str:
    if reading.type == "string":
        return f"{reading.values[0]!r}".replace("#", "")
    numbers = [float(v) for v in reading.available]
    if not numbers:
        return "always NaN"
    low, high = min(numbers), max(numbers)
    return f"always {low:.6g}" if low == high else f"{low:.6g} to {high:.6g}"


def _tag(reading: Interpretation) -> list[str]:
    """Return the lines of the draft for one value. For a value of unknown type each of its registers becomes a plain number."""
    if reading.level is Level.UNKNOWN and reading.type != "uint16":
        return [
            f'  {reading.table}_{a}: {{at: "{reading.table}:{a}", type: uint16}}  # {doubts(reading)}'
            for a in range(reading.address, reading.address + reading.registers)
        ]
    keys = [f'at: "{reading.table}:{reading.address}"', f"type: {reading.type}"]
    if reading.order != "ABCD":
        keys.append(f"order: {reading.order}")
    if reading.type == "string":
        keys += [f"registers: {reading.registers}", "poll: identity"]
    if reading.scale != 1.0:
        keys.append(f"scale: {reading.scale:g}")
    if reading.sentinels:
        keys.append(f"sentinels: [{', '.join(f'0x{s:0{4 * reading.registers}X}' for s in reading.sentinels)}]")
    if {"counter", "seconds"} & set(reading.marks):
        keys.append("counter: true")
    if "enumeration" in reading.marks:
        states = sorted({int(v) for v in reading.values})
        keys.append("values: {" + ", ".join(f"{s}: state_{s}" for s in states) + "}")
    return [f"  {tag_name(reading)}: {{{', '.join(keys)}}}  # {doubts(reading)}", *_flags(reading)]


def _flags(reading: Interpretation) -> list[str]:
    """Return a line for each bit that changed, if the register is a status word: a tag of this bit."""
    if "bits" not in reading.marks:
        return []
    words = [int(v) & 0xFFFF for v in reading.values]
    lines = []
    for bit in toggled_bits(words):
        changes = sum((a ^ b) >> bit & 1 for a, b in pairwise(words))
        place = f'at: "{reading.table}:{reading.address}", bits: [{bit}, {bit}]'
        lines.append(f"  {tag_name(reading)}_bit_{bit}: {{{place}}}  # changed {changes} times")
    return lines


def _states(dumps: Sequence[Dump]) -> list[str]:
    """Return comments with the number of addresses in each state and the silent ranges, so that a user does not take silent
    addresses for refused ones.
    """
    lines = []
    for line in (m for d in dumps for m in d.maps.values() if "counts" in m):
        counts = line["counts"]
        parts = [f"{counts[key]} {name}" for key, name in zip(STATE_KEYS, STATE_NAMES, strict=True) if counts.get(key)]
        lines.append(f"# {line['map']}: {', '.join(parts)}")
        silent = [*line.get("silent", []), *(s["range"] for s in line.get("sampled", []) if s["state"] == "silent")]
        if silent:
            more = f" and {len(silent) - 6} more" if len(silent) > 6 else ""
            lines.append(
                f"#   the device is silent in {', '.join(silent[:6])}{more}; an emulator of this draft refuses"
            )
    return lines


def _bits(series: Series) -> tuple[list[str], int]:
    """Return a line with a tag for each coil and discrete input, at most `MOST_BITS`, and the number of omitted ones."""
    lines: list[str] = []
    left = 0
    for table in BIT_TABLES:
        for address, bits in series.cells.get(table, {}).items():
            if len(lines) >= MOST_BITS:
                left += 1
                continue
            changes = sum(a != b for a, b in pairwise(bits))
            seen = f"changed {changes} times" if changes else "always on" if any(bits) else "always off"
            lines.append(f'  {table}_{address}: {{at: "{table}:{address}", type: bool}}  # certain; {seen}')
    return lines, left


def _limits(dumps: Sequence[Dump], series: Series) -> list[str]:
    """Return the functions, read length and gaps that the dumps found, as lines of a profile."""
    maps = [m for d in dumps for m in d.maps.values()]
    words = [m for m in maps if m["map"] in ("holding", "input") and m.get("max_read")]
    proved = [int(m["max_read"]) for m in words if m.get("limit_proved")]
    keys = []
    if series.cells:
        keys.append(f"functions: {sorted(FUNCTIONS[t] for t in series.cells)}")
    if proved:
        keys.append(f"read_registers: {max(2, min(125, *proved, 125))}")
    if any(m.get("pairs") for m in words):
        keys.append("even_only: true")
    hint = f"  {_WRITABLE}" if series.cells.keys() & {"holding", "coil"} else ""
    lines = [f"limits: {{{', '.join(keys)}}}{hint}"] if keys else []
    gaps = _gaps(series)
    if gaps:
        lines.append("gaps: [" + ", ".join(f'"{g}"' for g in gaps) + "]")
    return lines


def _gaps(series: Series) -> list[str]:
    """Return the gaps between readable registers that are short enough to lie within one read."""
    gaps = []
    for table, cells in series.cells.items():
        known = sorted(cells)
        for before, after in pairwise(known):
            if 1 < after - before <= 125 and table in ("holding", "input"):
                gaps.append(gap_text(RegisterRange(table, before + 1, after - before - 1)))  # type: ignore[arg-type]
    return gaps


def _day(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M UTC")
