"""A changed configuration for a running plant: the comparison, rejected reloads, and the effects on the wires.

The whole gateway and PLC in virtual time, with files as a user writes them.
"""

from __future__ import annotations

import asyncio
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.gateway.connections.tap import CaptureTap
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.values import Quality
from fieldtwin.gateway.runtime.reconfigure import reconfigure
from fieldtwin.twin.plant.physical import gateway_config
from fieldtwin.twin.plant.reloading import compare, limits_changed
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.prototype.virtual import VirtualPrototype
from fieldtwin.twin.site.system import load_system

SYSTEM = """\
fieldtwin: 1
system: tanks
buses:
  line: {url: "rtu:/dev/ttyS0?baudrate=19200&frame=8E1", timeout_ms: 300}
  can0: {url: "can:socketcan/can0", bitrate: 125000}
devices:
  tank: {profile: tank.yaml, bus: line, unit: 1, poll: {values: {every_ms: 1000}, slow: {every_ms: 4000}},
    stale_after_ms: 3000, writable: [target, code, dose], safe: {target: 1, code: 5}}
  other: {profile: tank.yaml, bus: line, unit: 2, poll: {values: {every_ms: 500}}, stale_after_ms: 3000}
  tilt: {profile: inclinometer-cia410, bus: can0, node: 5, poll: {values: {every_ms: 1000}}, stale_after_ms: 3000}
plc: {cycle_ms: 50, programs: {fill: {source: fill.st, inputs: {level: {tag: tank.level}},
    outputs: {target: tank.target, dose: tank.dose}}}}
remote: remote
"""
TANK = """\
device: test/tank
source: a test
protocol: modbus
limits: {max_gap: 0}
defaults: {type: int16, poll: values}
tags:
  level:  {at: "holding:0", scale: 0.1, unit: m}
  target: {at: "holding:1", scale: 0.1, range: [0, 50], access: rw}
  volume: {at: "holding:10", scale: 0.5, poll: slow}
  size:   {at: "holding:20", scale: 0.5, poll: once}
  dose:   {at: "holding:35", scale: 0.1, access: wo}
  code:   {at: "holding:30", access: rw, secret: true, poll: once}
"""
PROTOTYPE = """\
prototype_of: plant.yaml
buses: {line: {listen: "pty:line"}, can0: {listen: "can:fieldtwin/127.0.0.1:0"}}
devices:
  tank:  {model: profile, profile: as-made.yaml, values: {level: 7.5, volume: 30, size: 8}}
  other: {model: profile, profile: as-made.yaml}
  tilt:  {model: profile}
"""
PROGRAM = """\
PROGRAM Fill
VAR_INPUT level : REAL; END_VAR
VAR_OUTPUT target : REAL := 2.0; dose : REAL := 3.0; END_VAR
target := 2.0;
END_PROGRAM
"""


@pytest.fixture
def plant(tmp_path: Path) -> Path:
    for name, text in {"plant.yaml": SYSTEM, "tank.yaml": TANK, "as-made.yaml": TANK, "fill.st": PROGRAM}.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    (tmp_path / "plant.prototype.yaml").write_text(PROTOTYPE, encoding="utf-8")
    return tmp_path / "plant.yaml"


def edit(path: Path, *changes: tuple[str, str]) -> None:
    text = path.read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path.write_text(text, encoding="utf-8")


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("every_ms: 1000}", "every_ms: 250}", "devices.tank.poll.values.every_ms: 1000 -> 250"),
        (", slow: {every_ms: 4000}", "", "devices.tank.poll.slow: {'every_ms': 4000, 'phase_ms': None} -> nothing"),
        ("stale_after_ms: 3000, w", "stale_after_ms: 9000, w", "devices.tank.stale_after_ms: 3000 -> 9000"),
        ("target: 1", "target: 2", "devices.tank.safe.target: 1 -> 2"),
        ("code: 5", "code: 6", "devices.tank.safe.code: (secret) -> (secret)"),
        ("code, dose]", "code, dose, volume]", None),
        ("timeout_ms: 300", "timeout_ms: 500, retries: 3, spacing_ms: 20", "buses.line.timeout_ms: 300 -> 500"),
        ("stale_after_ms: 3000}\n  tilt", "stale_after_ms: 3000, timeout_ms: 900}\n  tilt", "devices.other.timeout_ms"),
        ("node: 5, poll: {values: {every_ms: 1000}", "node: 5, poll: {values: {every_ms: 200}", "devices.tilt.poll"),
        ("remote: remote", "remote: local", "remote: remote -> local"),
        ("remote: remote", "remote: remote\ncommands: {per_minute: 6}", "commands.per_minute: 60 -> 6"),
    ],
)
def test_each_change_is_reloadable_or_needs_a_restart(plant: Path, old: str, new: str, says: str | None) -> None:
    before = load_system(str(plant))
    edit(plant, (old, new))
    if says is None:
        with pytest.raises(FileInvalid, match=r"plant\.yaml:8:\d+: the tag 'volume' of test/tank is read-only"):
            load_system(str(plant))
        return
    changes = compare(before, load_system(str(plant)))
    assert all(c.live for c in changes)
    assert str(changes[0]).startswith(says)
    assert changes[0].where.startswith(f"{plant}:")


