"""The live table of `fieldtwin plc watch` follows online changes: a new variable appears, and a removed one disappears."""

from __future__ import annotations

from contextlib import aclosing
from pathlib import Path

from support import run
from test_plc_process import config_in, plc_running

from fieldtwin.cli.plc.views import NAMES_EVERY, live_rows
from fieldtwin.gateway.core.control import ControlClient
from fieldtwin.plc.runtime.config import ProgramConfig

PROGRAM = "PROGRAM count VAR n : INT;{} END_VAR n := n + 1; END_PROGRAM"


async def reloaded(client: ControlClient) -> None:
    prepared = await client.call("prepare_change")
    await client.call("apply_change", number=prepared["number"])


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

    before, added, removed = run(main())
    assert before == removed == {"count.n"}
    assert added == {"count.n", "count.delay.IN", "count.delay.PT", "count.delay.Q", "count.delay.ET"}
