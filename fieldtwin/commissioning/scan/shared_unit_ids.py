"""Detect one device behind many unit IDs: a device on TCP often answers any unit ID. The module does no I/O.

Units may be one device if they answer the same request with the same bytes. Equal answers of a few units prove little,
because all new meters read 0. Equal answers of IDs over the whole range are conclusive, because no installation has 32
devices at such IDs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fieldtwin.commissioning.scan.sweep import UnitAnswer

SPREAD = 32
"""Number of IDs, spread over the whole range, from which on IDs with the same answer are taken for one device."""


@dataclass(frozen=True, slots=True)
class SharedUnitIds:
    """The `units` that may be one device. `one_device`: this is certain; `why` is the reason."""

    units: tuple[int, ...]
    one_device: bool
    why: str


def detect_shared_unit_ids(
    answers: Sequence[UnitAnswer], asked: int, again: Sequence[UnitAnswer] = ()
) -> SharedUnitIds | None:
    """Return the units that are certainly or possibly one device; None if they are several devices, or fewer than three.

    `asked` is the number of unit IDs that were tried: all of them must have answered. `again` are the answers to a second
    request.
    """
    if len(answers) < 3 or len(answers) < asked:
        return None
    units = tuple(sorted(a.unit for a in answers))
    contents = {a.reply for a in answers}
    if len(contents) == 1:
        text = next(iter(contents)).hex(" ")
        if asked >= SPREAD:
            return SharedUnitIds(
                units, True, f"all {asked} unit ids that were asked answered with the same bytes ({text})"
            )
        return SharedUnitIds(
            units,
            False,
            f"{asked} units answer with the same bytes ({text}): one device, or several new devices with equal values",
        )
    before = {a.unit: a.reply for a in answers}
    changed = sum(1 for a in again if before.get(a.unit) not in (None, a.reply))
    if asked >= SPREAD and changed > len(answers) // 2:
        return SharedUnitIds(
            units, False, f"all {asked} unit ids answer, and each gives a different answer a moment later"
        )
    return None


def spread_over(units: Sequence[int]) -> tuple[int, ...]:
    """Return `SPREAD` of `units` over their whole range, with likely ones among them; all if there are no more."""
    if len(units) <= SPREAD:
        return tuple(units)
    ordered = sorted(units)
    likely = [u for u in (1, 255, 0, 2, 247, 3) if u in units]
    steps = SPREAD - len(likely)
    others = [u for u in ordered if u not in likely]
    return (*likely, *(others[i * len(others) // steps] for i in range(steps)))
