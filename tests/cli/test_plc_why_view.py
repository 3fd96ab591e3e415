"""The text of `fieldtwin plc why`."""

from __future__ import annotations

import pytest

from fieldtwin.cli.plc.views import print_why


def test_the_statement_its_conditions_and_its_variables_are_shown(capsys: pytest.CaptureFixture[str]) -> None:
    change = {
        "tag": "pump.state", "age_ms": 12.0, "scan": 512, "program": "pump", "before": 1, "after": 3, "inputs": {"level": 10.5},
        "forced": False, "place": "pump.st:18",
        "decided": {
            "statement": "state := FAULT",
            "conditions": [
                {"line": 14, "text": "state = FILLING", "holds": True},
                {"line": 15, "text": "level >= 80.0", "holds": False},
            ],
            "variables": {"timer.Q": "TRUE", "levels[2]": "90"},
            "indices": {"i": "2"},
            "pointed": {"limit": "levels[3]"},
            "notes": ["at^: at is NULL"],
            "inside": [
                {
                    "instance": "levels[2]", "block": "", "place": "pump.st:9", "scan": 510, "statement": "levels[n] := raw",
                    "conditions": [], "variables": {},
                },
            ],
        },
    }  # fmt: skip
    print_why("pump.state", [change])
    assert capsys.readouterr().out.splitlines() == [
        "12 ms ago, scan 512: 1 to 3, by program pump",
        "    in pump.st:18  state := FAULT",
        "        because state = FILLING  (line 14)",
        "        because not level >= 80.0  (line 15)",
        "        timer.Q is TRUE after the scan",
        "        levels[2] is 90 after the scan",
        "        i was 2 in this line",
        "        limit pointed to levels[3] in this line",
        "        not followed: at^: at is NULL",
        "    levels[2]: in pump.st:9, scan 510  levels[n] := raw",
        "    level was 10.5",
    ]


def test_a_python_program_shows_its_line_only(capsys: pytest.CaptureFixture[str]) -> None:
    change = {
        "tag": "relay.state", "age_ms": 12.0, "scan": 512, "program": "relay", "before": 1, "after": 3, "inputs": {},
        "forced": False, "place": "relay.py:18", "decided": None,
    }  # fmt: skip
    print_why("relay.state", [change])
    assert capsys.readouterr().out.splitlines() == [
        "12 ms ago, scan 512: 1 to 3, by program relay",
        "    in relay.py:18",
    ]
