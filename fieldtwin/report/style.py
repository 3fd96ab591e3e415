"""The looks of the report: the style sheet beside this file, which goes into every report whole."""

from __future__ import annotations

from functools import cache
from importlib.resources import files

from fieldtwin.report.markup import Markup


@cache
def style() -> Markup:
    """The style sheet."""
    return Markup(files("fieldtwin.report").joinpath("style.css").read_text(encoding="utf-8"))
