"""The end of a campaign: repetitions of its seeds on different workers, and an early end by Ctrl-C."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fieldtwin.run.places.place import Repeats

INTERRUPTED = 130
"""The exit code of a command that Ctrl-C has ended."""
SHOWN = 10


def ends_early(campaign: Callable[[], None]) -> bool:
    """Run the campaign, and return whether Ctrl-C ended it early."""
    try:
        campaign()
    except KeyboardInterrupt:
        return True
    return False


def interrupted_text(ended: int, wanted: int) -> str:
    """Return a sentence about a campaign that ended early, with some of its seeds."""
    return f"interrupted: {ended} of {wanted} seeds have ended; with --ledger the same command continues"


def repeats_text(repeats: Repeats[int, Any]) -> str:
    """Return how many seeds ran again on a different worker."""
    return f"{repeats.count} on a different worker, {len(repeats.different)} with a different result"


def different_texts(seeds: Collection[int], repeats: Repeats[int, Any]) -> list[str]:
    """Return a sentence for each of these seeds, which have different results, with the workers of those that just ran."""
    workers = {one.unit: f" on {one.worker} and on {two.worker}" for one, two in repeats.different}
    return [
        f"seed {seed} has different results{workers.get(seed, '')}; the same seed must give the same run, so this is a defect: "
        "compare the traces of both computers (fieldtwin simulate --seed ... --trace FILE)"
        for seed in sorted(seeds)[:SHOWN]
    ]
