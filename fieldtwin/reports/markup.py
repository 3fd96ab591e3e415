"""SVG elements as Python values: text is escaped unless it is markup already, so that a name from a file cannot become markup.

This module does not depend on the contents of reports. Pages are made from templates (fieldtwin.reports.pages).
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from html import escape

from markupsafe import Markup as Markup  # re-exported for modules that make or annotate markup

Child = str | Iterable["Child"] | None

_SVG_EMPTY = frozenset({"rect", "path", "line", "circle", "polyline", "use"})
_UNSEEN = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff\u202a-\u202e\u2066-\u2069]")
"""Characters that no document may hold, or that change the direction of reading: shown as a replacement character."""


def text(value: object) -> Markup:
    """Return text for element content and attributes: escaped, and without characters that no document may hold."""
    return value if isinstance(value, Markup) else Markup(escape(_UNSEEN.sub("\ufffd", str(value))))


def clean(value: object) -> str:
    """Return text without characters that no document may hold, but not escaped, for writers that escape by themselves."""
    return _UNSEEN.sub("\ufffd", str(value))


def join(children: Child) -> Markup:
    """Return the children, concatenated into one markup text; plain text in them is escaped."""
    if children is None:
        return Markup("")
    if isinstance(children, str):
        return text(children)
    return Markup("".join(join(child) for child in children))


def el(name: str, /, *children: Child, **attributes: object) -> Markup:
    """Return the element `name` with these children and attributes.

    ``cls`` is the class, and ``_`` in a name means ``-``. None leaves an attribute out; True writes it without a value.
    """
    parts = [name]
    for key, value in attributes.items():
        attribute = "class" if key == "cls" else key.replace("_", "-")
        if value is True:
            parts.append(attribute)
        elif value is not None and value is not False:
            shown = f"{value:.1f}".removesuffix(".0") if isinstance(value, float) else text(value)
            parts.append(f'{attribute}="{shown}"')
    head = " ".join(parts)
    if name in _SVG_EMPTY and not children:
        return Markup(f"<{head}/>")
    return Markup(f"<{head}>{join(children)}</{name}>")
