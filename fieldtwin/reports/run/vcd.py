"""A run as a value change dump (IEEE 1364-2005, clause 18), for GTKWave and other waveform viewers.

There is one scope for each device and bus, one for the variables of programs (``plc``), and one for faults. Numbers are
``real``, booleans a ``wire``, and words (states, decoded frames) a ``reg`` of ASCII characters, to be displayed as
such. A tag has a second variable for its quality (0 good, 1 substituted, 2 simulated, 3 uncertain, 4 bad); while it has
no value, its number keeps the last one, and the quality shows that it is not valid. Secret tags are left out.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TextIO

from vcd import VCDWriter

from fieldtwin.capture.decoding.decoder import Decoder
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.values import Quality
from fieldtwin.reports.markup import clean
from fieldtwin.results.model import Machine
from fieldtwin.results.trace import TraceEvent, TraceKind
from fieldtwin.twin.site.system import System

MOST_CHARACTERS = 48
"""Largest number of characters of a word; a longer word is cut and ends with a dot."""
_BITS = {"wire": 1, "real": 64, "reg": 8 * MOST_CHARACTERS}
"""Bits of each type of variable. A type can show the values of the types before it."""
_TYPES = tuple(_BITS)
_QUALITY_BITS = 3
_QUALITIES = {str(q): int(q) for q in Quality}


class VcdChange(NamedTuple):
    """A change of one variable. `quality`: the value is the number of a tag's quality, not the tag's value."""

    t_ns: int
    scope: str
    name: str
    value: Any
    quality: bool = False


def write_vcd(
    path: Path,
    events: Sequence[TraceEvent],
    system: System | None = None,
    machines: Sequence[Machine] = (),
    comment: str = "",
) -> None:
    """Write the events of a run. With `system`, frames are decoded. Raises `FileInvalid` if that is not possible."""
    try:
        with path.open("w", encoding="ascii", newline="\n") as file:
            _write(file, events, system, machines, comment)
    except OSError as e:
        raise FileInvalid(f"cannot write the waveforms: {e.strerror or e}", path=str(path)) from e


def _write(
    file: TextIO, events: Sequence[TraceEvent], system: System | None, machines: Sequence[Machine], comment: str
) -> None:
    changes = sorted(_changes(events, system, {m.variable: m for m in machines}), key=lambda c: c.t_ns)
    types: dict[str, dict[tuple[str, bool], str]] = {}
    for change in changes:
        members, key = types.setdefault(change.scope, {}), (change.name, change.quality)
        members[key] = max(members.get(key, "wire"), _type(change), key=_TYPES.index)
    about = " ".join(clean(comment).replace("$", " ").split()).encode("ascii", "replace").decode()
    with VCDWriter(file, "1 ns", date="", comment=about, version="fieldtwin") as writer:
        variables = {
            (scope, *key): (type_, writer.register_var(("run", in_file), name, type_, _bits(type_, quality=key[1])))
            for (scope, members), in_file in zip(types.items(), _identifiers(types), strict=True)
            for (key, type_), name in zip(members.items(), _identifiers(n for n, _ in members), strict=True)
        }
        for change in changes:
            type_, variable = variables[change.scope, change.name, change.quality]
            value = change.value if change.quality else _value(type_, change.value)
            if value is not None:
                writer.change(variable, change.t_ns, value)


def _changes(events: Iterable[TraceEvent], system: System | None, machines: dict[str, Machine]) -> Iterator[VcdChange]:
    decoder = Decoder(system) if system is not None else None
    devices = system.devices.values() if system is not None else ()
    secrets = {f"{d.name}.{t.name}" for d in devices for t in d.profile.tags.values() if t.secret}
    for event in events:
        data, t_ns = event.data, max(0, event.t_ns)
        match event.kind:
            case TraceKind.TAG:
                scope, _, name = event.where.rpartition(".")
                if data.get("value") is not None and event.where not in secrets:
                    yield VcdChange(t_ns, scope, name or "value", data["value"])
                yield VcdChange(
                    t_ns, scope, f"{name}_quality", _QUALITIES.get(data.get("quality", ""), 4), quality=True
                )
            case TraceKind.STATE:
                machine, value = machines.get(event.where), data.get("value")
                yield VcdChange(t_ns, "plc", event.where, machine.name_of(value) if machine else value)
            case TraceKind.ALARM:
                scope, _, name = event.where.rpartition(".")
                yield VcdChange(t_ns, scope, name, data.get("value"))
                yield VcdChange(
                    t_ns, scope, f"{name}_quality", _QUALITIES.get(data.get("quality", ""), 4), quality=True
                )
            case TraceKind.FAULT:
                yield VcdChange(t_ns, "faults", f"{event.where}_{data.get('name', '')}", bool(data.get("on")))
            case TraceKind.STEP:
                text = f"{event.where} {data.get('text', '')} {data.get('verdict', '')}"
                yield VcdChange(t_ns, "scenario", "step", text)
            case TraceKind.FRAME if decoder is not None:
                decoded = decoder.decode(event)
                yield VcdChange(t_ns, event.where, "sent" if data.get("dir") == "sent" else "received", decoded.text)
                for exchange in decoded.exchanges:
                    if exchange.latency_ns is not None:  # a request was still waiting for its answer
                        waiting = f"waiting_{exchange.unit}"
                        yield VcdChange(max(0, exchange.t_ns), event.where, waiting, True)
                        yield VcdChange(max(0, exchange.end_ns), event.where, waiting, False)
                    if exchange.problem:
                        yield VcdChange(t_ns, event.where, "problem", f"{exchange.device} {exchange.problem}")


def _type(change: VcdChange) -> str:
    if isinstance(change.value, bool):
        return "wire"
    return "real" if isinstance(change.value, int | float) and not change.quality else "reg"


def _bits(type_: str, *, quality: bool) -> int:
    return _QUALITY_BITS if quality else _BITS[type_]


def _value(type_: str, value: Any) -> bool | int | float | None:
    """Return what the file holds for `value`; None for a number that is not finite."""
    if type_ == "wire":
        return bool(value)
    if type_ == "real":
        try:
            return float(value) if math.isfinite(value) else None
        except OverflowError:
            return None
    text = str(value)
    text = text if len(text) <= MOST_CHARACTERS else text[: MOST_CHARACTERS - 1] + "."
    return int.from_bytes(text.encode("ascii", "replace"))


def _identifiers(names: Iterable[str]) -> Iterator[str]:
    """Return a name that every viewer accepts for each of `names`, with a number appended if it is already in use."""
    taken: set[str] = set()
    for name in names:
        plain = first = re.sub(r"[^A-Za-z0-9_]", "_", name) or "_"
        number = 2
        while plain in taken:
            plain = f"{first}_{number}"
            number += 1
        taken.add(plain)
        yield plain
