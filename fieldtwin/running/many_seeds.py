"""One run in virtual time after the other, a seed each, in several processes: which seeds fail, and why."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, replace
from typing import Any

from fieldtwin.running.shrink import smallest
from fieldtwin.running.virtual_network_run import VirtualNetworkOptions
from fieldtwin.running.virtual_run import VirtualOptions
from fieldtwin.running.workers import Workers

MAX_SEEDS = 100_000
_ERRORS_SHOWN = 5
Options = VirtualOptions | VirtualNetworkOptions
"""Of a run that a seed makes: a system's, or a network's."""


@dataclass(frozen=True, slots=True)
class SeedResult:
    """How the run of one seed ended. `checked` values were compared with what devices held, `wrong` of them never were."""

    seed: int
    ok: bool
    errors: tuple[str, ...]
    checked: int
    wrong: int
    events: int
    sha256: str


def fingerprint(*parts: str) -> str:
    """A name for what was run: the same texts (files, options) give the same name."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(len(part).to_bytes(8, "big") + part.encode())
    return digest.hexdigest()[:16]


def what_runs(options: Options) -> str:
    """A name for what these options run, whatever the seed: of the files' contents and what the command line says."""
    anyhow = replace(options, seed=None, trace=None, profiles=())
    if isinstance(anyhow, VirtualOptions):
        anyhow = replace(anyhow, prototype_file=None)
    return fingerprint(*options.make().files, repr(anyhow))


def run_seed(options: Options) -> SeedResult:
    """One run, whole."""
    run = options.make()
    run.run()
    summary = run.summary()
    systems: dict[str, dict[str, Any]] = summary.get("systems", {})
    errors = summary["errors"] + [f"{name}: {error}" for name, one in systems.items() for error in one["errors"]]
    published = [one["published"] for one in systems.values() or [summary]]
    return SeedResult(
        run.seed,
        summary["ok"],
        tuple(errors[:_ERRORS_SHOWN]),
        sum(one["checked"] for one in published),
        sum(one["wrong"] for one in published),
        summary["trace"]["events"],
        summary["trace"]["sha256"],
    )


def shrunk(options: Options, seed: int, most_runs: int = 60) -> tuple[list[dict[str, Any]], SeedResult]:
    """The fewest faults with which the run of `seed` still fails, and how it fails with them. It must fail with all."""
    options = replace(options, seed=seed)
    faults = options.make().faults
    base = replace(options, random_faults=False, faults=())

    def fails(part: Sequence[dict[str, Any]]) -> bool:
        return not run_seed(replace(base, faults=tuple(part))).ok

    left = smallest(faults, fails, most_runs)
    return left, run_seed(replace(base, faults=tuple(left)))


def run_seeds(
    options: Options, seeds: Sequence[int], jobs: int, on_result: Callable[[SeedResult], None] | None = None
) -> list[SeedResult]:
    """A run a seed, `jobs` at a time, in the order of the seeds. `on_result` is told of each as it ends."""
    if jobs <= 1:
        results = []
        for seed in seeds:
            results.append(run_seed(replace(options, seed=seed)))
            if on_result is not None:
                on_result(results[-1])
        return results
    found: dict[int, SeedResult] = {}
    with Workers(jobs) as pool:
        for result in _as_they_end(pool, options, seeds, 2 * jobs):
            found[result.seed] = result
            if on_result is not None:
                on_result(result)
    return [found[seed] for seed in seeds]


def _as_they_end(pool: Workers, options: Options, seeds: Sequence[int], at_once: int) -> Iterator[SeedResult]:
    waiting: set[Future[SeedResult]] = set()
    for seed in seeds:
        waiting.add(pool.submit(run_seed, replace(options, seed=seed)))
        if len(waiting) >= at_once:
            done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            yield from (future.result() for future in done)
    while waiting:
        done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
        yield from (future.result() for future in done)
