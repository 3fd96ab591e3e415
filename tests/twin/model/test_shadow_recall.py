"""A restarted shadow begins with its store's data of this plant: of no other plant, and of one log."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from support import run

from fieldtwin.gateway.store.event import Event, Kind
from fieldtwin.gateway.store.sqlite_knowledge import SqliteKnowledge, in_place
from fieldtwin.run.shadow.shadow import Shadowing
from fieldtwin.twin.model.status import encode_status
from fieldtwin.twin.plant.instance import Instance
from fieldtwin.twin.site.system import load_system

NOW_MS = 1_790_000_000_000


def log(pressure: float, period_s: int, t_ms: int) -> list[Event]:
    """The plant's reports at that time: an older value, a current one, and its state."""
    return [
        Event(1, t_ms - 1000, Kind.VALUE, "ctd.pressure", -1.0),
        Event(2, t_ms, Kind.VALUE, "ctd.pressure", pressure),
        Event(3, t_ms, Kind.STATE, "relay", encode_status("ACTIVE", period_s).data),
    ]


def begins(folder: Path, logs: dict[str, tuple[str, list[Event]]]) -> tuple[int, object]:
    """Return the initial period and pressure of an observatory's shadow whose store holds these logs of these systems."""

    async def main() -> tuple[int, object]:
        store = await SqliteKnowledge.open(folder / "k.sqlite", offload=in_place)
        for name, (system, events) in logs.items():
            await store.keep(name, events, system=system)
        await store.own("shadow", system="observatory", prototype=False, log="aa")
        await store.append("shadow:aa", [Event(0, NOW_MS + 9000, Kind.VERDICT, "ctd.pressure", "outside: 1")])
        await store.aclose()
        with Instance("shadow") as here:
            shadowing = Shadowing(
                load_system("observatory"), "tcp://127.0.0.1:1", here,
                store=str(folder / "k.sqlite"), on_verdict=lambda verdict: None,
            )  # fmt: skip
            await shadowing.run(asyncio.Event(), 0.1)
        seen = shadowing.describe()
        assert (seen["measurements"], seen["statuses"], seen["origins"]) == (0, 0, []), "nothing came"
        return seen["period_s"], seen["variables"]["ctd.pressure"]["value"]

    return run(main())


@pytest.mark.parametrize(
    ("logs", "period_s", "pressure"),
    [
        ({}, 0, None),
        ({"plant:a": ("observatory", log(5.0, 7, NOW_MS))}, 7, 5.0),
        ({"plant:a": ("observatory", log(5.0, 7, NOW_MS)), "plant:b": ("ocean", log(9.0, 9, NOW_MS + 5))}, 7, 5.0),
        (
            {"plant:a": ("observatory", log(5.0, 7, NOW_MS)), "plant:b": ("observatory", log(9.0, 9, NOW_MS - 5))},
            7,
            5.0,
        ),
        (
            {"plant:a": ("observatory", log(5.0, 7, NOW_MS)), "plant:b": ("observatory", log(9.0, 9, NOW_MS)[:2])},
            7,
            5.0,
        ),
    ],
    ids=["new", "again", "another system", "an older log", "not of two logs"],
)
def test_a_shadow_begins_with_the_newest_log_of_its_system(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    logs: dict[str, tuple[str, list[Event]]],
    period_s: int,
    pressure: object,
) -> None:
    monkeypatch.setenv("FIELDTWIN_RUN", str(tmp_path))
    assert begins(tmp_path, logs) == (period_s, pressure)
