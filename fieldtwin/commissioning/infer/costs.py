"""The cost of reading a series of register words as a value of a type and order, in nats (negative natural logarithms of
probabilities).

The correct reading of a device's registers is the least surprising one: a float in the correct word order changes a little,
in the wrong one it jumps over decades. The costs of neighbouring values add up, and the costs of readings can be compared.
The module only calculates; it is independent of dumps and profiles.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import pairwise
from statistics import median

from fieldtwin.commissioning.infer.joint import bits_cost, carry_evidence
from fieldtwin.gateway.core.files.profile import REGISTERS_OF
from fieldtwin.gateway.devices.codec import reorder

IMPOSSIBLE = math.inf
"""The cost of a reading that no device can have, such as infinity or a float of an implausible magnitude."""
MOST_TEXT_REGISTERS = 24

TYPE_COST = {
    "uint16": 1.0, "int16": 1.4, "uint32": 2.0, "int32": 2.6, "float32": 1.5, "float64": 3.0, "uint64": 4.0, "int64": 5.0,
    "bcd16": 5.0, "string": 3.0,
}  # fmt: skip
ORDER_COST = {"ABCD": 0.3, "CDAB": 1.0, "BADC": 3.0, "DCBA": 2.5}
"""The cost of each byte order, by its rarity among devices."""
NUMBERS = tuple(kind for kind in TYPE_COST if kind != "string")
SWAPPED_SINGLE_COST = 3.0
"""The cost of swapped bytes in a single register: devices that swap the bytes of longer values seldom swap these."""
ZERO_COST = 0.7
"""The cost of a register that is always 0, like most unused registers."""

_FORMATS = {
    "int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "int64": ">q", "uint64": ">Q", "float32": ">f",
    "float64": ">d",
}  # fmt: skip
_MANTISSA_BITS = {"float32": 23, "float64": 52}
SUNSPEC_NAN = 0x7FC0_0000
"""The bits of a float32 that a SunSpec device has not implemented."""
NANS = {
    "float32": frozenset({SUNSPEC_NAN, 0xFFC0_0000}),
    "float64": frozenset({0x7FF8_0000_0000_0000, 0xFFF8_0000_0000_0000}),
}
"""The bit patterns of NaN that devices send for a value that is not available: quiet and without a payload (IEEE 754-2019,
6.2.1).
"""
_NAN_COST, _NAN_CHANGE_COST = 3.0, 1.5
"""The cost of a float that is sometimes not available, and of each change between available and not available."""
ABSENT_COST = 9.5
"""The cost of a float32 that was never available, on a device with other floats. It is higher than that of other constants,
because two integers with these values are possible.
"""
_LN2 = math.log(2)
WILD_COST = 9.0
"""The cost of a number that jumps over its whole range, as the lower half of a longer number does."""
LARGE, LARGE_COST = 1 << 28, 4.0
"""The limit above which a 32-bit integer that rises and falls is unlikely, and the cost of such an integer.

