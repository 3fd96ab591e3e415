"""Generated register maps with known content, as samples of many devices, against which the claims of `infer` are compared.

This shares no code with the code under test: values are packed with `struct`.
"""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass

START_S = 1_790_000_000.0
FORMS = {
    "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip


@dataclass(frozen=True)
class Field:
    """A value of a generated device: its start, and the words of its registers, one row per pass."""

    address: int
    kind: str
    order: str
    rows: tuple[tuple[int, ...], ...]
    what: str

    @property
    def registers(self) -> int:
        return len(self.rows[0])

    @property
    def moves(self) -> bool:
        return len(set(self.rows)) > 1


@dataclass(frozen=True)
class Map:
    """A device, dumped at `times_s`."""

    times_s: tuple[float, ...]
    fields: tuple[Field, ...]

    @property
    def words(self) -> dict[int, list[int]]:
        return {f.address + i: [row[i] for row in f.rows] for f in self.fields for i in range(f.registers)}


def packed(kind: str, order: str, value: float) -> tuple[int, ...]:
    """The registers of a number, clipped to what the type can hold."""
    if "float" not in kind:
        bits = 8 * struct.calcsize(FORMS[kind])
        low, high = (0, (1 << bits) - 1) if kind.startswith("u") else (-(1 << bits - 1), (1 << bits - 1) - 1)
        value = min(high, max(low, round(value)))
    raw = struct.pack(">" + FORMS[kind], value)
    pairs = [raw[i : i + 2] for i in range(0, len(raw), 2)]
    if order in ("CDAB", "DCBA"):
        pairs.reverse()
    swaps = len(pairs) > 1 and order in ("BADC", "DCBA")
    return tuple(p[1] << 8 | p[0] if swaps else p[0] << 8 | p[1] for p in pairs)


class _Maker:
    """One device. `passes` values are made for each field."""

    def __init__(self, seed: int) -> None:
        self.r = random.Random(seed)
        self.passes = self.r.choice((6, 8, 10, 12, 15, 20, 30))
        every_s = self.r.choice((1.0, 5.0, 10.0, 15.0, 60.0))
        self.times = tuple(START_S + i * every_s + self.r.uniform(0, 0.05) for i in range(self.passes))
        self.order = self.r.choices(("ABCD", "CDAB", "BADC", "DCBA"), (6, 3, 0.5, 0.5))[0]
        self.fields: list[Field] = []
        self.at = self.r.choice((0, 1, 100))

    def put(self, kind: str, values: list[float], what: str) -> None:
        rows = tuple(packed(kind, self.order, v) for v in values)
        self.fields.append(Field(self.at, kind, self.order, rows, what))
        self.at += len(rows[0])

    def counter(self) -> None:
        """A count of pulses or energy, whose low word often wraps during observation."""
        r = self.r
        step = int(10 ** r.uniform(0, 4.2))
        start = int(10 ** r.uniform(1, 8.5))
        if r.random() < 0.5:  # near a wrap of the low word
            start = (start >> 16 << 16) + 65536 - r.randint(1, max(2, step * self.passes))
        value, values = max(0, start), []
        steady = r.random() < 0.3
        for _ in range(self.passes):
            values.append(float(value))
            value += step if steady else r.randint(0, 2 * step)
        self.put(r.choices(("uint32", "int32", "uint64"), (8, 2, 1))[0], values, "counter")

    def short_counter(self) -> None:
        start, step, values = self.r.randint(0, 60000), self.r.choice((1, 2, 7, 40)), []
        for _ in range(self.passes):
            values.append(float(start % 65536))
            start += self.r.randint(0, 2 * step)
        self.put("uint16", values, "short counter")

    def measurement(self) -> None:
        r = self.r
        kind = r.choices(("float32", "int16", "uint16", "int32", "float64"), (5, 4, 4, 1.5, 0.5))[0]
        centre = 10 ** r.uniform(-1, 4) * r.choice((1, 1, 1, -1))
        if kind in ("int16", "uint16", "int32"):
            centre = float(round(centre)) + r.choice((0, 0, 100))
            centre = abs(centre) if kind == "uint16" else centre
        noise = abs(centre) * 10 ** r.uniform(-3, -0.7) + (1 if "int" in kind else 0)
        phase, period = r.uniform(0, 6), r.uniform(6, 60)
        smooth = r.random() < 0.4
        values = [
            centre + noise * (math.sin(i * 6.28 / period + phase) if smooth else r.gauss(0, 1))
            for i in range(self.passes)
        ]
        self.put(kind, values, "measurement")

    def setting(self) -> None:
        r = self.r
        kind = r.choices(("uint16", "int16", "float32", "uint32"), (6, 1, 2, 1))[0]
        value = r.choice((1, 2, 5, 10, 50, 60, 100, 230, 1000, 1500, 9600, 30000))
        value = value + r.choice((0.5, 0.25)) if kind == "float32" and r.random() < 0.5 else value
        self.put(kind, [float(value)] * self.passes, "setting")

    def zeros(self) -> None:
        for _ in range(self.r.randint(1, 4)):
            self.put("uint16", [0.0] * self.passes, "always zero")

    def status(self) -> None:
        """Flags, each of which is set or cleared at random times."""
        r = self.r
        bits = r.sample(range(16), r.randint(1, 5))
        word = sum(1 << b for b in r.sample(range(16), r.randint(0, 4)))
        values = []
        for _ in range(self.passes):
            values.append(float(word))
            if r.random() < 0.35:
                word ^= 1 << r.choice(bits)
        self.put("uint16", values, "status word")

    def state(self) -> None:
        state, values = self.r.randint(0, 5), []
        for _ in range(self.passes):
            values.append(float(state))
            if self.r.random() < 0.15:
                state = self.r.randint(0, 5)
        self.put("uint16", values, "state")

    def uptime(self) -> None:
        start = self.r.randint(0, 10_000_000)
        self.put("uint32", [start + t - START_S for t in self.times], "uptime")

    def text(self) -> None:
        raw = self.r.choice(("ACME 3000", "Flow meter", "SN 20260117", "PM-5560", "v2.1.7")).encode()
        raw += b"\0" * (len(raw) % 2)
        row = tuple(raw[i] << 8 | raw[i + 1] for i in range(0, len(raw), 2))
        if self.order in ("BADC", "DCBA"):
            row = tuple(w >> 8 | (w & 0xFF) << 8 for w in row)
        padding = (0, 0, 2, 5)[(self.at + len(row)) % 4]  # most devices have fields of a fixed length
        row += (0x2020 if self.at % 3 == 0 else 0,) * padding
        self.fields.append(Field(self.at, "string", self.order, (row,) * self.passes, "text"))
        self.at += len(row)

    def made(self) -> Map:
        r = self.r
        kinds: list[tuple[Callable[[], None], float]] = [
            (self.measurement, 7), (self.counter, 2), (self.short_counter, 0.7), (self.setting, 3), (self.zeros, 2),
            (self.status, 1), (self.state, 1), (self.uptime, 0.4), (self.text, 0.4),
        ]  # fmt: skip
        for _ in range(r.randint(6, 14)):
            r.choices([k for k, _ in kinds], [w for _, w in kinds])[0]()
            if r.random() < 0.12:
                self.at += r.randint(1, 5)  # a hole
        return Map(self.times, tuple(self.fields))


def corpus(count: int, seed: int) -> Iterator[Map]:
    """Return `count` maps, the same ones for the same `seed`."""
    for i in range(count):
        yield _Maker(seed * 1_000_003 + i).made()
