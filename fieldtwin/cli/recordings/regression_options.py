"""The options for the tolerances between two runs."""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.cli.option_groups import option
from fieldtwin.cli.options import Duration


@dataclass(frozen=True)
class ToleranceOptions:
    """The options for tolerances of values (as texts) and of times (in seconds), and the names to ignore."""

    tolerances: tuple[str, ...] = option(
        "--tolerance",
        multiple=True,
        metavar="[TAG=]AMOUNT",
        help="Tolerance of values: 2% of their size, or DEVICE.TAG=0.5. Repeatable; default: 1%.",
    )
    window_s: float = option("--window", type=Duration(), default="1s", show_default=True, help="Tolerance of times.")
    ignored: tuple[str, ...] = option(
        "--ignore", multiple=True, metavar="NAME", help="Tag, device, state or program to ignore. Repeatable."
    )
