"""Traces of virtual runs in Studio's interface: its values at an instant are those in the lines of the trace."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from click.testing import CliRunner
from studio_rig import VIEW, studio, until
from trace_rig import FAILED_NS, FAULT_NS, TITLE, failing_trace, folded, lines_of

from fieldtwin.cli.test.test_command import command
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.studio.replay.replay import Replay

TRACE = "/traces/fail.jsonl"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("traces")
    failing_trace(made, "--html", "report.html")
    return made


@pytest.fixture(scope="module")
def client(folder: Path) -> Iterator[httpx.Client]:
    with studio("fail.jsonl", folder=folder) as running, running.client() as client:
        until(lambda: client.get(TRACE).json()["behind_bytes"] == 0, "the trace is read to its end")
        yield client


def get(client: httpx.Client, path: str, status: int = 200, **parameters: Any) -> Any:
    answer = client.get(path, params=parameters)
    assert answer.status_code == status, answer.text
    return answer.json()


def test_the_trace_is_described_with_its_failed_check_and_its_marks(client: httpx.Client) -> None:
    about = get(client, TRACE)
    assert (about["title"], about["verdict"], about["end_ns"]) == (TITLE, "failed", FAILED_NS + 1)
    [failed] = about["failed"]
    assert (failed["number"], failed["t_ns"], failed["got"]) == ("5", FAILED_NS, "bad (timeout)")
    marks = [(mark["kind"], mark["t_ns"]) for mark in about["marks"]]
    assert ("fault", FAULT_NS) in marks
    assert ("failed", FAILED_NS) in marks
    assert [mark["text"] for mark in about["marks"] if mark["kind"] == "state"] == ["relay: STANDBY to ACTIVE"]
    assert get(client, "/traces")[0]["name"] == "fail.jsonl"


@pytest.mark.parametrize("t_ns", [0, 10_000_000, FAULT_NS - 1, FAULT_NS, 2_000_000_000, FAILED_NS])
def test_values_qualities_and_variables_of_an_instant_are_those_of_the_trace(
    client: httpx.Client, folder: Path, t_ns: int
) -> None:
    state = get(client, f"{TRACE}/state", at_ns=t_ns)
    seen = {
        name: (tag["value"], tag["quality"], tag["reason"])
        for name, tag in state["gateway"]["tags"].items()
        if tag["reason"] != "never_read"
    }
    trace = folder / "fail.jsonl"
    tags = folded(trace, "tag", t_ns)
    assert seen == {name: (data["value"], data["quality"], data["reason"]) for name, data in tags.items()}
    for name, data in tags.items():
        assert state["gateway"]["tags"][name]["age_s"] == pytest.approx((t_ns - data["t_ns"]) / 1e9)
    states = folded(trace, "state", t_ns)
    assert state["plc"]["outputs"] == {name: data["value"] for name, data in states.items()}
    assert [fault["name"] for fault in state["field"]["faults"]] == (["silence"] if t_ns >= FAULT_NS else [])


def test_the_failed_check_shows_the_bad_value_and_not_what_the_run_did_after_it(client: httpx.Client) -> None:
    state = get(client, f"{TRACE}/state", at_ns=FAILED_NS)
    pressure = state["gateway"]["tags"]["ctd.pressure"]
    assert (pressure["quality"], pressure["reason"]) == ("bad", "timeout")
    assert state["gateway"]["devices"]["ctd"]["online"] is False
    assert state["gateway"]["devices"]["inclinometer"]["online"] is True
    after = get(client, f"{TRACE}/state", at_ns=FAILED_NS + 1)
    assert after["gateway"]["devices"]["inclinometer"]["error"] == "unreachable"


def test_frames_of_an_instant_are_those_of_the_trace(client: httpx.Client, folder: Path) -> None:
    frames = [line for line in lines_of(folder / "fail.jsonl") if line[1] == "frame"]
    page = get(client, f"{TRACE}/frames", count=500)
    assert [(row["bus"], row["bytes"]) for row in page["rows"]] == [
        (where, data["bytes"]) for _, _, where, data in frames
    ]
    around = get(client, f"{TRACE}/frames", at_ns=2_000_000_000, count=10)
    before = sum(t_ns < 2_000_000_000 for t_ns, *_ in frames)
    assert around["start"] == before - 5
    request = next(row for row in page["rows"] if row["device"] == "ctd" and row["verdict"] == "no reply")
    detail = get(client, f"{TRACE}/frames/{request['number']}")
    assert detail["fields"]
    message = next(row for row in page["rows"] if row["service"] == "TPDO1" and row["t_ns"] > 2_000_000_000)
    slope = folded(folder / "fail.jsonl", "tag", message["t_ns"])["inclinometer.slope_long"]["value"]
    effects = get(client, f"{TRACE}/frames/{message['number']}")["effects"]
    assert (effects[0]["tag"], effects[0]["value"]) == ("inclinometer.slope_long", slope)


def test_the_history_of_a_tag_is_that_of_the_trace(client: httpx.Client, folder: Path) -> None:
    name = "inclinometer.slope_long"
    expected = [
        [t_ns, data["value"], data["quality"], data["reason"]]
        for t_ns, kind, where, data in lines_of(folder / "fail.jsonl")
        if kind == "tag" and where == name and t_ns < FAILED_NS
    ]
    found = get(client, f"{TRACE}/tags/{name}/history", to_ns=FAILED_NS - 1)
    assert found["points"] == expected
    part = get(client, f"{TRACE}/tags/{name}/history", from_ns=1_000_000_000, to_ns=2_000_000_000)["points"]
    assert part[0] == [point for point in expected if point[0] <= 1_000_000_000][-1]
    assert part[-1] == [point for point in expected if point[0] <= 2_000_000_000][-1]
    assert get(client, f"{TRACE}/tags/ctd.pressure/history", to_ns=0)["points"] == [], "it was not read yet"
    recent = get(client, f"{TRACE}/recent", at_ns=FAILED_NS)
    assert recent["ctd.pressure"][-1][1] is None
    assert recent[name][-1][1] == expected[-1][1]
    assert get(client, f"{TRACE}/tags/nothing.there/history", 404)["error"]["kind"] == "NotFound"


def test_programs_and_transitions_are_shown_without_the_program(client: httpx.Client) -> None:
    assert get(client, f"{TRACE}/plc/programs")["relay"]["machine"]["initial"] == "STANDBY"
    assert get(client, f"{TRACE}/plc/transitions", at_ns=349_999_999) == {"relay": []}
    [change] = get(client, f"{TRACE}/plc/transitions", at_ns=350_000_000)["relay"]
    assert (change["before"], change["after"]) == ("STANDBY", "ACTIVE")


def test_the_report_of_the_run_links_to_its_trace_and_may_not_execute_scripts(client: httpx.Client) -> None:
    assert get(client, TRACE)["report"] is True
    answer = client.get(f"{TRACE}/report")
    assert answer.status_code == 200, answer.text
    assert f'href="/#/trace%3Afail.jsonl/overview?t={FAILED_NS / 1e9}"' in answer.text
    policy = dict(rule.split(" ", 1) for rule in answer.headers["Content-Security-Policy"].split("; "))
    assert policy["default-src"] == "'none'"
    assert policy["style-src"] == "'unsafe-inline'"
    assert "script-src" not in policy


def test_a_description_cannot_make_studio_serve_another_file(client: httpx.Client, folder: Path) -> None:
    about = json.loads((folder / "fail.jsonl.about.json").read_text())
    other, moved = folder / "other.jsonl", folder / "other.jsonl.about.json"
    other.write_bytes((folder / "fail.jsonl").read_bytes())
    try:
        (folder / "secret").write_text("root:x:0:0")
        moved.write_text(json.dumps(about | {"report": "secret"}))
        answer = client.get("/traces/other.jsonl/report")
        assert "root:x" not in answer.text
        assert "not a report of fieldtwin" in answer.json()["error"]["message"]
        moved.write_text(json.dumps(about | {"report": "no-such-file.html"}))
        assert client.get("/traces/other.jsonl/report").status_code == 404
    finally:
        other.unlink()
        moved.unlink()


@pytest.mark.long
def test_the_trace_of_a_network_shows_its_systems_under_the_names_of_the_network(
    client: httpx.Client, folder: Path
) -> None:
    scenario, trace = folder / "net.scenario.yaml", folder / "net.jsonl"
    steps = "  - expect: {tag: east.modem.address, quality: good, within: 3s}\n  - pause: 2s\n"
    scenario.write_text(f"scenario: a network\nsystem: ocean_network\nsteps:\n{steps}")
    ran = CliRunner().invoke(command, [str(scenario), "--trace", str(trace)], standalone_mode=False)
    assert ran.return_value == 0, ran.output
    name = "/traces/net.jsonl"
    until(lambda: get(client, name)["behind_bytes"] == 0, "the trace is read to its end")
    about, state = get(client, name), get(client, f"{name}/state")
    assert {"west.ctd", "middle.optode", "east.modem"} <= set(about["system"]["devices"])
    tags = folded(trace, "tag", about["end_ns"])
    assert state["gateway"]["tags"]["west.ctd.sample_count"]["value"] == tags["west.ctd.sample_count"]["value"]
    assert "west.adapt.state" in state["plc"]["variables"]
    assert {"west.line", "east.lan"} <= {row["bus"] for row in get(client, f"{name}/frames", count=200)["rows"]}


@pytest.mark.long
def test_the_trace_of_processes_says_that_its_programs_are_not_described(tmp_path: Path) -> None:
    failing_trace(tmp_path, "--target", "local", "--html", "report.html")
    with studio("fail.jsonl", folder=tmp_path) as running, running.client() as client:
        until(lambda: client.get(TRACE).json()["behind_bytes"] == 0, "the trace is read to its end")
        about = get(client, TRACE)
        assert (about["verdict"], about["growing"], about["programs_described"]) == ("failed", False, False)
        [failed] = about["failed"]
        state = get(client, f"{TRACE}/state", at_ns=failed["t_ns"])
        assert state["gateway"]["tags"]["ctd.pressure"]["quality"] == "bad"
        assert "Show the trace at this instant" in client.get(f"{TRACE}/report").text


def test_only_known_traces_are_opened_and_the_role_view_may_read_them(client: httpx.Client, folder: Path) -> None:
    for name in ("../fail.jsonl", "..%2Ffail.jsonl", "fail.scenario.yaml", "%2Fetc%2Fpasswd"):
        assert client.get(f"/traces/{name}").status_code == 404
    answer = client.get(f"{TRACE}/state", headers={"Authorization": f"Bearer {VIEW}"})
    assert answer.status_code == 200
    assert client.get(f"{TRACE}/state", headers={"Authorization": "Bearer no"}).status_code == 401


def test_a_trace_that_grows_is_followed(client: httpx.Client, folder: Path) -> None:
    whole = (folder / "fail.jsonl").read_bytes()
    lines = whole.splitlines(keepends=True)
    half = len(lines) // 2
    about = json.loads((folder / "fail.jsonl.about.json").read_bytes())
    growing = folder / "growing.jsonl"
    growing.write_bytes(b"".join(lines[:half]) + lines[half][:20])
    unfinished = about | {"finished": False, "verdict": "", "checks": []}
    (folder / "growing.jsonl.about.json").write_text(json.dumps(unfinished))
    path = "/traces/growing.jsonl"
    try:
        first_ns = json.loads(lines[half - 1])[0]
        until(lambda: get(client, path)["events"] == half, "the first half is read")
        seen = get(client, path)
        assert (seen["growing"], seen["end_ns"], seen["failed"]) == (True, first_ns, [])
        with growing.open("ab") as file:
            file.write(lines[half][20:] + b"".join(lines[half + 1 :]))
        until(lambda: get(client, path)["events"] == len(lines), "the second half is read")
        assert [check["number"] for check in get(client, path)["failed"]] == ["5"], (
            "known from the step, before the end"
        )
        (folder / "growing.jsonl.about.json").write_text(json.dumps(about))
        until(lambda: get(client, path)["growing"] is False, "the end of the run is noticed")
        assert get(client, path)["failed"][0]["got"] == "bad (timeout)"
    finally:
        growing.unlink()
        (folder / "growing.jsonl.about.json").unlink()


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (b"not a line\n", "no event"),
        (b'[1,"tag","ctd.pressure",{"quality":"good"}]\n', "no event"),
        (b'[-1,"note","x",{}]\n', "not within a run"),
        (b'[1,"note","x",' + b"[" * 5000 + b"]\n", "no event"),
        (b'[99999999999999999999999,"note","x",{}]\n', "no event"),
        (b" " * (1 << 20) + b"  ", "longer than"),
    ],
)
def test_an_invalid_line_is_named_and_the_events_before_it_are_shown(
    client: httpx.Client, folder: Path, line: bytes, said: str
) -> None:
    name = f"broken{abs(hash(line))}.jsonl"
    good = (folder / "fail.jsonl").read_bytes().splitlines(keepends=True)[:100]
    broken = folder / name
    broken.write_bytes(b"".join(good) + line + b"".join(good))
    about = folder / f"{name}.about.json"
    about.write_bytes((folder / "fail.jsonl.about.json").read_bytes())
    try:
        state = until(
            lambda: "trace" in (found := get(client, f"/traces/{name}/state"))["troubles"] and found, "it is named"
        )
        assert said in state["troubles"]["trace"]
        assert f"{name}:101" in state["troubles"]["trace"]
        assert get(client, f"/traces/{name}")["events"] == 100
    finally:
        broken.unlink()
        about.unlink()


def test_a_trace_without_a_description_needs_the_system(folder: Path, tmp_path: Path) -> None:
    trace = tmp_path / "bare.jsonl"
    trace.write_bytes((folder / "fail.jsonl").read_bytes())
    with pytest.raises(FileInvalid, match="--system SYSTEM"):
        Replay("bare.jsonl", trace)
    with studio(str(trace), "--system", "observatory", folder=tmp_path) as running, running.client() as client:
        until(lambda: get(client, "/traces/bare.jsonl")["behind_bytes"] == 0, "it is read")
        state = get(client, "/traces/bare.jsonl/state", at_ns=FAILED_NS)
        assert state["gateway"]["tags"]["ctd.pressure"]["quality"] == "bad"
        assert state["plc"]["outputs"]["relay.state"] == "ACTIVE"
        assert [check["number"] for check in get(client, "/traces/bare.jsonl")["failed"]] == ["5"]
