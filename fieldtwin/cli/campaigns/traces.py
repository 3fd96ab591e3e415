"""The traces of failed runs: which seeds have one, and texts about those that have none."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from fieldtwin.cli.campaigns.causes import seeds_text
from fieldtwin.cli.campaigns.ending import ends_early
from fieldtwin.console import stderr, stdout

if TYPE_CHECKING:
    from fieldtwin.run.campaigns.failure_traces import KeptTraces, TracedWork
    from fieldtwin.run.places.place import Place

RESULT = TypeVar("RESULT")


def keep_traces(
    place: Place, work: TracedWork[RESULT], hashes: Mapping[int, str], first: Sequence[int], stem: str
) -> tuple[KeptTraces, bool]:
    """Run failed seeds again, and write their traces into the working directory. Return whether Ctrl-C ended this early.

    `hashes` has the hash of the run of each failed seed that finished. The seeds of `first` get a trace before the others do.
    """
    from fieldtwin.run.campaigns.failure_traces import KeptTraces, choose, fetch

    kept = KeptTraces()
    if not hashes:
        return kept, False
    chosen = {seed: hashes[seed] for seed in choose(list(hashes), first)}

    def keep() -> None:
        stderr.print(f"running {seeds_text(list(chosen))} again to keep the traces", soft_wrap=True, markup=False)
        fetch(place, work, chosen, Path(), stem, kept)

    return kept, ends_early(keep)


def show_traces(kept: KeptTraces, failed: Sequence[int], again: Callable[[int], str]) -> None:
    """Print the files of the traces, and why failed seeds have none. `again` returns the command that repeats a seed's run."""
    for seed, path in kept.files.items():
        stdout.print(f"trace of seed {seed}: {path}", soft_wrap=True, markup=False, highlight=False)
    for line in missing_texts(kept, failed, again):
        stdout.print(line, soft_wrap=True, markup=False, highlight=False)


def missing_texts(kept: KeptTraces, failed: Sequence[int], again: Callable[[int], str]) -> list[str]:
    """Return a sentence for each failed seed whose trace could not be kept, and one for all seeds beyond the limit."""
    from fieldtwin.run.campaigns.failure_traces import MOST_TRACES

    texts = [
        f"no trace of seed {seed}: {why}; repeat its run with: {again(seed)}" for seed, why in kept.missing.items()
    ]
    left = [seed for seed in failed if seed not in kept.files and seed not in kept.missing]
    if left:
        texts.append(
            f"no trace of {seeds_text(left)}: a campaign keeps at most {MOST_TRACES} traces; repeat the run of seed {left[0]} "
            f"with: {again(left[0])}"
        )
    return texts
