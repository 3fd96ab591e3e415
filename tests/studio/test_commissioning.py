"""The commissioning guide of Studio over its interface: steps as jobs, files, drafts, and what is refused."""

from __future__ import annotations

import asyncio
import json
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import websockets
from studio_rig import VIEW, Studio, studio, until

from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.studio.commissioning.jobs import LONGEST_LINE, MOST_LINES, Job
from fieldtwin.studio.commissioning.steps import Emulate, Listen
from fieldtwin.studio.commissioning.work_folder import WorkFolder

GUIDE = "/commissioning"
PRACTICE = {"step": "emulate", "what": "ctd-reference", "on": "pty:practice"}
PORT = "rtu:practice"
PROFILE = """device: mysite/meter
source: "a test"
protocol: modbus
tags:
  flow: {at: 30001, type: uint16, unit: l/s}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The working folder of Studio."""
    return tmp_path_factory.mktemp("site")


@pytest.fixture(scope="module")
def running(folder: Path) -> Iterator[Studio]:
    """A Studio without instances, with the emulated device for practice."""
    with studio(folder=folder) as server:
        with server.client() as client:
            job = begin(client, PRACTICE)
            until(lambda: "units 1" in " ".join(state(client, job)["lines"]), "the emulated device answers")
        yield server


def begin(client: httpx.Client, step: dict[str, Any]) -> int:
    answer = client.post(f"{GUIDE}/jobs", json={"step": step})
    assert answer.status_code == 200, answer.text
    number: int = answer.json()["number"]
    return number


def state(client: httpx.Client, job: int) -> dict[str, Any]:
    found: dict[str, Any] = client.get(f"{GUIDE}/jobs/{job}").json()
    return found


def whole(client: httpx.Client, step: dict[str, Any]) -> dict[str, Any]:
    """Run a step and return its job at the end."""
    job = begin(client, step)
    return until(lambda: (s := state(client, job))["state"] != "running" and s, f"{step['step']} ends")


def refusal(client: httpx.Client, step: dict[str, Any]) -> str:
    answer = client.post(f"{GUIDE}/jobs", json={"step": step})
    assert 400 <= answer.status_code < 500 or answer.status_code == 503, answer.text
    message: str = answer.json()["error"]["message"]
    return message


def test_the_guide_names_folder_ports_practice_devices_and_files(running: Studio, folder: Path) -> None:
    with running.client(VIEW) as client:
        guide = client.get(GUIDE).json()
    assert guide["folder"] == str(folder)
    assert guide["role"] == "view"
    ctd = {"name": "ctd-reference", "device": "fieldtwin/ctd-reference", "protocol": "modbus", "address": 1}
    assert ctd in guide["profiles"]
    assert ("inclinometer-cia410", "canopen", 5) in [
        (p["name"], p["protocol"], p["address"]) for p in guide["profiles"]
    ]


def test_a_scan_finds_the_device_and_its_result_is_data(running: Studio) -> None:
    with running.client() as client:
        job = whole(client, {"step": "scan", "endpoint": PORT, "listen_s": 0.5})
    assert job["state"] == "done"
    assert job["exit_code"] == 0
    assert [u["unit"] for u in job["result"]["units"]] == [1]
    assert job["command"] == "fieldtwin scan rtu:practice --quick --listen-for 500ms"
    assert any("listening" in line for line in job["lines"])


def test_a_stopped_dump_keeps_its_values_and_is_continued(running: Studio, folder: Path) -> None:
    step = {
        "step": "dump",
        "endpoint": PORT,
        "ranges": ["holding:0..7"],
        "passes": 200,
        "every_s": 0.2,
        "out": "long.jsonl",
    }
    with running.client() as client:
        job = begin(client, step)
        until(lambda: state(client, job)["writes"].get("long.jsonl", 0) > 600, "some values are written")
        busy = refusal(client, {"step": "scan", "endpoint": PORT})
        stopped = client.delete(f"{GUIDE}/jobs/{job}").json()
        before = len((folder / "long.jsonl").read_text().splitlines())
        resumed = begin(client, step | {"resume": True})
        until(lambda: len((folder / "long.jsonl").read_text().splitlines()) > before, "the dump goes on")
        client.delete(f"{GUIDE}/jobs/{resumed}")
        again = refusal(client, step)
    assert "'dump' uses this port" in busy
    assert stopped["state"] == "stopped"
    assert any("--resume continues" in line for line in stopped["lines"])
    assert "already exists" in again


def test_another_name_of_the_same_port_is_the_same_port(running: Studio, folder: Path) -> None:
    device = (folder / "practice").resolve()
    with running.client() as client:
        job = begin(client, {"step": "line", "endpoint": f"rtu:{device}", "listen_s": 60})
        message = refusal(client, {"step": "identify", "endpoint": f"{PORT}?baudrate=9600&frame=8N1"})
        client.delete(f"{GUIDE}/jobs/{job}")
    assert "'line' uses this port" in message


