"""The command `about` of a PLC process: variables, states and transitions, and source texts of limited size."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest
from support import run
from test_plc_process import RELAY, config_in, got, plc_running

from fieldtwin.gateway.core.histogram import Histogram
from fieldtwin.gateway.core.statemachine import encode_period
from fieldtwin.plc.binding import InputBinding
from fieldtwin.plc.runtime import about
from fieldtwin.plc.runtime.config import ProgramConfig

VALVE_ST = """TYPE Mode : (CLOSED, OPEN); END_TYPE
PROGRAM Valve
VAR_INPUT n : INT; END_VAR
VAR state : Mode; turns : INT; END_VAR
  IF n > 0 THEN state := OPEN; ELSE state := CLOSED; END_IF
END_PROGRAM
"""
COUNTER_PY = """
from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.plc.program import Program, var_local


class Counter(Program):
    scans = var_local(TagKind.INT, initial=0)

    def execute(self, scan):
        self.scans = scan.number
"""
VALVE = ProgramConfig("valve", "valve.st", {"n": InputBinding("ctd.sample_period_s")})
COUNTER = ProgramConfig("counter", "python: counter:Counter")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "valve.st").write_text(VALVE_ST)
    (tmp_path / "counter.py").write_text(COUNTER_PY)
    return tmp_path


async def programs(folder: Path, *configs: ProgramConfig) -> dict[str, Any]:
    async with plc_running(config_in(folder, *configs)) as (_, _, client):
        answer: dict[str, Any] = (await client.call("about"))["programs"]
        return answer


def test_a_state_table_is_described_with_its_initial_state_and_transitions(folder: Path) -> None:
    relay = run(programs(folder, RELAY))["relay"]
    machine = relay["machine"]
    assert machine["states"] == ["STANDBY", "ACTIVE", "OFF"]
    assert machine["initial"] == "STANDBY"
    assert {"source": "", "target": "ACTIVE", "label": "command > 0"} in machine["transitions"]
    assert relay["variables"]["state"]["words"] == {"0": "STANDBY", "1": "ACTIVE", "2": "OFF"}
    assert relay["variables"]["period_s"]["tag"] == "ctd.sample_period_s"
    assert relay["variables"]["command"] == {
        "tag": "modem.inbox",
        "role": "input",
        "kind": "message",
        "unit": "",
        "type": "",
        "words": {},
    }


def test_the_text_of_a_user_file_is_given_and_that_of_a_library_is_not(folder: Path) -> None:
    found = run(programs(folder, RELAY, VALVE, COUNTER))
    assert found["relay"]["source"]["file"] == "relay.py"
    assert found["relay"]["source"]["text"] == ""
    assert "library" in found["relay"]["source"]["reason"]
    assert found["valve"]["source"] == {
        "language": "Structured Text",
        "file": "valve.st",
        "text": VALVE_ST,
        "reason": "",
    }
    assert found["counter"]["source"]["language"] == "Python"
    assert found["counter"]["source"]["text"] == COUNTER_PY


def test_states_of_structured_text_have_names_but_no_declared_transitions(folder: Path) -> None:
    found = run(programs(folder, VALVE, COUNTER))
    assert found["valve"]["machine"] == {
        "states": ["CLOSED", "OPEN"],
        "initial": "",
        "transitions": [],
        "declared": False,
    }
    assert found["counter"]["machine"] is None


def test_a_large_source_is_described_without_its_text(folder: Path) -> None:
    (folder / "valve.st").write_text(VALVE_ST + "(* " + "x" * about.MAX_TEXT_BYTES + " *)\n")
    source = run(programs(folder, VALVE))["valve"]["source"]
    assert source["text"] == ""
    assert source["reason"] == f"it is larger than {about.MAX_TEXT_BYTES} bytes"


def test_a_file_that_was_edited_is_not_shown_as_the_running_program(folder: Path) -> None:
    async def main() -> tuple[dict[str, Any], dict[str, Any]]:
        async with plc_running(config_in(folder, VALVE)) as (_, _, client):
            (folder / "valve.st").write_text(VALVE_ST.replace("n > 0", "n > 5"))
            edited = (await client.call("about"))["programs"]["valve"]["source"]
            await client.call("restart")
            return edited, (await client.call("about"))["programs"]["valve"]["source"]

    edited, restarted = run(main())
    assert (edited["text"], edited["reason"]) == ("", "the file has changed since the PLC read it")
    assert "n > 5" in restarted["text"]


def test_the_status_has_buckets_whose_counts_are_all_scans(tmp_path: Path) -> None:
    async def main() -> None:
        async with plc_running(config_in(tmp_path, RELAY)) as (_, gateway, client):
            beating = asyncio.create_task(gateway.alive())
            gateway.publish(modem_inbox=encode_period(2).data)
            status = await got(client, lambda s: s["scans"] > 20)
            assert sum(count for _, count in status["duration_buckets"]) == status["duration_us"]["count"]
            limits = [limit for limit, _ in status["duration_buckets"]]
            assert limits == sorted(limits)
            assert (await client.call("get", brief=True))["duration_buckets"] == []
            asked = await client.call("get", brief=True, buckets=True)
            assert sum(count for _, count in asked["duration_buckets"]) == asked["duration_us"]["count"]
            assert "outputs" not in asked
            beating.cancel()
            await asyncio.wait([beating])

    run(main())


def test_buckets_for_a_display_are_few_and_cover_every_duration() -> None:
    histogram = Histogram()
    assert histogram.buckets_us() == []
    for exponent in range(13):
        histogram.record(10**exponent)
    buckets = histogram.buckets_us()
    assert sum(count for _, count in buckets) == 13
    assert len(buckets) <= 30
    histogram = Histogram()
    for _ in range(3):
        histogram.record(150_000)
    histogram.record(1_500_000)
    assert histogram.buckets_us() == [(200.0, 3), (500.0, 0), (1000.0, 0), (2000.0, 1)]
