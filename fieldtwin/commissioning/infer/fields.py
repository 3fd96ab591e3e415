"""Find the registers that belong together, their type and order, by comparing all readings of a run of neighbouring
registers.

Each reading of a stretch of registers has a cost (`costs`); a tiling divides a run of registers into readings. A reading's
probability is the share of all tilings, weighted by their costs, that contain it (forward and backward sums, as in a hidden
Markov model). So a word that fits both of its neighbours is doubtful, and is reported as such.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import pairwise
from statistics import median

from fieldtwin.commissioning.infer.costs import (
    ABSENT_COST,
    IMPOSSIBLE,
    MOST_TEXT_REGISTERS,
    NANS,
    NUMBERS,
    ORDER_COST,
    SUNSPEC_NAN,
    cost,
    cost_of,
    decode_series,
    order_cost,
    orders_of,
    whole_numbers,
)
from fieldtwin.gateway.core.files.profile import REGISTERS_OF
from fieldtwin.gateway.devices.codec import reorder

CERTAIN, LIKELY, GUESS = 0.9997, 0.80, 0.50
"""The smallest probability of each level. `CERTAIN` is compared with the probability of the model, the others with the
calibrated one.
"""
FEWEST_PASSES, FEWEST_VALUES = 6, 4
"""With fewer passes, or fewer different values, no reading is certain."""


class Level(Enum):
    """The certainty of a reading in words."""

    CERTAIN = "certain"
    LIKELY = "likely"
    GUESS = "guess"
    UNKNOWN = "unknown"

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True, slots=True)
class Interpretation:
    """A reading of a stretch of registers as one value. `probability` compares it with all other readings, and `rivals` holds the
    next best readings, the best first.

    `model` is the probability before calibration (`calibration`), None if not calibrated. `sign_open`: no value was seen that
    distinguishes a signed integer from an unsigned one; `probability` is then that of both. `capped` is the reason why the
    reading is not certain, however probable it is. `values` has NaN for each pass in which a float was not available, and
    `sentinels` holds the bit patterns of these NaNs.
    """

    table: str
    address: int
    registers: int
    type: str
    order: str
    probability: float
    values: tuple[float | str, ...]
    rivals: tuple[tuple[str, int, str, float], ...] = ()
    capped: str = ""
    sign_open: bool = False
    marks: tuple[str, ...] = ()
    scale: float = 1.0
    notes: tuple[str, ...] = field(default=())
    model: float | None = None
    sentinels: tuple[int, ...] = ()

    @property
    def available(self) -> list[float | str]:
        """Return the values without those that are NaN."""
        return [v for v in self.values if isinstance(v, str) or not math.isnan(v)]

    @property
    def distinct(self) -> int:
        return len(set(self.available))

    @property
    def moves(self) -> bool:
        return self.distinct > 1

    @property
    def level(self) -> Level:
        """Return the certainty of the reading.

        `CERTAIN` requires observed changes, because a constant could be any value with the same bits.
        """
        if self.probability < GUESS:
            return Level.UNKNOWN
        if self.probability < LIKELY:
            return Level.GUESS
        enough = len(self.available) >= FEWEST_PASSES and self.distinct >= FEWEST_VALUES
        trusted = self.probability if self.model is None else self.model
        if trusted < CERTAIN or not enough or self.capped:
            return Level.LIKELY
        return Level.CERTAIN


@dataclass(frozen=True, slots=True)
class _Tile:
    start: int
    size: int
    type: str
    order: str
    cost: float
    idle: bool = False

    @property
    def end(self) -> int:
        return self.start + self.size


@dataclass(frozen=True, slots=True)
class Run:
    """A run of neighbouring registers and every way to read a stretch of them. `words[i]` has the word of the register
    ``address + i`` in each pass.
    """

    table: str
    address: int
    words: Sequence[Sequence[int]]
    tiles: Sequence[_Tile]


def run_of(table: str, address: int, words: Sequence[Sequence[int]]) -> Run:
    """Return a run with all readings and their costs. This takes most of the time: a few milliseconds per register."""
    return Run(table, address, words, [t for start in range(len(words)) for t in _tiles(words, start)])


def with_absent_floats(run: Run, orders: Sequence[str]) -> Run:
    """Return the run with one more reading for each pair of registers that was always 7FC0 0000 in one of these byte orders:
    a float32 that was never available. The other NaN, FFC0 0000, is not used, because -64 and 0 are plausible settings.
    """
    tiles = []
    for start, pair in enumerate(pairwise(run.words)):
        rows = set(zip(*pair, strict=True))
        for order in orders if len(rows) == 1 else ():
            if whole_numbers(list(rows), order)[0] == SUNSPEC_NAN:
                tiles.append(_Tile(start, 2, "float32", order, ABSENT_COST))
    return replace(run, tiles=[*run.tiles, *tiles])


def infer_run(run: Run, orders: Mapping[str, float] = ORDER_COST, single_cost: float = 0.0) -> list[Interpretation]:
    """Return the most probable division of a run of registers into values (its tiling).

    `orders`: the cost of each order; `single_cost`: the additional cost of a value of one register.
    """
    count = len(run.words)
    extra = {(t.type, t.order): order_cost(t.type, t.order, orders) for t in run.tiles}
    tiles = [
        replace(t, cost=t.cost + extra[t.type, t.order] + (single_cost if t.size == 1 and not t.idle else 0.0))
        for t in run.tiles
    ]
    by_end: list[list[_Tile]] = [[] for _ in range(count + 1)]
    by_start: list[list[_Tile]] = [[] for _ in range(count + 1)]
    for tile in tiles:
        by_end[tile.end].append(tile)
        by_start[tile.start].append(tile)
    forward, backward = _sums(by_end, count), _sums_back(by_start, count)
    covering: list[list[tuple[float, _Tile]]] = [[] for _ in range(count)]
    for tile in tiles:
        weight = forward[tile.start] - tile.cost + backward[tile.end] - forward[count]
        for place in range(tile.start, tile.end):
            covering[place].append((weight, tile))
    readings = []
    for tile in _best(by_end, count):
        share = min(1.0, math.exp(forward[tile.start] - tile.cost + backward[tile.end] - forward[count]))
        readings.append(_reading(run.table, run.address, run.words, tile, share, covering[tile.start]))
    return readings


def _tiles(words: Sequence[Sequence[int]], start: int) -> list[_Tile]:
    if not any(words[start]):
        tiles = [_Tile(start, 1, "uint16", "ABCD", cost_of(words[start], "uint16", "ABCD"), idle=True)]
    else:
        tiles = _number_tiles(words, start, 1)
    for size in (2, 4):
        if start + size <= len(words) and any(any(w) for w in words[start : start + size]):
            tiles += _number_tiles(words, start, size)
    for size in range(2, min(MOST_TEXT_REGISTERS, len(words) - start) + 1):
        last = words[start + size - 1]
        if any(w != last[0] for w in last) or (size == 2 and any(w != words[start][0] for w in words[start])):
            break  # a text does not change
        row = [w[0] for w in words[start : start + size]]
        for order in orders_of("string"):
            price = cost([row] * len(last), "string", order)
            if price < IMPOSSIBLE:
                tiles.append(_Tile(start, size, "string", order, price))
    return tiles


def _number_tiles(words: Sequence[Sequence[int]], start: int, size: int) -> list[_Tile]:
    rows = list(zip(*words[start : start + size], strict=True))
    kinds = [kind for kind in NUMBERS if REGISTERS_OF[kind] == size]
    tiles = []
    for order in orders_of(kinds[0]):
        wholes = whole_numbers(rows, order)
        for kind in kinds:
            if kind != "bcd16" or order == "ABCD":
                price = cost_of(wholes, kind, order)
                if price < IMPOSSIBLE:
                    tiles.append(_Tile(start, size, kind, order, price))
    return tiles


def _sums(by_end: Sequence[Sequence[_Tile]], count: int) -> list[float]:
    """Return, for each i from 0 to `count`, the log of the summed weights of all tilings of the first i registers."""
    sums = [0.0] * (count + 1)
    for end in range(1, count + 1):
        sums[end] = _log_sum([sums[t.start] - t.cost for t in by_end[end]])
    return sums


def _sums_back(by_start: Sequence[Sequence[_Tile]], count: int) -> list[float]:
    sums = [0.0] * (count + 1)
    for start in range(count - 1, -1, -1):
        sums[start] = _log_sum([sums[t.end] - t.cost for t in by_start[start]])
    return sums


def _log_sum(logs: Sequence[float]) -> float:
    most = max(logs)
    return most + math.log(sum(math.exp(x - most) for x in logs))


def _best(by_end: Sequence[Sequence[_Tile]], count: int) -> list[_Tile]:
    """Return the tiling with the least cost."""
    least = [0.0] + [math.inf] * count
    chosen: list[_Tile | None] = [None] * (count + 1)
    for end in range(1, count + 1):
        for tile in by_end[end]:
            if least[tile.start] + tile.cost < least[end]:
                least[end], chosen[end] = least[tile.start] + tile.cost, tile
    tiles: list[_Tile] = []
    end = count
    while end > 0:
        last = chosen[end]
        assert last is not None
        tiles.append(last)
        end = last.start
    return tiles[::-1]


def _reading(
    table: str,
    address: int,
    words: Sequence[Sequence[int]],
    tile: _Tile,
    share: float,
    covering: Sequence[tuple[float, _Tile]],
) -> Interpretation:
    rows = list(zip(*words[tile.start : tile.end], strict=True))
    values: tuple[float | str, ...]
    if tile.type == "string":
        values = (text_of(rows[0], tile.order),) * len(rows)
    else:
        values = tuple(decode_series(rows, tile.type, tile.order) or ())
    if tile.type == "string":
        equal = _same_text(words, tile, [t for _, t in covering])
    else:
        twin = _twin(tile, values)
        equal = [
            t for _, t in covering if (t.start, t.size, t.type, t.order) == (tile.start, tile.size, twin, tile.order)
        ]
    nans = NANS[tile.type].intersection(whole_numbers(rows, tile.order)) if tile.type in NANS else ()
    share = min(1.0, share + sum(math.exp(w) for w, t in covering if t in equal))
    others = sorted(((w, t) for w, t in covering if t is not tile and t not in equal), key=lambda x: -x[0])[:3]
    rivals = tuple((t.type, address + t.start, t.order, min(1.0, math.exp(w))) for w, t in others)
    sign_open = bool(equal) and tile.type != "string"
    kind = f"u{tile.type.removeprefix('u')}" if sign_open else tile.type
    return Interpretation(
        table,
        address + tile.start,
        tile.size,
        kind,
        tile.order,
        share,
        values,
        rivals,
        _cap(tile, words, values),
        sign_open,
        sentinels=tuple(sorted(nans)),
    )


def _same_text(words: Sequence[Sequence[int]], tile: _Tile, covering: Sequence[_Tile]) -> list[_Tile]:
    """Return the other readings with the same text: registers cannot show whether the padding after a text belongs to it."""

    def text(size: int) -> str:
        return text_of([w[0] for w in words[tile.start : tile.start + size]], tile.order)

    texts = [t for t in covering if (t.start, t.type, t.order) == (tile.start, "string", tile.order)]
    return [t for t in texts if t is not tile and text(t.size) == text(tile.size)]


def _twin(tile: _Tile, values: Sequence[float | str]) -> str:
    """Return the integer type of the same size with the other signedness, if both give the same values; else ""."""
    if "int" not in tile.type:
        return ""
    most = 1 << (16 * tile.size - 1)
    if not all(0 <= float(v) < most for v in values):
        return ""
    return tile.type[1:] if tile.type.startswith("u") else f"u{tile.type}"


def _cap(tile: _Tile, words: Sequence[Sequence[int]], values: Sequence[float | str]) -> str:
    """Return why a reading is not certain whatever its probability: another reading would have shown the same values."""
    if tile.type == "string":
        return ""
    absent = {i for i, v in enumerate(values) if math.isnan(float(v))}
    numbers = [float(v) for i, v in enumerate(values) if i not in absent]
    steps = [b - a for a, b in pairwise(numbers)]
    monotone = all(s >= 0 for s in steps) or all(s <= 0 for s in steps)
    if tile.type.startswith("int") and monotone and min(numbers) < 0 <= max(numbers):
        return "a counter that overflowed looks the same"
    if tile.type.startswith("float") and monotone:
        return "it changed in only one direction"
    still = [len({w for i, w in enumerate(row) if i not in absent}) == 1 for row in words[tile.start : tile.end]]
    if tile.order in ("CDAB", "DCBA"):
        still.reverse()
    half = tile.size // 2
    if tile.size > 1 and all(still[:half]) and tile.type != "float32":
        return "its upper half never changed"
    if tile.size > 1 and all(still[half:]):
        return "its lower half never changed"
    if tile.size == 2 and "int" in tile.type and _zeros_beside(tile, words):
        return "two adjacent registers were always 0 and may be its upper half"
    beside = [words[i] for i in (tile.start - 1, tile.end) if 0 <= i < len(words)]
    if tile.size == 1 and all(still) and any(len(set(w)) > 1 for w in beside):
        return "it may be the upper half of an adjacent register that changes"
    if tile.size == 1 and any(len(set(w)) == 1 for w in beside):
        return "an adjacent register never changed and may be its upper half"
    if tile.size == 1 and any(len(set(w)) > 1 for w in beside) and (monotone or _is_regular(steps)):
        return "it changes evenly, like half of a float, and an adjacent register changes too"
    return ""


def _zeros_beside(tile: _Tile, words: Sequence[Sequence[int]]) -> bool:
    """Return whether the two registers that would be the upper half of a longer number were always 0."""
    places = (tile.end, tile.end + 1) if tile.order in ("CDAB", "DCBA") else (tile.start - 2, tile.start - 1)
    return all(0 <= i < len(words) and not any(words[i]) for i in places)


def _is_regular(steps: Sequence[float]) -> bool:
    """Return whether most steps of a register are about equal, also when the value wraps around at the end of its range.

    In half of a float the steps change when the float passes a power of two; therefore not all steps need to be equal.
    """
    usual = median(steps)
    off = [abs((s - usual + 0x8000) % 0x10000 - 0x8000) for s in steps]
    return usual != 0 and sum(o <= max(2.0, 0.1 * abs(usual)) for o in off) >= 0.6 * len(off)


def text_of(words: Sequence[int], order: str) -> str:
    """Return the characters of registers."""
    data = b"".join(w.to_bytes(2) for w in words)
    return reorder(data, order if order == "BADC" else "ABCD").rstrip(b"\0 ").decode("ascii", errors="replace")


def runs_of(cells: Mapping[int, Sequence[int]], most: int = 4096) -> list[tuple[int, list[Sequence[int]]]]:
    """Return the runs of neighbouring registers, as ``(first address, the words of each register)``, of at most `most`
    registers each.
    """
    runs: list[tuple[int, list[Sequence[int]]]] = []
    for address in sorted(cells):
        if runs and runs[-1][0] + len(runs[-1][1]) == address and len(runs[-1][1]) < most:
            runs[-1][1].append(cells[address])
        else:
            runs.append((address, [cells[address]]))
    return runs
