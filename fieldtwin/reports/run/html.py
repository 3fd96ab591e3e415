"""The HTML report: one file, without network access and scripts, and printable.

    write_html(report, path)

It is bounded: at most `MOST_DRAWN` failures are drawn, within `BUDGET` characters; every other failure is in the tables,
with the command that runs the scenario again. The page's text is in templates/run.html.j2.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.reports.file import put
from fieldtwin.reports.markup import Markup
from fieldtwin.reports.pages import cut, fill
from fieldtwin.reports.run.coverage_tables import coverage_section
from fieldtwin.reports.run.diagram import timing_diagram
from fieldtwin.reports.run.logic import logic_section
from fieldtwin.reports.run.requirements import requirement_matrix
from fieldtwin.reports.run.window import MOST_FRAMES, FrameLine, Study, Window
from fieldtwin.results.model import AccessCounts, CheckResult, Report, ScenarioResult, SystemKey, Verdict, key_of

MOST_DRAWN = 16
"""Largest number of failures with a diagram and frames."""
BUDGET = 2_500_000
"""Largest number of characters of all diagrams and frames together. The first failures use as many as they need."""
MOST_SCENARIOS = 2000
MOST_CHECKS = 3000
"""Largest number of rows in the tables of checks, over all scenarios."""
MOST_SAID = 2000
"""Largest number of characters of a check's expected value, and of its actual value."""
PER_SCENARIO = 2
"""Largest number of checks of one scenario that are drawn."""
_ORDER = (Verdict.ERROR, Verdict.FAILED, Verdict.INCONCLUSIVE, Verdict.SKIPPED, Verdict.PASSED)
_SHARED = {"NS_PER_S": NS_PER_S, "MOST_SAID": MOST_SAID, "MOST_FRAMES": MOST_FRAMES}


def write_html(report: Report, path: Path) -> None:
    """Write the report. Raises `FileInvalid` if that is not possible."""
    put(path, render_html(report))


def render_html(report: Report) -> str:
    """Return the whole page."""
    studied = _study(report)
    counts = report.counts
    return fill(
        "run.html.j2",
        report=report,
        counts={verdict: counts[verdict] for verdict in _ORDER},
        facts=_facts(report),
        check_count=sum(len(s.checks) for s in report.scenarios),
        columns=[name for name in ("case", "role", "impact") if any(getattr(s, name) for s in report.scenarios)],
        ordered=sorted(enumerate(report.scenarios), key=lambda item: _ORDER.index(item[1].verdict)),
        why=_why,
        passed=lambda scenario: sum(c.verdict is Verdict.PASSED for c in scenario.checks),
        requirements=requirement_matrix(report),
        failures=studied.failures,
        not_drawn=studied.not_drawn,
        coverage=[
            (
                part.system.name if part.system is not None else "runs without a system file",
                coverage_section(part, counts),
            )
            for part, counts in studied.parts.values()
        ],
        logic=logic_section(report.logic) if report.logic is not None else "",
        listed=_listed(report),
        MOST_SCENARIOS=MOST_SCENARIOS,
        MOST_CHECKS=MOST_CHECKS,
        **_SHARED,
    )


def _facts(report: Report) -> list[tuple[str, str]]:
    facts = [("system", f"{system.name} ({system.path.name}, {system.hash})") for system in report.systems]
    seed = "" if report.seed is None else str(report.seed)
    facts += [("target", report.target), ("seed", seed), ("started", report.started), *report.versions.items()]
    hashes = [s.trace_hash for s in report.scenarios if s.trace_hash]
    return [*facts, ("trace hash", hashes[0])] if len(hashes) == 1 else facts


def _listed(report: Report) -> list[tuple[ScenarioResult, list[CheckResult]]]:
    """Return the first `MOST_CHECKS` checks, by scenario."""
    listed, room = [], MOST_CHECKS
    for scenario in report.scenarios:
        if shown := list(scenario.checks[:room]):
            listed.append((scenario, shown))
            room -= len(shown)
    return listed


