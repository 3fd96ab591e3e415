"""The choice of the seeds that a campaign runs a second time."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

ONE_OF = 100
"""One seed of this number of seeds is repeated, and at least one."""


def sample_of(seeds: Sequence[int]) -> frozenset[int]:
    """Return the seeds that run again on a different worker. The choice depends on the seeds only."""
    count = -(-len(seeds) // ONE_OF)
    return frozenset(sorted(seeds, key=lambda seed: (hashlib.sha256(b"%d" % seed).digest(), seed))[:count])
