"""Run a small system in virtual time through a table of faults and record their effects on values, driver, tag and
program.

It uses the real gateway, PLC and emulators with wires in memory: a sensor on a paced RTU line, the same sensor on
Modbus TCP, and a CANopen node. One run executes all rows of a wire one after the other, and the wires in parallel. A
row has its fault for `LASTS_S`, and within the following `AFTER_S` the system must recover.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.gateway.runtime.buses.canopen.canopen_bus import CanopenBus
from fieldtwin.plc.program import Program, ScanInfo, var_input, var_local, var_output
from fieldtwin.results.trace import TraceEvent, TraceKind
from fieldtwin.run.benches.virtual_bench import VirtualBench
from fieldtwin.run.virtual.group_kinds import VirtualSystems
from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun

LASTS_S, AFTER_S, FIRST_S = 2.0, 2.6, 5.0
ROW_S = LASTS_S + AFTER_S

SYSTEM = """
fieldtwin: 1
system: spoilt
buses:
  line: {url: "rtu:/dev/ttyS0?baudrate=19200&frame=8E1", timeout_ms: 150, retries: 1}
  lan:  {url: "tcp://sensor:502", timeout_ms: 150, retries: 1}
  can0: {url: "can:socketcan/can0", bitrate: 125000, timeout_ms: 200, sync: {period_ms: 200}}
devices:
  ctd: {profile: ctd-reference, bus: line, %(sensor)s}
  probe: {profile: ctd-reference, bus: lan, %(sensor)s}
  tilt:
    profile: tilt
    bus: can0
    node: 5
    poll: {values: {every_ms: 200}, text: {every_ms: 500}}
    heartbeat: {producer_ms: 200, consumer_ms: 500}
    tpdo1: {map: [slope_long], event_ms: 200}
    stale_after_ms: 600
    backoff_limit_ms: 1000
    start: true
plc:
  cycle_ms: 100
  programs:
    watch:
      source: "python: faults_rig:Watch"
      start: {timeout_ms: 200, at_timeout: start_anyway}  # its outputs make the sensors measure
      inputs:
        line: {tag: ctd.pressure}
        lan: {tag: probe.pressure}
        can: {tag: tilt.slope_long}
        sdo: {tag: tilt.slope_lateral}
      outputs: {line_period_s: ctd.sample_period_s, lan_period_s: probe.sample_period_s}
remote: remote
"""
SENSOR = """unit: 1, poll: {values: {every_ms: 250}, status: {every_ms: 500}}, stale_after_ms: 1000,
    backoff_limit_ms: 1000, writable: [sample_period_s], safe: {sample_period_s: 0}"""
PROTOTYPE = """
prototype_of: system.yaml
seed: 1
buses:
  line: {listen: "pty:line", pace: true}
  lan:  {listen: "tcp://127.0.0.1:0"}
  can0: {listen: "can:fieldtwin/127.0.0.1:0"}
devices:
  ctd:   {recording: cast.jsonl, at_end: loop, identity: {serial: "0042"}}
  probe: {recording: cast.jsonl, at_end: loop, identity: {serial: "0042"}}
  tilt:  {recording: incl.jsonl, at_end: loop}
"""
PROFILE = """
device: fieldtwin/tilt
source: "The reference inclinometer, and a text that takes segments"
protocol: canopen
factory: {node: 5}
eds: %s
tags:
  slope_long: {object: "6010:00", type: int16, scale: 0.01, unit: deg}
  slope_lateral: {object: "6020:00", type: int16, scale: 0.01, unit: deg, poll: values}
  software:   {object: "1008:00", type: string, poll: text}
"""
EDS = Path(__file__).parents[3] / "profiles" / "devices" / "inclinometer-cia410.eds"
DEVICES = {"line": "ctd", "lan": "probe", "can": "tilt", "sdo": "tilt", "text": "tilt"}
TAGS = {
    "line": "ctd.pressure",
    "lan": "probe.pressure",
    "can": "tilt.slope_long",
    "sdo": "tilt.slope_lateral",
    "text": "tilt.software",
}


class Watch(Program):
    """Make both sensors sample, and show whether the values read are good."""

    line: float | None = var_input(TagKind.REAL)
    lan: float | None = var_input(TagKind.REAL)
    can: float | None = var_input(TagKind.REAL)
    sdo: float | None = var_input(TagKind.REAL)
    line_period_s: int = var_output(TagKind.INT, initial=1)
    lan_period_s: int = var_output(TagKind.INT, initial=1)
    line_ok: bool = var_local(TagKind.BOOL, initial=False)
    lan_ok: bool = var_local(TagKind.BOOL, initial=False)
    can_ok: bool = var_local(TagKind.BOOL, initial=False)
    sdo_ok: bool = var_local(TagKind.BOOL, initial=False)

    def execute(self, scan: ScanInfo) -> None:
        self.line_ok, self.lan_ok = self.tag("line").good, self.tag("lan").good
        self.can_ok, self.sdo_ok = self.tag("can").good, self.tag("sdo").good


@dataclass
class Seen:
    """The result of a row. Times are in s after the start of the fault; `well_s` is in s after its end."""

    reasons: set[str] = field(default_factory=set)
    """Reasons why the tag was not good."""
    driver_says: set[str] = field(default_factory=set)
    """The driver's view of the device: the errors in its status, and `offline`."""
    program_saw: bool = False
    """Whether the program saw that its input was not good."""
    published: int = 0
    """Number of good values during the fault."""
    values: list[Any] = field(default_factory=list)
    well_s: float | None = None
    """Time from which the tag remained good; None if never."""
    struck: int = 0

    def not_good(self, reason: str) -> None:
        self.reasons.add(reason)