def _why(scenario: ScenarioResult) -> str:
    """Return the scenario's reason, or its first check that did not pass."""
    if scenario.reason or scenario.verdict is Verdict.PASSED:
        return cut(scenario.reason, 300)
    first = next((c for c in scenario.checks if c.verdict is scenario.verdict), None)
    if first is None:
        return ""
    why = f"; got {first.got}" if first.got else f"; {first.reason}" if first.reason else ""
    return cut(f"{first.number}: {first.text}{why}", 300)


@dataclass
class _Studied:
    """The results of a single pass over the traces. `parts` holds the counts of each system, with the report for that system."""

    parts: dict[SystemKey | None, tuple[Report, AccessCounts]] = field(default_factory=dict)
    failures: list[Markup] = field(default_factory=list)
    not_drawn: list[tuple[int, ScenarioResult]] = field(default_factory=list)


def _study(report: Report) -> _Studied:
    studied = _Studied()
    used = 0
    if not report.scenarios or report.system is not None:
        studied.parts[key_of(report.system) if report.system is not None else None] = report, AccessCounts()
    for number, scenario in enumerate(report.scenarios):
        if scenario.system is None and report.logic is not None:  # a unit test, which has no buses
            if scenario.verdict.bad:
                studied.failures.append(_failure(report, number, scenario, [], opened=len(studied.failures) < 4))
            continue
        own_part = report.part_of(scenario)
        key = None if own_part.system is None else key_of(own_part.system)
        part, counts = studied.parts.setdefault(key, (own_part, AccessCounts()))
        room = scenario.verdict.bad and len(studied.failures) < MOST_DRAWN and used < BUDGET
        wanted = [c for c in scenario.checks if c.verdict.bad][:PER_SCENARIO] if room else []
        windows: list[Window] = []
        if scenario.counts is None or wanted:
            own, windows = Study(part, scenario).run(wanted)
            counts.add(own)
        else:
            counts.add(scenario.counts)
        if room:
            studied.failures.append(_failure(part, number, scenario, windows, opened=len(studied.failures) < 4))
            used += len(studied.failures[-1])
        elif scenario.verdict.bad:
            studied.not_drawn.append((number, scenario))
    return studied


def _failure(report: Report, number: int, scenario: ScenarioResult, windows: list[Window], *, opened: bool) -> Markup:
    drawn: list[tuple[Window, Markup, Sequence[FrameLine], Sequence[FrameLine]]] = []
    for window in {(w.start_ns, w.end_ns, w.check.names): w for w in reversed(windows)}.values():
        diagram = timing_diagram(window, report.system, f"{scenario.title}, {window.check.number}: {window.check.text}")
        after = next((n for n, line in enumerate(window.lines) if line.t_ns > window.at_ns), len(window.lines))
        drawn.insert(0, (window, diagram, window.lines[:after], window.lines[after:]))
    failing = [c for c in scenario.checks if c.verdict.bad]
    return fill(
        "failure.html.j2", number=number, scenario=scenario, place=_place(scenario), failing=failing, drawn=drawn,
        opened=opened, in_studio=_in_studio, seconds=_seconds, **_SHARED,
    )  # fmt: skip


def _in_studio(scenario: ScenarioResult, t_ns: int | None) -> str:
    """Return the command that shows an instant of the scenario's trace in Studio, empty without such a trace."""
    if not scenario.trace_file:
        return ""
    at = _seconds(t_ns)
    return shlex.join(["fieldtwin", "studio", scenario.trace_file, *(["--at", f"{at}s"] if at else [])])


def _seconds(t_ns: int | None) -> str:
    """Return an instant in seconds, exactly; empty for None."""
    return "" if t_ns is None else f"{t_ns // NS_PER_S}.{t_ns % NS_PER_S:09d}".rstrip("0").rstrip(".")


def _place(scenario: ScenarioResult) -> str:
    where = f"{scenario.file}:{scenario.line}" if scenario.file and scenario.line else scenario.file
    target = f"target {scenario.target}" if scenario.target else ""
    hashed = f"trace {scenario.trace_hash}" if scenario.trace_hash else ""
    needs = f"requirements {', '.join(scenario.requirements)}" if scenario.requirements else ""
    about = ", ".join(f"{name} {value}" for name in ("case", "role", "impact") if (value := getattr(scenario, name)))
    return " · ".join(p for p in (about, where, target, needs, hashed) if p)
