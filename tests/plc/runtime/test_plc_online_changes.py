"""Online changes of a PLC process: which files count as changed, and a live table that follows the variables."""

from __future__ import annotations

from contextlib import aclosing
from pathlib import Path

import pytest
from support import run
from test_plc_process import config_in, plc_running

from fieldtwin.cli.plc.views import NAMES_EVERY, live_rows
from fieldtwin.gateway.core.control import ControlClient
from fieldtwin.plc.runtime.config import ProgramConfig

PROGRAM = "PROGRAM count VAR n : INT;{} END_VAR n := n + 1; END_PROGRAM"


async def reloaded(client: ControlClient) -> None:
    prepared = await client.call("prepare_change", timeout_s=60)
    await client.call("apply_change", timeout_s=60, number=prepared["number"])


@pytest.mark.timeout(200)
def test_new_and_removed_variables_appear_and_disappear_in_a_live_table(tmp_path: Path) -> None:
    """Defect: a new variable was not shown, and a removed one ended the command with an error."""
    source = tmp_path / "count.st"
    source.write_text(PROGRAM.format(""))

    async def main() -> list[set[str]]:
        shown = []
        async with (
            plc_running(config_in(tmp_path, ProgramConfig("count", "count.st"))) as (_, _, client),
            aclosing(live_rows(client, ("count",))) as table,
        ):
            for text in ("", " delay : TON;", ""):
                source.write_text(PROGRAM.format(text))
                if shown:
                    await reloaded(client)
                tables = [await anext(table) for _ in range(NAMES_EVERY if text else 1)]
                shown.append({row["tag"] for row in tables[-1]})
        return shown

    before, added, removed = run(main(), timeout_s=180)
    assert before == removed == {"count.n"}
    assert added == {"count.n", "count.delay.IN", "count.delay.PT", "count.delay.Q", "count.delay.ET"}


@pytest.mark.timeout(200)
def test_a_new_and_a_removed_file_of_a_folder_are_changes(tmp_path: Path) -> None:
    folder = tmp_path / "plc"
    folder.mkdir()
    (folder / "count.st").write_text(PROGRAM.format(""))
    new = folder / "more" / "limit.st"

    async def main() -> list[list[str]]:
        seen = []
        async with plc_running(config_in(tmp_path, ProgramConfig("count", "plc"))) as (_, _, client):

            async def files() -> list[str]:
                return [change["where"] for change in (await client.call("prepare_change", timeout_s=60))["changes"]]

            seen.append(await files())
            new.parent.mkdir()
            new.write_text("VAR_GLOBAL limit : INT := 7; END_VAR")
            seen.append(await files())
            await reloaded(client)
            seen.append(await files())
            assert (await client.call("image", tags=["count.limit"]))["tags"][0]["value"] == 7
            new.unlink()
            seen.append(await files())
            await reloaded(client)
            seen.append(await files())
        return seen

    assert run(main(), timeout_s=180) == [[], [str(new)], [], [str(new)], []]
