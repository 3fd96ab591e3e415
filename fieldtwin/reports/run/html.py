"""The HTML report: one file, without network access and scripts, and printable.

    write_html(report, path)

It is bounded: at most `MOST_DRAWN` failures are drawn, within `BUDGET` characters; every other one is in the tables,
with the command that runs it again.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.reports.file import put
from fieldtwin.reports.markup import Markup, el, join, page
from fieldtwin.reports.run.coverage_tables import coverage_section
from fieldtwin.reports.run.diagram import timing_diagram
from fieldtwin.reports.run.requirements import requirement_section
from fieldtwin.reports.run.window import MOST_FRAMES, Study, Window
from fieldtwin.reports.style import style
from fieldtwin.results.model import CheckResult, Counts, Report, ScenarioResult, SystemKey, Verdict, key_of

MOST_DRAWN = 16
"""Largest number of failures with a diagram and frames."""
BUDGET = 2_500_000
"""Characters of all diagrams and frames; the first failures take what they need."""
MOST_SCENARIOS = 2000
MOST_CHECKS = 3000
"""Rows of the tables of checks, over all scenarios."""
MOST_SAID = 2000
"""Characters of a check's expected value, and of its actual value."""
PER_SCENARIO = 2
"""Checks of one scenario that are drawn."""
_ORDER = (Verdict.ERROR, Verdict.FAILED, Verdict.INCONCLUSIVE, Verdict.SKIPPED, Verdict.PASSED)
MARKS = {
    Verdict.PASSED: "✓", Verdict.FAILED: "✗", Verdict.ERROR: "!", Verdict.INCONCLUSIVE: "?", Verdict.SKIPPED: "–",
}  # fmt: skip


def write_html(report: Report, path: Path) -> None:
    """Write the report. Raises `FileInvalid` if that is not possible."""
    put(path, render_html(report))


def render_html(report: Report) -> str:
    """Return the whole page."""
    parts, failures = _study(report)
    body = [
        _header(report),
        el("h2", "Verdicts", id="verdicts"),
        _verdict_table(report),
        el("h2", "Requirements", id="requirements"),
        requirement_section(report),
    ]
    if failures:
        body += [el("h2", "Failures", id="failures"), *failures]
    body += [el("h2", "Coverage", id="coverage"), _coverage(parts), _checks(report)]
    return page(f"{report.verdict.value}: {report.title}", style(), body)


def pill(verdict: Verdict, *, big: bool = False) -> Markup:
    """Return the verdict as a coloured word."""
    return el("span", f"{MARKS[verdict]} {verdict.value}", cls=f"pill {verdict.value}" + (" big" if big else ""))


# -- header --------------------------------------------------------------------------------------------------------------


def _header(report: Report) -> Markup:
    facts: list[tuple[str, object]] = [
        ("system", f"{system.name} ({system.path.name}, {system.hash})") for system in report.systems
    ]
    facts += [("target", report.target), ("seed", report.seed), ("started", report.started)]
    facts += list(report.versions.items())
    hashes = [s.trace_hash for s in report.scenarios if s.trace_hash]
    if len(hashes) == 1:
        facts.append(("trace hash", hashes[0]))
    rows = [join([el("dt", name), el("dd", str(value))]) for name, value in facts if value not in ("", None)]
    counts = report.counts
    total = max(1, len(report.scenarios))
    bar = [el("i", cls=v.value, style=f"flex:{counts[v]}") for v in _ORDER if counts[v]]
    said = [el("span", el("b", str(counts[v])), f" {v.value}") for v in _ORDER if counts[v]]
    checks = sum(len(s.checks) for s in report.scenarios)
    simulated = sum(s.simulated_s for s in report.scenarios)
    took = sum(s.took_s for s in report.scenarios)
    said.append(el("span", f"{len(report.scenarios)} scenarios, {checks} checks, {_time(simulated)} in {_time(took)}"))
    links = [("verdicts", "Verdicts"), ("requirements", "Requirements"), ("coverage", "Coverage"), ("checks", "Checks")]
    if any(s.verdict.bad for s in report.scenarios):
        links.insert(2, ("failures", "Failures"))
    return join(
        [
            el("header", el("div", el("h1", report.title)), pill(report.verdict, big=True), cls="top"),
            el("div", bar, cls="bar") if total and report.scenarios else "",
            el("div", said, cls="counts"),
            el("dl", rows, cls="facts"),
            join([el("p", "This runs it again:", cls="small"), el("pre", report.reproduce)])
            if report.reproduce
            else "",
            el("nav", [el("a", name, href=f"#{id}") for id, name in links]),
        ]
    )