def test_a_located_variable_whose_register_changes_is_named_with_its_server(plant: Path) -> None:
    """Defect: the change was called `serve`, a key that the user had not edited."""
    edit(plant, ("remote: remote", 'serve: {hmi: {url: "tcp://127.0.0.1:0", addresses: openplc}}'))
    program = plant.with_name("fill.st")
    edit(
        program,
        ("target := 2.0;", "kept := 1;"),
        ("END_VAR\nVAR_OUTPUT", "END_VAR VAR kept AT %MW3 : INT; END_VAR VAR_OUTPUT"),
    )
    before = load_system(str(plant))
    edit(program, ("%MW3 : INT;", "%MW4 : INT; added AT %MW5 : INT;"))
    (change,) = compare(before, load_system(str(plant)))
    assert str(change) == "serve.hmi: the registers of fill.added, fill.kept change with the source"
    assert not change.live
    assert change.where == f"{plant}:13:9"


@pytest.mark.parametrize(
    ("file", "old", "new", "where", "what"),
    [
        ("plant", "baudrate=19200", "baudrate=9600", "4:10", "buses.line.url"),
        ("plant", "bitrate: 125000", "bitrate: 250000", "5:37", "buses.can0.bitrate"),
        ("plant", "unit: 2", "unit: 3", "9:42", "devices.other.unit"),
        ("plant", "node: 5, poll", "node: 5, timeout_ms: 50, poll", "10:60", "devices.tilt.timeout_ms"),
        ("plant", "node: 5, poll: {values: {every_ms: 1000}}, ", "node: 5, ", "10:3", "devices.tilt.poll.values"),
        ("plant", "  other:", "  another:", "9:3", "devices.another"),
        ("plant", "cycle_ms: 50", "cycle_ms: 20", "11:7", "plc.cycle_ms"),
        ("tank", 'level:  {at: "holding:0"', 'level:  {at: "holding:3"', "7:12", "test/tank: tags.level.at"),
        ("tank", "scale: 0.1, unit", "unit", "7:3", "test/tank: tags.level.scale"),  # a whole number from now on
        ("tank", "  volume:", '  depth: {at: "holding:9"}\n  volume:', "9:3", "test/tank: tags.depth"),
        ("plant", "remote: remote", "alarms: {a: {condition: tank.level > 1}}", "13:10", "alarms.a"),
        ("tank", "unit: m", "unit: cm", "7:41", "test/tank: tags.level.unit"),
    ],
)
def test_changes_that_need_a_restart_are_named_with_their_place(
    plant: Path, file: str, old: str, new: str, where: str, what: str
) -> None:
    before = load_system(str(plant))
    changed = plant.with_name(f"{file}.yaml")
    edit(changed, (old, new))
    if file == "plant":
        edit(plant, ("timeout_ms: 300", "timeout_ms: 400"))  # reloadable changes do not hide it
    stuck = [c for c in compare(before, load_system(str(plant))) if not c.live]
    assert (stuck[0].where, stuck[0].what) == (f"{changed}:{where}", what)


def test_the_files_named_in_the_system_file_are_compared_too(plant: Path) -> None:
    """No reloadable key explains the change: the same profile text in a different file is no difference, a different text is."""
    before = load_system(str(plant))
    (plant.parent / "copy.yaml").write_text(TANK, encoding="utf-8")
    edit(plant, ("profile: tank.yaml", "profile: copy.yaml"))
    assert [c.live for c in compare(before, load_system(str(plant)))] == [False]


def test_profiles_are_compared_and_limits_are_sent_to_the_plc(plant: Path) -> None:
    before = load_system(str(plant))
    edit(plant.with_name("tank.yaml"), ("range: [0, 50]", "range: [0, 20]"), ("volume: {", "volume: {range: [0, 1], "))
    new = load_system(str(plant))
    assert [(str(c), c.live) for c in compare(before, new)] == [
        ("test/tank: tags.target.range: (0.0, 50.0) -> (0.0, 20.0)", True),
        ("test/tank: tags.volume.range: None -> (0.0, 1.0)", True),
    ]
    assert limits_changed(before, new)["tank.target"] == (0, 20)
    assert set(limits_changed(before, new)) == {f"{d}.{t}" for d in ("tank", "other") for t in ("target", "volume")}


