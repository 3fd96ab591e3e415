"""The options of `fieldtwin compare`: the tolerances within which answers are equal, and the requests to a live device."""

from __future__ import annotations

from dataclasses import dataclass

import click

from fieldtwin.capture.recordings.comparing import Rules, Tolerance
from fieldtwin.cli.option_groups import option
from fieldtwin.cli.options import Duration, pairs
from fieldtwin.gateway.core.errors import UsageError


@dataclass(frozen=True)
class RuleOptions:
    """The options that state by how much the two compared sides may differ, as texts."""

    tolerances: tuple[str, ...] = option(
        "--tolerance",
        multiple=True,
        metavar="[TAG=]AMOUNT",
        help="Tolerance of values, such as 2 or 1% or frequency=0.05; repeatable. Default: 0.",
    )
    latency: str = option(
        "--latency",
        default="20ms/50%",
        show_default=True,
        metavar="AMOUNT",
        help="Permitted difference of each function's median and 90th percentile latency: a time, a percentage of the recorded "
        "latency, or both (the larger applies); `any`: latencies are not compared.",
    )
    least: float = option(
        "--least",
        type=click.FloatRange(0, 100),
        default=100.0,
        show_default=True,
        metavar="PERCENT",
        help="Required share of equal exchanges.",
    )

    @property
    def rules(self) -> Rules:
        """Return the parsed rules. Raises `UsageError`."""
        return Rules(*_tolerances(self.tolerances), _latency(self.latency), self.least / 100)


@dataclass(frozen=True)
class LiveOptions:
    """The options for the requests to a live device and for the confirmation of writes. `most` None: every request of the
    recording.
    """

    most: int | None = option(
        "--most", type=click.IntRange(1), default=None, help="With a live device: send only this many requests."
    )
    listen_s: float = option(
        "--listen",
        type=Duration(),
        default="0s",
        help="With a live bus: listen for this time, and compare messages too.",
    )
    spacing_s: float = option(
        "--spacing", type=Duration(), default="0s", help="With a live device: pause after every exchange."
    )
    writes: bool = option(
        "--writes", is_flag=True, help="With a live device: repeat the recorded writes as well, after a confirmation."
    )
    yes: bool = option("--yes", is_flag=True, help="With --writes: do not ask for confirmation.")
    i_know: bool = option(
        "--i-know", is_flag=True, help="With --writes: repeat broadcasts and restarts (FC08) as well."
    )
    dry_run: bool = option(
        "--dry-run", is_flag=True, help="With a live device: print the frames that would be sent; send nothing."
    )


def _tolerances(texts: tuple[str, ...]) -> tuple[Tolerance, dict[str, Tolerance]]:
    plain = [t for t in texts if "=" not in t]
    named = pairs(tuple(t for t in texts if "=" in t), "--tolerance")
    if len(plain) > 1:
        raise UsageError("several tolerances without a tag; at most one is possible", got=", ".join(plain))
    return (_tolerance(plain[0]) if plain else Tolerance()), {tag: _tolerance(text) for tag, text in named.items()}


def _tolerance(text: str) -> Tolerance:
    try:
        if text.endswith("%"):
            return Tolerance(share=_positive(text[:-1]) / 100)
        return Tolerance(_positive(text))
    except ValueError:
        raise UsageError("cannot read a tolerance", expected="a number such as 2, or 1%", got=text) from None


def _positive(text: str) -> float:
    value = float(text)
    if not 0 <= value < 1e300:
        raise ValueError
    return value


def _latency(text: str) -> Tolerance | None:
    if text == "any":
        return None
    absolute = share = 0.0
    for part in text.split("/"):
        if part.endswith("%"):
            share = _tolerance(part).share
        else:
            absolute = float(Duration().convert(part, None, None))
    return Tolerance(absolute, share)
