"""The seeds of a campaign: a range, and the part of it that one computer runs."""

from __future__ import annotations

from fieldtwin.gateway.core.errors import UsageError

MAX_SEEDS = 100_000
"""Greatest number of seeds of one campaign."""
MAX_SHARDS = 10_000
"""Greatest number of parts into which the seeds can be divided."""


def parse_seeds(text: str, shard: str = "") -> range:
    """Parse ``7`` or ``1..200``, and return the seeds of a shard such as ``3/16``, or all of them without a shard.

    Shard N of M has every M-th seed, beginning with the N-th: the shards have no seed in common, and all of them together have
    each seed once. Raises `UsageError` for a text of a different form, or a shard without a seed.
    """
    first, dots, last = text.partition("..")
    if not first.isdigit() or (dots and not last.isdigit()):
        raise UsageError("seeds", expected="a number, or 1..200", got=text)
    seeds = range(int(first), int(last or first) + 1)
    if not 0 < len(seeds) <= MAX_SEEDS:
        raise UsageError("seeds", expected=f"1 to {MAX_SEEDS} of them, the lower first", got=text)
    return _part(seeds, shard) if shard else seeds


def _part(seeds: range, shard: str) -> range:
    number, slash, count = shard.partition("/")
    if not (slash and number.isascii() and number.isdigit() and count.isascii() and count.isdigit()):
        raise UsageError("--shard", expected="which part of how many, such as 3/16", got=shard)
    if not 1 <= int(number) <= int(count) <= MAX_SHARDS:
        raise UsageError("--shard", expected=f"1/N to N/N, with N of at most {MAX_SHARDS}", got=shard)
    part = seeds[int(number) - 1 :: int(count)]
    if not part:
        raise UsageError(
            "--shard has no seed", expected=f"at most {len(seeds)} shards for {len(seeds)} seeds", got=shard
        )
    return part
