"""The causes of failures in a campaign of `fieldtwin simulate`, and the texts about them that `fieldtwin test` has too."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from fieldtwin.cli.campaigns.ending import ends_early
from fieldtwin.cli.output_files import write_text
from fieldtwin.console import stderr, stdout

if TYPE_CHECKING:
    from fieldtwin.results.model import ScenarioResult
    from fieldtwin.run.campaigns.causes import Cause
    from fieldtwin.run.campaigns.many_seeds import SeedResult, SeedRuns
    from fieldtwin.run.campaigns.reruns import FaultyWork, Shrunk
    from fieldtwin.run.places.place import Place
    from fieldtwin.run.virtual.run import VirtualOptions

RESULT = TypeVar("RESULT")
SEEDS_SHOWN = 10
SEARCH_INTERRUPTED = "interrupted: the search for causes has not ended; repeat a seed to search its cause"


@dataclass(frozen=True)
class FoundCause:
    """Failed seeds with the same cause. `faults` names the faults that suffice. `scenario` is empty if none was written, and
    `confirmed` is the result of its run if that fails like the seeds.
    """

    check: str
    faults: str
    seeds: tuple[int, ...]
    scenario: str
    lines: tuple[str, ...]
    confirmed: ScenarioResult | None = None

    @property
    def title(self) -> str:
        return f"{self.faults}: {seeds_text(self.seeds)}"

    def plain(self) -> dict[str, Any]:
        """Return the cause as plain data."""
        return {
            "check": self.check,
            "faults": self.faults,
            "count": len(self.seeds),
            "seeds": list(self.seeds),
            "scenario": self.scenario,
        }


def seeds_text(seeds: Sequence[int]) -> str:
    """Return the number of failed seeds, and the first of them."""
    more = ", ..." if len(seeds) > SEEDS_SHOWN else ""
    return f"{len(seeds)} failed seed{'s' if len(seeds) > 1 else ''} ({', '.join(map(str, seeds[:SEEDS_SHOWN]))}{more})"


def find_causes(
    place: Place,
    work: FaultyWork[RESULT],
    failed: Mapping[int, RESULT],
    seeds: int,
    written: Callable[[Cause[int, Shrunk[RESULT]]], FoundCause],
) -> tuple[list[FoundCause], bool]:
    """Return the causes of failed runs of `seeds` seeds, and whether Ctrl-C ended the search early.

    The search uses the workers of `place`. `failed` has the results by seed. `written` writes the scenario of a cause and
    confirms it, as soon as the cause is found.
    """
    from fieldtwin.run.campaigns.reruns import SearchStopped, open_search
    from fieldtwin.run.campaigns.shrink import FurtherRuns

    further, found, stopped = FurtherRuns(seeds), list[FoundCause](), list[str]()

    def search() -> None:
        stderr.print(shrinking_text(list(failed), further.most), markup=False)
        try:
            with open_search(place, work, further) as opened:
                found.extend(map(written, opened.causes(failed)))
        except SearchStopped as e:
            stopped.append(str(e))

    interrupted = ends_early(search)
    known = {seed for one in found for seed in one.seeds}
    left = [seed for seed in failed if seed not in known]
    if left and not interrupted:
        text = stopped_text(left, stopped[0]) if stopped else not_compared_text(left)
        stderr.print(text, soft_wrap=True, markup=False)
    return found, interrupted


def simulated_causes(
    place: Place, work: SeedRuns, failed: Sequence[SeedResult], seeds: int
) -> tuple[list[FoundCause], bool]:
    """Return the causes of failed runs of `fieldtwin simulate`, and whether Ctrl-C ended the search early."""
    from fieldtwin.run.campaigns.causes import shape_text

    by_seed = {result.seed: result for result in failed}

    def written(cause: Cause[int, Shrunk[SeedResult]]) -> FoundCause:
        first = by_seed[cause.runs[0]]
        scenario, lines = _written(work.options, first, cause.small)
        check, faults = next(iter(first.errors), ""), shape_text(cause.small.faults)
        return FoundCause(check, faults, tuple(cause.runs), scenario, tuple(lines))

    return find_causes(place, work, by_seed, seeds, written)


def shrinking_text(seeds: Sequence[int], most: int) -> str:
    """Return a sentence about the search for causes, with the largest number of its runs."""
    return f"searching the causes of {seeds_text(seeds)} with at most {most} further runs"


def not_compared_text(seeds: Sequence[int]) -> str:
    """Return a sentence about the failed seeds that have no cause because the numbers of causes and runs are limited."""
    return f"not grouped by cause, because the numbers of causes and further runs are limited: {seeds_text(seeds)}"


def stopped_text(seeds: Sequence[int], reason: str) -> str:
    """Return a sentence about the failed seeds that have no cause because the search could not continue."""
    return (
        f"the search for causes stopped, and these have no cause: {seeds_text(seeds)}: {reason}; "
        "run these seeds again, without --ledger, to search their causes"
    )


def show_causes(found: Sequence[FoundCause]) -> None:
    """Print each cause, its example and its scenario."""
    for cause in found:
        stdout.print(f"[bold]cause[/bold]  {cause.title}", soft_wrap=True, highlight=False)
        for line in cause.lines:
            stdout.print(f"  {line}", soft_wrap=True, markup=False, highlight=False)


def _written(options: VirtualOptions, failed: SeedResult, small: Shrunk[SeedResult]) -> tuple[str, list[str]]:
    """Write the shrunk schedule as a scenario. Return its path, and sentences about it.

    Nothing is written if the seed does not fail again with the same faults.
    """
    from fieldtwin.run.campaigns.confirming import confirm_run
    from fieldtwin.run.campaigns.shrink import as_scenario
    from fieldtwin.run.virtual.run import VirtualRun
    from fieldtwin.scenarios.language.file_name import SUFFIX

    if small.result.ok:
        return "", [f"seed {failed.seed} does not fail again with the same faults, so no scenario is written"]
    path = Path(f"{Path(options.system).stem}-seed{failed.seed}{SUFFIX}")
    title = f"what failed with seed {failed.seed}"
    commands = VirtualRun(replace(options, seed=failed.seed)).scripted
    acts = [(one.at_s, {"send": {"period_s": one.period_s}}) for one in commands]
    text = as_scenario(title, options.system, failed.seed, options.duration_s, small.faults, small.result.errors, acts)
    write_text(path, text)
    told = shrunk_texts(failed.seed, len(small.faults), small.minimal, small.without.ok, small.without.errors)
    return str(path), [*told, f"it is written to {path}", confirm_run(path, small.result, options.profiles)]


def shrunk_texts(seed: int, count: int, minimal: bool, passes_without: bool, otherwise: Sequence[str]) -> list[str]:
    """Return sentences that state how many faults of its schedule a seed needs to fail, and the result of a run without
    faults.
    """
    if not count:
        return [f"seed {seed} also fails without faults, so the faults are not the cause"]
    what = f"{count} fault{'s' if count > 1 else ''}"
    least = f"; none of {'them' if count > 1 else 'it'} can be left out" if minimal and count > 1 else ""
    without = (
        "without faults the run passes"
        if passes_without
        else f"without faults it fails in a different way: {otherwise[0]}"
    )
    return [f"seed {seed} fails with {what} of its schedule{least}; {without}"]
