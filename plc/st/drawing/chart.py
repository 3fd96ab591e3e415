"""Draw a sequential function chart as SVG, from top to bottom.

The chart is followed from its initial step. Alternative branches end where they lead to the same step, and simultaneous ones at
the transition that joins them. Each step is drawn once. A transition to a step that is already drawn becomes an arrow with the
name of the step, which the standard allows for a loop. A join that is not at the end of one branch is drawn separately.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence

from fieldtwin.plc.st.drawing.canvas import Canvas
from fieldtwin.plc.st.drawing.pieces import (
    Branches,
    Column,
    JumpPiece,
    NotePiece,
    StepPiece,
    TransitionPiece,
)
from fieldtwin.plc.st.syntax import tree as t

_BETWEEN = 60.0
"""The distance between parts that are drawn separately, in px."""


def draw_chart(chart: t.Chart, title: str, style: bool = True) -> str:
    """Return a chart as SVG text; without `style`, a page has the style. The chart has one initial step and no unknown steps."""
    canvas, x = Canvas(), 0.0
    for part in _Layout(chart).parts():
        part.draw(canvas, x + part.left, 0.0)
        x += part.left + part.right + _BETWEEN
    return canvas.svg(title, style)


class _Layout:
    """The arrangement of the steps and transitions of a chart in columns."""

    def __init__(self, chart: t.Chart) -> None:
        self.chart = chart
        self.steps = {step.name.lower(): step for step in chart.steps}
        self.numbers = {id(one): number for number, one in enumerate(chart.transitions)}
        order = sorted(chart.transitions, key=lambda one: (one.priority is None, one.priority or 0))
        self.leaving = {
            name: [one for one in order if name in map(str.lower, one.sources)] for name in self.steps
        }  # fmt: skip
        self.placed: set[str] = set()
        self.drawn: set[int] = set()
        """The numbers of the transitions that are drawn."""
        self.reserved: list[str] = []
        """The steps after the branches that are being drawn."""

    def parts(self) -> list[Column]:
        """Return the chart from its initial step, and the parts that begin with a join elsewhere."""
        first = next(step.name.lower() for step in self.chart.steps if step.initial)
        found = [self._column(first, None)]
        for one in self.chart.transitions:
            if self.numbers[id(one)] not in self.drawn:
                column = Column([NotePiece(_join(one))])
                self._after(column, one, None)
                found.append(column)
        for name in self.steps:
            if name not in self.placed:
                found.append(self._column(name, None))
        return found

    def _column(self, step: str, end: str | t.Transition | None) -> Column:
        column = Column()
        self._sequence(column, step, end)
        return column

    def _sequence(self, column: Column, step: str | None, end: str | t.Transition | None) -> None:
        """Add a step, and what follows it, up to `end`: the step or the joining transition after the branches around it."""
        while step is not None:
            if step == end:
                return
            if step in self.placed or step in self.reserved:
                self._jump(column, self.steps[step].name)
                return
            self.placed.add(step)
            column.pieces.append(StepPiece(self.steps[step]))
            leaving = [one for one in self.leaving[step] if self.numbers[id(one)] not in self.drawn]
            if not leaving:
                column.open = False
                return
            if len(leaving) > 1:
                step = self._alternatives(column, leaving, end)
                continue
            (only,) = leaving
            if only is end:
                return
            if len(only.sources) > 1:
                self._jump(column, _join(only))
                return
            step = self._after(column, only, end, follow=False)

    def _jump(self, column: Column, name: str) -> None:
        column.pieces.append(JumpPiece(name))
        column.open = False

    def _after(
        self, column: Column, one: t.Transition, end: str | t.Transition | None, follow: bool = True
    ) -> str | None:
        """Add a transition and, with `follow`, the steps after it. Return the step that still has to be added, or None."""
        self.drawn.add(self.numbers[id(one)])
        column.pieces.append(TransitionPiece(one, self.numbers[id(one)]))
        step = one.targets[0].lower() if len(one.targets) == 1 else self._simultaneous(column, one, end)
        if step is None or not follow:
            return step
        self._sequence(column, step, end)
        return None

    def _simultaneous(self, column: Column, one: t.Transition, end: str | t.Transition | None) -> str | None:
        targets = [name.lower() for name in one.targets]
        join = self._joining(targets)
        branches = Branches([self._column(name, join) for name in targets], double=True)
        column.pieces.append(branches)
        if join is None or not branches.open:
            column.open = False
            return None
        if join is end:  # the branches around this one end at the same join
            return None
        return self._after(column, join, end, follow=False)

    def _alternatives(
        self, column: Column, leaving: Sequence[t.Transition], end: str | t.Transition | None
    ) -> str | None:
        merge = self._merging(leaving, end)
        inner = end if merge is None else merge
        if merge is not None and merge != end:
            self.reserved.append(merge)
        columns = []
        groups = self._groups(leaving, inner)
        for group in groups if len(groups) > 1 else [[one] for one in leaving]:
            branch, (one, *others) = Column(), group
            if others:  # these lead to one step before the others do
                self._sequence(branch, self._alternatives(branch, group, inner), inner)
            elif len(one.sources) > 1:
                self._jump(branch, _join(one))
            else:
                self._after(branch, one, inner)
            columns.append(branch)
        if merge is not None and merge != end:
            self.reserved.remove(merge)
        branches = Branches(columns, double=False)
        column.pieces.append(branches)
        column.open = branches.open
        return merge if branches.open and merge != end else None

    # -- where branches end -------------------------------------------------------------------------------------------------

    def _distances(self, steps: Iterable[str], end: str | t.Transition | None) -> dict[str, int]:
        """Return the steps that can be reached from `steps` without a step that is already drawn, and their distances."""
        found: dict[str, int] = {}
        waiting = deque((step, 0) for step in steps)
        while waiting:
            step, distance = waiting.popleft()
            if step in found or step in self.placed or (step in self.reserved and step != end):
                continue
            found[step] = distance
            if step != end:
                waiting.extend(
                    (name.lower(), distance + 1) for one in self.leaving[step] if one is not end for name in one.targets
                )
        return found

    def _groups(self, leaving: Sequence[t.Transition], end: str | t.Transition | None) -> list[list[t.Transition]]:
        """Return the alternatives in groups that lead to a common step before `end`."""
        groups: list[tuple[set[str], list[t.Transition]]] = []
        for one in leaving:
            steps = set(self._distances(map(str.lower, one.targets), end)) - {end}
            near = [group for group in groups if group[0] & steps]
            groups = [group for group in groups if group not in near]
            groups.append((steps.union(*(own for own, _ in near)), [each for _, own in near for each in own] + [one]))
        return [own for _, own in groups]

    def _merging(self, leaving: Sequence[t.Transition], end: str | t.Transition | None) -> str | None:
        """Return the step to which most of the alternatives lead, the nearest one first.

        If only one of them leads on, return its step, so that the others are short branches at the side of the main sequence.
        """
        reached = [self._distances(map(str.lower, one.targets), end) for one in leaving]
        counts = {step: [each[step] for each in reached if step in each] for each in reached for step in each}
        shared = {step: distances for step, distances in counts.items() if len(distances) > 1}
        leading_on = [one for one, steps in zip(leaving, reached, strict=True) if steps]
        if not shared and len(leading_on) == 1 and len(leading_on[0].targets) == 1:
            return leading_on[0].targets[0].lower()
        return min(shared, key=lambda step: (-len(shared[step]), sum(shared[step])), default=None)

    def _joining(self, targets: Sequence[str]) -> t.Transition | None:
        """Return the nearest transition that joins simultaneous branches, or None."""
        reached = [self._distances([name], None) for name in targets]
        best: tuple[int, int, t.Transition] | None = None
        for one in self.chart.transitions:
            if len(one.sources) < 2 or self.numbers[id(one)] in self.drawn:
                continue
            sources = [name.lower() for name in one.sources]
            of = {n for n, each in enumerate(reached) for name in sources if name in each}
            near = [min((each[name] for each in reached if name in each), default=-1) for name in sources]
            rank = (-len(of), sum(near))
            if len(of) > 1 and min(near) >= 0 and (best is None or rank < best[:2]):
                best = (*rank, one)
        return best[2] if best is not None else None


def _join(one: t.Transition) -> str:
    return f"join of {', '.join(one.sources)}"
