"""A Studio that is started late shows what the gateway has kept of a run: in order, once, and since when."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest
from studio_rig import Studio, studio, until
from test_writing import process

from fieldtwin.gateway.core.control import ControlClient
from fieldtwin.gateway.runtime.gateway_status import GatewayStatus

PATH = "/instances/observatory"
TAG = "inclinometer.slope_long"

pytestmark = [pytest.mark.long, pytest.mark.timeout(180)]


def history(running: Studio, tag: str = TAG) -> list[list[Any]]:
    with running.client() as client:
        answer = client.get(f"{PATH}/tags/{tag}/history")
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


FAULTY = "ctd.status"


async def silence_comes_and_goes(run_dir: Path) -> None:
    """Silence a sensor until its values are bad, and let it answer until they are good, without observing the changes."""
    field = await ControlClient.connect_unix(run_dir / "field.sock")
    gateway = await ControlClient.connect_unix(run_dir / "gateway.sock")

    async def reaches(quality: str) -> None:
        async with asyncio.timeout(60):
            while (await gateway.ask("get", GatewayStatus)).tags[FAULTY].quality != quality:
                await asyncio.sleep(0.05)

    try:
        await reaches("good")
        fault = await field.call("fault", fault={"name": "silence", "device": "ctd"})
        await reaches("bad")
        await field.call("clear", id=fault["id"])
        await reaches("good")
    finally:
        await field.aclose()
        await gateway.aclose()


def test_a_studio_that_is_started_after_a_fault_has_the_changes_at_its_beginning_and_end(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    root: Path = tmp_path_factory.mktemp("h")
    with process("run", "observatory", "--prototype", "--log", "text", root=root, ready="started"):
        asyncio.run(silence_comes_and_goes(root / "run" / "observatory"))
        with studio(root=root) as late, late.client() as client:
            points = client.get(f"{PATH}/tags/{FAULTY}/history").json()["points"]
            recent = client.get(f"{PATH}/recent").json()
            about = client.get(PATH).json()
    qualities = [quality for n, (_, _, quality, _) in enumerate(points) if n == 0 or quality != points[n - 1][2]]
    assert qualities[-3:] == ["good", "bad", "good"]
    assert [number is None for _, number in recent[FAULTY]].count(True) >= 1
    assert recent[TAG], "the page of a device has a sparkline at once"
    assert about["history_from_ns"] <= points[0][0]