A large integer is usually a counter. One that rises and falls would be a measurement of nine digits, and is more likely a
float.
"""
_LEAST_STEP_COST = 0.05
_TEMPER = 0.7
"""The weight of the costs of steps. It is less than 1, because successive steps are not independent evidence."""


def orders_of(kind: str) -> tuple[str, ...]:
    """Return the orders that make a difference for this type."""
    if kind == "string":
        return ("ABCD", "BADC")
    return ("ABCD", "BADC") if REGISTERS_OF[kind] == 1 else ("ABCD", "CDAB", "BADC", "DCBA")


def whole_numbers(words: Sequence[Sequence[int]], order: str) -> list[int]:
    """Return one unsigned number for each row of `words` (a pass): the words of the row combined in this order."""
    if order in ("BADC", "DCBA"):
        words = [[w >> 8 | (w & 0xFF) << 8 for w in row] for row in words]
    if order in ("CDAB", "DCBA"):
        words = [row[::-1] for row in words]
    if len(words[0]) == 1:
        return [row[0] for row in words]
    if len(words[0]) == 2:
        return [row[0] << 16 | row[1] for row in words]
    return [row[0] << 48 | row[1] << 32 | row[2] << 16 | row[3] for row in words]


def decode_series(words: Sequence[Sequence[int]], kind: str, order: str) -> list[float] | None:
    """Return one raw number for each row of `words` (a pass); None if a word is not a number (a BCD digit above 9)."""
    return decode_numbers(whole_numbers(words, order), kind)


def decode_numbers(wholes: Sequence[int], kind: str) -> list[float] | None:
    """Return the bit patterns `wholes` as numbers of the type `kind`; None if one of them is not a number of that type."""
    if kind.startswith("uint"):
        return list(wholes)
    bits = 16 * REGISTERS_OF[kind]
    if kind.startswith("int"):
        return [x - (1 << bits) if x >> (bits - 1) else x for x in wholes]
    if kind.startswith("bcd"):
        digits = [f"{x:0{bits // 4}x}" for x in wholes]
        return [int(d) for d in digits] if all(map(str.isdecimal, digits)) else None
    count, letter = len(wholes), _FORMATS[kind][1]
    raw = struct.pack(f">{count}{'I' if bits == 32 else 'Q'}", *wholes)
    return list(struct.unpack(f">{count}{letter}", raw))


def cost(words: Sequence[Sequence[int]], kind: str, order: str) -> float:
    """Return the cost of `words` (one row per pass) as a series of values of this type.

    The rarity of the type is included; that of the order is not (`order_cost`).
    """
    if kind == "string":
        return _text_cost(words, order) + TYPE_COST[kind]
    return cost_of(whole_numbers(words, order), kind, order)


def cost_of(wholes: Sequence[int], kind: str, order: str) -> float:
    """Return the same cost as `cost`, for words that are already combined to unsigned numbers."""
    if not any(wholes):
        return ZERO_COST if kind == "uint16" and order == "ABCD" else 6.0 + TYPE_COST[kind]
    rarity = TYPE_COST[kind]
    if kind in NANS and not NANS[kind].isdisjoint(wholes):
        absent = [w in NANS[kind] for w in wholes]
        if all(absent):
            return IMPOSSIBLE
        wholes = [w for w in wholes if w not in NANS[kind]]
        rarity += _NAN_COST + _NAN_CHANGE_COST * sum(a != b for a, b in pairwise(absent))
    numbers = decode_numbers(wholes, kind)
    if numbers is None:
        return IMPOSSIBLE
    carried = 0.0
    if REGISTERS_OF[kind] == 2:
        carried = carry_evidence([w >> 16 for w in wholes], [w & 0xFFFF for w in wholes])
    if kind in _MANTISSA_BITS:
        return rarity + _float_cost(numbers, kind) - carried
    integers = [int(x) for x in numbers]
    bits = 16 * REGISTERS_OF[kind]
    wild = WILD_COST if _is_wild(integers, bits) else 0.0
    if bits == 32 and abs(integers[0]) > LARGE and _wavers(integers):
        wild = max(wild, LARGE_COST)
    signed = kind.startswith("int")
    if kind == "uint16" and order == "ABCD" and (flags := bits_cost(integers)) < math.inf:
        return rarity + min(wild + _first_cost(integers[0], bits, signed=False) + walk_cost(integers), flags)
    return rarity + wild - carried + _first_cost(integers[0], bits, signed=signed) + walk_cost(integers)


def order_cost(kind: str, order: str, orders: Mapping[str, float]) -> float:
    """Return the cost of the order `order`, given the costs of the four orders.

    One register and a text have no word order; their bytes are either swapped or not.
    """
    if kind != "string" and REGISTERS_OF[kind] > 1:
        return orders[order]
    pair = ("ABCD", "CDAB") if order == "ABCD" else ("BADC", "DCBA")
    rare = SWAPPED_SINGLE_COST if order == "BADC" and kind != "string" else 0.0
    return rare - math.log(sum(math.exp(-orders[o]) for o in pair))


def _wavers(numbers: Sequence[int]) -> bool:
    steps = [b - a for a, b in pairwise(numbers)]
    return any(s > 0 for s in steps) and any(s < 0 for s in steps)


def _is_wild(numbers: Sequence[int], bits: int) -> bool:
    """Return whether the numbers jump on average over more than an eighth of their range, wrapping around its ends."""
    whole = 1 << bits
    leaps = [min((b - a) % whole, (a - b) % whole) for a, b in pairwise(numbers)]
    return bool(leaps) and sum(leaps) / len(leaps) > whole / 8


def _first_cost(first: int, bits: int, *, signed: bool) -> float:
    """Return the cost of the first number of a series: each order of magnitude is equally likely, so small numbers are cheap."""
    return math.log(abs(first) + 1) + math.log(bits * _LN2) + (_LN2 if signed else 0.0)


def walk_cost(numbers: Sequence[int]) -> float:
    """Return the cost of the steps of a series that is constant, rises and falls, or counts.

    The assumed distribution has heavy tails around a step of zero or around the median step.
    """
    steps = [b - a for a, b in pairwise(numbers)]
    if not steps:
        return 0.0
    if not any(steps):
        return _LEAST_STEP_COST * len(steps)
    centres = {0.0, float(median(steps))}
    return _TEMPER * min(_steps_cost([abs(s - c) for s in steps]) + math.log(abs(c) + 1) for c in centres)


def _steps_cost(distances: Sequence[float]) -> float:
    """Return the cost of Cauchy distributed distances with the scale that fits them best."""
    best = math.inf
    for scale in (median(distances), sum(distances) / len(distances)):
        scale = max(scale, 0.3)
        total = math.log(2 + 2 * math.log2(1 + scale))
        total += sum(max(_LEAST_STEP_COST, math.log(math.pi * scale * (1 + (d / scale) ** 2))) for d in distances)
        best = min(best, total)
    return best


def _float_cost(numbers: Sequence[float], kind: str) -> float:
    if any(not math.isfinite(x) or (x != 0 and not 1e-15 < abs(x) < 1e15) for x in numbers):
        return IMPOSSIBLE
    bits = _MANTISSA_BITS[kind]
    first = next(x for x in (*numbers, 1.0) if x != 0)
    size = math.log10(abs(first))
    decades = 3.2 if -2 <= size <= 5 else 6.0 if -6 <= size <= 9 else 12.0
    powers = [math.frexp(x)[1] for x in numbers if x != 0]
    leaps = [abs(b - a) for a, b in pairwise(powers)]
    decades += 3.0 * max(0.0, median(leaps) - 1) if leaps else 0.0  # the series jumps over powers of two
    start = decades + (1.0 if first < 0 else 0.3) + _mantissa_cost(first, kind)
    ordered = [_ordered(x, kind) for x in numbers]
    return start + min(walk_cost(ordered), _TEMPER * _real_steps_cost(numbers, bits))


def _real_steps_cost(numbers: Sequence[float], bits: int) -> float:
    """Return the cost of steps as real numbers, for values that cross zero or a power of two, and for even changes.

    A step costs more, the larger it is and the finer the resolution of its value is compared with the scale of all steps.
    """
    steps = [b - a for a, b in pairwise(numbers)]
    if not steps or not any(steps):
        return _LEAST_STEP_COST * len(steps)
    fine = [2.0 ** (math.frexp(v)[1] - 1 - bits) if v != 0 else 0.0 for v in numbers[1:]]
    usual = median(steps)
    wandering = _real_walk([abs(s) for s in steps], fine)
    finest = max(fine)
    if not usual or not finest:
        return wandering
    return min(wandering, _real_walk([abs(s - usual) for s in steps], fine) + math.log(abs(usual) / finest + 1) + 1.0)


def _real_walk(distances: Sequence[float], fine: Sequence[float]) -> float:
    """Return the cost of Cauchy distributed distances, given the resolution `fine` of each value (0: the value is 0.0, a
    fixed cost).
    """
    scale = max(median(distances), sum(distances) / len(distances) / 4, 0.3 * max(fine), 1e-300)
    total = 3.0
    for distance, resolution in zip(distances, fine, strict=True):
        if not resolution:
            total += 3.0
        else:
            total += max(_LEAST_STEP_COST, math.log(math.pi * scale * (1 + (distance / scale) ** 2) / resolution))
    return total


@lru_cache(maxsize=4096)
def _mantissa_cost(value: float, kind: str) -> float:
    """Return the cost of the digits of a series' first value: low for a round number, binary or decimal."""
    bits = _MANTISSA_BITS[kind]
    raw = struct.pack(_FORMATS[kind], value)
    mantissa = int.from_bytes(raw) & ((1 << bits) - 1)
    zeros = (mantissa & -mantissa).bit_length() - 1 if mantissa else bits
    best = min(bits * _LN2, (bits - zeros) * _LN2 + 2.5)
    for digits in range(1, 7):
        if struct.pack(_FORMATS[kind], float(f"{value:.{digits}g}")) == raw:
            return min(best, digits * math.log(10) + 2.0)
    return best