@pytest.fixture
def loop() -> Any:
    loop = VirtualLoop()
    yield loop
    loop.close()


class Running:
    """The plant in virtual time, and every request on the line."""

    def __init__(self, run: VirtualPrototype, tap: CaptureTap, plant: Path) -> None:
        self.run, self._tap, self._plant = run, tap, plant
        self._system = run.system

    def asked(self, unit: int, address: int, since_s: float = 0.0) -> list[float]:
        """Return when registers from `address` were read, in seconds of the run."""
        head = bytes([unit, 3]) + address.to_bytes(2)
        return [
            (c.t_ns - self.run.started_ns) / 1e9
            for c in self._tap.captured
            if c.direction is Direction.SENT
            and isinstance(c.item, bytes)
            and c.item[:4] == head
            and (c.t_ns - self.run.started_ns) / 1e9 >= since_s
        ]

    def written(self, address: int) -> list[int]:
        """Return the values written to unit 1, in order."""
        head = bytes([1, 16]) + address.to_bytes(2)
        sent = [c.item for c in self._tap.captured if c.direction is Direction.SENT and isinstance(c.item, bytes)]
        return [int.from_bytes(item[7:9]) for item in sent if item[:4] == head]

    def value(self, tag: str) -> Any:
        return self.run.gateway.tags.current(tag, self.run.loop.now_ns)

    @property
    def now_s(self) -> float:
        return (self.run.loop.now_ns - self.run.started_ns) / 1e9

    async def reload(self) -> None:
        new = load_system(str(self._plant))
        assert all(c.live for c in compare(self._system, new))
        await reconfigure(self.run.gateway, gateway_config(new, allow_writes=True, free_ports=True, true_silences=True))
        self._system = new


def running(plant: Path, loop: VirtualLoop, scenario: Any) -> None:
    async def main() -> None:
        system = load_system(str(plant))
        tap = CaptureTap(100_000)
        async with VirtualPrototype(system, load_prototype(system), loop, plant.parent, taps=[tap]) as run:
            await asyncio.sleep(10.3)
            await scenario(Running(run, tap, plant))

    loop.run_until_complete(main())


def gaps(times: list[float]) -> list[float]:
    """With a tolerance of 50 ms, because a poll waits for the reply to a different one."""
    return [round(20 * (b - a)) / 20 for a, b in pairwise(times)]


def test_no_poll_is_lost_or_doubled_on_the_line(plant: Path, loop: VirtualLoop) -> None:
    async def scenario(p: Running) -> None:
        edit(plant, ("every_ms: 1000}", "every_ms: 250}"), ("every_ms: 4000", "every_ms: 6000"))
        reloaded_s = p.now_s
        await p.reload()
        await asyncio.sleep(20)
        fast, slow, others = p.asked(1, 0, 2.0), p.asked(1, 10, 2.0), p.asked(2, 0, 2.0)
        before = [t for t in fast if t < reloaded_s]
        assert set(gaps(before)) == {1.0}
        behind = gaps(fast)[len(before) :]
        assert min(behind[:9]) >= 0.2  # on its way to its place next to the others, an eighth earlier each time
        assert behind[9:] == [0.25] * len(behind[9:])
        assert 0.25 <= gaps(fast)[len(before) - 1] <= 1.0  # the one interval that contains the change
        assert gaps(slow)[:2] == [4.0, 6.0]
        assert all(5.25 <= gap <= 6.0 for gap in gaps(slow)[1:])
        assert set(gaps(others)[-20:]) == {0.5}  # only its place differs
        assert min(gaps(others)) >= 0.4
        assert not any(d.schedule.missed[g] for d in p.run.gateway.buses["line"].devices for g in d.schedule.missed)

    running(plant, loop, scenario)


def test_a_node_is_polled_at_its_new_period(plant: Path, loop: VirtualLoop) -> None:
    async def scenario(p: Running) -> None:
        status = p.run.gateway.buses["can0"].nodes[5]  # type: ignore[union-attr]
        polls = status.polls
        edit(plant, ("node: 5, poll: {values: {every_ms: 1000}", "node: 5, poll: {values: {every_ms: 100}"))
        await p.reload()
        await asyncio.sleep(5.05)
        assert 50 <= status.polls - polls <= 52
        assert status.poll_errors == 0
        assert not any(status.schedule.missed.values())
        edit(plant, ("every_ms: 100}", "every_ms: 2000}"))
        polls = status.polls
        await p.reload()
        await asyncio.sleep(20.05)
        assert 10 <= status.polls - polls <= 11

    running(plant, loop, scenario)