@dataclass
class Row:
    """A fault on a wire, with its parameters."""

    wire: str
    name: str
    said: dict[str, Any]
    number: int

    @property
    def begins_s(self) -> float:
        return FIRST_S + self.number * ROW_S

    def fault(self) -> dict[str, Any]:
        return {
            "id": f"{self.wire} {self.name}",
            "name": self.name,
            "device": DEVICES[self.wire],
            "from": self.begins_s,
            "until": self.begins_s + LASTS_S,
            **self.said,
        }


class _Run(VirtualRun):
    """Check every tag in each scan."""

    def __init__(self, options: VirtualOptions, rows: Sequence[Row]) -> None:
        super().__init__(options)
        self.rows = rows
        self.before: Callable[[VirtualBench], Awaitable[None]] | None = None
        self.seen = {(row.wire, row.name): Seen() for row in rows}

    async def _through(self, bench: Any, loop: VirtualLoop, judge: Callable[[], None]) -> None:
        values_before: dict[str, int] = {}
        while bench.now_s() < self.options.duration_s:
            await bench.sleep_until_s(bench.now_s() + 0.1)
            if self.before is not None and bench.now_s() > FIRST_S - 3:
                before, self.before = self.before, None
                await before(bench)
            for row in self.rows:
                at_s = bench.now_s() - row.begins_s
                if 0 <= at_s < ROW_S - 0.05:
                    self._look(bench, row, self.seen[row.wire, row.name], at_s, values_before)
        judge()
        self.elapsed_s = bench.now_s()

    def attach(self, running: VirtualSystems) -> None:
        super().attach(running)
        running.systems[""].trace.listen(self._on_tag, TraceKind.TAG)

    def _on_tag(self, event: TraceEvent) -> None:
        """States shorter than a scan count as well."""
        if event.data["quality"] != "good":
            for row in self.rows:
                at_s = event.t_ns / NS_PER_S - row.begins_s
                if TAGS[row.wire] == event.where and 0 <= at_s < ROW_S:
                    self.seen[row.wire, row.name].not_good(event.data["reason"])

    def _look(self, bench: VirtualBench, row: Row, seen: Seen, at_s: float, before: dict[str, int]) -> None:
        reading = bench.reading(TAGS[row.wire])
        program = bench.reading(f"watch.{row.wire}_ok") if row.wire != "text" else None  # no program reads texts
        good = reading is not None and reading.quality == "good"
        updates = reading.updates if reading is not None else 0
        if good and at_s < LASTS_S:
            seen.published += updates - before.get(row.wire, updates)
            seen.values.append(reading.value if reading is not None else None)
        before[row.wire] = updates
        if at_s < LASTS_S:
            seen.driver_says |= _said_by_driver(bench, DEVICES[row.wire])
        if not good:
            seen.not_good(reading.reason if reading is not None else "never")
        seen.program_saw |= program is not None and not program.value
        if not (good and (program is None or program.value)):
            seen.well_s = None
        elif seen.well_s is None:
            seen.well_s = max(0.0, at_s - LASTS_S)
        if at_s >= LASTS_S - 0.2:
            for known in bench.run.field.faults.active():
                if known.id == f"{row.wire} {row.name}":
                    seen.struck = known.struck


def _said_by_driver(bench: VirtualBench, device: str) -> set[str]:
    """Return the errors that the gateway's status shows for a device now. A conflict of node IDs is shown until the
    end."""
    bus: Any = bench.run.gateway.buses[bench.system.devices[device].bus]
    if isinstance(bus, CanopenBus):
        state: Any = next(s for s in bus.nodes.values() if s.driver.config.name == device)
    else:
        state = next(s for s in bus.devices if s.driver.config.name == device)
    conflict = state.conflict if isinstance(bus, CanopenBus) else ""
    return {text for text in (state.error, conflict, "" if state.online else "offline") if text}


def through(
    rows: Sequence[tuple[str, str, dict[str, Any]]], before: Callable[[VirtualBench], Awaitable[None]] | None = None
) -> _Run:
    """Run the rows: wire, fault, parameters. A `before` function may do something else for 3 s first."""
    numbers: dict[str, int] = {}
    made = []
    for wire, name, said in rows:
        turn = DEVICES[wire]  # one fault at a time per device
        made.append(Row(wire, name, said, numbers.get(turn, 0)))
        numbers[turn] = made[-1].number + 1
    with TemporaryDirectory() as directory:
        (Path(directory) / "system.yaml").write_text(SYSTEM % {"sensor": SENSOR})
        (Path(directory) / "system.prototype.yaml").write_text(PROTOTYPE)
        (Path(directory) / "tilt.yaml").write_text(PROFILE % EDS)
        options = VirtualOptions(
            str(Path(directory) / "system.yaml"),
            FIRST_S + max(numbers.values()) * ROW_S,
            profiles=(Path(directory),),
            faults=tuple(row.fault() for row in made),
        )
        run = _Run(options, made)
        run.before = before
        run.run()
    return run
