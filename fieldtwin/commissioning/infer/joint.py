"""Evidence beyond the numbers of one register: a carry from the low word into the high word of a neighbour, and single bits
of status words.

The module only calculates. Costs and evidence are in nats, as in `costs`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

HALF = 0x8000
_CARRY_SIGN = math.log(40)
"""The evidence in nats of a carry: by chance a change of the high word would rarely match the low word's overflow exactly."""
MOST_BITS, FEWEST_CHANGES = 8, 3


def carry_evidence(highs: Sequence[int], lows: Sequence[int]) -> float:
    """Return the evidence in nats that `highs` and `lows` are the words of one number and not two independent numbers; 0 without
    evidence.

    Evidence is a high word that changes exactly in those passes in which the low word overflows or underflows: of all ways to
    place these changes among the passes only one fits. A high word that changes without such an overflow is not evidence.
    """
    steps = [((b - a), (d - c)) for (a, b), (c, d) in zip(pairwise(highs), pairwise(lows), strict=True)]
    changes = [(up, low) for up, low in steps if up]
    if not changes or len(changes) == len(steps):
        return 0.0
    within = [abs(low) for up, low in steps if not up]
    usual = max(1, max(within))
    for up, low in changes:
        whole = up * 0x10000 + low
        if abs(whole) > min(HALF, 8 * usual + 64) or abs(low) < HALF:
            return 0.0
    if any(size > HALF for size in within):
        return 0.0  # the low word wraps around, and the high word does not change
    count = len(changes)
    ways = math.lgamma(len(steps) + 1) - math.lgamma(count + 1) - math.lgamma(len(steps) - count + 1)
    return ways + _CARRY_SIGN + (count - 1) * math.log(4)


def toggled_bits(values: Sequence[int]) -> tuple[int, ...]:
    """Return the bits of a status word that changed, lowest first; empty if the register does not behave like one.

    In a status word one or two bits change at a time, with pauses between. In a counter the lowest bits change most often, and in
    a measurement many bits change at once.
    """
    flips = [a ^ b for a, b in pairwise(values) if a != b]
    if len(flips) < FEWEST_CHANGES or any(v >> 16 or v < 0 for v in values):
        return ()
    if sum(f.bit_count() for f in flips) > 1.3 * len(flips):
        return ()
    every = 0
    for flip in flips:
        every |= flip
    bits = tuple(b for b in range(16) if every >> b & 1)
    steps = [b - a for a, b in pairwise(values) if a != b]
    goes_one_way = all(s > 0 for s in steps) or all(s < 0 for s in steps)
    span = max(values) - min(values)
    if len(bits) > MOST_BITS or goes_one_way or (span <= 3 and bits and bits[-1] <= 1 and max(values) > 3):
        return ()
    return bits


def bits_cost(values: Sequence[int]) -> float:
    """Return the cost of a register as sixteen flags of which a few change; `math.inf` if it does not behave like a status
    word.
    """
    bits = toggled_bits(values)
    if not bits:
        return math.inf
    first = 3.0 + math.log(math.comb(16, values[0].bit_count()))
    which = math.log(math.comb(16, len(bits)))
    total = first + which
    for a, b in pairwise(values):
        flips = (a ^ b).bit_count()
        total += 0.4 if not flips else 1.2 + flips * (math.log(len(bits)) + 0.3)
    return total