# -- verdicts ------------------------------------------------------------------------------------------------------------


def _verdict_table(report: Report) -> Markup:
    if not report.scenarios:
        return el("p", "No scenario was run: nothing is known.")
    rows = []
    columns = [name for name in ("case", "role", "danger") if any(getattr(s, name) for s in report.scenarios)]
    ordered = sorted(enumerate(report.scenarios), key=lambda item: _ORDER.index(item[1].verdict))
    for number, scenario in ordered[:MOST_SCENARIOS]:
        name: Markup | str = scenario.title
        if scenario.verdict.bad:
            name = el("a", scenario.title, href=f"#s{number}")
        passed = sum(c.verdict is Verdict.PASSED for c in scenario.checks)
        checks = f"{passed}/{len(scenario.checks)}" if scenario.checks else ""
        simulated = _time(scenario.simulated_s) if scenario.simulated_s else ""
        about = [el("td", getattr(scenario, column)) for column in columns]
        rows.append(
            el(
                "tr", el("td", pill(scenario.verdict)), el("td", name, cls="name"), about,
                el("td", _why(scenario), _attempts(scenario), cls="long check"),
                el("td", checks, cls="num"), el("td", ", ".join(scenario.requirements)),
                el("td", simulated, cls="num"), el("td", _time(scenario.took_s), cls="num"),
                id=None if scenario.verdict.bad else f"s{number}",
            )
        )  # fmt: skip
    head = [el("th", t) for t in ("", "scenario", *columns, "why")] + [
        el("th", "checks", cls="num"),
        el("th", "requirements"),
    ]
    head += [el("th", "simulated", cls="num"), el("th", "took", cls="num")]
    more = len(report.scenarios) - MOST_SCENARIOS
    return join(
        [
            el("div", el("table", el("thead", el("tr", head)), el("tbody", rows)), cls="wide"),
            el("p", f"and {more} more scenarios", cls="small") if more > 0 else "",
        ]
    )


def _attempts(scenario: ScenarioResult) -> list[Markup]:
    """Return the reason why each attempt before the last one was inconclusive."""
    return [
        el("p", f"attempt {n} of {scenario.attempts} was inconclusive: {_cut(reason, MOST_SAID)}", cls="small")
        for n, reason in enumerate(scenario.earlier, 1)
    ]


def _why(scenario: ScenarioResult) -> str:
    """Return the scenario's reason, or its first check that did not pass."""
    if scenario.reason or scenario.verdict is Verdict.PASSED:
        return _cut(scenario.reason, 300)
    first = next((c for c in scenario.checks if c.verdict is scenario.verdict), None)
    if first is None:
        return ""
    why = f"; got {first.got}" if first.got else f"; {first.reason}" if first.reason else ""
    return _cut(f"{first.number}: {first.text}{why}", 300)


def _cut(said: str, most: int) -> str:
    return said if len(said) <= most else said[: most - 1] + "…"


# -- failures ------------------------------------------------------------------------------------------------------------


def _study(report: Report) -> tuple[list[tuple[Report, Counts]], list[Markup]]:
    """Read every trace once.

    Return the counts by system, each with the report for that system, and the sections of the failures.
    """
    parts: dict[SystemKey | None, tuple[Report, Counts]] = {}
    sections, drawn, used, plain = [], 0, 0, []
    if not report.scenarios or report.system is not None:
        parts[key_of(report.system) if report.system is not None else None] = report, Counts()
    for number, scenario in enumerate(report.scenarios):
        own_part = report.part_of(scenario)
        key = None if own_part.system is None else key_of(own_part.system)
        part, counts = parts.setdefault(key, (own_part, Counts()))
        failing = [c for c in scenario.checks if c.verdict.bad][:PER_SCENARIO] if scenario.verdict.bad else []
        room = drawn < MOST_DRAWN and used < BUDGET
        if scenario.verdict.bad and not room:
            plain.append((number, scenario))
        wanted = failing if room else []
        windows: list[Window] = []
        if scenario.counts is None or wanted:
            own, windows = Study(part, scenario).run(wanted)
            counts.add(own)
        else:
            counts.add(scenario.counts)
        if scenario.verdict.bad and room:
            section = _failure(part, number, scenario, windows, opened=drawn < 4)
            sections.append(section)
            drawn, used = drawn + 1, used + len(section)
    if plain:
        sections.append(_plain(plain))
    return list(parts.values()), sections