def _ordered(value: float, kind: str) -> int:
    """Return the position of a float in the ordered sequence of all floats of its type, so that neighbours differ by 1."""
    raw = int.from_bytes(struct.pack(_FORMATS[kind], value))
    sign = 1 << (31 if kind == "float32" else 63)
    return raw if raw < sign else sign - raw


def _text_cost(words: Sequence[Sequence[int]], order: str) -> float:
    """Return the cost of a text: `IMPOSSIBLE` unless it is constant, printable and padded only with NULs or blanks at its end."""
    if any(row != words[0] for row in words[1:]):
        return IMPOSSIBLE
    data = b"".join(w.to_bytes(2) for w in words[0])
    if order == "BADC":
        data = reorder(data, "BADC")
    text = data.rstrip(b"\0 ")
    if len(text) < 3 or not all(0x20 <= c < 0x7F for c in text) or not any(c > 0x40 for c in text):
        return IMPOSSIBLE
    total = 2.0 + math.log(MOST_TEXT_REGISTERS)
    for char in text:
        letter = chr(char)
        total += 3.2 if letter.isalpha() else 2.7 if letter.isdigit() else 3.3 if letter in " -_./:" else 5.5
    kinds = [_kind(chr(c)) for c in text]
    total += sum(0.2 if a == b or (a, b) == ("A", "a") else 1.5 for a, b in pairwise(kinds))
    return total + 0.1 * (len(data) - len(text)) + _LEAST_STEP_COST * (len(words) - 1)


def _kind(letter: str) -> str:
    """Return the class of a character: small, capital, digit, or a mark between words. Classes change rarely within text."""
    return "a" if letter.islower() else "A" if letter.isupper() else "0" if letter.isdigit() else "-"
