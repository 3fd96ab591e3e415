"""The parts of the drawing of a sequential function chart, in the notation of IEC 61131-3 (6.7): steps, transitions and branches.

Each piece has an axis, the vertical line that joins it to the pieces above and below it. `left` and `right` are its widths
on both sides of the axis. Sizes are in px.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from fieldtwin.plc.st.charts.check import TIMED, indicators
from fieldtwin.plc.st.drawing.canvas import CHAR, LINE, Canvas, shortened, widest, wrapped
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.written import text_of

_STEP_H, _ROW_H, _STUB = 40.0, 22.0, 16.0
_LONGEST_NAME = 40
_CONDITION = (36, 4)
"""The most characters in a line of a condition, and the most lines."""
_BAR = 15.0
"""Half of the width of the bar of a transition."""
_GAP = 26.0
"""The distance between two branches."""
_BEYOND = 18.0
"""How far the double line of a simultaneous branch reaches beyond its outer branches."""


class Piece:
    """A part of a chart. `open` is whether a line leads on from its lower end."""

    left = right = height = 0.0
    open = True

    def draw(self, canvas: Canvas, x: float, y: float) -> None:
        """Draw the piece with its axis at `x` and its upper end at `y`."""
        raise NotImplementedError


class StepPiece(Piece):
    """A step with its action blocks. The outline of the initial step is double."""

    def __init__(self, step: t.Step) -> None:
        self.step, self.name = step, shortened(step.name, _LONGEST_NAME)
        self.half = max(84.0, len(self.name) * CHAR + 26) / 2
        self.rows = [_action_row(one) for one in step.associations]
        self.widths = [
            max(26.0, widest(column) + 14) if any(column) else 0.0 for column in zip(*self.rows, strict=True)
        ]
        self.left = self.half
        self.right = self.half + (_STUB + sum(self.widths) if self.rows else 0)
        self.height = max(_STEP_H, _STEP_H / 2 - _ROW_H / 2 + _ROW_H * len(self.rows) + 6)

    def draw(self, canvas: Canvas, x: float, y: float) -> None:
        middle = y + _STEP_H / 2
        if self.height > _STEP_H:
            canvas.line((x, y + _STEP_H), (x, y + self.height))
        with canvas.group("step", self.step.name, step=self.step.name):
            canvas.rect(x - self.half, y, 2 * self.half, _STEP_H)
            if self.step.initial:
                canvas.rect(x - self.half + 4, y + 4, 2 * self.half - 8, _STEP_H - 8, "inner")
            canvas.text(x, middle + 4, self.name, "name")
        if not self.rows:
            return
        canvas.line((x + self.half, middle), (x + self.half + _STUB, middle))
        for number, row in enumerate(self.rows):
            left, top = x + self.half + _STUB, middle - _ROW_H / 2 + number * _ROW_H
            one = self.step.associations[number]
            with canvas.group(
                "action", ", ".join(filter(None, row)), action=f"{self.step.name}.{number}", of=one.action
            ):
                for text, width in zip(row, self.widths, strict=True):
                    if width:
                        canvas.rect(left, top, width, _ROW_H, "field")
                        canvas.text(left + width / 2, top + _ROW_H / 2 + 4, text)
                    left += width


def _action_row(one: t.Association) -> tuple[str, str, str]:
    """Return the fields of an action block: the qualifier with its time, the action, and its indicator variables."""
    time = f" {text_of(one.arguments[0])}" if one.qualifier in TIMED and one.arguments else ""
    shown = ", ".join(text_of(indicator) for indicator in indicators(one))
    return (
        shortened(one.qualifier + time, 24), shortened(one.action, _LONGEST_NAME), shortened(shown, _LONGEST_NAME)
    )  # fmt: skip


class TransitionPiece(Piece):
    """A transition: a bar with its condition on the right, and its priority if the source states one."""

    def __init__(self, transition: t.Transition, number: int) -> None:
        self.transition, self.number = transition, number
        condition = transition.name if transition.body else text_of(transition.condition)
        named = f"{transition.name}: " if transition.name and not transition.body else ""
        self.whole = named + condition
        self.lines = wrapped(self.whole, *_CONDITION)
        self.priority = "" if transition.priority is None else str(transition.priority)
        self.left = _BAR + (8 + len(self.priority) * CHAR if self.priority else 0)
        self.right = _BAR + 8 + widest(self.lines)
        self.height = max(36.0, len(self.lines) * LINE + 12)

    def draw(self, canvas: Canvas, x: float, y: float) -> None:
        middle = y + self.height / 2
        canvas.line((x, y), (x, y + self.height))
        with canvas.group("transition", self.whole, transition=str(self.number)):
            canvas.rect(x - _BAR, middle - 2, 2 * _BAR, 4, "bar")
            for number, line in enumerate(self.lines):
                top = middle - len(self.lines) * LINE / 2
                canvas.text(x + _BAR + 8, top + 11.5 + number * LINE, line, anchor="start")
            if self.priority:
                canvas.text(x - _BAR - 6, middle + 4, self.priority, "soft", "end")


class JumpPiece(Piece):
    """An arrow to a step that is drawn elsewhere, or to the transition that joins it with other steps."""

    open = False

    def __init__(self, name: str) -> None:
        self.name = shortened(name, _LONGEST_NAME)
        self.left = self.right = max(20.0, len(self.name) * CHAR / 2)
        self.height = 46.0

    def draw(self, canvas: Canvas, x: float, y: float) -> None:
        canvas.line((x, y), (x, y + 18))
        canvas.tip(x, y + 25)
        with canvas.group("jump"):
            canvas.text(x, y + 40, self.name)


class NotePiece(Piece):
    """A text above the first transition of a part that is drawn separately."""

    def __init__(self, text: str) -> None:
        self.text = shortened(text, 2 * _LONGEST_NAME)
        self.left = self.right = len(self.text) * CHAR / 2
        self.height = 24.0

    def draw(self, canvas: Canvas, x: float, y: float) -> None:
        canvas.text(x, y + 12, self.text, "soft")


@dataclass
class Column(Piece):
    """Pieces below each other."""

    pieces: list[Piece] = field(default_factory=list)

    @property
    def left(self) -> float:  # type: ignore[override]
        return max((piece.left for piece in self.pieces), default=0.0)

    @property
    def right(self) -> float:  # type: ignore[override]
        return max((piece.right for piece in self.pieces), default=0.0)

    @property
    def height(self) -> float:  # type: ignore[override]
        return sum(piece.height for piece in self.pieces)

    def draw(self, canvas: Canvas, x: float, y: float) -> None:
        for piece in self.pieces:
            piece.draw(canvas, x, y)
            y += piece.height


class Branches(Piece):
    """Alternative branches, between single lines, or simultaneous ones, between double lines."""

    def __init__(self, columns: Sequence[Column], double: bool) -> None:
        self.columns, self.double = columns, double
        places, at = [], 0.0
        for column in columns:
            at += column.left
            places.append(at)
            at += column.right + _GAP
        axis = (places[0] + places[-1]) / 2
        self.places = [place - axis for place in places]
        """The axes of the branches, from the axis of the whole."""
        self.inside = max(column.height for column in columns)
        self.open = any(column.open for column in columns)
        beyond = _BEYOND if double else 0.0
        self.left = max(columns[0].left - self.places[0], beyond - self.places[0])
        self.right = max(at - _GAP - axis, beyond + self.places[-1])
        self.lines = 5.0 if double else 0.0
        """The distance of the double lines."""
        self.stub = 12.0 if double else 0.0
        """The distance between the double lines and the branches."""
        self.height = _STUB + self.lines + 2 * self.stub + self.inside + (self.lines + _STUB if self.open else 0)

    def draw(self, canvas: Canvas, x: float, y: float) -> None:
        canvas.line((x, y), (x, y + _STUB))
        self._across(canvas, x, y + _STUB, [0.0, *self.places])
        top = y + _STUB + self.lines + self.stub
        bottom = top + self.inside + self.stub
        for column, place in zip(self.columns, self.places, strict=True):
            if self.stub:
                canvas.line((x + place, top - self.stub), (x + place, top))
            column.draw(canvas, x + place, top)
            if column.open and top + column.height < bottom:
                canvas.line((x + place, top + column.height), (x + place, bottom))
        if self.open:
            ends = [place for column, place in zip(self.columns, self.places, strict=True) if column.open]
            self._across(canvas, x, bottom, [0.0, *ends])
            canvas.line((x, bottom + self.lines), (x, y + self.height))

    def _across(self, canvas: Canvas, x: float, y: float, places: Sequence[float]) -> None:
        beyond = _BEYOND if self.double else 0.0
        left, right = x + min(places) - beyond, x + max(places) + beyond
        canvas.line((left, y), (right, y))
        if self.double:
            canvas.line((left, y + self.lines), (right, y + self.lines))
