"""Twins in Studio's interface: the model compared with the plant, the thread, decisions, and forecasts of the real command."""

from __future__ import annotations

import asyncio
import os
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from studio_rig import OPERATE, VIEW, until
from twin_rig import TwinSite, twin_site

from fieldtwin.gateway.core.control import ControlClient

pytestmark = [pytest.mark.long, pytest.mark.timeout(180)]

NAME = "/instances/observatory"
WHAT_IF = f"{NAME}/what-if"


@pytest.fixture(scope="module")
def site() -> Iterator[TwinSite]:
    with tempfile.TemporaryDirectory(prefix="ftt", dir="/tmp") as root, twin_site(Path(root)) as running:
        yield running


def test_the_command_lines_that_start_a_twin_name_the_place_of_the_thread(site: TwinSite) -> None:
    place = site.twins()["plant_thread"]["place"]
    assert [line["command"] for line in site.proposed] == [
        f"fieldtwin shadow observatory --from {place}",
        f"fieldtwin twin observatory --from {place} --command 2",  # the rig has run this one
    ]


def test_the_model_has_the_values_of_the_plant(site: TwinSite) -> None:
    def settled() -> bool:
        verdicts = {name: v["verdict"] for name, v in site.variables().items() if v["plant_quality"] is not None}
        return set(verdicts.values()) == {"agrees"}

    until(settled, "every value of the plant is in the model")
    variables = site.variables()
    serial = variables["inclinometer.serial"]
    assert serial["model"] == serial["plant"] == 1005
    assert serial["difference"] == 0
    assert serial["model_age_s"] < 30
    assert variables["relay"]["model"] is True
    assert variables["ctd.sample"]["verdict"] == "unknown"  # a message, which the gateway does not keep


def test_a_value_that_has_not_reached_the_model_deviates_with_the_reason(site: TwinSite) -> None:
    until(lambda: site.variables()["ctd.sample_period_s"]["verdict"] == "agrees", "model and plant agree")
    pid = asyncio.run(thread_pid(site))
    os.kill(pid, signal.SIGSTOP)
    try:
        with site.studio.client(OPERATE) as client:
            client.put(f"{NAME}/tags/ctd.sample_period_s/set", json={"value": 7}).raise_for_status()
        until(lambda: site.variables()["ctd.sample_period_s"]["verdict"] == "deviates", "the model is behind")
        behind = site.variables()["ctd.sample_period_s"]
    finally:
        os.kill(pid, signal.SIGCONT)
        with site.studio.client(OPERATE) as client:
            client.delete(f"{NAME}/tags/ctd.sample_period_s/set")
    assert (behind["model"], behind["plant"], behind["difference"]) == (2, 7, -5)
    assert behind["reason"] == "the model has an older value"
    until(lambda: site.variables()["ctd.sample_period_s"]["verdict"] == "agrees", "the thread has delivered the value")


async def thread_pid(site: TwinSite) -> int:
    """Return the process ID of the plant's end of the thread."""
    client = await ControlClient.connect_unix(site.studio.run_root / "observatory" / "thread.sock")
    try:
        return int((await client.call("ready"))["pid"])
    finally:
        await client.aclose()


def test_both_ends_of_the_thread_are_connected_and_their_numbers_agree(site: TwinSite) -> None:
    found = site.twins()
    plant, twin = found["plant_thread"], found["followers"][0]["status"]["thread"]
    assert found["followers"][0]["is_of_instance"] is True
    assert plant["connected"]
    assert twin["connected"]
    assert 0 < twin["since_ms"] <= found["followers"][0]["status"]["now_ms"]
    until(
        lambda: site.twin()["status"]["thread"]["received"][plant["origin"]]["through"] >= plant["written"],
        "what the plant had written is received",
    )
    assert twin["received"][plant["origin"]]["lost"] == 0


