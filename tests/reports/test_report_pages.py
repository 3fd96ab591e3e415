"""The HTML report: its content, escaped names, no external resources, and a bounded size."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from report_rig import MS, adu, answer, ask, can, chunk, note, observatory, run_trace

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.devices.config import DeviceConfig
from fieldtwin.reports.markup import Markup, el, text
from fieldtwin.reports.run.coverage import Collector, devices_covered
from fieldtwin.reports.run.html import BUDGET, render_html, write_html
from fieldtwin.reports.run.machines import machines_of
from fieldtwin.reports.run.requirements import requirement_verdicts
from fieldtwin.reports.run.window import LONGEST_NS, MOST_EXCHANGES, MOST_FRAMES, MOST_STEPS, Study
from fieldtwin.results.model import AccessCounts, CheckResult, Report, ScenarioResult, Verdict
from fieldtwin.results.trace import TraceEvent, TraceKind

EVIL = "<script>alert(1)</script>\" onload='x' & \u202e\x00"
TRACE = run_trace(20)
FAILED = CheckResult(
    "4", "ctd.pressure is good again", Verdict.FAILED, 13_300 * MS, 12_200 * MS, "good", "bad: timeout",
    where="a.scenario.yaml:31", names=("ctd.pressure",),
)  # fmt: skip
PASSED = CheckResult("1", "relay.state is ACTIVE", Verdict.PASSED, 2020 * MS, 0)


def scenario(**changes: object) -> ScenarioResult:
    base = ScenarioResult(
        "a sensor that loses replies", Verdict.FAILED, (PASSED, FAILED), ("R-1",), "a.scenario.yaml", 12, "virtual", 42,
        reproduce="fieldtwin test a.scenario.yaml --seed 42", trace=TRACE, trace_hash="ab" * 32,
    )  # fmt: skip
    return replace(base, **changes)  # type: ignore[arg-type]


def report(*scenarios: ScenarioResult, **changes: object) -> Report:
    system = observatory()
    base = Report("nightly", scenarios, system, machines=machines_of(system), faults=("drop", "delay"))
    return replace(base, **changes)  # type: ignore[arg-type]


class Page(HTMLParser):
    """The page as a browser parses it: unclosed elements, ids, links, and its text."""

    VOID = frozenset({"meta", "br", "rect", "path", "line"})

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.tags: set[str] = set()
        self.words: list[str] = []
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.ids += [v for k, v in attrs if k == "id" and v]
        self.links += [v for k, v in attrs if k in ("href", "src") and v]
        assert not [k for k, _ in attrs if k.startswith("on")], attrs
        if tag not in self.VOID or (tag in ("rect", "path") and not self.get_starttag_text().endswith("/>")):  # type: ignore[union-attr]
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] != "style":
            self.words.append(data)

    @property
    def said(self) -> str:
        return " ".join(" ".join(self.words).split())


def page(of: Report) -> Page:
    found = Page(render_html(of))
    assert not found.open
    assert len(found.ids) == len(set(found.ids))
    assert {link.removeprefix("#") for link in found.links} <= set(found.ids)  # only resources inside the page
    assert not found.tags & {"script", "link", "img", "iframe"}
    return found


def test_a_failure_is_reported_with_its_context() -> None:
    said = page(
        report(scenario(), requirements={"R-1": "replies are asked for again", "R-2": "the plant is safe"})
    ).said
    for words in (
        "✗ failed a sensor that loses replies [seed 42]", "fieldtwin test a.scenario.yaml --seed 42", "ab" * 32,
        "R-1 replies are asked for again failed", "R-2 the plant is safe not covered",
        "expected good", "got bad: timeout", "fault f1", "drop ctd", "ctd: no reply", "bad: timeout", "ACTIVE",
        "ctd: read input registers 30001 (input:0) x 10 (no reply)", "01 04 00 00 00 0a 70 0d",
        "inclinometer: TPDO1 slope_long 4.15 deg, slope_lateral 0.29 deg",
    ):  # fmt: skip
        assert words in said, words


def test_coverage_lists_missing_items() -> None:
    said = page(report(scenario())).said
    assert "7 of 8 read" in said
    assert "Never: sample_period_s (written) serial (read)" in said
    assert "0 of 9 of the standard occurred" in said
    assert "01 illegal function" in said
    assert "3 of 6 taken" in said
    assert "STANDBY – 1 never" in said  # from STANDBY: to ACTIVE once, to OFF never
    assert "1 of 6 pairs" in said
    assert "delay never never never never" in said
    assert "ctd no reply 6" in said


def test_names_out_of_files_stay_names() -> None:
    check = replace(FAILED, text=EVIL, got=EVIL, names=(EVIL,), number=EVIL, where=EVIL)
    events = [
        *TRACE, note(13_000, TraceKind.TAG, f"ctd.{EVIL}", value=EVIL, quality=EVIL, reason=EVIL),
        note(13_000, TraceKind.STATE, EVIL, value=EVIL), note(13_000, TraceKind.FAULT, EVIL, name=EVIL, on=True, target=EVIL),
        note(13_000, TraceKind.FRAME, EVIL, bytes="00", dir=EVIL), note(13_000, TraceKind.FRAME, "can0", id=EVIL, bytes="00"),
    ]  # fmt: skip
    events.sort(key=lambda e: e.t_ns)
    evil = scenario(
        name=EVIL, checks=(check,), reason=EVIL, file=EVIL, reproduce=EVIL, requirements=(EVIL,), trace=events
    )
    html = render_html(report(evil, title=EVIL, versions={EVIL: EVIL}, requirements={EVIL: EVIL}, target=EVIL))
    assert "<script" not in html
    assert "\x00" not in html
    assert "\u202e" not in html
    found = page(report(evil, title=EVIL))
    assert "alert(1)" in found.said


@given(st.text(max_size=30), st.text(max_size=30))
@settings(max_examples=50)
def test_markup_holds_any_text(inside: str, attribute: str) -> None:
    html = el("p", inside, el("b", "x"), title=attribute, cls=None)
    found = Page(html)
    assert found.tags == {"p", "b"}
    assert not found.open
    assert text(Markup("<i>")) == "<i>"


def test_a_report_of_a_run_without_scenarios_is_inconclusive() -> None:
    empty = Report("nothing", [])
    assert empty.verdict is Verdict.INCONCLUSIVE  # not a pass
    said = page(empty).said
    assert "No scenario was run" in said
    assert "No scenario names a requirement" in said
    assert page(report()).said.count("No frame was recorded") == 1


def test_a_failure_without_a_trace() -> None:
    assert "There is no trace of it" in page(report(scenario(trace=()))).said
    never = replace(FAILED, t_ns=None)
    assert "There is no trace of it" in page(report(scenario(checks=(never,)))).said


def test_losses_of_a_full_trace_are_reported() -> None:
    late = [e for e in TRACE if e.t_ns > 12_500 * MS]
    assert "no longer contains the beginning" in page(report(scenario(trace=late, dropped=500))).said


def test_five_hundred_failures_are_listed_and_few_are_drawn() -> None:
    short = [e for e in TRACE if 12_000 * MS <= e.t_ns <= 13_600 * MS]
    counts = AccessCounts()
    many = [scenario(seed=n, trace=short, counts=counts, name=f"{'long' * 60} {n}") for n in range(500)]
    html = render_html(report(*many))
    assert len(html) < BUDGET
    assert html.count("<svg") == 16
    assert html.count('id="s') == 500
    assert "484 more" in html


def test_many_events_give_a_small_file() -> None:
    """A window with the maximum content: each lane, mark and row is bounded."""
    crowd: list[TraceEvent] = []
    for n in range(6000):
        at = 12_200 + n / 4
        crowd.append(can(at, "185#9E013500"))
        crowd.append(note(at, TraceKind.TAG, f"ctd.t{n % 40}", value=n % 97 / 7, quality="good", reason="none"))
    html = render_html(report(scenario(trace=crowd)))
    assert html.count("<svg") == 1
    assert len(html) < 700_000
    assert "thinned: too many" in html
    assert f"{MOST_FRAMES + MOST_FRAMES // 4} frames, " in html


def test_a_long_wait_is_drawn_at_its_end() -> None:
    waited = replace(FAILED, since_ns=0, t_ns=3_600_000 * MS)
    (window,) = Study(report(), scenario(trace=TRACE)).run([waited])[1]
    assert window.at_ns - window.start_ns == LONGEST_NS


def test_counts_of_a_listener_count_more_than_the_trace() -> None:
    """A `Collector` sees events that a full trace has dropped."""
    collector = Collector(observatory(), machines_of(observatory()))
    for event in TRACE:
        collector.feed(event)
    counts = collector.finish()
    assert counts.problems["ctd", "no reply"] == 6
    assert counts.transitions == {
        ("relay.state", "STANDBY", "ACTIVE"): 1, ("relay.state", "ACTIVE", "OFF"): 1, ("relay.state", "OFF", "STANDBY"): 1,
    }  # fmt: skip
    assert counts.pairs == {("drop", "relay.state", "ACTIVE"): 1}
    twice = AccessCounts()
    twice.add(counts)
    twice.add(counts)
    assert twice.problems["ctd", "no reply"] == 12
    by_device = {d.device: d for d in devices_covered(observatory(), counts)}
    assert by_device["ctd"].share("read") == (7, 8)
    assert by_device["modem"].share("written") == (0, 2)
    assert [p.missing for p in by_device["modem"].places if p.name == "inbox"] == [[]]
    trace_less = page(report(scenario(trace=(), counts=counts, verdict=Verdict.PASSED, checks=()))).said
    assert "ctd no reply 6" in trace_less


def test_a_transition_that_the_table_does_not_have() -> None:
    machine = replace(machines_of(observatory())[0], transitions=(("STANDBY", "ACTIVE"),))
    said = page(report(scenario(), machines=(machine,))).said
    assert "1, not in its table" in said
    assert "1 of 1 taken" in said


@pytest.mark.parametrize(
    ("verdicts", "worst"),
    [
        (["passed", "passed"], "passed"), (["passed", "skipped"], "skipped"), (["passed", "inconclusive"], "inconclusive"),
        (["failed", "inconclusive", "skipped"], "failed"), (["error", "passed"], "error"),
    ],
)  # fmt: skip
def test_neither_skipped_nor_inconclusive_passes(verdicts: list[str], worst: str) -> None:
    run = report(*(scenario(verdict=Verdict(v), checks=()) for v in verdicts))
    assert run.verdict is Verdict(worst)
    assert requirement_verdicts(run) == {"R-1": Verdict(worst)}


def test_many_scenarios_make_the_matrix_a_list() -> None:
    runs = [scenario(name=f"scenario {n}", verdict=Verdict.PASSED, checks=(), trace=()) for n in range(30)]
    assert "and 18 more" in page(report(*runs)).said
    seeds = [scenario(seed=n, verdict=Verdict.FAILED if n else Verdict.PASSED, checks=(), trace=()) for n in range(3)]
    assert "2 of 3 failed" in page(report(*seeds)).said


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    write_html(report(), tmp_path / "new" / "r.html")
    assert (tmp_path / "new" / "r.html").read_text(encoding="utf-8").startswith("<!doctype html>")
    with pytest.raises(FileInvalid, match="cannot write the report"):
        write_html(report(), tmp_path / "new" / "r.html" / "r.html")


def test_a_thinned_drawing_still_reaches_the_failure() -> None:
    """However much happens in a window, its end is drawn, because the failure is there."""
    crowd: list[TraceEvent] = []
    for n in range(5000):
        at = 12_200 + n / 5
        crowd.append(can(at, "185#9E013500"))
        crowd.append(note(at, TraceKind.TAG, "ctd.pressure", value=n % 97 / 7, quality="bad" if n == 77 else "good"))
    (window,) = Study(report(), scenario(trace=crowd)).run([FAILED])[1]
    assert window.thinned == {"can0", "ctd.pressure"}
    for kept, most in ((window.exchanges, MOST_EXCHANGES), (window.tags["ctd.pressure"], MOST_STEPS)):
        assert most // 4 < len(kept) <= most
        assert kept[-1].t_ns > 13_195 * MS
    assert "bad" in {s.quality for s in window.tags["ctd.pressure"]}


def test_a_tag_that_was_never_published_has_a_lane_with_that_remark() -> None:
    check = replace(FAILED, names=("ctd.conductivity", "ctd.pressure"))
    said = page(report(scenario(checks=(check,)))).said
    assert "ctd.conductivity never published" in said.replace("ctd.conductivity ctd.conductivity", "ctd.conductivity")


def test_secrets_are_not_in_the_page() -> None:
    profile = load_profile(Path(__file__).parents[2] / "profiles" / "devices" / "eastron-sdm630.yaml")
    system = replace(observatory(), devices={"meter": DeviceConfig("meter", profile, "line1", 1)})
    events = [ask(13_000, "10 000E 0002 04 447A0000"), answer(13_050, "10 000E 0002")]
    events.append(note(13_060, TraceKind.TAG, "meter.password", value=1000.5, quality="good", reason="none"))
    html = render_html(report(scenario(trace=events), system=system))
    assert "password (secret)" in html
    assert "1000.5" not in html
    assert "44 7a" not in html.lower()


def test_refused_registers_are_not_covered() -> None:
    counts = Collector(observatory())
    counts.feed(ask(0, "03 0064 0004"))
    counts.feed(answer(5, "83 02"))
    ctd = devices_covered(observatory(), counts.finish())[0]
    (serial,) = [p for p in ctd.places if p.name == "serial"]
    assert (serial.read, serial.refused, serial.missing) == (0, 1, ["read"])


def test_a_wire_without_a_system_is_decoded_by_its_protocol() -> None:
    """Conformance: a third-party client sends requests."""
    events = [chunk(13_000, False, adu(1, "03 0000 0001"), "listen"), chunk(13_020, True, adu(1, "83 06"), "listen")]
    judged = scenario(trace=events, requirements=())
    of = Report("a master", [judged], framings={"listen": "mbap"}, served=("listen",))
    said = page(of).said
    assert "unit 1: read holding registers 40001 (holding:0)" in said
    assert "unit 1: exception 06 server device busy" in said
    assert "listen 1 exception 1" in said


def test_results_need_no_protocols() -> None:
    """A program that only creates results (a plugin in a user's environment) needs neither pymodbus nor canopen."""
    needless = "pymodbus", "canopen", "fieldtwin.twin.site.system"
    code = f"import sys, fieldtwin.results.model; print([m for m in {needless} if m in sys.modules])"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=30)
    assert ran.stdout == "[]\n"


def test_scans_that_changed_something_are_a_lane() -> None:
    check = replace(FAILED, t_ns=2500 * MS, since_ns=1800 * MS, names=("relay.state",))
    said = page(report(scenario(checks=(check,)))).said
    assert "scans with changes every 10 ms" in said.replace(
        "scans with changes scans with changes", "scans with changes"
    )
    assert "2.0100 s relay.state = 'ACTIVE' relay.period_s = 1" in said
