"""The options that set the tolerances between two runs; several commands share them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from fieldtwin.cli.options import Duration

_OPTIONS = (
    click.option(
        "--tolerance",
        "tolerances",
        multiple=True,
        metavar="[TAG=]AMOUNT",
        help="Tolerance of values: 2% of their size, or DEVICE.TAG=0.5. Repeatable; default: 1%.",
    ),
    click.option("--window", "window_s", type=Duration(), default="1s", show_default=True, help="Tolerance of times."),
    click.option(
        "--ignore",
        "ignored",
        multiple=True,
        metavar="NAME",
        help="Tag, device, state or program to ignore. Repeatable.",
    ),
)


def tolerance_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options for ``tolerances``, ``window_s`` and ``ignored``."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command
