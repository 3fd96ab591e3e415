"""A campaign in progress on the terminal: a live view, or a line at most every ten seconds where stderr is not a terminal."""

from __future__ import annotations

from types import TracebackType
from typing import Self

from rich.console import Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from fieldtwin.console import stderr
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.run.campaigns.progress import CampaignProgress

LINE_S = 10.0
"""Shortest time between two lines of progress, in seconds."""
REFRESH_PER_S = 4
BAR_WIDTH = 40
MOST_TITLE = 28
"""Largest width of the title, in columns."""


class CampaignView:
    """The view of a campaign. It is updated during ``with CampaignView(...) as view: view.ended(seed, hours, cause)``."""

    def __init__(self, title: str, total: int, clock: Clock | None = None) -> None:
        self._clock = clock or WallClock()
        self.progress = CampaignProgress(title, total, self._clock.monotonic_ns())
        self._next_line_ns = self.progress.began_ns + round(LINE_S * NS_PER_S)
        self._live: Live | None = None
        if stderr.is_terminal and total:
            self._live = Live(
                console=stderr, refresh_per_second=REFRESH_PER_S, transient=True, get_renderable=self._render
            )

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        if self._live is not None:
            self._live.stop()

    def ended(self, seed: int, hours: float, cause: str | None, coverage: str = "") -> None:
        """Count a run that has ended (see `CampaignProgress.ended`)."""
        self.progress.ended(seed, hours, cause, coverage)
        if self._live is not None:
            return
        if cause is not None and len(self.progress.failures) == self.progress.failed:
            stderr.print(f"! seed {seed}: {cause}", soft_wrap=True, markup=False)
        now_ns = self._clock.monotonic_ns()
        if now_ns >= self._next_line_ns:
            self._next_line_ns = now_ns + round(LINE_S * NS_PER_S)
            stderr.print(line(self.progress, now_ns), soft_wrap=True, markup=False)

    def _render(self) -> RenderableType:
        return render(self.progress, self._clock.monotonic_ns())


def line(progress: CampaignProgress, now_ns: int) -> str:
    """Return the progress as one line."""
    covered = [f"{len(progress.coverage)} different situations"] if progress.coverage.elements else []
    parts = [
        f"{progress.done} of {progress.total} runs",
        f"{progress.failed} failed",
        f"{_hours(progress.hours)} of virtual time",
        f"{progress.hours_per_hour(now_ns):,.0f} virtual hours per hour",
        *covered,
        _remaining(progress, now_ns),
    ]
    return ", ".join(parts)


def render(progress: CampaignProgress, now_ns: int) -> RenderableType:
    """Return the live view. Lines that are wider than the terminal are cut."""
    share = progress.done / progress.total
    head = Table.grid(padding=(0, 1))
    title = Text(f" {progress.title}", "bold reverse")
    title.truncate(MOST_TITLE, overflow="ellipsis")
    head.add_row(
        title.append(" "),
        Text(f"{progress.done} of {progress.total} runs"),
        ProgressBar(total=progress.total, completed=progress.done, width=BAR_WIDTH if stderr.width >= 100 else 16),
        Text(f"{100 * share:.0f} %"),
    )
    facts = Table.grid(padding=(0, 2))
    facts.add_column(style="dim")
    rate = progress.runs_per_s(now_ns)
    shown_rate = f"{rate:.2f} runs/s" if rate >= 0.1 else f"{rate * 60:.2f} runs/min"
    facts.add_row("rate", f"{shown_rate}, {_remaining(progress, now_ns)}" if progress.done else "no run has ended yet")
    hours = f"{_hours(progress.hours)}, {progress.hours_per_hour(now_ns):,.0f} hours per hour"
    if progress.done:
        facts.add_row("virtual time", hours)
    if progress.coverage.elements:
        facts.add_row("coverage", f"{len(progress.coverage):,} different situations")
    facts.add_row("failed", Text(str(progress.failed), "bold red") if progress.failed else Text("none", "green"))
    parts: list[RenderableType] = [head, facts]
    for failure in progress.failures:
        shown = (f"  seed {failure.seed}", "red"), f"  {failure.cause}"
        parts.append(Text.assemble(*shown, no_wrap=True, overflow="ellipsis"))
    if (more := progress.failed - len(progress.failures)) > 0:
        parts.append(Text(f"  and {more} more", "dim"))
    return Group(*parts)


def _hours(hours: float) -> str:
    return f"{hours:,.6g} h" if hours >= 2 else f"{hours * 60:.3g} min"


def _remaining(progress: CampaignProgress, now_ns: int) -> str:
    left_s = progress.remaining_s(now_ns)
    return "" if left_s is None else f"{wall_time(left_s)} left"


def wall_time(seconds: float) -> str:
    """Return a wall time as text: ``12 s``, ``3 min 20 s`` or ``5 h 10 min``."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
