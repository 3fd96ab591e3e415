"""Compare the percentages that `fieldtwin infer` claims with the observed share of correct readings, on generated maps.

``benchmarks/infer_calibration.py [--maps 600] [--svg FILE] [--fit]``. The curves in the program were fitted on other maps,
with another seed (`--fit --maps 2000` prints them).
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
for folder in (ROOT, ROOT / "tests" / "rigs" / "devices"):
    sys.path.insert(0, str(folder))

from infer_corpus import Map, corpus  # noqa: E402

from fieldtwin.commissioning.infer.calibration import fitted, kind_of  # noqa: E402
from fieldtwin.commissioning.infer.fields import Interpretation, Level, text_of  # noqa: E402
from fieldtwin.commissioning.infer.infer import Series, infer  # noqa: E402

FIT_SEED, CHECK_SEED = 1, 2
MOST_BRIER = 0.11
MOST_OVERCONFIDENT = 0.06
"""Maximum excess of a claimed share over the observed one in a bin of at least 50 readings."""


@dataclass(frozen=True)
class Judged:
    """A reading: the probabilities of the model and of the program, and whether it is correct."""

    model: float
    claimed: float
    right: bool
    kind: str
    level: Level


@dataclass(frozen=True)
class Bin:
    """Readings whose claimed probability is in one tenth."""

    low: float
    count: int
    claimed: float
    observed: float


def is_right(reading: Interpretation, one: Map) -> bool:
    """Return whether a generated map has this value there: same registers, type and order; of a text, also with other padding."""
    kinds = {reading.type, reading.type[1:]} if reading.sign_open else {reading.type}
    for f in one.fields:
        if f.kind == "string" and f.address == reading.address:
            text = text_of(f.rows[0], "BADC" if f.order in ("BADC", "DCBA") else "ABCD")
            return reading.type == "string" and reading.values[0] == text
        if f.address == reading.address and f.registers == reading.registers:
            order = f.order if f.registers > 1 else "ABCD"
            return f.kind in kinds and order == reading.order
    return False


def judged(maps: int, seed: int) -> list[Judged]:
    """Return every reading of every map of a corpus."""
    out = []
    for one in corpus(maps, seed):
        for r in infer(Series(one.times_s, {"holding": one.words})).readings:
            kind = kind_of(r.type, r.registers, moves=r.moves, capped=r.capped)
            model = r.probability if r.model is None else r.model
            out.append(Judged(model, r.probability, is_right(r, one), kind, r.level))
    return out


def brier(readings: Sequence[Judged]) -> float:
    """Return the mean squared difference of claim and truth: 0 is perfect; always claiming 50 % gives 0.25."""
    return sum((j.claimed - j.right) ** 2 for j in readings) / len(readings)


def bins(readings: Sequence[Judged]) -> list[Bin]:
    """Return claimed and observed shares by tenths of the claim."""
    parts: dict[int, list[Judged]] = defaultdict(list)
    for j in readings:
        parts[min(9, int(10 * j.claimed))].append(j)
    return [
        Bin(i / 10, len(p), sum(j.claimed for j in p) / len(p), sum(j.right for j in p) / len(p))
        for i, p in sorted(parts.items())
    ]


def diagram(found: Sequence[Bin], score: float, maps: int) -> str:
    """Return the reliability diagram as SVG: on the diagonal, claims equal observations."""
    size, edge = 360, 50

    def at(claimed: float, observed: float) -> str:
        return f"{edge + size * claimed:.1f},{edge + size * (1 - observed):.1f}"

    most = max(b.count for b in found)
    dots = "".join(
        f'<circle cx="{at(b.claimed, b.observed).split(",")[0]}" cy="{at(b.claimed, b.observed).split(",")[1]}" '
        f'r="{4 + 8 * (b.count / most) ** 0.5:.1f}" fill="#1565c0" fill-opacity="0.7"><title>{b.count} readings: claimed '
        f"{b.claimed:.1%}, observed {b.observed:.1%}</title></circle>"
        for b in found
    )
    ticks = "".join(
        f'<text x="{edge + size * i / 5:.0f}" y="{edge + size + 18}" text-anchor="middle">{20 * i}</text>'
        f'<text x="{edge - 8}" y="{edge + size * (1 - i / 5) + 4:.0f}" text-anchor="end">{20 * i}</text>'
        for i in range(6)
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{size + 2 * edge}" height="{size + 2 * edge}" '
        'font-family="sans-serif" font-size="12">\n'
        f'<text x="{edge}" y="24">Claimed and observed shares of right readings: {maps} maps, Brier score {score:.3f}</text>\n'
        f'<rect x="{edge}" y="{edge}" width="{size}" height="{size}" fill="none" stroke="#888"/>\n'
        f'<polyline points="{at(0, 0)} {at(1, 1)}" stroke="#888" stroke-dasharray="4"/>\n'
        f'<polyline points="{" ".join(at(b.claimed, b.observed) for b in found)}" fill="none" stroke="#1565c0"/>\n'
        f"{dots}\n{ticks}\n"
        f'<text x="{edge + size / 2}" y="{size + 2 * edge - 12}" text-anchor="middle">claimed, %</text>\n'
        f'<text x="14" y="{edge + size / 2}" text-anchor="middle" transform="rotate(-90 14 {edge + size / 2})">'
        "observed, %</text>\n"
        "</svg>\n"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--maps", type=int, default=600)
    parser.add_argument("--quick", action="store_true", help="60 maps")
    parser.add_argument("--svg", type=Path)
    parser.add_argument("--fit", action="store_true", help="print curves fitted on the other corpus")
    options = parser.parse_args()
    maps = 60 if options.quick else options.maps
    if options.fit:
        samples: dict[str, list[tuple[float, bool]]] = defaultdict(list)
        for j in judged(maps, FIT_SEED):
            samples[j.kind].append((j.model, j.right))
        for kind, found in samples.items():
            print(f'    "{kind}": {fitted(found)},  # {len(found)} readings')
        return 0
    readings = judged(maps, CHECK_SEED)
    score, found_bins = brier(readings), bins(readings)
    print(f"{len(readings)} readings of {maps} generated maps; Brier score {score:.3f}")
    print("claimed    readings  mean claim  observed")
    for b in found_bins:
        print(f"{b.low:.0%}..{b.low + 0.1:.0%}".ljust(11) + f"{b.count:8}{b.claimed:12.1%}{b.observed:10.1%}")
    for level in Level:
        of_level = [j for j in readings if j.level is level]
        right = sum(j.right for j in of_level)
        print(f"{level}: {right} of {len(of_level)} right")
    if options.svg is not None:
        options.svg.write_text(diagram(found_bins, score, maps), encoding="utf-8")
    worst = max((b.claimed - b.observed for b in found_bins if b.count >= 50), default=0.0)
    missed = False
    for what, value, goal in (("Brier score", score, MOST_BRIER), ("overconfident by", worst, MOST_OVERCONFIDENT)):
        missed |= value > goal
        print(f"{what}: {value:.3f}, goal at most {goal:g}: {'MISSED' if value > goal else 'reached'}")
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
