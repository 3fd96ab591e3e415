"""Campaigns in Studio: the state of a ledger while it grows, and its report."""

from __future__ import annotations

from pathlib import Path

import httpx
import pytest
from studio_rig import studio

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.run.campaigns.ledger import Ledger, LedgerEntry, write_entries
from fieldtwin.studio.campaigns.ledgers import Ledgers, NoLedger

CAUSE = "tank: the level was 12 m"


def entry(seed: int, *errors: str, ago_s: float = 1000.0) -> LedgerEntry:
    ended_s = WallClock().utc_ns() / 1e9 - ago_s
    reproduce = f"fieldtwin simulate tank.yaml --seed {seed}" if errors else ""
    return LedgerEntry(
        "w", "1", seed, 8.0, not errors, 1, 0, "ab", errors, "tank", reproduce, ended_s, 2.0, f"node-{seed % 2}:7"
    )


def test_a_growing_ledger_is_followed_and_an_incomplete_line_waits(tmp_path: Path) -> None:
    ledgers = Ledgers(tmp_path, WallClock())
    assert ledgers.states() == []
    path = tmp_path / "hours.jsonl"
    write_entries(path, [entry(1), entry(2, CAUSE)])
    [state] = ledgers.states()
    [campaign] = state["campaigns"]
    assert (campaign["runs"], campaign["failed"], campaign["hours"], campaign["workers"]) == (2, 1, 16.0, 2)
    assert campaign["causes"] == [
        {"cause": CAUSE, "runs": 1, "seed": 2, "reproduce": "fieldtwin simulate tank.yaml --seed 2"}
    ]
    assert not campaign["running"]
    Ledger(path).record(entry(3, ago_s=1.0))
    whole = path.read_bytes()
    path.write_bytes(whole + whole[:40])
    [campaign] = ledgers.states()[0]["campaigns"]
    assert (campaign["runs"], campaign["running"]) == (3, True)
    path.write_bytes(whole + whole[: whole.index(b"\n") + 1].replace(b'"seed":1', b'"seed":4'))
    assert ledgers.states()[0]["campaigns"][0]["runs"] == 4


def test_a_ledger_that_was_replaced_is_read_from_its_beginning(tmp_path: Path) -> None:
    path, ledgers = tmp_path / "hours.jsonl", Ledgers(tmp_path, WallClock())
    write_entries(path, [entry(1), entry(2)])
    assert ledgers.states()[0]["campaigns"][0]["runs"] == 2
    write_entries(tmp_path / "new", [entry(seed) for seed in range(9)])
    (tmp_path / "new").replace(path)
    assert ledgers.states()[0]["campaigns"][0]["runs"] == 9


def test_a_line_that_is_not_of_a_ledger_is_the_trouble_of_this_ledger_only(tmp_path: Path) -> None:
    ledgers = Ledgers(tmp_path, WallClock())
    (tmp_path / "bad.jsonl").write_text('{"what": 1}\n'.replace(" ", "") + '{"what":"w"}\n')
    write_entries(tmp_path / "good.jsonl", [entry(1)])
    (tmp_path / "broken.jsonl").write_text('{"what":"w"}\n')
    (tmp_path / "events.jsonl").write_text('{"t_ns":1}\n')
    states = {state["name"]: state for state in ledgers.states()}
    assert set(states) == {"good.jsonl", "broken.jsonl"}
    assert "not a line of a ledger" in states["broken.jsonl"]["trouble"]
    with pytest.raises(FileInvalid):
        ledgers.named("broken.jsonl")
    with pytest.raises(NoLedger):
        ledgers.named("../good.jsonl")


def test_the_interface_lists_ledgers_of_folders_and_serves_their_report(tmp_path: Path) -> None:
    (tmp_path / "night").mkdir()
    write_entries(tmp_path / "night" / "hours.jsonl", [entry(1), entry(2, CAUSE)])
    with studio(folder=tmp_path) as running, running.client() as client:
        [state] = client.get("/campaigns").json()
        assert state["name"] == "night~hours.jsonl"
        assert state["campaigns"][0]["title"] == "tank"
        page: httpx.Response = client.get("/campaigns/night~hours.jsonl/report")
        assert page.status_code == 200
        assert CAUSE in page.text
        assert "default-src 'none'" in page.headers["Content-Security-Policy"]
        assert client.get("/campaigns/none.jsonl/report").status_code >= 400
