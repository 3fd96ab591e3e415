"""Stylesheets for SVG files: literal colours for every viewer, and dark ones where the reader prefers a dark page.

Many viewers (CairoSVG, librsvg, editors) know neither variables of CSS nor media queries, and draw black where a colour is
`var(--ink)`. A stylesheet made here has literal colours in its plain rules, and the dark ones in a media query.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

_RULE = re.compile(r"([^{}]+)\{([^{}]*)\}")
_ALPHA = re.compile(r"(fill|stroke): (#[0-9a-fA-F]{6})([0-9a-fA-F]{2})\b")
_NAME = re.compile(r"var\(--([\w-]+)\)")


def themed(rules: str, light: Mapping[str, str], dark: Mapping[str, str]) -> str:
    """Return `rules` with each `var(--name)` as the colour in `light`, and in a media query as the colour in `dark`.

    A colour with an opacity (`#rrggbbaa`) becomes two declarations. `rules` is CSS without nested blocks.

    Raises KeyError for a name without a colour.
    """
    plain, other = [], []
    for match in _RULE.finditer(rules):
        selector = " ".join(match[1].split())
        declarations = [part.strip() for part in match[2].split(";") if part.strip()]
        plain.append(_rule(selector, declarations, light))
        if coloured := [part for part in declarations if _NAME.search(part)]:
            other.append("  " + _rule(selector, coloured, dark))
    return "\n".join([*plain, "@media (prefers-color-scheme: dark) {", *other, "}"])


def _rule(selector: str, declarations: list[str], colours: Mapping[str, str]) -> str:
    body = "; ".join(_NAME.sub(lambda name: colours[name[1]], part) for part in declarations)
    return f"{selector} {{ {_ALPHA.sub(_opaque, body)} }}"


def _opaque(match: re.Match[str]) -> str:
    return f"{match[1]}: {match[2]}; {match[1]}-opacity: {int(match[3], 16) / 255:.2g}"