def test_scaling_applies_at_once_also_to_values_that_are_read_only_once(plant: Path, loop: VirtualLoop) -> None:
    async def scenario(p: Running) -> None:
        assert p.value("tank.level").value == pytest.approx(7.5)
        assert p.value("tank.size").value == 8
        age_ns = p.value("tank.size").t_ns
        edit(
            plant.with_name("tank.yaml"),
            ("scale: 0.1, unit", "scale: 0.2, offset: 1, unit"),
            ('"holding:20", scale: 0.5', '"holding:20", scale: 0.25, range: [0, 3]'),
        )
        await p.reload()
        assert p.value("tank.level").value == pytest.approx(16)
        assert (p.value("tank.size").value, p.value("tank.size").t_ns) == (4, age_ns)
        assert p.value("tank.size").quality is Quality.UNCERTAIN  # beyond its range, which needed no poll to detect
        assert len(p.asked(1, 20)) == 1
        await asyncio.sleep(2)
        assert p.value("tank.level").value == pytest.approx(16)

    running(plant, loop, scenario)


def test_outputs_are_written_again_according_to_the_new_scaling(plant: Path, loop: VirtualLoop) -> None:
    async def scenario(p: Running) -> None:
        def held() -> int:
            return p.run.field.devices["tank"].unit.bank.read("holding", 1, 1, loop.now_ns)[0]  # type: ignore[union-attr]

        assert (held(), p.written(35)) == (20, [30])
        edit(plant.with_name("tank.yaml"), ("scale: 0.1, range: [0, 50]", "scale: 0.01, range: [0, 50]"))
        edit(plant.with_name("tank.yaml"), ("scale: 0.1, access: wo", "scale: 0.01, access: wo"))
        edit(plant, ("target: 1", "target: 3"))
        await p.reload()
        await asyncio.sleep(1)
        assert (held(), p.written(35)) == (200, [30, 300])  # also an output that cannot be read back
        writer = p.run.gateway.outputs
        writes = writer.writes
        await asyncio.sleep(5)
        assert writer.writes == writes
        assert await p.run.stop_gateway()
        assert held() == 300  # the new safe value

    running(plant, loop, scenario)


def test_a_value_that_the_new_limits_forbid_is_a_refused_output_and_the_gateway_continues(
    plant: Path, loop: VirtualLoop
) -> None:
    """Defect: the comparison of the held value with the device raised `NotAllowed`, the gateway died, and the safe value was
    never written."""

    async def scenario(p: Running) -> None:
        def held() -> int:
            return p.run.field.devices["tank"].unit.bank.read("holding", 1, 1, loop.now_ns)[0]  # type: ignore[union-attr]

        assert held() == 20
        edit(plant.with_name("tank.yaml"), ("range: [0, 50]", "range: [0, 1.5]"))
        await p.reload()
        await asyncio.sleep(3)
        entries = p.run.gateway.outputs.journal.status().entries
        assert [(e.tag, e.cause, e.by) for e in entries] == [("tank.target", "limit", "plc")]
        assert held() == 20
        assert await p.run.stop_gateway()
        assert held() == 10  # the safe value

    running(plant, loop, scenario)


def test_limits_hold_for_forces_and_for_writes(plant: Path, loop: VirtualLoop) -> None:
    async def scenario(p: Running) -> None:
        before = load_system(str(plant))
        edit(plant.with_name("tank.yaml"), ("range: [0, 50]", "range: [0, 20]"))
        await p.reload()
        p.run.plc.limit(limits_changed(before, load_system(str(plant))))
        with pytest.raises(UsageError, match="expected 0 to 20"):
            p.run.plc.force("tank.target", 30.0)
        assert p.value("tank.target").value == 2

    running(plant, loop, scenario)


def test_a_fresh_value_is_not_made_stale_by_a_shorter_limit(plant: Path, loop: VirtualLoop) -> None:
    async def scenario(p: Running) -> None:
        stale: list[str] = []
        p.run.gateway.tags.subscribe(lambda name, value: stale.append(name) if not value.good else None)
        edit(plant, ("every_ms: 4000", "every_ms: 100"), ("stale_after_ms: 3000", "stale_after_ms: 300"))
        edit(plant, ("every_ms: 1000}", "every_ms: 90}"))
        await p.reload()
        for _ in range(200):
            await asyncio.sleep(0.01)
            assert all(p.value(f"tank.{t}").good for t in ("level", "volume"))
        assert not stale

    running(plant, loop, scenario)
