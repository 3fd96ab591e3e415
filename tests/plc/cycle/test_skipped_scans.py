"""Skipped scans: with and without them, the same inputs give the same publications, changes and counters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from st_bench import program

from fieldtwin.gateway.core.image.image import INPUTS, OUTPUTS, Snapshot, TagKind, TagSpec, message_tag
from fieldtwin.gateway.core.statemachine import encode_period
from fieldtwin.gateway.core.values import Quality, Reason, Scalar, TagValue
from fieldtwin.plc.binding import BoundProgram, InputBinding, image_for
from fieldtwin.plc.cycle.scan import Scan
from fieldtwin.plc.program import Outbox, Program, ProgramFailed, ScanInfo, message_output, var_input, var_local
from fieldtwin.plc.relay import Relay

MS = 1_000_000
CYCLE_MS = 10
PLANT = {
    "d.level": TagSpec("d.level", TagKind.REAL),
    "d.on": TagSpec("d.on", TagKind.BOOL),
    "m.inbox": message_tag("m.inbox", 16, 4),
    "s.sample": message_tag("s.sample", 16, 4),
    "m.outbox": message_tag("m.outbox", 16, 2),
}
DELAYED = """
    PROGRAM Delayed
    VAR_INPUT level : REAL; on : BOOL; END_VAR
    VAR_OUTPUT run : BOOL; ok : BOOL; edges : INT; END_VAR
    VAR delay : TON; rise : R_TRIG; END_VAR
        delay(IN := on AND level > 1.0, PT := T#50ms);
        rise(CLK := on);
        IF rise.Q THEN edges := edges + 1; END_IF;
        run := delay.Q;
        ok := IS_GOOD(level);
    END_PROGRAM
"""


@dataclass(frozen=True)
class Given:
    """The values that the gateway publishes before a scan. A `silent` gateway publishes none, and its heartbeat becomes old."""

    level: float = 0.0
    on: bool = False
    quality: Quality = Quality.GOOD
    messages: tuple[str, ...] = ()
    taken: int = 0
    silent: bool = False
    forced: bool = False
    scans: int = 1


class Rig:
    """A program in a scan, and the gateway's side of its image."""

    def __init__(self, made: Program, inputs: Mapping[str, str], outputs: Mapping[str, str], *, may_skip: bool) -> None:
        bound = BoundProgram("p", made, {n: InputBinding(tag, "hold") for n, tag in inputs.items()}, dict(outputs))
        layout = image_for([bound], PLANT)
        memory = memoryview(bytearray(layout.size))
        layout.format(memory)
        image = layout.attach(memory, private=may_skip)
        self.program = made
        self.changes: list[Any] = []
        self.now_ms = 0
        self.writer, self.reader = image.writer(INPUTS), image.reader(OUTPUTS)
        self.scan = Scan(image, [bound], heartbeat_limit_ms=35, may_skip=may_skip)
        self.scan.output_image.on_change = self.changes.append
        self.tags = {spec.name: spec for spec in self.writer.shape.layout.tags}

    def execute(self, given: Given) -> list[Snapshot]:
        return [self._one(given, first=n == 0) for n in range(given.scans)]

    def _one(self, given: Given, *, first: bool) -> Snapshot:
        self.now_ms += CYCLE_MS
        now_ns = self.now_ms * MS
        if not given.silent:
            values: dict[str, Scalar] = {"d.level": given.level, "d.on": given.on, "m.outbox.taken": given.taken}
            row = [TagValue(values.get(tag, 0), given.quality, Reason.NONE, t_ns=now_ns - 3 * MS) for tag in self.tags]
            new = {tag: [(now_ns, encode_period(2).data)] for tag in given.messages if first and tag in self.tags}
            self.writer.publish(row, now_ns, new)
        forces = self.scan.output_image.forces
        if given.forced and "d.level" in self.tags:
            forces.force(self.tags["d.level"], 7.0, True, now_ns, "test")
        else:
            forces.inputs.clear()
        self.scan.execute(now_ns)
        return self.reader.snapshot()


def delayed(*, may_skip: bool) -> Rig:
    return Rig(program(DELAYED), {"level": "d.level", "on": "d.on"}, {}, may_skip=may_skip)


def relay(*, may_skip: bool) -> Rig:
    inputs = {"command": "m.inbox", "sample": "s.sample"}
    return Rig(Relay(), inputs, {"response": "m.outbox"}, may_skip=may_skip)


GIVEN = st.builds(
    Given,
    level=st.sampled_from([0.0, -0.0, 2.0]),
    on=st.booleans(),
    quality=st.sampled_from([Quality.GOOD, Quality.GOOD, Quality.UNCERTAIN, Quality.BAD]),
    messages=st.sets(st.sampled_from(["m.inbox", "s.sample"])).map(lambda s: tuple(sorted(s))),
    taken=st.integers(0, 3),
    silent=st.sampled_from([False] * 5 + [True]),
    forced=st.sampled_from([False] * 5 + [True]),
    scans=st.integers(1, 12),
)


@pytest.mark.parametrize("make", [delayed, relay])
@given(steps=st.lists(GIVEN, max_size=12))
def test_skipped_scans_change_nothing_that_can_be_observed(make: Callable[..., Rig], steps: Sequence[Given]) -> None:
    plain, skipping = make(may_skip=False), make(may_skip=True)
    for step in steps:
        for ours, theirs in zip(skipping.execute(step), plain.execute(step), strict=True):
            assert (ours.counter, ours.t_ns, ours.all()) == (theirs.counter, theirs.t_ns, theirs.all())
            assert ours.messages == theirs.messages
        assert skipping.scan.inputs() == plain.scan.inputs()
        assert skipping.program.whole_state(plain.now_ms * MS) == plain.program.whole_state(plain.now_ms * MS)
    assert [(c.tag, c.t_ns, c.scan, c.after, str(c.place)) for c in skipping.changes] == [
        (c.tag, c.t_ns, c.scan, c.after, str(c.place)) for c in plain.changes
    ]
    assert skipping.scan.number == plain.scan.number
    assert plain.scan.skipped == 0


def test_a_scan_is_skipped_after_two_scans_that_changed_nothing() -> None:
    rig = relay(may_skip=True)
    rig.execute(Given(messages=("m.inbox",)))
    rig.execute(Given(scans=2))
    assert rig.scan.skipped == 0
    rig.execute(Given(scans=20))
    assert rig.scan.skipped == 20
    assert rig.scan.counters()["scans_skipped"] == 20


def test_no_scan_is_skipped_while_a_timer_runs() -> None:
    rig = delayed(may_skip=True)
    rig.execute(Given(level=2.0, on=True, scans=5))
    assert rig.scan.skipped == 0
    rig.execute(Given(level=2.0, on=True, scans=200))
    assert rig.scan.skipped > 100


def test_no_scan_is_skipped_without_a_heartbeat_of_the_gateway() -> None:
    rig = relay(may_skip=True)
    rig.execute(Given(scans=10))
    rig.execute(Given(silent=True, scans=4))
    before = rig.scan.skipped
    rig.execute(Given(silent=True, scans=10))
    assert rig.scan.skipped == before


class Counting(Program):
    """Counts its scans, which no state describes."""

    on: bool | None = var_input(TagKind.BOOL)
    scans: int = var_local(TagKind.INT, initial=0)

    def execute(self, scan: ScanInfo) -> None:
        self.scans += 1


class Described(Counting):
    """Describes a state that every scan changes."""

    def whole_state(self, now_ns: int) -> Any:
        return self.scans


class Extended(Counting):
    """Inherits a description that does not cover its own logic."""

    def whole_state(self, now_ns: int) -> Any:
        return 0


class MoreLogic(Extended):
    def execute(self, scan: ScanInfo) -> None:
        return


class Hidden(Program):
    """Changes a part of its state that it does not publish."""

    on: bool | None = var_input(TagKind.BOOL)

    def __init__(self) -> None:
        self.count = 0

    def execute(self, scan: ScanInfo) -> None:
        self.count += 1

    def whole_state(self, now_ns: int) -> Any:
        return self.count


class Measuring(Hidden):
    """Measures the time since its last scan."""

    def execute(self, scan: ScanInfo) -> None:
        self.last_ns = scan.now_ns

    def whole_state(self, now_ns: int) -> Any:
        return now_ns - self.last_ns


class Sender(Program):
    """Sends when there is room. Without room it does not try."""

    on: bool | None = var_input(TagKind.BOOL)
    box: Outbox = message_output()

    def execute(self, scan: ScanInfo) -> None:
        if self.box.room:
            self.box.send(b"a", scan.now_ns)

    def whole_state(self, now_ns: int) -> Any:
        return 0


class Wrong(Counting):
    def execute(self, scan: ScanInfo) -> None:
        return

    def whole_state(self, now_ns: int) -> Any:
        raise ValueError("no state")


@pytest.mark.parametrize("kind", [Counting, Described, Extended, MoreLogic, Hidden, Measuring])
def test_a_program_is_not_skipped_unless_its_state_is_known_and_stays_the_same(kind: type[Program]) -> None:
    rig = Rig(kind(), {"on": "d.on"}, {}, may_skip=True)
    rig.execute(Given(scans=200))
    assert rig.scan.skipped == 0


def test_an_error_in_the_description_of_a_state_names_the_program_and_the_line() -> None:
    rig = Rig(Wrong(), {"on": "d.on"}, {}, may_skip=True)
    with pytest.raises(ProgramFailed, match="no state") as e:
        rig.execute(Given(scans=3))
    assert "test_skipped_scans.py" in str(e.value)


def test_a_changed_quality_ends_the_skipping() -> None:
    rig = delayed(may_skip=True)
    assert rig.execute(Given(scans=20))[-1].value("p.ok").value is True
    assert rig.scan.skipped > 0
    assert rig.execute(Given(quality=Quality.UNCERTAIN))[-1].value("p.ok").value is False


def test_a_held_input_keeps_the_time_of_its_last_good_value_although_scans_were_skipped() -> None:
    rig = delayed(may_skip=True)
    rig.execute(Given(scans=20))
    last_ns = rig.now_ms * MS - 3 * MS
    rig.execute(Given(quality=Quality.BAD))
    assert rig.program.tag("level").t_ns == last_ns


def test_room_in_a_mailbox_ends_the_skipping() -> None:
    rig = Rig(Sender(), {"on": "d.on"}, {"box": "m.outbox"}, may_skip=True)
    assert rig.execute(Given(scans=20))[-1].value("m.outbox").value == 2
    assert rig.scan.skipped > 0
    assert rig.execute(Given(taken=1))[-1].value("m.outbox").value == 3


def test_every_scan_is_executed_when_a_debugger_attaches_to_settled_programs() -> None:
    rig = delayed(may_skip=True)
    rig.execute(Given(scans=20))
    skipped = rig.scan.skipped
    assert skipped > 0
    rig.scan.may_skip(skip=False)
    rig.execute(Given(scans=20))
    assert rig.scan.skipped == skipped
