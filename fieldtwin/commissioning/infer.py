"""From several dumps of one unit to what its registers probably are.

The orders of bytes that the device seems to keep to are learnt from a first look and weigh in a second one. A float by itself is
never certain: large whole numbers that waver look the same, but not several of them. It must never see a profile.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from fieldtwin.commissioning.dump_file import Dump
from fieldtwin.commissioning.infer_costs import ORDER_COST, decode_series
from fieldtwin.commissioning.infer_fields import LIKELY, Reading, infer_run, runs_of
from fieldtwin.commissioning.infer_marks import marked, with_scales
from gateway.core.clock import NS_PER_S
from gateway.core.errors import FileInvalid

FLOCK = 3
"""So many floats of one order support each other."""
PRIOR_WEIGHT = 4.0
"""What is known of devices in general counts as this many registers seen."""
SINGLE_COST = 7.0
"""What a value of one register costs where the device knows pairs only."""
REGISTER_TABLES, BIT_TABLES = ("holding", "input"), ("coil", "discrete")


@dataclass(frozen=True, slots=True)
class Series:
    """What cells held over time: per table and address a word (or bit) for each pass. Only cells that every pass has."""

    times_s: tuple[float, ...]
    cells: Mapping[str, Mapping[int, Sequence[int]]]
    pairs: frozenset[str] = frozenset()
    """Tables whose registers the device gives in pairs only: its values take two."""

    @property
    def passes(self) -> int:
        return len(self.times_s)

    @property
    def span_s(self) -> float:
        return self.times_s[-1] - self.times_s[0]


@dataclass(frozen=True, slots=True)
class Inference:
    """Readings in the order of tables and addresses; bits as they were."""

    series: Series
    readings: tuple[Reading, ...]
    orders: Mapping[str, float]


def series_of(dumps: Sequence[Dump]) -> Series:
    """All passes of all dumps by time. Raises `FileInvalid` where they are not of one Modbus unit, or have nothing in common."""
    for dump in dumps:
        if dump.protocol != "modbus":
            raise FileInvalid("a CANopen node's EDS says its types: there is nothing to infer", path=dump.path)
        if dump.header.get("address") != dumps[0].header.get("address"):
            raise FileInvalid("dumps of two units", path=dump.path, expected=f"unit {dumps[0].header.get('address')}")
    passes = sorted((p for d in dumps for p in d.passes if p.cells), key=lambda p: p.utc_ns)
    if dumps and not all(d.ended for d in dumps) and len(passes) > 1:
        most = max(len(p.cells) for p in passes)
        passes = [p for p in passes if len(p.cells) >= 0.9 * most]  # an interrupted pass would leave nothing in common
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
    """The passes in which some register differs from the pass before: a device that was asked faster than it measures says the
    same again, which is no evidence."""
    columns = [words for table in REGISTER_TABLES for words in series.cells.get(table, {}).values()]
    kept = [i for i in range(series.passes) if i == 0 or any(w[i] != w[i - 1] for w in columns)]
    if len(kept) in (1, series.passes):
        return series
    cells = {t: {a: [w[i] for i in kept] for a, w in ws.items()} for t, ws in series.cells.items()}
    return Series(tuple(series.times_s[i] for i in kept), cells, series.pairs)


def infer(series: Series) -> Inference:
    """What the registers probably are. Pure; takes about a millisecond a register."""
    seen = without_repetitions(series)
    orders = _orders_kept(_look(seen, ORDER_COST))
    readings = with_scales([_marked(r, series) for r in _look(seen, orders)])
    return Inference(series, tuple(_supported(readings)), orders)


def _look(series: Series, orders: Mapping[str, float]) -> list[Reading]:
    readings = []
    for table in REGISTER_TABLES:
        for address, words in runs_of(series.cells.get(table, {})):
            readings += infer_run(table, address, words, orders, SINGLE_COST if table in series.pairs else 0.0)
    return readings


def _marked(reading: Reading, series: Series) -> Reading:
    """With the marks of all passes, the repetitions too: how long a state was held is what makes it one."""
    if reading.type == "string":
        return reading
    columns = [series.cells[reading.table][reading.address + i] for i in range(reading.registers)]
    values = decode_series(list(zip(*columns, strict=True)), reading.type, reading.order)
    seen = marked(replace(reading, values=tuple(values or reading.values)), series.times_s)
    return replace(reading, marks=seen.marks, notes=seen.notes)


def _orders_kept(readings: Sequence[Reading]) -> dict[str, float]:
    """What each order costs on this device: devices keep to one."""
    seen = {order: PRIOR_WEIGHT * math.exp(-cost) for order, cost in ORDER_COST.items()}
    for reading in readings:
        if reading.registers > 1 and reading.type != "string" and reading.moves and reading.probability >= LIKELY:
            seen[reading.order] += reading.probability
    total = sum(seen.values())
    return {order: -math.log(seen[order] / total) for order in ORDER_COST}


def _supported(readings: Sequence[Reading]) -> list[Reading]:
    """Floats that stand alone with their order are capped."""
    flocks = Counter(r.order for r in readings if r.type.startswith("float") and r.moves and r.probability >= LIKELY)
    return [
        replace(r, capped=r.capped or "a single float looks like a large whole number that wavers")
        if r.type == "float32" and flocks[r.order] < FLOCK
        else r
        for r in readings
    ]
