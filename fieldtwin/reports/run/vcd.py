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
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from fieldtwin.capture.decoding.decoder import Decoder
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.values import Quality
from fieldtwin.reports.markup import clean
from fieldtwin.results.model import Machine
from fieldtwin.results.trace import Event, Kind
from fieldtwin.twin.site.system import System

MOST_CHARACTERS = 48
"""Characters of a word; a longer one is cut and ends with a dot."""
_QUALITY_BITS = 3
_QUALITIES = {str(q): int(q) for q in Quality}
_FIRST, _LAST = 33, 126  # printable characters, of which identifiers consist


@dataclass(slots=True)
class _Signal:
    """A declared variable: ``real``, ``wire`` of one bit, ``reg`` of `bits`."""

    kind: str
    bits: int
    id: str
    name: str
    last: str = ""


class _Signals:
    """All variables by scope and name, created when they are first seen.

    A first pass declares them, and a second one writes them.
    """

    def __init__(self) -> None:
        self.scopes: dict[str, dict[str, _Signal]] = {}
        self.plain: dict[str, str] = {}
        """The name of each scope in the file."""
        self._names: dict[str, set[str]] = {}
        self._count = 0

    def get(self, scope: str, name: str, value: Any, bits: int = 0) -> _Signal:
        if scope not in self.scopes:
            self.scopes[scope], self.plain[scope] = {}, self._free("scopes", scope)
        signals = self.scopes[scope]
        found = signals.get(name)
        kind = "reg" if bits else _kind(value)
        if found is None:
            found = signals[name] = _Signal(kind, bits or _bits(kind), self._next_id(), self._free(f".{scope}", name))
        elif kind == "reg" and found.kind != "reg" and not bits:
            found.kind, found.bits = "reg", _bits("reg")  # a word after numbers: the whole variable becomes words
        elif kind == "real" and found.kind == "wire":
            found.kind, found.bits = "real", 64
        return found

    def _free(self, within: str, name: str) -> str:
        """Return a name that viewers accept, with a number appended if it is already in use."""
        taken = self._names.setdefault(within, set())
        plain = _plain(name)
        number = 2
        while plain in taken:
            plain = f"{_plain(name)}_{number}"
            number += 1
        taken.add(plain)
        return plain

    def _next_id(self) -> str:
        number, text = self._count, ""
        self._count += 1
        while True:
            number, digit = divmod(number, _LAST - _FIRST + 1)
            text += chr(_FIRST + digit)
            if not number:
                return text
            number -= 1


Change = tuple[int, str, str, Any, int]
"""Time, scope, name, value, bits (0: derived from the value)."""


def write_vcd(
    path: Path,
    events: Sequence[Event],
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
    file: TextIO, events: Sequence[Event], system: System | None, machines: Sequence[Machine], comment: str
) -> None:
    names = {m.variable: m for m in machines}
    changes = sorted(_changes(events, system, names), key=lambda c: c[0])
    signals = _Signals()
    for _, scope, name, value, bits in changes:
        signals.get(scope, name, value, bits)
    _declare(file, signals, comment)
    now: int | None = None
    for t_ns, scope, name, value, _ in changes:
        signal = signals.scopes[scope][name]
        said = _change(signal, value)
        if said is None or said == signal.last:
            continue
        signal.last = said
        if t_ns != now:
            file.write(f"#{t_ns}\n")
            now = t_ns
        file.write(said + "\n")


def _declare(file: TextIO, signals: _Signals, comment: str) -> None:
    said = " ".join(clean(comment).replace("$", " ").split()).encode("ascii", "replace").decode()
    if said:
        file.write(f"$comment {said} $end\n")
    file.write("$version fieldtwin $end\n$timescale 1 ns $end\n$scope module run $end\n")
    for scope, members in signals.scopes.items():
        file.write(f"$scope module {signals.plain[scope]} $end\n")
        for signal in members.values():
            file.write(f"$var {signal.kind} {signal.bits} {signal.id} {signal.name} $end\n")
        file.write("$upscope $end\n")
    file.write("$upscope $end\n$enddefinitions $end\n#0\n$dumpvars\n")
    for members in signals.scopes.values():
        for signal in members.values():
            file.write({"real": f"r0 {signal.id}\n", "wire": f"x{signal.id}\n"}.get(signal.kind, f"bx {signal.id}\n"))
    file.write("$end\n")


def _changes(events: Iterable[Event], system: System | None, machines: dict[str, Machine]) -> Iterator[Change]:
    decoder = Decoder(system) if system is not None else None
    devices = system.devices.values() if system is not None else ()
    secrets = {f"{d.name}.{t.name}" for d in devices for t in d.profile.tags.values() if t.secret}
    for event in events:
        data, t_ns = event.data, max(0, event.t_ns)
        match event.kind:
            case Kind.TAG:
                scope, _, name = event.where.rpartition(".")
                if data.get("value") is not None and event.where not in secrets:
                    yield t_ns, scope, name or "value", data["value"], 0
                yield t_ns, scope, f"{name}_quality", _QUALITIES.get(data.get("quality", ""), 4), _QUALITY_BITS
            case Kind.STATE:
                machine, value = machines.get(event.where), data.get("value")
                yield t_ns, "plc", event.where, machine.name_of(value) if machine else value, 0
            case Kind.FAULT:
                yield t_ns, "faults", f"{event.where}_{data.get('name', '')}", bool(data.get("on")), 0
            case Kind.STEP:
                yield t_ns, "scenario", "step", f"{event.where} {data.get('text', '')} {data.get('verdict', '')}", 0
            case Kind.FRAME if decoder is not None:
                decoded = decoder.decode(event)
                yield t_ns, event.where, "sent" if data.get("dir") == "sent" else "received", decoded.text, 0
                for exchange in decoded.exchanges:
                    if exchange.latency_ns is not None:  # a request waited for its answer
                        yield max(0, exchange.t_ns), event.where, f"waiting_{exchange.unit}", True, 0
                        yield max(0, exchange.end_ns), event.where, f"waiting_{exchange.unit}", False, 0
                    if exchange.problem:
                        yield t_ns, event.where, "problem", f"{exchange.device} {exchange.problem}", 0


def _kind(value: Any) -> str:
    if isinstance(value, bool):
        return "wire"
    return "real" if isinstance(value, int | float) else "reg"


def _bits(kind: str) -> int:
    return {"wire": 1, "real": 64}.get(kind, 8 * MOST_CHARACTERS)


def _change(signal: _Signal, value: Any) -> str | None:
    """Return the line that sets `signal`; None if the value is not a finite number."""
    if signal.kind == "wire":
        return f"{int(bool(value))}{signal.id}"
    if signal.kind == "real":
        try:
            number = float(value) if isinstance(value, int | float) else math.nan
        except OverflowError:
            number = math.nan
        return f"r{number:.16g} {signal.id}" if math.isfinite(number) else None
    if signal.bits == _QUALITY_BITS:
        return f"b{int(value):b} {signal.id}"
    text = str(value)
    text = text if len(text) <= MOST_CHARACTERS else text[: MOST_CHARACTERS - 1] + "."
    raw = text.encode("ascii", "replace")
    return f"b{int.from_bytes(raw) if raw else 0:b} {signal.id}"


def _plain(name: str) -> str:
    """Return an identifier that every reader accepts."""
    return re.sub(r"[^A-Za-z0-9_]", "_", name) or "_"
