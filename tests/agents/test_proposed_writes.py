"""A write that an agent proposes reaches the plant only after a user has confirmed it in a terminal."""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from agent_site import Agent, Failed, agent, write_project
from emulated_plant import READS, Bus, plant, registers
from procs import fieldtwin, run_to_end
from pyModbusTCP.client import ModbusClient
from terminal import Terminal

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]


@asynccontextmanager
async def proposing(root: Path) -> AsyncIterator[tuple[Agent, Bus, int]]:
    """The plant `shed`, and an agent that may propose writes to it."""
    project = write_project(root)
    async with plant(root, project) as (_, bus, port), agent(root, project, "--allow-proposals", "shed") as one:
        await one.data("wait_for_tag", instance="shed", tag="tank.valve", quality="good", seconds=30)
        yield one, bus, port


async def propose(one: Agent, value: float = 1, reason: str = "the level is low") -> int:
    made = await one.data("propose_write", instance="shed", tag="tank.valve", value=value, reason=reason)
    return int(made["proposal"])


async def decided(root: Path, number: int, answer: str) -> tuple[int, str]:
    """Answer the question of `fieldtwin approve`, and return the exit code and the output."""

    def work() -> tuple[int, str]:
        terminal = Terminal(root, "approve", str(number))
        terminal.until("[y/N]")
        terminal.answer(answer)
        return terminal.end(), terminal.text

    return await asyncio.to_thread(work)


def decisions(root: Path) -> list[dict[str, Any]]:
    lines = (root / "agent-audit.jsonl").read_text().splitlines()
    return [entry for entry in map(json.loads, lines) if entry["action"] == "proposal"]


def test_a_confirmed_write_is_made_once_and_a_refused_one_never(tmp_path: Path) -> None:
    async def work() -> None:
        async with proposing(tmp_path) as (one, bus, port):
            number = await propose(one)
            assert set(bus.requests) <= READS
            waiting = await one.data("get_proposal", proposal=number)
            assert (waiting["decided"], waiting["state"]) == (False, "waiting for a user")
            code, text = await decided(tmp_path, number, "y")
            assert code == 0, text
            assert re.search(r"write +0 → 1\n", text)
            assert "agent over stdio" in text
            assert "the level is low  (the agent's words)" in text
            assert "tank.valve: 0 → 1, written" in text
            assert (await asyncio.to_thread(registers, port))[1] == [1]
            assert sum(n for function, n in bus.requests.items() if function not in READS) == 1
            told = await one.data("get_proposal", proposal=number)
            assert (told["decided"], told["state"].split()[0]) == (True, "written")

            number = await propose(one, 0)
            code, text = await decided(tmp_path, number, "n")
            assert (code, "nothing was written" in text) == (0, True), text
            assert (await asyncio.to_thread(registers, port))[1] == [1]
            assert (await one.data("get_proposal", proposal=number))["state"].startswith("refused by user")
            ended = await asyncio.to_thread(run_to_end, tmp_path, "approve", str(number))
            assert (ended.process.returncode, "does not wait: refused by user" in ended.err) == (2, True), ended.err

    asyncio.run(work())
    results = [(entry["number"], entry["result"].split(":")[0]) for entry in decisions(tmp_path)]
    assert results == [(1, "confirmed"), (1, "written"), (2, "refused")]
    assert all(entry["by"].startswith("user ") for entry in decisions(tmp_path))
    written = [json.loads(line) for line in (tmp_path / "shed" / "audit.jsonl").read_text().splitlines()]
    [asked, done] = [entry for entry in written if entry["action"] == "write"]
    assert (asked["result"], done["result"], asked["new"]) == ("asked", "done", 1.0)
    assert re.fullmatch(r"user \S+ pts/\d+, proposal 1 of agent over stdio", asked["by"])


