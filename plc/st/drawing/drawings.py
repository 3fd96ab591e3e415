"""The drawings of a unit: its charts, and its bodies in Ladder Diagram and Function Block Diagram."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.plc.st.charts.check import charts_of
from fieldtwin.plc.st.drawing.chart import draw_chart
from fieldtwin.plc.st.drawing.network import count_networks, draw_network
from fieldtwin.plc.st.syntax import tree as t


@dataclass(frozen=True, slots=True)
class Drawing:
    """A drawn body of a POU, or of its `action`: a chart, or the networks of a PLCopen XML file."""

    pou: str
    action: str
    body: t.Chart | t.Graphic

    def svg(self, title: str, network: int = 0, style: bool = True) -> str:
        """Return the drawing as SVG text. `network` selects a network, from 1; 0 draws the whole body.

        Raises `UsageError` for an unknown network, and for a chart with too many branches inside each other.
        """
        if isinstance(self.body, t.Graphic):
            return draw_network(self.body.body, title, network, style)
        if network:
            raise UsageError(f"{title} is a chart, which has no networks")
        try:
            return draw_chart(self.body, title, style)
        except RecursionError as e:
            raise UsageError(f"{title} has too many branches inside each other to be drawn") from e

    @property
    def elements(self) -> int:
        """Return the number of elements, steps and transitions."""
        if isinstance(self.body, t.Graphic):
            return len(self.body.body.children)
        return len(self.body.steps) + len(self.body.transitions)

    @property
    def networks(self) -> int:
        """Return the number of networks; 0 for a chart."""
        return count_networks(self.body.body) if isinstance(self.body, t.Graphic) else 0


def drawings_of(unit: t.SourceUnit) -> Iterator[Drawing]:
    """Return the drawings of all POUs in the order of the unit."""
    for pou in unit.pous:
        yield from (Drawing(pou.name, action, chart) for action, chart in charts_of(pou).items())
        bodies = {"": pou.graphic, **{action.name: action.graphic for action in pou.actions}}
        yield from (Drawing(pou.name, action, body) for action, body in bodies.items() if body is not None)
