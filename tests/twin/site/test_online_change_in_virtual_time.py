"""Programs that are replaced in virtual time, with the whole gateway and PLC: the plant's outputs change when they would have.

Virtual time is deterministic, so a run without a change tells when the timer of a program ends.
"""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.plc.cycle.publishing import TagChange
from fieldtwin.plc.runtime.online.change import prepare
from fieldtwin.plc.runtime.online.compiling import CompileRequest, compile_programs
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.prototype.virtual import VirtualPrototype
from fieldtwin.twin.site.system import load_system

SYSTEM = """\
fieldtwin: 1
system: tanks
buses:
  line: {url: "rtu:/dev/ttyS0?baudrate=19200&frame=8E1", timeout_ms: 300}
devices:
  tank: {profile: tank.yaml, bus: line, unit: 1, poll: {values: {every_ms: 1000}}, writable: [target], safe: {target: 1}}
plc: {cycle_ms: 50, programs: {fill: {source: fill.st, inputs: {level: {tag: tank.level}}, outputs: {target: tank.target}}}}
"""
TANK = """\
device: test/tank
source: a test
protocol: modbus
defaults: {type: int16, poll: values}
tags:
  level:  {at: "holding:0", unit: m}
  target: {at: "holding:1", access: rw}
"""
PROTOTYPE = """\
prototype_of: plant.yaml
buses: {line: {listen: "pty:line"}}
devices: {tank: {model: profile, values: {level: 7}}}
"""
PROGRAM = """\
PROGRAM Fill
VAR_INPUT level : INT; END_VAR
VAR_OUTPUT target : INT := 2; END_VAR
VAR delay : TON; END_VAR
delay(IN := level > 0, PT := T#8s);
IF delay.Q THEN target := 4; END_IF;
END_PROGRAM
"""
EDITED = PROGRAM.replace("VAR delay", "VAR extra : REAL; delay").replace("target := 4", "target := 5")


def changes_of(folder: Path, at_s: float | None, later: str = EDITED) -> tuple[list[TagChange], int]:
    """Run for 20 s of virtual time, with another version of the program from `at_s` on.

    Return the changes of the target, and the time (ns) at which the version was ready, 0 without one.
    """
    files = {"plant.yaml": SYSTEM, "tank.yaml": TANK, "plant.prototype.yaml": PROTOTYPE, "fill.st": PROGRAM}
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    seen: list[TagChange] = []
    loop = VirtualLoop()

    async def main() -> tuple[int, int]:
        ready_ns = 0
        system = load_system(str(folder / "plant.yaml"))
        async with VirtualPrototype(system, load_prototype(system), loop, folder, on_change=seen.append) as run:
            if at_s is not None:
                await asyncio.sleep(at_s)
                (folder / "fill.st").write_text(later, encoding="utf-8")
                config = run.plc.config
                versions = compile_programs(CompileRequest(config.programs, config.python_path))
                ready_ns = loop.now_ns
                run.plc.between_scans(prepare(run.plc, versions).commit)
            await asyncio.sleep(20 - (at_s or 0))
            assert run.plc.entries[0].task.missed_periods == 0
            return run.plc.entries[0].task.scans, ready_ns

    try:
        scans, ready_ns = loop.run_until_complete(main())
    finally:
        loop.close()
    assert scans == pytest.approx(20 * 20, abs=2)
    return [change for change in seen if change.tag == "tank.target"], ready_ns


def test_a_timer_ends_at_the_same_time_as_without_a_change(tmp_path: Path) -> None:
    (_, undisturbed), _ = changes_of(tmp_path, None)
    (first, changed), _ = changes_of(tmp_path, 4.0)
    assert (first.after, undisturbed.after, changed.after) == (2, 4, 5)
    assert changed.t_ns == undisturbed.t_ns
    assert changed.t_ns - first.t_ns == 8 * NS_PER_S  # TON: the first scan starts it, and Q follows after PT


def test_a_program_whose_scans_are_skipped_is_executed_after_a_change(tmp_path: Path) -> None:
    """From 9 s on nothing changes any more, and the logic is not executed."""
    (*_, last), ready_ns = changes_of(tmp_path, 15.02, PROGRAM.replace("target := 4", "target := 6"))
    assert last.after == 6
    assert last.t_ns - ready_ns <= 2 * 50 * NS_PER_MS  # the program is replaced after the next scan, and then executed
