"""The two consoles: results on stdout, diagnostics on stderr.

rich honours NO_COLOR, and prints without colour if the output is not a terminal.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NoReturn

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from fieldtwin.gateway.core.escaping import escape_controls


class _Console(Console):
    def on_broken_pipe(self) -> NoReturn:
        """Do nothing, because rich would end the program with exit code 1. For `| head` a broken pipe is not an error: see
        `LazyGroup.invoke`.
        """
        self.quiet = True
        raise BrokenPipeError

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        """Render as rich does, but show control characters in a text instead of sending them. Otherwise a name in an untrusted
        file could clear the screen or change the title of the terminal.
        """
        for segment in super().render(renderable, options):
            text = segment.text if segment.control is not None else escape_controls(segment.text)
            yield segment if text is segment.text else Segment(text, segment.style)


# emoji=False: `model.py:Boom:` in a text is the name of a user's class and must not become a picture of an explosion.
stderr = _Console(stderr=True, highlight=False, emoji=False)
stdout = _Console(highlight=False, emoji=False)


def show_warnings(warnings: Iterable[str]) -> None:
    """Print warnings for the author of a file, one line each, on stderr."""
    for warning in warnings:
        stderr.print(f"warning: {warning}", style="yellow", soft_wrap=True, markup=False)
