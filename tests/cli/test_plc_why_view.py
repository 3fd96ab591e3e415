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
            "variables": {"timer.Q": "TRUE"},
        },
    }  # fmt: skip
    print_why("pump.state", [change])
    assert capsys.readouterr().out.splitlines() == [
        "12 ms ago, scan 512: 1 to 3, by program pump",
        "    in pump.st:18  state := FAULT",
        "        because state = FILLING  (line 14)",
        "        because not level >= 80.0  (line 15)",
        "        timer.Q is TRUE after the scan",
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
