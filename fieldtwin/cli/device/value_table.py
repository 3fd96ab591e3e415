"""Values of one device as a table, and the exit code that reports failed reads to a script."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from rich.table import Table
from rich.text import Text

from fieldtwin.commissioning.access.point import PointValue
from fieldtwin.commissioning.access.reading import place_of, text_of
from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.gateway.core.values import Reason

COLOUR = {"good": "", "uncertain": "yellow", "bad": "red"}
REFUSED, UNREACHABLE = 5, 4


def value_table(tags: Sequence[Tag], answers: Mapping[str, PointValue]) -> Table:
    """Return a table with name, value, unit, address and the raw data received."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("name", overflow="fold")
    table.add_column("value", overflow="fold")
    table.add_column("at", overflow="fold")
    table.add_column("raw", overflow="fold", max_width=32)
    for tag in tags:
        answer = answers[tag.name]
        value = answer.value
        text = Text(f"{text_of(tag, answer)} {tag.unit}".rstrip(), COLOUR.get(str(value.quality), ""))
        if answer.problem:
            text = Text(answer.problem, "red")
        elif value.reason is not Reason.NONE:
            text.append(f" ({value.reason})")
        raw = Text("" if tag.secret else value.raw[:24].hex(" ", 2 if tag.at is not None else 1), "dim")
        table.add_row(Text(tag.name), text, Text(place_of(tag) if place_of(tag) != tag.name else ""), raw)
    return table


def exit_code(answers: Iterable[PointValue]) -> int:
    """Return 0 if every value was read; 4 if one was lost on the bus, else 5 if the device refused one."""
    reasons = {a.value.reason for a in answers if a.problem}
    if reasons - {Reason.REFUSED}:
        return UNREACHABLE
    return REFUSED if reasons else 0
