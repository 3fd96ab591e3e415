"""Options of many runs in virtual time: seeds, and faults that each seed chooses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fieldtwin.cli.option_groups import option
from fieldtwin.cli.options import Duration
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.run.places.names import LOCAL, PLACES

if TYPE_CHECKING:
    from fieldtwin.run.places.place import Place
    from fieldtwin.run.virtual.fault_schedule import RandomFaults


GUIDED = "guided"
CHOSEN_FAULTS = ("random", GUIDED)
"""The values of --faults with which each seed chooses the faults."""


def _each(context: click.Context, param: click.Parameter, value: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in value.split(",") if part.strip())


def _places(context: click.Context, param: click.Parameter, start: str) -> list[str]:
    return [place for place in PLACES if place.startswith(start)]


@dataclass(frozen=True)
class SeedOptions:
    """The options for the seeds of several runs, as text such as ``1..200`` or empty, for the part of them that this computer
    runs, such as ``3/16`` or empty, for the place of the runs, and for the number of runs at a time.
    """

    seeds: str = option(
        "--seeds",
        default="",
        metavar="1..200",
        help="In virtual time: one run for each of these seeds, such as 1..200.",
    )
    shard: str = option(
        "--shard",
        default="",
        metavar="3/16",
        help="With --seeds: run only this part of the seeds, for several computers or CI jobs.",
    )
    jobs: int | None = option(
        "--jobs", type=click.IntRange(1, 10_000), default=None, help="Number of --seeds runs at a time; default: 1."
    )
    on: str = option(
        "--on",
        default=LOCAL,
        metavar="PLACE",
        shell_complete=_places,
        help="With --seeds: run on local processes (default), dask://HOST:PORT, slurm or kubernetes.",
    )
    ledger: Path | None = option(
        "--ledger",
        type=click.Path(dir_okay=False, path_type=Path),
        help="With --seeds: record each run in this file, and skip seeds that it contains.",
    )

    def place(self) -> Place:
        """Return where the seeds run. Raises `UsageError`."""
        from fieldtwin.run.places.clusters import place_named

        return place_named(self.on, self.jobs)

    @property
    def given(self) -> str:
        """Return an option that was given and has no effect without --seeds, or an empty text."""
        values = {
            "--shard": self.shard,
            "--jobs": self.jobs is not None,
            "--on": self.on != LOCAL,
            "--ledger": self.ledger,
        }
        return next((option for option, value in values.items() if value), "")

    def chosen(self) -> range:
        """Return the seeds that this computer runs. Raises `UsageError`."""
        from fieldtwin.run.campaigns.seeds import parse_seeds

        return parse_seeds(self.seeds, self.shard)


@dataclass(frozen=True)
class FaultChoice:
    """The options for the faults from which a seed chooses. `fault_every` is in seconds; None: the default interval."""

    fault_every: float | None = option(
        "--fault-every",
        type=Duration(),
        default=None,
        help="With random or guided faults: mean time between two faults; default: 2min.",
    )
    fault_kinds: tuple[str, ...] = option(
        "--fault-kinds",
        default="",
        callback=_each,
        metavar="NAME,...",
        help="With random or guided faults: only these (see fieldtwin faults); value faults occur only if they are named here.",
    )
    fault_aims: tuple[str, ...] = option(
        "--fault-aims",
        default="",
        callback=_each,
        metavar="AIM,...",
        help="With random or guided faults: only on these targets (DEVICE, BUS or DEVICE.TAG); default: every device.",
    )

    def of(self, faults: str | None) -> RandomFaults | None:
        """Return the faults that seeds may choose; None without random faults.

        Raise `UsageError` for options without effect.
        """
        if faults not in CHOSEN_FAULTS:
            if self.fault_every is not None or self.fault_kinds or self.fault_aims:
                raise UsageError(
                    "--fault-every, --fault-kinds and --fault-aims choose random faults",
                    expected="--faults random or --faults guided",
                )
            return None
        # this module is imported here, because it loads emulators, which a plant does not need
        from fieldtwin.run.virtual.fault_schedule import MEAN_S, RandomFaults

        every_s = MEAN_S if self.fault_every is None else self.fault_every
        return RandomFaults(every_s, self.fault_kinds, self.fault_aims, guided=faults == GUIDED)


@dataclass(frozen=True)
class _ScenarioRuns(SeedOptions):
    """The options for the runs of a campaign of scenarios: their faults, and their length in seconds, 0 for the default."""

    faults: str | None = option(
        "--faults",
        type=click.Choice(CHOSEN_FAULTS),
        default=None,
        help="With --seeds: each seed chooses faults; guided: also by their effects and by the states of the programs. "
        "Only always, never, within and invariants are then checked.",
    )
    duration_s: float = option(
        "--for",
        type=Duration(),
        default=0.0,
        help="With random or guided faults: length of a run; default: the maximum time of the steps, at least 10min.",
    )


@dataclass(frozen=True)
class CampaignOptions(FaultChoice, _ScenarioRuns):
    """The options of a campaign of scenarios. `seeds` is empty if no campaign was requested."""

    def check(self) -> None:
        """Raise `UsageError` for options that have no effect without --seeds, or without random faults."""
        self.of(self.faults)
        given = "--faults" if self.faults else "--for" if self.duration_s else self.given
        if given and not self.seeds:
            raise UsageError(f"{given} of scenarios needs --seeds", expected="--seeds 1..200")
        if self.duration_s and not self.faults:
            raise UsageError(
                "--for needs --faults random or guided: without it the steps determine the length of a run"
            )
