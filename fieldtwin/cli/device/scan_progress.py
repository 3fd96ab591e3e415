"""The progress of a scan: a bar with an estimate on a terminal, elsewhere one line per phase."""

from __future__ import annotations

from types import TracebackType
from typing import Self

from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from fieldtwin.commissioning.access.progress import PhaseProgress
from fieldtwin.console import stderr


class ScanProgress:
    """The progress bar of a scan: ``with ScanProgress(stoppable) as show:``; call `show` with each `PhaseProgress`."""

    def __init__(self, stoppable: bool) -> None:
        self._hint = "q stops and keeps the results" if stoppable else "Ctrl-C stops and keeps the results"
        self._live = Live(console=stderr, transient=True, auto_refresh=False) if stderr.is_terminal else None
        self._phase = ""
        self._shown = -1.0

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        if self._live is not None:
            self._live.stop()

    def __call__(self, progress: PhaseProgress) -> None:
        new = progress.phase != self._phase
        self._phase = progress.phase
        if self._live is None:
            if new:
                stderr.print(phase_line(progress), soft_wrap=True, markup=False)
            return
        if new or abs(progress.done_s - self._shown) >= 0.1 or progress.done_s >= progress.total_s:
            self._shown = progress.done_s
            self._live.update(self._render(progress), refresh=True)

    def _render(self, progress: PhaseProgress) -> Table:
        table = Table.grid(padding=(0, 1))
        left_s = max(0.0, progress.total_s - progress.done_s)
        table.add_row(
            Text(progress.phase, "bold"),
            ProgressBar(total=max(progress.total_s, 0.001), completed=progress.done_s, width=20),
            Text(f"{duration(left_s)} left"),
            Text(f"{progress.found} found", "green" if progress.found else "dim"),
            Text(progress.detail, "dim", no_wrap=True, overflow="ellipsis"),
        )
        outer = Table.grid()
        outer.add_row(table)
        outer.add_row(Text(self._hint, "dim"))
        return outer


def phase_line(progress: PhaseProgress) -> str:
    """Return the name of a phase of the scan with its longest duration: ``likely settings: up to 30 s``."""
    about = f": up to {duration(progress.total_s)}" if progress.total_s >= 1 else ""
    return f"{progress.phase}{about}"


def duration(seconds: float) -> str:
    """Return a duration as text: ``12 s``, ``4 min``, ``1 h 20 min``."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"
