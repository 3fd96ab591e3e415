"""The style sheet of the report, from the file in this folder. Every report includes it completely."""

from __future__ import annotations

from functools import cache
from importlib.resources import files

from fieldtwin.reports.markup import Markup


@cache
def style() -> Markup:
    """Return the style sheet."""
    return Markup(files("fieldtwin.reports").joinpath("style.css").read_text(encoding="utf-8"))
