"""The causes of failures in a campaign of `fieldtwin simulate`, and the texts about them that `fieldtwin test` has too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fieldtwin.cli.output_files import write_text
from fieldtwin.console import stderr, stdout

if TYPE_CHECKING:
    from fieldtwin.run.campaigns.many_seeds import SeedResult, Shrunk
    from fieldtwin.run.virtual.run import VirtualOptions

SEEDS_SHOWN = 10


@dataclass(frozen=True)
class FoundCause:
    """Failed seeds with the same cause. `faults` names the faults that suffice. `scenario` is empty if none was written."""

    check: str
    faults: str
    seeds: tuple[int, ...]
    scenario: str
    lines: tuple[str, ...]

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


def find_causes(options: VirtualOptions, failed: Sequence[SeedResult], seeds: int, jobs: int) -> list[FoundCause]:
    """Shrink the failed ones of `seeds` seeds by cause, and write a scenario for each cause into the working directory."""
    from fieldtwin.run.campaigns.causes import shape_text
    from fieldtwin.run.campaigns.many_seeds import causes_of
    from fieldtwin.run.campaigns.shrink import FurtherRuns

    further = FurtherRuns(seeds)
    stderr.print(shrinking_text([one.seed for one in failed], further.most), markup=False)
    causes, left = causes_of(options, failed, jobs, further)
    found = []
    for cause in causes:
        scenario, lines = _written(options, cause.runs[0], cause.small)
        check, alike = next(iter(cause.runs[0].errors), ""), tuple(one.seed for one in cause.runs)
        found.append(FoundCause(check, shape_text(cause.small.faults), alike, scenario, tuple(lines)))
    if left:
        stderr.print(not_compared_text([one.seed for one in left]), markup=False)
    return found


def shrinking_text(seeds: Sequence[int], most: int) -> str:
    """Return a sentence about the search for causes, with the largest number of its runs."""
    return f"searching the causes of {seeds_text(seeds)} with at most {most} further runs"


def not_compared_text(seeds: Sequence[int]) -> str:
    """Return a sentence about the failed seeds that have no cause because the numbers of causes and runs are limited."""
    return f"not grouped by cause, because the numbers of causes and further runs are limited: {seeds_text(seeds)}"


def show_causes(found: Sequence[FoundCause]) -> None:
    """Print each cause, its example and its scenario."""
    for cause in found:
        stdout.print(f"[bold]cause[/bold]  {cause.title}", soft_wrap=True, highlight=False)
        for line in cause.lines:
            stdout.print(f"  {line}", soft_wrap=True, markup=False, highlight=False)


def _written(options: VirtualOptions, failed: SeedResult, small: Shrunk) -> tuple[str, list[str]]:
    """Write the shrunk schedule as a scenario. Return its path, and sentences about it.

    Nothing is written if the seed does not fail again with the same faults.
    """
    from fieldtwin.run.campaigns.confirming import confirm_run
    from fieldtwin.run.campaigns.shrink import as_scenario
    from fieldtwin.scenarios.language.file_name import SUFFIX

    if small.result.ok:
        return "", [f"seed {failed.seed} does not fail again with the same faults, so no scenario is written"]
    path = Path(f"{Path(options.system).stem}-seed{failed.seed}{SUFFIX}")
    title = f"what failed with seed {failed.seed}"
    acts = [(one.at_s, {"send": {"period_s": one.period_s}}) for one in small.scripted]
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
