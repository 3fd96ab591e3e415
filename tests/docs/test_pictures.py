"""The pictures of the book: every viewer shows their colours, and those that scripts draw are of the present files."""

from __future__ import annotations

import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from page_runner import ROOT

PICTURES = sorted((ROOT / "docs" / "pictures").rglob("*.svg"))
SCREENS = sorted((ROOT / "docs" / "pictures").rglob("*.png"))
DRAWN = {"rect", "path", "line", "circle", "polyline", "polygon", "ellipse", "text"}
MOST_BYTES = 200_000
_RULE = re.compile(r"([^{}]+)\{([^{}]*)\}")
_COLOUR = re.compile(r"(?:^|;)\s*(?:fill|stroke)\s*:\s*(?!var\(|currentcolor)\S", re.IGNORECASE)


def uncoloured(svg: str) -> list[str]:
    """Return the drawn elements that no literal colour applies to, in a viewer without variables and media queries."""
    root = ET.fromstring(svg)
    names = {element: element.tag.rpartition("}")[2] for element in root.iter()}
    style = "".join(element.text or "" for element in root.iter() if names[element] == "style").split("@media")[0]
    selectors = [
        selector.split()[-1]
        for rule in _RULE.finditer(style)
        if _COLOUR.search(rule[2])
        for selector in rule[1].split(",")
        if selector.split()
    ]
    hidden = {child for element in root.iter() if names[element] in ("defs", "clipPath") for child in element.iter()}
    return [
        ET.tostring(element, encoding="unicode")[:160]
        for element in root.iter()
        if names[element] in DRAWN and element not in hidden and not _is_coloured(element, names[element], selectors)
    ]


def _is_coloured(element: ET.Element, name: str, selectors: list[str]) -> bool:
    attributes = ";".join(f"{key}:{element.get(key)}" for key in ("fill", "stroke") if element.get(key))
    if _COLOUR.search(f"{attributes};{element.get('style', '')}"):
        return True
    classes = set(element.get("class", "").split())
    for selector in selectors:
        tag, *wanted = selector.split(".")
        if tag in ("", name) and classes >= set(wanted) and (tag or wanted):
            return True
    return False


@pytest.mark.parametrize("path", PICTURES, ids=lambda path: path.stem)
def test_every_element_of_a_picture_has_a_literal_colour(path: Path) -> None:
    svg = path.read_text("utf-8")
    assert "var(" not in svg
    assert uncoloured(svg) == []


def test_an_element_that_only_a_variable_colours_is_found() -> None:
    svg = '<svg xmlns="http://www.w3.org/2000/svg"><style>.a { fill: var(--a) } .b { fill: #fff }</style>%s</svg>'
    assert uncoloured(svg % '<rect class="b"/><text fill="red"/>') == []
    assert len(uncoloured(svg % '<rect class="a"/><rect/><text fill="currentColor"/>')) == 3


@pytest.mark.parametrize("path", PICTURES, ids=lambda path: path.stem)
def test_cairosvg_draws_a_picture_in_more_than_black(path: Path) -> None:
    cairosvg = pytest.importorskip("cairosvg", reason="pip install cairosvg", exc_type=ImportError)
    pixels = cairosvg.svg2png(bytestring=path.read_bytes(), output_width=200)
    assert len(pixels) > 2000  # a black rectangle is compressed to less


def test_diagrams_are_of_the_present_files() -> None:
    done = subprocess.run([sys.executable, "scripts/diagrams", "--check"], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_screenshots_are_small() -> None:
    assert {path.stem for path in SCREENS} >= {"acceptance", "report"}
    assert [path.name for path in SCREENS if path.stat().st_size > MOST_BYTES] == []


def test_every_picture_is_on_a_page() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    shown = "".join(page.read_text("utf-8") for page in pages)
    assert [path.name for path in [*PICTURES, *SCREENS] if f"/{path.name})" not in shown] == []