def _coverage(parts: Sequence[tuple[Report, Counts]]) -> Markup:
    """Return the coverage, one section per system."""
    if len(parts) == 1:
        return coverage_section(*parts[0])
    every: list[Markup] = []
    for part, counts in parts:
        name = part.system.name if part.system is not None else "what has no system file"
        every += [el("h2", f"Coverage of {name}"), coverage_section(part, counts)]
    return join(every)


def _failure(report: Report, number: int, scenario: ScenarioResult, windows: list[Window], *, opened: bool) -> Markup:
    parts: list[Markup | str] = [
        el("h3", pill(scenario.verdict), " ", scenario.title),
        el("p", _place(scenario), cls="small"),
    ]
    if scenario.reason:
        parts.append(el("p", scenario.reason))
    parts += _attempts(scenario)
    parts += _struck(scenario)
    failing = [c for c in scenario.checks if c.verdict.bad]
    if failing:
        parts.append(_check_table(failing[:20]))
    if scenario.reproduce:
        parts += [el("p", "This runs it again:", cls="small"), el("pre", scenario.reproduce)]
    drawn: set[tuple[int, int, tuple[str, ...]]] = set()
    for window in windows:
        if (same := (window.start_ns, window.end_ns, window.check.names)) in drawn:
            continue
        drawn.add(same)
        title = f"{scenario.title}, {window.check.number}: {window.check.text}"
        parts.append(el("h4", f"Around {window.at_ns / NS_PER_S:.3f} s: {window.check.text}"))
        if window.lost:
            parts.append(el("p", "The trace no longer holds the beginning of this time.", cls="small"))
        parts += [
            _legend(),
            el("div", timing_diagram(window, report.system, title), cls="wide"),
            _frames(window, opened),
        ]
    if failing and not windows:
        parts.append(el("p", "There is no trace of it: nothing to draw.", cls="small"))
    return el("section", parts, cls="failure", id=f"s{number}")


def _place(scenario: ScenarioResult) -> str:
    where = f"{scenario.file}:{scenario.line}" if scenario.file and scenario.line else scenario.file
    target = f"target {scenario.target}" if scenario.target else ""
    hashed = f"trace {scenario.trace_hash}" if scenario.trace_hash else ""
    needs = f"requirements {', '.join(scenario.requirements)}" if scenario.requirements else ""
    about = ", ".join(f"{name} {value}" for name in ("case", "role", "danger") if (value := getattr(scenario, name)))
    return " · ".join(p for p in (about, where, target, needs, hashed) if p)


def _plain(scenarios: Sequence[tuple[int, ScenarioResult]]) -> Markup:
    """Return the table of the failures that are not drawn because of the limits."""
    rows = [
        el(
            "tr", el("td", pill(s.verdict)), el("td", s.title, cls="name"), el("td", _why(s)),
            el("td", el("code", s.reproduce) if s.reproduce else ""), id=f"s{number}",
        )
        for number, s in scenarios[:MOST_SCENARIOS]
    ]  # fmt: skip
    head = [el("th", t) for t in ("", "scenario", "why", "this runs it again")]
    return join(
        [
            el("h3", f"{len(scenarios)} more"),
            el("div", el("table", el("thead", el("tr", head)), el("tbody", rows)), cls="wide"),
        ]
    )


def _legend() -> Markup:
    kinds = [
        ("asked", "read"), ("wrote", "written"), ("message", "message without answer"), ("doubt", "refused"),
        ("fail", "no reply (dashed) or damaged"), ("watch", "the time that was looked at"), ("faultbg", "fault"),
    ]  # fmt: skip
    return el("div", [el("span", el("i", style=f"background:var(--{k})"), said) for k, said in kinds], cls="legend")