def test_the_shown_command_line_is_the_command_that_runs(running: Studio) -> None:
    form = {
        "step": "report",
        "files": ["a.jsonl"],
        "out": "r.html",
        "site": "Pump; house's",
        "label": "-o x",
        "device": "unit 3",
    }
    with running.client(VIEW) as client:
        shown = client.post(f"{GUIDE}/command", json={"step": form}).json()["command"]
        unfinished = client.post(f"{GUIDE}/command", json={"step": form | {"out": "../r.html"}}).json()
    assert shlex.split(shown) == [
        *("fieldtwin", "report", "a.jsonl", "-o", "r.html"),
        *("--site=Pump; house's", "--label=unit 3=-o x"),
    ]
    assert unfinished["command"] == ""
    assert "plain name" in unfinished["problem"]


@pytest.mark.parametrize(
    ("step", "text"),
    [
        ({"step": "infer", "dump": "../secret.jsonl", "out": "a.yaml"}, "plain name"),
        ({"step": "infer", "dump": "/etc/passwd", "out": "a.yaml"}, "plain name"),
        ({"step": "infer", "dump": "-h.jsonl", "out": "a.yaml"}, "plain name"),
        ({"step": "infer", "dump": "a\u0000.jsonl", "out": "a.yaml"}, "plain name"),
        ({"step": "infer", "dump": "link.jsonl", "out": "a.yaml"}, "is a link"),
        ({"step": "infer", "dump": "a.txt", "out": "a.yaml"}, ".jsonl"),
        ({"step": "infer", "dump": "nothing.jsonl", "out": "a.yaml"}, "there is no file"),
        ({"step": "dump", "endpoint": PORT, "out": "sub/a.jsonl"}, "plain name"),
        ({"step": "dump", "endpoint": PORT, "out": "a.jsonl", "ranges": ["--help"]}, "Expected"),
        ({"step": "dump", "endpoint": PORT, "out": "a.jsonl", "passes": 0}, "Expected"),
        ({"step": "scan", "endpoint": PORT, "units": "1;ls"}, "Expected"),
        ({"step": "scan", "endpoint": "--help"}, "endpoint"),
        ({"step": "scan", "endpoint": "file:///etc/passwd"}, "endpoint"),
        ({"step": "scan", "endpoint": "tls://h:802?ca=../ca.pem"}, "plain name"),
        ({"step": "scan", "endpoint": "pty:practice"}, "rtu:practice"),
        ({"step": "emulate", "what": "ctd-reference", "on": "tcp://0.0.0.0:1502"}, "this computer only"),
        ({"step": "emulate", "what": "ctd-reference", "on": "pty:/tmp/elsewhere"}, "plain name"),
        ({"step": "emulate", "what": "../x.yaml", "on": "pty:copy"}, "plain name"),
        ({"step": "record", "endpoint": PORT, "out": "r.jsonl"}, "needs a profile"),
        (
            {"step": "check", "endpoint": PORT, "out": "c.json", "html": "c.html", "writes": ["holding:1"]},
            "confirmation",
        ),
        ({"step": "report", "files": [], "out": "a.html"}, "Expected"),
        ({"step": "report", "files": ["a.json"], "out": "a.html", "site": "a\nb"}, "control characters"),
        ({"step": "run", "system": "observatory"}, "Invalid value"),
        ({"step": "scan", "endpoint": PORT, "arguments": ["--log", "x"]}, "unknown field"),
    ],
)
def test_values_that_could_become_other_arguments_or_files_are_refused(
    running: Studio, folder: Path, step: dict[str, Any], text: str
) -> None:
    if not (folder / "link.jsonl").is_symlink():
        (folder / "link.jsonl").symlink_to("/etc/passwd")
    with running.client() as client:
        known = client.get(GUIDE).json()["jobs"][-1]["number"]
        assert text in refusal(client, step)
        assert client.get(GUIDE).json()["jobs"][-1]["number"] == known
    assert "Traceback" not in running.log.read_text()


def test_the_role_view_looks_and_starts_nothing(running: Studio) -> None:
    with running.client(VIEW) as client:
        assert client.get(GUIDE).status_code == 200
        assert client.get(f"{GUIDE}/jobs/1").status_code == 200
        for method, path in (
            ("POST", "/jobs"),
            ("DELETE", "/jobs"),
            ("DELETE", "/jobs/1"),
            ("PUT", "/drafts/meter.yaml"),
        ):
            answer = client.request(method, GUIDE + path, json={"step": PRACTICE, "text": "x"})
            assert answer.status_code == 403, (method, path)
        assert state(client, 1)["state"] == "running"


def test_only_files_of_the_guide_can_be_downloaded(running: Studio, folder: Path) -> None:
    (folder / "operate.txt").write_text("a token")
    (folder / "settings.json").write_text('{"token": 1}')
    (folder / "other.yaml").write_text("services:\n  db: {}\n")
    (folder / "meter.yaml").write_text(PROFILE)
    (folder / "<b>.yaml").write_text(PROFILE)
    with running.client(VIEW) as client:
        listed = {f["name"]: f["kind"] for f in client.get(GUIDE).json()["files"]}
        assert listed["meter.yaml"] == "profile"
        for name in ("operate.txt", "settings.json", "other.yaml", "<b>.yaml", "link.jsonl", "nothing.yaml"):
            assert name not in listed
            assert client.get(f"{GUIDE}/files/{name}").status_code == 400, name
        assert client.get(f"{GUIDE}/files/..%2Fmeter.yaml").status_code == 404
        got = client.get(f"{GUIDE}/files/meter.yaml")
    assert got.text == PROFILE
    assert got.headers["Content-Disposition"].startswith("attachment")


