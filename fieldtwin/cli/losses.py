"""Print what a conversion of a description loses."""

from __future__ import annotations

from collections.abc import Iterable

from fieldtwin.console import stderr
from fieldtwin.descriptions.conversion import Loss

SHOWN_PLACES = 4


def show_losses(losses: Iterable[Loss]) -> None:
    """Print the losses on stderr; those with the same property and reason in one line, with the first places."""
    together: dict[tuple[bool, str, str], list[str]] = {}
    for loss in losses:
        together.setdefault((loss.note, loss.what, loss.why), []).append(loss.place)
    for (note, what, why), places in together.items():
        more = f" and {len(places) - SHOWN_PLACES} more" if len(places) > SHOWN_PLACES else ""
        label = "not converted" if note else "lost"
        stderr.print(f"{label}: {what} ({', '.join(places[:SHOWN_PLACES])}{more}): {why}", soft_wrap=True, markup=False)
