"""A Studio that is started again shows what the gateway remembers of a run: in order, once, and since when."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from studio_rig import Studio, studio, until
from test_writing import process

PATH = "/instances/observatory"
TAG = "inclinometer.slope_long"

pytestmark = [pytest.mark.long, pytest.mark.timeout(180)]


def history(running: Studio) -> list[list[Any]]:
    with running.client() as client:
        answer = client.get(f"{PATH}/tags/{TAG}/history")
        return list(answer.json()["points"]) if answer.status_code == 200 else []


def test_a_second_studio_has_the_changes_since_the_first_one(tmp_path_factory: pytest.TempPathFactory) -> None:
    root: Path = tmp_path_factory.mktemp("h")
    with process("run", "observatory", "--prototype", "--log", "text", root=root, ready="started"):
        with studio(root=root) as first:
            seen = until(lambda: len(found := history(first)) > 5 and found, "values change")
        with studio(root=root) as second:
            known = until(lambda: len(found := history(second)) > len(seen) and found, "later values change")
            with second.client() as client:
                about = client.get(PATH).json()
                lost = client.get(f"{PATH}/status").json()["changes_lost"]
    times = [point[0] for point in known]
    assert times == sorted(times)
    assert [point for point in seen[1:] if point not in known] == []
    assert about["history_from_ns"] <= seen[1][0]
    assert lost == 0
