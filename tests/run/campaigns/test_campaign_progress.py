"""The view of a campaign in progress: its figures, its width, and the number of lines without a terminal."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from fieldtwin.cli.run.campaign_progress import CampaignView, line, render, wall_time
from fieldtwin.run.campaigns.coverage import Coverage
from fieldtwin.run.campaigns.progress import MOST_FAILURES, CampaignProgress

S = 1_000_000_000
CAUSE = "tank: the level was 12 m, which is more than the 10 m that the invariant of the system file allows at any time"


def after_400_runs(failed: int) -> CampaignProgress:
    progress = CampaignProgress("observatory", 1000, 0)
    for seed in range(400):
        progress.ended(seed, 8.0, CAUSE if seed < failed else None)
    return progress


def test_rate_remaining_time_and_hours_per_hour_are_of_the_runs_that_ended() -> None:
    progress = after_400_runs(0)
    assert progress.runs_per_s(200 * S) == 2
    assert progress.remaining_s(200 * S) == 300
    assert progress.hours_per_hour(200 * S) == 3200 * 3600 / 200
    assert CampaignProgress("observatory", 1000, 0).remaining_s(S) is None


def test_the_number_of_kept_failures_is_limited_and_all_are_counted() -> None:
    progress = after_400_runs(50)
    assert (progress.failed, len(progress.failures)) == (50, MOST_FAILURES)


@pytest.mark.parametrize("width", [80, 140])
def test_no_line_is_wider_than_the_terminal_and_failures_are_named(width: int) -> None:
    out = Console(width=width, file=io.StringIO(), force_terminal=True, color_system=None)
    with out.capture() as captured:
        out.print(render(after_400_runs(12), 200 * S))
    lines = captured.get().splitlines()
    assert max(map(len, lines)) <= width
    text = "\n".join(lines)
    assert "400 of 1000 runs" in text
    assert "seed 0  tank: the level was 12 m" in text
    assert "and 2 more" in text


def test_the_coverage_of_all_runs_is_shown() -> None:
    progress = CampaignProgress("observatory", 1000, 0)
    for numbers in ({1, 2}, {2, 3}):
        progress.ended(1, 8.0, None, Coverage(frozenset(numbers)).text())
    assert "3 different situations" in line(progress, S)


class Clock:
    """A clock that the test sets."""

    now_ns = 0

    def monotonic_ns(self) -> int:
        return self.now_ns

    def utc_ns(self) -> int:
        return self.now_ns

    async def sleep_until_ns(self, deadline_ns: int) -> None:
        raise NotImplementedError


def test_without_a_terminal_lines_have_a_bounded_rate(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    with CampaignView("observatory", 1000, clock) as view:
        for seed in range(600):
            clock.now_ns += S // 10
            view.ended(seed, 1.0, CAUSE if seed % 20 == 0 else None)
    lines = capsys.readouterr().err.splitlines()
    assert sum(text.startswith("! seed") for text in lines) == MOST_FAILURES
    progress = [text for text in lines if " of 1000 runs" in text]
    assert len(progress) == 6  # 60 s, a line every 10 s
    assert progress[0] == line(_until(100), 10 * S)


def _until(count: int) -> CampaignProgress:
    progress = CampaignProgress("observatory", 1000, 0)
    for seed in range(count):
        progress.ended(seed, 1.0, CAUSE if seed % 20 == 0 else None)
    return progress


@pytest.mark.parametrize(("seconds", "text"), [(12.4, "12 s"), (200, "3 min 20 s"), (18600, "5 h 10 min")])
def test_wall_times_are_shown_in_the_units_of_their_size(seconds: float, text: str) -> None:
    assert wall_time(seconds) == text
