"""Options of campaigns: seeds, and faults that each seed chooses."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from fieldtwin.cli.options import Duration
from fieldtwin.gateway.core.errors import UsageError

if TYPE_CHECKING:
    from fieldtwin.run.virtual.fault_schedule import RandomFaults


def _each(context: click.Context, param: click.Parameter, value: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in value.split(",") if part.strip())


_CHOICE = (
    click.option(
        "--fault-every",
        type=Duration(),
        default=None,
        help="With random faults: mean time between two faults; default: 2min.",
    ),
    click.option(
        "--fault-kinds",
        default="",
        callback=_each,
        metavar="NAME,...",
        help="With random faults: only these (see fieldtwin faults); value faults occur only if they are named here.",
    ),
    click.option(
        "--fault-aims",
        default="",
        callback=_each,
        metavar="AIM,...",
        help="With random faults: only on these targets (DEVICE, BUS or DEVICE.TAG); default: every device.",
    ),
)
_CAMPAIGN = (
    click.option(
        "--seeds",
        default="",
        metavar="1..200",
        help="In virtual time: one run for each of these seeds, such as 1..200.",
    ),
    click.option("--jobs", type=click.IntRange(1, 256), default=1, help="Number of --seeds runs at a time."),
    click.option(
        "--faults",
        type=click.Choice(["random"]),
        default=None,
        help="With --seeds: random faults, chosen by each seed. Only always, never, within and invariants are then checked.",
    ),
    click.option(
        "--for",
        "duration_s",
        type=Duration(),
        default=0.0,
        help="With random faults: length of a run; default: the maximum time of the steps, at least 10min.",
    ),
)


class Choice(NamedTuple):
    """The options for random faults. `every_s` None: the default interval."""

    every_s: float | None
    kinds: tuple[str, ...]
    aims: tuple[str, ...]

    def of(self, faults: str | None) -> RandomFaults | None:
        """Return the faults that seeds may choose; None without random faults.

        Raise `UsageError` for options without effect.
        """
        if faults != "random":
            if self.every_s is not None or self.kinds or self.aims:
                raise UsageError(
                    "--fault-every, --fault-kinds and --fault-aims choose random faults", expected="--faults random"
                )
            return None
        # imported here, because it loads emulators, which a plant does not need
        from fieldtwin.run.virtual.fault_schedule import MEAN_S, RandomFaults

        return RandomFaults(MEAN_S if self.every_s is None else self.every_s, self.kinds, self.aims)


class CampaignRequest(NamedTuple):
    """The options of a campaign. `seeds` is empty if no campaign was requested."""

    seeds: str
    jobs: int
    faults: str | None
    duration_s: float
    choice: Choice

    def check(self) -> None:
        """Raise `UsageError` for options that have no effect without --seeds, or without random faults."""
        self.choice.of(self.faults)
        if not self.seeds and (self.faults or self.jobs != 1 or self.duration_s):
            raise UsageError("--faults, --for and --jobs of scenarios need --seeds", expected="--seeds 1..200")
        if self.duration_s and not self.faults:
            raise UsageError("--for needs --faults random: without it the steps determine the length of a run")


def fault_choice(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that choose random faults; the command gets them as `choice`."""

    @wraps(function)
    def with_choice(*args: Any, **named: Any) -> Any:
        said = Choice(named.pop("fault_every"), named.pop("fault_kinds"), named.pop("fault_aims"))
        return function(*args, choice=said, **named)

    return _with(with_choice, _CHOICE)


def campaign_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of a campaign of scenarios; the command gets them as `campaign`."""

    @wraps(function)
    def with_campaign(*args: Any, choice: Choice, **named: Any) -> Any:
        request = CampaignRequest(
            named.pop("seeds"), named.pop("jobs"), named.pop("faults"), named.pop("duration_s"), choice
        )
        return function(*args, campaign=request, **named)

    return _with(fault_choice(with_campaign), _CAMPAIGN)


def _with(function: Callable[..., Any], options: tuple[Callable[..., Any], ...]) -> Callable[..., Any]:
    for option in reversed(options):
        function = option(function)
    return function