def test_a_draft_is_checked_with_the_lines_of_its_errors_and_saved(running: Studio, folder: Path) -> None:
    (folder / "draft.yaml").write_text(PROFILE)
    path = f"{GUIDE}/drafts/draft.yaml"
    with running.client() as client:
        opened = client.get(path).json()
        assert opened["checked"]["errors"] == []
        assert opened["checked"]["tags"][0]["unit"] == "l/s"
        wrong = PROFILE.replace("30001", "99999").replace("protocol: modbus", "protocol: modbus\nfactory: {unit: 300}")
        schema = client.post(path, json={"text": wrong}).json()["checked"]["errors"]
        loader = client.post(path, json={"text": PROFILE.replace("30001", "99999")}).json()["checked"]["errors"]
        syntax = client.post(path, json={"text": "device: [\n"}).json()["checked"]["errors"]
        saved = client.put(path, json={"text": PROFILE + "# mine\n", "version": opened["version"]})
        assert saved.status_code == 200, saved.text
        stale = client.put(path, json={"text": PROFILE, "version": opened["version"]})
        other = client.put(f"{GUIDE}/drafts/other.yaml", json={"text": PROFILE, "version": ""})
        outside = client.put(f"{GUIDE}/drafts/..%2Fx.yaml", json={"text": PROFILE})
    assert [e["line"] for e in schema] == [4]
    assert [e["line"] for e in loader] == [5]
    assert syntax[0]["line"] >= 1
    assert "draft.yaml" not in schema[0]["message"]
    assert (folder / "draft.yaml").read_text() == PROFILE + "# mine\n"
    assert stale.status_code == 409
    assert "has changed" in stale.json()["error"]["message"]
    assert other.status_code == 400
    assert outside.status_code == 404


def test_changes_of_jobs_arrive_over_the_websocket(running: Studio) -> None:
    async def main() -> list[str]:
        url = f"{running.api}{GUIDE}/stream".replace("http", "ws", 1)
        async with websockets.connect(url, additional_headers={"Authorization": f"Bearer {VIEW}"}) as socket:
            first = json.loads(await socket.recv())["jobs"]
            with running.client() as client:
                number = await asyncio.to_thread(begin, client, {"step": "line", "endpoint": PORT, "listen_s": 0.5})
            states = [first[0]["state"]]
            async with asyncio.timeout(30):
                while states[-1] != "done":
                    jobs = json.loads(await socket.recv())["jobs"]
                    states += [job["state"] for job in jobs if job["number"] == number]
            return states

    assert "running" in (states := asyncio.run(main()))[1:]
    assert states[-1] == "done"


def test_a_command_that_fails_tells_why(running: Studio) -> None:
    with running.client() as client:
        job = whole(client, {"step": "identify", "endpoint": "rtu:nowhere"})
    assert job["state"] == "failed"
    assert job["exit_code"] == 4
    assert "no such serial port" in " ".join(job["lines"])


def test_long_and_many_lines_of_a_command_are_bounded_and_counted(tmp_path: Path) -> None:
    async def main() -> dict[str, Any]:
        step = Emulate(what="ctd-reference", on="pty:copy")
        folder = WorkFolder(tmp_path)
        job = Job(1, step, step.command(folder), folder, lambda: None)
        stream = asyncio.StreamReader()
        stream.feed_data(b"x" * 10_000 + b"\n" + b"\x1b[31mred\n" * (MOST_LINES + 20))
        stream.feed_eof()
        await job._read_lines(stream)
        return job.whole()

    told = asyncio.run(main())
    assert len(told["lines"]) == MOST_LINES
    assert told["dropped_lines"] == told["line_count"] - MOST_LINES > 20
    assert max(len(line) for line in told["lines"]) <= LONGEST_LINE
    assert "\x1b" not in "".join(told["lines"])


def test_an_endpoint_with_control_characters_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FieldtwinError, match="control characters"):
        Listen(endpoint="rtu:/dev/tty\x07").command(WorkFolder(tmp_path))


def test_finished_jobs_are_forgotten_only_while_no_step_runs(tmp_path: Path) -> None:
    with studio(folder=tmp_path) as server, server.client() as client:
        job = begin(client, PRACTICE)
        refused = client.delete(f"{GUIDE}/jobs")
        assert refused.status_code == 403
        assert "emulate" in refused.json()["error"]["message"]
        client.delete(f"{GUIDE}/jobs/{job}").raise_for_status()
        assert client.delete(f"{GUIDE}/jobs").json() == {"jobs": []}
        assert client.get(f"{GUIDE}/jobs/{job}").status_code == 404
