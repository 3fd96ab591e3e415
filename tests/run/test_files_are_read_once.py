"""A run reads its files once: a file that changes while the run starts does not give its processes different systems."""

from __future__ import annotations

import asyncio
import stat
from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import Bug
from fieldtwin.run.live.options import RunOptions
from fieldtwin.run.live.session import RunSession
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.site.resolved import read_resolved, write_resolved
from fieldtwin.twin.site.system import System, load_system

SITE = """fieldtwin: 1
system: shed
buses: {lan: {url: "tcp://tank:502", timeout_ms: 500}}
devices: {tank: {profile: tank.yaml, bus: lan, unit: 1, poll: {values: {every_ms: 100}}}}
"""
PROTOTYPE = """prototype_of: shed.yaml
buses: {lan: {listen: "tcp://127.0.0.1:0"}}
devices: {tank: {model: profile, values: {level: 7}}}
"""
PROFILE = """device: own/tank
source: "this test"
protocol: modbus
numbering: printed
defaults: {poll: values}
tags: {level: {at: 30001, type: uint16}}
"""
FAULTS = "faults: [{name: delay, device: tank, by_ms: 10, from: 0}]\n"
FILES = {"shed.yaml": SITE, "shed.prototype.yaml": PROTOTYPE, "tank.yaml": PROFILE, "faults.yaml": FAULTS}


@pytest.mark.long
def test_files_that_change_while_a_run_starts_do_not_matter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FIELDTWIN_RUN", str(tmp_path / "r"))
    for name, text in FILES.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    session = RunSession(
        RunOptions(
            system=str(tmp_path / "shed.yaml"),
            prototype=True,
            duration_s=2.0,
            thread="tcp://127.0.0.1:0",
            fault_file=tmp_path / "faults.yaml",
        )
    )
    for name in FILES:
        (tmp_path / name).write_text("neither YAML: [nor\n", encoding="utf-8")

    async def run() -> None:
        async with session:
            await session.wait()

    asyncio.run(run())
    summary = session.summary()
    assert summary["errors"] == []
    assert summary["tags"]["tank.level"]["value"] == 7
    assert [fault["name"] for fault in summary["faults"]] == ["delay"]


def test_the_files_handed_over_are_equal_and_readable_for_their_owner_only(tmp_path: Path) -> None:
    system = load_system("observatory")
    prototype = load_prototype(system)
    path = write_resolved(tmp_path / "prototype.pickle", system, prototype)
    assert read_resolved(path) == (system, prototype)
    assert stat.S_IMODE(Path(path).stat().st_mode) == 0o600
    assert [p.name for p in tmp_path.iterdir()] == ["prototype.pickle"]


def test_a_damaged_hand_over_is_an_error_of_fieldtwin(tmp_path: Path) -> None:
    path = tmp_path / "system.pickle"
    path.write_bytes(b"\x80\x04")
    with pytest.raises(Bug, match="the system that the run has written for its processes"):
        read_resolved(str(path))


def test_after_a_reload_a_process_that_starts_again_gets_the_new_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FIELDTWIN_RUN", str(tmp_path / "r"))
    for name, text in FILES.items():
        (tmp_path / name).write_text(text, encoding="utf-8")

    async def polled_every_ms() -> int:
        async with RunSession(RunOptions(system=str(tmp_path / "shed.yaml"), prototype=True)) as session:
            (tmp_path / "shed.yaml").write_text(SITE.replace("every_ms: 100", "every_ms: 250"), encoding="utf-8")
            assert (await session.reload("test")).applied
            [system] = read_resolved(str(session.instance.path("system.pickle")))
            assert isinstance(system, System)
            return system.devices["tank"].poll["values"]

    assert asyncio.run(polled_every_ms()) == 250
