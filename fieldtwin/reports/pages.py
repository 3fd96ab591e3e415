"""HTML pages from the templates in this folder. A template escapes every value, so that a name from a file cannot become markup.

This module does not depend on the contents of reports.
"""

from __future__ import annotations

from functools import cache

from jinja2 import Environment, PackageLoader, StrictUndefined

from fieldtwin.reports.markup import Markup, clean
from fieldtwin.results.model import Verdict

MARKS = {
    Verdict.PASSED: "✓", Verdict.FAILED: "✗", Verdict.ERROR: "!", Verdict.INCONCLUSIVE: "?", Verdict.SKIPPED: "–",
}  # fmt: skip


def fill(template: str, **values: object) -> Markup:
    """Return the template with `values`. Characters that no document may hold become replacement characters."""
    return Markup(clean(_environment().get_template(template).render(values)))


def cut(text: str, most: int) -> str:
    """Return `text` with at most `most` characters; a longer text is cut and ends with an ellipsis."""
    return text if len(text) <= most else text[: most - 1] + "…"


def duration(seconds: float) -> str:
    """Return a duration as text, such as ``0.25 s``, ``12 min`` or ``3.5 h``."""
    if seconds >= 5400:
        return f"{seconds / 3600:.3g} h"
    if seconds >= 90:
        return f"{seconds / 60:.3g} min"
    return f"{seconds:.3g} s"


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("fieldtwin.reports"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    environment.filters |= {"cut": cut, "duration": duration}
    environment.globals["MARKS"] = MARKS
    return environment
