"""The timing diagram of a failure: no text crosses a line of the time grid or the line of the verdict."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
from test_report_pages import FAILED, MS, TRACE, report, scenario

from fieldtwin.reports.run.axis import LEFT
from fieldtwin.reports.run.html import render_html

GLYPH = 6.0
"""Width of a character in px, a little less than what the diagram reserves for it."""


def crossings(svg: str) -> list[str]:
    """Return the texts of a diagram that a vertical line crosses without a box between them."""
    failed = float(re.search(r'class="failed" x1="([\d.]+)"', svg)[1])  # type: ignore[index]
    crossed = []
    for lane in re.findall(r'<g transform="translate.*?</g>', svg, re.DOTALL):
        grid = [
            tuple(map(float, g)) for g in re.findall(r'"grid" x1="([\d.]+)" x2="[\d.]+" y1="(\S+)" y2="(\S+)"', lane)
        ]
        for cls, x, y, said in re.findall(r'<text class="([\w ]+)" x="([\d.]+)" y="([\d.]+)">([^<]*)</text>', lane):
            x1, x2, top, low = float(x), float(x) + len(said) * GLYPH, float(y) - 8, float(y) + 2
            boxed = cls.startswith(("faulttext", "qtext", "statetext", "valuetext"))
            cut = x1 < failed < x2 or any(x1 < gx < x2 and y1 < low and y2 > top for gx, y1, y2 in grid if not boxed)
            if cut and x1 >= LEFT:
                crossed.append(said)
    return crossed


@pytest.mark.parametrize("at_ms", range(12_300, 14_300, 250))
def test_no_text_of_a_timing_diagram_crosses_a_line(at_ms: int) -> None:
    failed = replace(FAILED, t_ns=at_ms * MS, since_ns=(at_ms - 800) * MS)
    html = render_html(report(scenario(trace=TRACE, checks=(failed,))))
    svg = re.search(r'<svg class="timing".*?</svg>', html, re.DOTALL)
    assert svg is not None
    assert len(re.findall(r'class="(?:words|statetext|qtext)', svg[0])) > 3
    assert crossings(svg[0]) == []