def _frames(window: Window, opened: bool) -> Markup:
    if not window.frames:
        return el("p", "No frames in this time.", cls="small")
    rows, marked = [], False
    for line in window.lines:
        if line.t_ns > window.at_ns and not marked:
            rows.append(_moment(window))
            marked = True
        bad = window.bad.get((line.bus, line.t_ns), "")
        said = f"{line.text} ({bad})" if bad == "no reply" else line.text
        rows.append(
            el(
                "tr", el("td", f"{line.t_ns / NS_PER_S:.6f}", cls="mono"), el("td", line.bus),
                el("td", "→" if line.sent else "←", title="sent" if line.sent else "received"),
                el("td", _cut(said, 400), cls="long check"), el("td", _cut(line.raw, 96), cls="mono raw"),
                cls="bad" if bad else None,
            )
        )  # fmt: skip
    if not marked:
        rows.append(_moment(window))
    cut = f", {window.cut} more are not shown" if window.cut else ""
    head = el("tr", [el("th", t) for t in ("s", "bus", "", "decoded", "bytes")])
    said = f"{len(window.lines)} frames{cut}"
    table = el("table", el("thead", head), el("tbody", rows), cls="frames")
    return el(
        "details", el("summary", said), el("div", table, cls="wide"), open=opened and len(rows) <= MOST_FRAMES // 2
    )


def _moment(window: Window) -> Markup:
    said = f"{window.check.number}: {window.check.text}"
    return el(
        "tr", el("td", f"{window.at_ns / NS_PER_S:.6f}", cls="mono"), el("td", _cut(said, 200), colspan=4), cls="mark"
    )


# -- checks --------------------------------------------------------------------------------------------------------------


def _checks(report: Report) -> Markup:
    """Return every check of every scenario, in sections that can be unfolded."""
    parts: list[Markup] = [el("h2", "Checks", id="checks")]
    room = MOST_CHECKS
    for scenario in report.scenarios:
        if not scenario.checks or room <= 0:
            continue
        shown = scenario.checks[:room]
        room -= len(shown)
        title = f"{MARKS[scenario.verdict]} {scenario.title}"
        parts.append(el("details", el("summary", title), _check_table(shown), _struck(scenario)))
    left = sum(len(s.checks) for s in report.scenarios) - (MOST_CHECKS - room)
    if left > 0:
        parts.append(el("p", f"{left} more checks are not listed here; the JUnit file has all of them.", cls="small"))
    if len(parts) == 1:
        parts.append(el("p", "There were none."))
    return join(parts)


def _struck(scenario: ScenarioResult) -> list[Markup]:
    """Return how often each fault struck."""
    return [el("p", f"fault {fault.text}", cls="small") for fault in scenario.faults]


def _check_table(checks: Iterable[CheckResult]) -> Markup:
    rows = []
    for check in checks:
        at = f"{check.t_ns / NS_PER_S:.3f}" if check.t_ns is not None else "–"
        found = [
            join([el("span", f"{name} ", cls="none"), _lines(_cut(said, MOST_SAID)), el("br")])
            for name, said in (("expected", check.expected), ("got", check.got), ("", check.reason)) if said
        ]  # fmt: skip
        rows.append(
            el(
                "tr", el("td", pill(check.verdict)), el("td", check.number), el("td", _cut(check.text, 400), cls="long check"),
                el("td", at, cls="num"), el("td", found, cls="long"), el("td", check.where, cls="mono"),
            )
        )  # fmt: skip
    head = [el("th", t) for t in ("", "no.", "check")] + [el("th", "at s", cls="num"), el("th", ""), el("th", "where")]
    return el("div", el("table", el("thead", el("tr", head)), el("tbody", rows)), cls="wide")


def _lines(said: str) -> Markup | str:
    """Keep the lines of a text of several lines."""
    return el("pre", said) if "\n" in said else said


def _time(seconds: float) -> str:
    if seconds >= 5400:
        return f"{seconds / 3600:.3g} h"
    if seconds >= 90:
        return f"{seconds / 60:.3g} min"
    return f"{seconds:.3g} s"