def test_decisions_have_the_plan_and_why_it_was_sent_or_refused(site: TwinSite) -> None:
    until(lambda: site.twin()["status"]["commands"]["refused"], "the planner's command is refused")
    decisions = site.twin()["status"]["decisions"]
    [sent] = [d for d in decisions if d["finding"] == "by hand"]
    refused = next(d for d in decisions if d["outcome"] == "refused")
    assert (sent["plan"], sent["outcome"], sent["reason"]) == ("period 2 s", "sent", "the model accepts it")
    assert (refused["subject"], refused["observed"], refused["plan"]) == ("relay", "ACTIVE, period 2 s", "the bytes 01")
    assert "1 byte" in refused["reason"]
    assert sent["settled_ms"] >= sent["t_ms"]
    assert site.twin()["status"]["commands"]["sent"] == 1


def test_a_forecast_has_the_values_over_time_and_judges_the_requirement(site: TwinSite) -> None:
    question = {
        "horizon_s": 40,
        "commands": [{"period_s": 10, "at_s": 10}],
        "faults": [{"name": "silence", "device": "ctd", "from": "20s"}],
        "require": ["quality(ctd.status) == 'good'"],
        "finally": ["relay.period == 10"],
        "series": ["ctd.sample_period_s", "relay.period"],
    }
    with site.studio.client(OPERATE) as client:
        begun = client.post(WHAT_IF, json=question).json()["run"]
        assert begun["running"], begun
        assert client.post(WHAT_IF, json=question).status_code >= 400, "one question at a time"
        until(lambda: not client.get(WHAT_IF).json()["run"]["running"], "the forecast is ready")
        run = client.get(WHAT_IF).json()["run"]
    result = run["result"]
    assert run["trouble"] == ""
    assert [r["met"] for r in result["requirements"]] == [False, True]
    assert 20 <= result["requirements"][0]["at_s"] < 30
    assert [value for _, value in result["series"]["relay.period"]][-1] == 10
    assert result["series"]["ctd.sample_period_s"][-1][1] is None, "the silent sensor has no good value"
    assert all(0 <= t <= 40 for t, _ in result["series"]["ctd.sample_period_s"])
    assert "what-if observatory --from instance:observatory" in run["command"]
    assert "/tmp" not in run["command"]


def test_a_forecast_can_be_stopped_and_an_error_in_the_question_is_explained(site: TwinSite) -> None:
    with site.studio.client(OPERATE) as client:
        client.post(WHAT_IF, json={"horizon_s": 86_400}).raise_for_status()
        stopped = client.delete(WHAT_IF).json()["run"]
        assert (stopped["running"], stopped["trouble"]) == (False, "stopped")
        client.post(WHAT_IF, json={"horizon_s": 10, "series": ["ctd.nothing"]}).raise_for_status()
        until(lambda: not client.get(WHAT_IF).json()["run"]["running"], "the question is refused")
        trouble = client.get(WHAT_IF).json()["run"]["trouble"]
    assert "no tag or variable 'ctd.nothing'" in trouble
    assert "Traceback" not in trouble


@pytest.mark.parametrize(
    ("question", "text"),
    [
        ({"horizon_s": 0}, "the horizon"),
        ({"horizon_s": 1e9}, "the horizon"),
        ({"horizon_s": 60, "commands": [{"period_s": 1, "at_s": 61}]}, "the time of a command"),
        ({"horizon_s": 60, "series": ["ctd.status"] * 9}, "too many series"),
        ({"horizon_s": 60, "file": "/etc/passwd"}, "file"),
    ],
)
def test_bad_questions_are_refused(site: TwinSite, question: dict[str, Any], text: str) -> None:
    with site.studio.client(OPERATE) as client:
        answer = client.post(WHAT_IF, json=question)
    assert answer.status_code == 400
    assert text in answer.json()["error"]["message"]


def test_the_role_view_asks_no_question(site: TwinSite) -> None:
    with site.studio.client(VIEW) as client:
        assert client.get(WHAT_IF).status_code == 200
        assert client.post(WHAT_IF, json={"horizon_s": 60}).status_code == 403
        assert client.delete(WHAT_IF).status_code == 403
