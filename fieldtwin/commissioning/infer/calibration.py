"""Calibrate the model's probabilities with the share of correct readings on generated register maps whose meaning is known.

A reading is an interpretation of registers as a value of a type and order. The model relies on its assumptions, so its
probabilities are too high where several readings of the same registers look alike. Each kind of reading therefore has a curve
from the model's probability to the observed share of correct readings. The curves are fitted by
`benchmarks/infer_calibration.py --fit` and checked there on other maps. The module does no I/O.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from itertools import pairwise

Curve = tuple[tuple[float, float], ...]
"""Points ``(log odds of the model's probability, observed share of correct readings)``; both numbers rise from point to point."""

UPPER_HALF = "may be its upper half"
"""A part of the text that says why the certainty of a reading is limited: the register and its neighbour could be one longer
number."""

OTHER_HALF = "it may be the upper half of"
"""A part of the text that says why the certainty of a reading is limited: the register never changed, but its neighbour did."""

CURVES: dict[str, Curve] = {
    "single": ((2.31, 0.9359), (8.97, 0.9904)),
    "doubtful": (
        (-0.27, 0.4947),
        (0.24, 0.6357),
        (0.64, 0.6914),
        (1.1, 0.7724),
        (2.36, 0.8548),
        (3.76, 0.9554),
        (4.52, 0.9757),
        (6.51, 0.9796),
        (9.63, 0.9841),
        (12.0, 0.9932),
    ),
    "half": (
        (0.96, 0.4129),
        (1.38, 0.502),
        (1.6, 0.5627),
        (1.87, 0.7505),
        (2.22, 0.8557),
        (5.04, 0.884),
        (12.0, 0.994),
    ),
    "still": (
        (0.33, 0.5934),
        (1.11, 0.6111),
        (1.49, 0.7533),
        (1.88, 0.8274),
        (2.48, 0.9088),
        (2.99, 0.9467),
        (6.11, 0.9558),
        (12.0, 0.9955),
    ),
    "neighbour": ((0.89, 0.4332), (1.44, 0.4611), (1.74, 0.6701), (2.1, 0.7492), (5.3, 0.8964), (12.0, 0.9932)),
    "text": ((0.71, 0.3307), (3.24, 0.9188), (8.99, 0.9537)),
    "several": ((3.89, 0.9787), (8.92, 0.9877), (12.0, 0.9877)),
}


def kind_of(kind: str, registers: int, *, moves: bool, capped: str) -> str:
    """Return the name of the calibration curve for a reading of the type `kind`.

    `moves`: its values changed. `capped` is the reason why its certainty is limited, "" without one.
    """
    if kind == "string":
        return "text"
    if not moves:
        return "half" if OTHER_HALF in capped else "still"
    if capped:
        return "neighbour" if UPPER_HALF in capped else "doubtful"
    return "single" if registers == 1 else "several"


def log_odds(probability: float) -> float:
    """Return the log odds of a probability, limited to 12 in both directions."""
    p = min(1 - 1e-6, max(1e-6, probability))
    return max(-12.0, min(12.0, math.log(p / (1 - p))))


def calibrated(probability: float, kind: str) -> float:
    """Return the observed share of correct readings for this kind of reading (see `kind_of`) and this probability of the
    model.
    """
    curve = CURVES[kind]
    if not curve:
        return probability
    at = log_odds(probability)
    i = bisect_right(curve, (at, 2.0))
    if i == 0:
        return curve[0][1]
    if i == len(curve):
        return curve[-1][1]
    (x0, y0), (x1, y1) = curve[i - 1], curve[i]
    return y0 + (y1 - y0) * (at - x0) / (x1 - x0)


def fitted(samples: Sequence[tuple[float, bool]], bins: int = 16) -> Curve:
    """Return the calibration curve for `samples`, which are ``(probability of the model, whether the reading was correct)``.

    Bins have equally many samples; adjacent bins are merged where the curve would decrease. The curve lies one standard error
    below the observation, so that it claims too little rather than too much.
    """
    ordered = sorted((log_odds(p), right) for p, right in samples)
    size = max(25, -(-len(ordered) // bins))
    parts = [ordered[i : i + size] for i in range(0, len(ordered), size)]
    if len(parts) > 1 and len(parts[-1]) < size / 2:
        parts[-2] += parts.pop()
    blocks = [[sum(x for x, _ in part) / len(part), sum(r for _, r in part) + 0.0, len(part) + 1.0] for part in parts]
    falling = True
    while falling:
        falling = False
        for i, (a, b) in enumerate(pairwise(blocks)):
            if a[1] / a[2] >= b[1] / b[2]:
                total = a[2] + b[2]
                blocks[i : i + 2] = [[(a[0] * a[2] + b[0] * b[2]) / total, a[1] + b[1], total]]
                falling = True
                break
    curve, floor = [], 0.0
    for x, good, count in blocks:
        share = good / count
        floor = max(floor, share - math.sqrt(share * (1 - share) / count))
        curve.append((round(x, 2), round(floor, 4)))
    return tuple(curve)