def test_only_a_terminal_confirms(tmp_path: Path) -> None:
    async def work() -> None:
        async with proposing(tmp_path) as (one, bus, _):
            number = await propose(one)
            for variable in ({}, {"FIELDTWIN_APPROVE_YES": "1", "FIELDTWIN_YES": "1", "CI": "1"}):
                with fieldtwin(tmp_path, "approve", str(number), name="approve", env=variable) as ended:
                    assert await asyncio.to_thread(ended.wait) == 2
                assert "confirmed in a terminal only" in ended.err
            assert set(bus.requests) <= READS
            with pytest.raises(Failed, match="no tool 'approve'"):
                await one.data("approve", proposal=number)
            ended = await asyncio.to_thread(run_to_end, tmp_path, "approve", str(number), "--refuse")
            assert ended.process.returncode == 0
            assert "without a terminal" in (await one.data("get_proposal", proposal=number))["state"]
        mode = (tmp_path / ".proposals").stat().st_mode & 0o777
        assert mode == 0o700
        assert all(file.stat().st_mode & 0o077 == 0 for file in (tmp_path / ".proposals").iterdir())

    asyncio.run(work())


def test_a_value_that_changes_while_the_user_reads_is_shown_again(tmp_path: Path) -> None:
    async def work() -> None:
        async with proposing(tmp_path) as (one, _, port):
            number = await propose(one)
            terminal = Terminal(tmp_path, "approve", str(number))
            await asyncio.to_thread(terminal.until, "[y/N]")
            client = ModbusClient("127.0.0.1", port, unit_id=1, auto_open=True, auto_close=True)
            assert await asyncio.to_thread(client.write_single_register, 0, 1)
            reached = await one.data("wait_for_tag", instance="shed", tag="tank.valve", quality="good", seconds=1)
            while reached["tank.valve"]["value"] != 1:
                reached = await one.data("wait_for_tag", instance="shed", tag="tank.valve", seconds=0.1)
            terminal.answer("y")
            assert await asyncio.to_thread(terminal.end) == 1
            assert "has changed since it was shown; expected 0; got 1" in terminal.text
            code, text = await decided(tmp_path, number, "n")
            assert (code, "The value was 0 when the agent proposed the write." in text) == (0, True), text

    asyncio.run(work())


def test_what_the_plant_would_refuse_is_not_proposed(tmp_path: Path) -> None:
    async def work() -> None:
        async with proposing(tmp_path) as (one, bus, _):
            for changed, message in (
                ({"instance": "other"}, "may not propose writes"),
                ({"instance": "../shed"}, "may not propose writes"),
                ({"tag": "tank.level"}, "no client may write tank.level"),
                ({"tag": "tank.valv"}, "no tag 'tank.valv'"),
                ({"value": 2}, "outside its limits; expected 0 to 1"),
                ({"reason": "x" * 201}, "at most 200 characters"),
            ):
                given = {"instance": "shed", "tag": "tank.valve", "value": 1, "reason": ""} | changed
                with pytest.raises(Failed, match=message):
                    await one.data("propose_write", **given)
            for _ in range(8):
                await propose(one, reason="\x1b[2J\x1b]0;title\x07 \u202e")
            with pytest.raises(Failed, match="at most 8"):
                await propose(one)
            listed = await asyncio.to_thread(run_to_end, tmp_path, "approve", "--json")
            waiting = json.loads(listed.out)
            assert [p["number"] for p in waiting] == list(range(1, 9))
            assert all(p["reason"].isprintable() for p in waiting)
            assert await one.data("withdraw_proposal", proposal=1) == {"withdrawn": 1}
            with pytest.raises(Failed, match="withdrawn by agent over stdio"):
                await one.data("withdraw_proposal", proposal=1)
            with pytest.raises(Failed, match="this agent has made no proposal 99"):
                await one.data("get_proposal", proposal=99)
            assert set(bus.requests) <= READS

    asyncio.run(work())


def test_an_agent_that_may_only_read_cannot_propose(tmp_path: Path) -> None:
    project = write_project(tmp_path)

    async def work() -> None:
        async with plant(tmp_path, project), agent(tmp_path, project, "--plant", "shed") as one:
            with pytest.raises(Failed, match="fieldtwin mcp --allow-proposals"):
                await propose(one)

    asyncio.run(work())
