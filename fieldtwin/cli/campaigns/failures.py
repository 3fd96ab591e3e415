"""The end of a campaign with failed runs: the search for their causes, and then their traces."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from fieldtwin.cli.campaigns.causes import FoundCause, show_causes
from fieldtwin.cli.campaigns.traces import keep_traces, show_traces

if TYPE_CHECKING:
    from fieldtwin.run.campaigns.failure_traces import KeptTraces, TracedWork
    from fieldtwin.run.places.place import Place

RESULT = TypeVar("RESULT")


@dataclass(frozen=True)
class ExaminedFailures:
    """The causes of failed runs, and their traces.

    `was_searched`: the search for causes was not interrupted, nor were the runs before it. `search_interrupted`: Ctrl-C ended
    the search. `interrupted`: Ctrl-C ended the runs, the search or the traces.
    """

    causes: list[FoundCause]
    traces: KeptTraces
    was_searched: bool
    search_interrupted: bool
    interrupted: bool

    def show(self, failed: Sequence[int], again: Callable[[int], str]) -> None:
        """Print causes and traces. `again` returns the command that repeats the run of a seed of `failed`."""
        show_causes(self.causes)
        if self.was_searched:
            show_traces(self.traces, failed, again)


def examine_failures(
    place: Place,
    work: TracedWork[RESULT],
    hashes: Mapping[int, str],
    stem: str,
    search: Callable[[], tuple[list[FoundCause], bool]] | None,
    *,
    interrupted: bool,
) -> ExaminedFailures:
    """Search the causes of failed runs and keep their traces, unless Ctrl-C ends this or has ended the runs.

    `hashes` has the hash of the run of each failed seed that finished. `search` returns the causes, and whether it was
    interrupted; None: the runs had no faults that could be their causes.
    """
    causes, search_interrupted = list[FoundCause](), False
    if hashes and search is not None and not interrupted:
        causes, search_interrupted = search()
    was_searched = not (interrupted or search_interrupted)
    traces, traces_interrupted = keep_traces(
        place, work, hashes if was_searched else {}, [one.seeds[0] for one in causes], stem
    )
    return ExaminedFailures(causes, traces, was_searched, search_interrupted, not was_searched or traces_interrupted)
