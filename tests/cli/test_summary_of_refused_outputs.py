"""The summary of a run has one line for all values of an output that did not reach its device, with the newest of them.

Defect: a program that counts up a watchdog register of an absent device filled the summary with a line for each number.
"""

from __future__ import annotations

import pytest

from fieldtwin.cli.run.summary_view import _print_refused


def refused(tag: str, value: int, **more: object) -> dict[str, object]:
    entry = {"cause": "away", "reason": "the device accepts no writes now", "fault": "", "by": "plc"}
    return {**entry, "tag": tag, "first": value, "value": value, "count": 1, "place": "pool.st:48", **more}


def test_values_of_one_output_have_one_line_with_the_newest(capsys: pytest.CaptureFixture[str]) -> None:
    entries = [refused("pump.watchdog", 1), refused("pump.setpoint", 0), refused("pump.watchdog", 3, first=2, count=2)]
    _print_refused({"refused": entries})
    lines = [line.split(maxsplit=2)[2] for line in capsys.readouterr().out.splitlines()]
    assert lines == [
        "pump.setpoint = 0 did not reach the device: the device accepts no writes now (pool.st:48)",
        "pump.watchdog = 3 did not reach the device: the device accepts no writes now; 3 times (pool.st:48)",
    ]


def test_different_causes_have_their_own_lines(capsys: pytest.CaptureFixture[str]) -> None:
    _print_refused({"refused": [refused("pump.setpoint", 0), refused("pump.setpoint", 0, cause="failed")]})
    assert len(capsys.readouterr().out.splitlines()) == 2
