"""The HTML report of a campaign: one file, without network access and scripts, and printable.

It is bounded: groups, seeds of a group, workers and listed seeds each have a limit, and the charts have a fixed number of marks.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from fieldtwin.reports.campaign.charts import curve_chart, runs_chart
from fieldtwin.reports.campaign.model import CampaignResult
from fieldtwin.reports.campaign.workers import BINS, Timeline, timeline_of, workers_of
from fieldtwin.reports.file import put
from fieldtwin.reports.markup import Markup
from fieldtwin.reports.pages import fill
from fieldtwin.reports.run.logic import logic_section
from fieldtwin.results.model import ScenarioResult, Verdict

MOST_GROUPS = 50
MOST_SEEDS = 20
"""Largest number of seeds of a group, and of missing or differing seeds, that are named."""
MOST_WORKERS = 256
MOST_CAMPAIGNS = 20
MOST_TEXT = 1000
"""Largest number of characters of an error and of a command."""
MOST_LEDGERS = 100
MOST_FINDINGS = 200
"""Largest number of findings and waivers about the programs that are listed."""
_ORDER = (Verdict.FAILED, Verdict.INCONCLUSIVE, Verdict.PASSED)


def write_campaign(campaigns: Sequence[CampaignResult], path: Path, findings: Sequence[ScenarioResult] = ()) -> None:
    """Write the report. Raises `FileInvalid` if that is not possible."""
    put(path, render_campaign(campaigns, findings))


def render_campaign(campaigns: Sequence[CampaignResult], findings: Sequence[ScenarioResult] = ()) -> str:
    """Return the whole page. `findings`: the results of checks of the programs, which belong to all campaigns."""
    shown = campaigns[:MOST_CAMPAIGNS]
    sections = [_section(campaign, alone=len(shown) == 1) for campaign in shown]
    verdicts = {campaign.verdict for campaign in campaigns} or {Verdict.INCONCLUSIVE}
    verdicts |= {result.verdict for result in findings}
    return fill(
        "campaign.html.j2",
        verdict=next(verdict for verdict in _ORDER if verdict in verdicts),
        title=f"Campaign of {campaigns[0].title}" if len(campaigns) == 1 else f"{len(campaigns)} campaigns",
        sections=sections,
        more_campaigns=len(campaigns) - len(shown),
        findings=findings,
        MOST_FINDINGS=MOST_FINDINGS,
        MOST_TEXT=MOST_TEXT,
    )


def _section(campaign: CampaignResult, *, alone: bool) -> Markup:
    timeline = timeline_of(campaign.runs)
    workers = workers_of(campaign.runs)
    return fill(
        "campaign_section.html.j2",
        campaign=campaign,
        alone=alone,
        counts={
            Verdict.FAILED: len(campaign.failed),
            Verdict.SKIPPED: len(campaign.missing),
            Verdict.PASSED: len(campaign.runs) - len(campaign.failed),
        },
        facts=_facts(campaign, timeline),
        speed=_speed(campaign, timeline),
        runs_chart=runs_chart(timeline) if timeline is not None else None,
        coverage_chart=curve_chart("different situations reached over virtual hours", campaign.coverage)
        if campaign.coverage
        else None,
        programs=logic_section(campaign.programs) if campaign.programs is not None and campaign.measured else None,
        causes_chart=_causes_chart(campaign) if len(campaign.groups) > 1 else None,
        workers=workers[:MOST_WORKERS],
        more_workers=len(workers) - MOST_WORKERS,
        wall_s=timeline.end_s - timeline.start_s if timeline is not None else 0.0,
        listed=listed,
        MOST_GROUPS=MOST_GROUPS,
        MOST_TEXT=MOST_TEXT,
        BINS=BINS,
    )


def _facts(campaign: CampaignResult, timeline: Timeline | None) -> list[tuple[str, str]]:
    names = ", ".join(campaign.ledgers[:MOST_LEDGERS])
    more = len(campaign.ledgers) - MOST_LEDGERS
    facts = [
        ("system", campaign.system),
        ("files and options", campaign.what),
        ("fieldtwin", campaign.version),
        ("ledgers", f"{names} and {more} more" if more > 0 else names),
    ]
    if timeline is not None:
        facts += [("started", _utc(timeline.start_s)), ("ended", _utc(timeline.end_s))]
    return facts


def _utc(seconds: float) -> str:
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%M:%S} UTC"


def _speed(campaign: CampaignResult, timeline: Timeline | None) -> str:
    """Return the virtual hours for each hour of wall time; empty if the times are not known."""
    if timeline is None:
        return ""
    timed = sum(run.hours for run in campaign.runs if run.ended_s)
    return f"{timed / (timeline.end_s - timeline.start_s) * 3600:,.0f}"


def _causes_chart(campaign: CampaignResult) -> Markup:
    """Return the number of causes found over the virtual hours, with the runs in the order in which they ended."""
    group_of = {run.seed: number for number, group in enumerate(campaign.groups) for run in group.runs}
    hours, found, points = 0.0, set[int](), []
    for run in sorted(campaign.runs, key=lambda run: (run.ended_s, run.seed)):
        hours += run.hours
        if run.seed in group_of and group_of[run.seed] not in found:
            found.add(group_of[run.seed])
            points.append((hours, len(found)))
    return curve_chart("causes of failures found over virtual hours", [*points, (hours, len(found))])


def listed(seeds: Sequence[int]) -> str:
    """Return the first seeds as text, with the number of the others."""
    more = len(seeds) - MOST_SEEDS
    return ", ".join(map(str, seeds[:MOST_SEEDS])) + (f" and {more} more" if more > 0 else "")
