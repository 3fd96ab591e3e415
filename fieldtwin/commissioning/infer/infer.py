"""Infer the meaning of registers from several dumps of one unit.

The inference has two passes: the byte orders that the device seems to use are learnt in the first, and weight the readings in
the second. A single float is never certain: it cannot be distinguished from a large integer that rises and falls. Several
floats can. This module must never see a profile.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from fieldtwin.commissioning.dump.file import Dump
from fieldtwin.commissioning.infer.calibration import calibrated, kind_of
from fieldtwin.commissioning.infer.costs import ORDER_COST, decode_series
from fieldtwin.commissioning.infer.fields import (
    LIKELY,
    Interpretation,
    Run,
    infer_run,
    run_of,
    runs_of,
    with_absent_floats,
)
from fieldtwin.commissioning.infer.marks import clock_fields, marked, with_scales
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import FileInvalid

FLOCK = 3
"""Number of floats of one word order from which on they support each other as evidence that the device uses floats."""
PRIOR_WEIGHT = 4.0
"""Weight of the general knowledge about byte orders of devices, expressed as a number of registers of this device."""
SINGLE_COST = 7.0
"""Cost of a value of one register where the device has pairs only."""
REGISTER_TABLES, BIT_TABLES = ("holding", "input"), ("coil", "discrete")


@dataclass(frozen=True, slots=True)
class Series:
    """The history of registers and bits: for each table and address one word (or bit) per pass. It contains only those that
    every pass has.
    """

    times_s: tuple[float, ...]
    cells: Mapping[str, Mapping[int, Sequence[int]]]
    pairs: frozenset[str] = frozenset()
    """Tables in which the device only permits reads of register pairs, so that each value takes two registers."""

    @property
    def passes(self) -> int:
        return len(self.times_s)

    @property
    def span_s(self) -> float:
        return self.times_s[-1] - self.times_s[0]


@dataclass(frozen=True, slots=True)
class Inference:
    """The result of `infer`: the readings of the registers, in the order of tables and addresses, and the cost of each byte
    order on this device. The bits are only in `series`.
    """

    series: Series
    readings: tuple[Interpretation, ...]
    orders: Mapping[str, float]


def series_of(dumps: Sequence[Dump]) -> Series:
    """Return all passes of all dumps, in the order of their times.

    Raises `FileInvalid` if they are not of one Modbus unit, or have no registers and bits in common.
    """
    for dump in dumps:
        if dump.protocol != "modbus":
            raise FileInvalid(
                "a dump of a CANopen node: `infer` only reads dumps of Modbus registers",
                path=dump.path,
                hint="the node's EDS states the types; without one, try a type: `fieldtwin read ... 2000:01 --type float32`",
            )
        if dump.header.get("address") != dumps[0].header.get("address"):
            raise FileInvalid("dumps of two units", path=dump.path, expected=f"unit {dumps[0].header.get('address')}")
    passes = sorted((p for d in dumps for p in d.passes if p.cells), key=lambda p: p.utc_ns)
    if dumps and not all(d.ended for d in dumps) and len(passes) > 1:
        most = max(len(p.cells) for p in passes)
        # with an interrupted pass there may be no common cells
        passes = [p for p in passes if len(p.cells) >= 0.9 * most]
    if not passes:
        raise FileInvalid("a dump without values", path=dumps[0].path if dumps else "")
    common = set(passes[0].cells)
    for later in passes[1:]:
        common &= later.cells.keys()
    cells: dict[str, dict[int, list[int]]] = {}
    for cell in sorted(common, key=str):
        table, address = str(cell[0]), int(cell[1])
        cells.setdefault(table, {})[address] = [int.from_bytes(p.cells[cell]) for p in passes]
    pairs = frozenset(table for d in dumps for table, m in d.maps.items() if m.get("pairs"))
    return Series(tuple(p.utc_ns / NS_PER_S for p in passes), cells, pairs)


def without_repetitions(series: Series) -> Series:
    """Return the passes in which some register differs from the pass before.

    A device that is read faster than it measures repeats its values, and repetitions are not evidence.
    """
    columns = [words for table in REGISTER_TABLES for words in series.cells.get(table, {}).values()]
    kept = [i for i in range(series.passes) if i == 0 or any(w[i] != w[i - 1] for w in columns)]
    if len(kept) in (1, series.passes):
        return series
    cells = {t: {a: [w[i] for i in kept] for a, w in ws.items()} for t, ws in series.cells.items()}
    return Series(tuple(series.times_s[i] for i in kept), cells, series.pairs)


def infer(series: Series) -> Inference:
    """Infer the meaning of the registers. The function does no I/O and takes a few milliseconds per register."""
    seen = without_repetitions(series)
    tables = [(table, seen.cells.get(table, {})) for table in REGISTER_TABLES]
    clocks, runs = [], []
    for table, cells in tables:
        for address, words in runs_of(cells):
            found = clock_fields(table, address, words, seen.times_s)
            clocks += found
            runs += [run_of(table, *part) for part in _between(address, words, found)]
    first = _look(runs, ORDER_COST, seen.pairs)
    orders = _orders_kept(first)
    usual = [order for order, count in _floats(first).items() if count >= FLOCK]
    runs = [with_absent_floats(run, usual) for run in runs]
    readings = with_scales([_marked(r, series) for r in _look(runs, orders, seen.pairs)])
    readings = [_as_observed(r) for r in _supported(readings)]
    readings = sorted([*readings, *clocks], key=lambda r: (r.table, r.address))
    return Inference(series, tuple(readings), orders)


def _between(
    address: int, words: Sequence[Sequence[int]], clocks: Sequence[Interpretation]
) -> list[tuple[int, Sequence[Sequence[int]]]]:
    """Return the parts of a block of consecutive registers that do not belong to a clock."""
    taken = {r.address - address for r in clocks}
    parts: list[tuple[int, list[Sequence[int]]]] = []
    for i, word in enumerate(words):
        if i in taken:
            continue
        if parts and parts[-1][0] + len(parts[-1][1]) == address + i:
            parts[-1][1].append(word)
        else:
            parts.append((address + i, [word]))
    return [(first, rows) for first, rows in parts]


def _look(runs: Sequence[Run], orders: Mapping[str, float], pairs: frozenset[str]) -> list[Interpretation]:
    return [r for run in runs for r in infer_run(run, orders, SINGLE_COST if run.table in pairs else 0.0)]


def _marked(reading: Interpretation, series: Series) -> Interpretation:
    """Return the reading with the marks and notes from all passes. Repetitions are included, because the time that a state is
    held matters.
    """
    if reading.type == "string":
        return reading
    columns = [series.cells[reading.table][reading.address + i] for i in range(reading.registers)]
    values = decode_series(list(zip(*columns, strict=True)), reading.type, reading.order)
    seen = marked(replace(reading, values=tuple(values or reading.values)), series.times_s)
    return replace(reading, marks=seen.marks, notes=seen.notes)


def _as_observed(reading: Interpretation) -> Interpretation:
    """Return the reading with its calibrated probability: the observed share of correct readings on generated maps."""
    kind = kind_of(reading.type, reading.registers, moves=reading.moves, capped=reading.capped)
    share = calibrated(reading.probability, kind)
    left = (1 - share) / max(1e-9, 1 - reading.probability)
    rivals = tuple((name, at, order, min(p * left, 1 - share)) for name, at, order, p in reading.rivals)
    return replace(reading, probability=share, model=reading.probability, rivals=rivals)


def _orders_kept(readings: Sequence[Interpretation]) -> dict[str, float]:
    """Return the cost of each order on this device, because devices use one order throughout."""
    seen = {order: PRIOR_WEIGHT * math.exp(-cost) for order, cost in ORDER_COST.items()}
    for reading in readings:
        if reading.registers > 1 and reading.type != "string" and reading.moves and reading.probability >= LIKELY:
            seen[reading.order] += reading.probability
    total = sum(seen.values())
    return {order: -math.log(seen[order] / total) for order in ORDER_COST}


def _floats(readings: Sequence[Interpretation]) -> Counter[str]:
    """Return the number of probable floats with changing values, for each byte order."""
    return Counter(r.order for r in readings if r.type.startswith("float") and r.moves and r.probability >= LIKELY)


def _supported(readings: Sequence[Interpretation]) -> list[Interpretation]:
    """Return the readings. A reading is limited (`capped`) if few values of the device have its order, or if it is a single
    float.
    """
    moving = [r for r in readings if r.moves and r.probability >= LIKELY and r.type != "string"]
    orders = Counter(r.order for r in moving if r.registers > 1)
    floats = _floats(readings)
    swapped = orders["BADC"] + orders["DCBA"]

    def doubt(r: Interpretation) -> str:
        if r.type == "string":
            return ""
        if r.type == "float32" and floats[r.order] < FLOCK:
            return "a single float looks like a large whole number that wavers"
        if r.registers > 1 and orders[r.order] < FLOCK:
            return "few other values use that order"
        if r.registers == 1 and r.order == "BADC" and swapped < FLOCK:
            return "no other value has its bytes swapped"
        return ""

    return [replace(r, capped=r.capped or doubt(r)) for r in readings]
