"""The value of a secret tag is in no answer of Studio."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from studio_rig import Studio, studio, until

PROFILE = """device: fieldtwin/door
source: "made for this test"
protocol: modbus
numbering: sent
tags:
  level: {at: "holding:0", poll: fast}
  pin:   {at: "holding:9", poll: fast, secret: true}
"""
SYSTEM = """fieldtwin: 1
system: door
buses:
  lan: {url: "tcp://192.0.2.1:502"}
devices:
  lock: {profile: door_profile.yaml, bus: lan, unit: 1, poll: {fast: {every_ms: 100}}}
"""
PROTOTYPE = """prototype_of: door.yaml
buses:
  lan: {listen: "tcp://127.0.0.1:0"}
devices:
  lock: {model: profile, values: {level: 42, pin: 28263}}
"""
DOOR = "/instances/door"
PATHS = ("/tags", "/status", "/plc", "/tags/lock.pin/history", "/twins")
PIN = re.compile(r"\b28263\b")


@pytest.fixture
def door(tmp_path: Path) -> Iterator[Studio]:
    (tmp_path / "door_profile.yaml").write_text(PROFILE)
    (tmp_path / "door.yaml").write_text(SYSTEM)
    (tmp_path / "door.prototype.yaml").write_text(PROTOTYPE)
    with studio("door.yaml", folder=tmp_path) as running:
        yield running


@pytest.mark.long
def test_the_value_of_a_secret_tag_is_in_no_answer_and_a_forecast_about_it_is_refused(door: Studio) -> None:
    with door.client() as client:
        until(lambda: client.get(f"{DOOR}/tags").json()["lock.pin"]["quality"] == "good", "the secret is read")
        answers = [client.get(DOOR + path) for path in PATHS]
        frames = until(
            lambda: [row for row in client.get(f"{DOOR}/frames", params={"count": 50}).json()["rows"] if row["tags"]],
            "a frame with values is indexed",
        )
        assert [answer.status_code for answer in answers] == [200] * len(PATHS)
        assert [str(answer.url) for answer in answers if PIN.search(answer.text)] == []
        assert [row for row in frames if PIN.search(str(row["tags"])) or PIN.search(row["text"])] == []
        for part in ({"series": ["lock.pin"]}, {"require": ["lock.pin == 28263"]}, {"finally": ["lock.pin > 0"]}):
            refused = client.post(f"{DOOR}/what-if", json={"horizon_s": 10} | part)
            assert (refused.status_code, "lock.pin is secret" in refused.text) == (403, True), refused.text
