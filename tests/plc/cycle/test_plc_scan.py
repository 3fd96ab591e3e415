"""The scan: one snapshot, frozen inputs, policies, a dead gateway, messages in both directions, and failing programs."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.image.image import (
    INPUTS,
    OUTPUTS,
    Image,
    RegionFlag,
    Snapshot,
    TagKind,
    TagSpec,
    consumed_name,
    message_tag,
    taken_name,
)
from fieldtwin.gateway.core.values import NEVER, Quality, Reason, Scalar, TagValue
from fieldtwin.plc.binding import BoundProgram, InputBinding, image_for, load_program
from fieldtwin.plc.cycle.scan import Scan
from fieldtwin.plc.program import (
    Message,
    Outbox,
    Program,
    ProgramFailed,
    ScanInfo,
    message_input,
    message_output,
    var_input,
    var_local,
    var_output,
)

MS = 1_000_000
PLANT = {
    "d.real": TagSpec("d.real", TagKind.REAL),
    "d.int": TagSpec("d.int", TagKind.INT),
    "d.bool": TagSpec("d.bool", TagKind.BOOL),
    "d.out": TagSpec("d.out", TagKind.REAL),
    "m.inbox": message_tag("m.inbox", 16, 4),
    "m.outbox": message_tag("m.outbox", 16, 4),
}


class Copy(Program):
    """Copies its inputs to its outputs and calls the test's function `also`."""

    x: float | None = var_input(TagKind.REAL)
    n: int | None = var_input(TagKind.INT)
    flag: bool | None = var_input(TagKind.BOOL)
    box: tuple[Message, ...] = message_input()
    out: float | None = var_output(TagKind.REAL)
    sent: Outbox = message_output()
    count: int = var_local(TagKind.INT, initial=0)
    first: bool = var_local(TagKind.BOOL)

    def __init__(self) -> None:
        self.also: Callable[[ScanInfo], None] = lambda scan: None
        self.waiting: list[bytes] = []

    def execute(self, scan: ScanInfo) -> None:
        self.out = self.x
        self.first = scan.first_scan
        self.waiting += [m.data for m in self.box]
        while self.waiting and self.sent.send(self.waiting[0], scan.now_ns):
            self.waiting.pop(0)
        self.count += 1
        self.also(scan)


class Rig:
    """A program, its image, and the gateway's side of it, controlled by the test."""

    def __init__(self, **if_bad: str | float) -> None:
        self.program = Copy()
        tags = {"x": "d.real", "n": "d.int", "flag": "d.bool", "box": "m.inbox"}
        inputs = {name: InputBinding(tag, if_bad.get(name, "pass")) for name, tag in tags.items()}
        self.bound = BoundProgram("copy", self.program, inputs, {"out": "d.out", "sent": "m.outbox"})
        self.layout = image_for([self.bound], PLANT)
        memory = memoryview(bytearray(self.layout.size))
        self.layout.format(memory)
        self.image: Image = self.layout.attach(memory)
        self.writer = self.image.writer(INPUTS)
        self.reader = self.image.reader(OUTPUTS)
        self.scan = Scan(self.image, [self.bound], heartbeat_limit_ms=100)

    def feed(self, now_ms: int, taken: int = 0, messages: tuple[bytes, ...] = (), **values: Scalar | TagValue) -> None:
        def value(name: str, default: Scalar) -> TagValue:
            given = values.get(name, default)
            return given if isinstance(given, TagValue) else TagValue(given, Quality.GOOD, t_ns=now_ms * MS)

        row = [value("x", 0.0), value("n", 0), value("flag", False), value("box", 0), value("taken", taken)]
        self.writer.publish(row, now_ms * MS, {"m.inbox": [(now_ms * MS, m) for m in messages]})

    def execute(self, now_ms: int) -> Snapshot:
        self.scan.execute(now_ms * MS)
        return self.reader.snapshot()


def bad(value: Scalar | None, t_ms: int = 1) -> TagValue:
    return TagValue(value, Quality.BAD, Reason.TIMEOUT, t_ms * MS)


def test_the_layout_holds_both_sides_of_every_message() -> None:
    rig = Rig()
    inputs, outputs = ([t.name for t in region.tags] for region in rig.layout.regions)
    assert inputs == ["d.real", "d.int", "d.bool", "m.inbox", taken_name("m.outbox")]
    assert outputs == ["d.out", "m.outbox", "copy.count", "copy.first", consumed_name("m.inbox")]


def test_a_scan_sees_one_snapshot_and_one_time_and_publishes_once() -> None:
    rig = Rig()
    rig.feed(10, x=1.5, n=7, flag=True)
    seen: list[object] = []

    def also(scan: ScanInfo) -> None:
        rig.feed(11, x=99.0, n=99)  # arrives while the logic runs
        p = rig.program
        seen.append((p.x, p.n, p.flag, scan.now_ns, scan.number, p.tag("n")))

    rig.program.also = also
    out = rig.execute(12)
    assert seen == [(1.5, 7, True, 12 * MS, 1, TagValue(7, Quality.GOOD, t_ns=10 * MS))]
    assert (out.counter, out.t_ns) == (1, 12 * MS)
    assert out.value("d.out") == TagValue(1.5, Quality.GOOD, t_ns=12 * MS)
    assert rig.execute(13).value("d.out").value == 99.0


def test_first_scan_is_flagged_once() -> None:
    rig = Rig()
    rig.feed(1)
    assert rig.execute(2).value("copy.first").value is True
    assert rig.execute(3).value("copy.first").value is False


def test_an_output_never_set_or_not_a_number_is_not_good() -> None:
    rig = Rig()
    rig.feed(1, x=math.nan)
    out = rig.execute(2)
    assert out.value("d.out").quality is Quality.BAD
    assert out.value("d.out").value is None
    assert out.value("copy.count").good


@pytest.mark.parametrize(
    ("policy", "expected"),
    [
        ("pass", TagValue(5.0, Quality.BAD, Reason.TIMEOUT, 1 * MS)),
        ("hold", TagValue(2.5, Quality.UNCERTAIN, Reason.TIMEOUT, 10 * MS)),
        (-1, TagValue(-1.0, Quality.SUBSTITUTED, Reason.TIMEOUT, 1 * MS)),
    ],
)
def test_the_policy_of_a_bad_input(policy: str | float, expected: TagValue) -> None:
    rig = Rig(x=policy)
    rig.feed(10, x=2.5)
    rig.execute(11)
    rig.feed(12, x=bad(5.0), n=3)
    rig.execute(13)
    assert rig.program.tag("x") == expected
    assert rig.program.x == expected.value
    assert rig.program.tag("n").good
    assert rig.scan.inputs()["d.real"] == bad(5.0)  # watchers see the true value
    rig.feed(14, x=4.0)
    rig.execute(15)
    assert rig.program.tag("x") == TagValue(4.0, Quality.GOOD, t_ns=14 * MS)


def test_hold_has_nothing_to_hold_before_the_first_good_value() -> None:
    rig = Rig(x="hold")
    rig.feed(1, x=NEVER)
    rig.execute(2)
    assert rig.program.x is None
    assert rig.program.tag("x").quality is Quality.BAD


def test_a_silent_gateway_turns_every_input_bad_and_a_living_one_good_again() -> None:
    rig = Rig(n=42)
    assert not rig.scan.gateway_alive
    rig.feed(10, x=1.0, n=1)
    rig.execute(110)
    assert rig.scan.gateway_alive
    rig.execute(111)
    assert not rig.scan.gateway_alive
    assert {(v.quality, v.reason) for v in rig.scan.inputs().values()} == {(Quality.BAD, Reason.GATEWAY_DEAD)}
    assert rig.program.tag("x") == TagValue(1.0, Quality.BAD, Reason.GATEWAY_DEAD, 10 * MS)
    assert rig.program.n == 42
    rig.feed(112, x=2.0)
    rig.execute(113)
    assert rig.program.tag("x").good


def test_a_gateway_with_status_stopped_is_dead_at_once() -> None:
    rig = Rig()
    rig.feed(10)
    rig.writer.publish([NEVER] * 5, 11 * MS, None, RegionFlag.STOPPED)
    rig.execute(12)
    assert not rig.scan.gateway_alive


def test_messages_pass_exactly_once_and_are_acknowledged_when_consumed() -> None:
    rig = Rig()
    rig.feed(1, messages=(b"a", b"b"))
    out = rig.execute(2)
    assert [m.data for m in out.messages["m.outbox"]] == [b"a", b"b"]
    assert out.value(consumed_name("m.inbox")).value == 2
    assert rig.execute(3).messages == {}
    rig.feed(4, messages=(b"c",))
    assert [m.data for m in rig.execute(5).messages["m.outbox"]] == [b"c"]
    assert rig.program.box[0].t_ns == 4 * MS


def test_messages_never_overrun_a_slow_taker() -> None:
    rig = Rig()
    for n in range(10):
        rig.feed(n + 1, messages=(bytes([n]),))
        rig.execute(n + 1)
    out = rig.reader.snapshot()
    assert out.value("m.outbox").value == 4  # depth
    assert rig.scan.counters()["mailbox_waits"] > 0
    rig.feed(20, taken=4)
    rig.execute(21)
    rig.feed(22, taken=8)
    rig.execute(23)
    fresh = rig.image.reader(OUTPUTS)
    assert [m.data for m in fresh.snapshot().messages["m.outbox"]] == [bytes([n]) for n in range(6, 10)]


def test_a_restarted_plc_consumes_nothing_twice() -> None:
    rig = Rig()
    rig.feed(1, messages=(b"a", b"b"))
    rig.execute(2)
    rig.feed(3, messages=(b"c",))
    again = Copy()
    scan = Scan(rig.image, [BoundProgram("copy", again, rig.bound.inputs, rig.bound.outputs)], 100)
    scan.stop(4 * MS)  # even when it is stopped before its first scan
    assert rig.reader.snapshot().value(consumed_name("m.inbox")).value == 2
    scan.execute(5 * MS)
    assert [m.data for m in again.box] == [b"c"]
    assert rig.reader.snapshot().value(consumed_name("m.inbox")).value == 3


def test_stop_flags_the_region_and_turns_every_output_bad() -> None:
    rig = Rig()
    rig.feed(1, x=8.0)
    rig.execute(2)
    rig.scan.stop(3 * MS)
    out = rig.reader.snapshot()
    assert out.stopped
    assert out.value("d.out") == TagValue(8.0, Quality.BAD, Reason.NOT_OPERATIONAL, 3 * MS)
    assert {v.quality for v in out.all().values()} == {Quality.BAD}


def test_a_program_that_raises_is_named_with_its_line_and_publishes_nothing() -> None:
    rig = Rig()
    rig.feed(1, messages=(b"a",))

    def also(scan: ScanInfo) -> None:
        raise ZeroDivisionError("boom")

    rig.program.also = also
    with pytest.raises(ProgramFailed, match=r"copy.*ZeroDivisionError: boom") as caught:
        rig.execute(2)
    assert (caught.value.program, caught.value.line) == ("copy", also.__code__.co_firstlineno + 1)
    assert rig.reader.snapshot().counter == 0


def test_an_output_that_its_tag_cannot_hold_names_the_tag() -> None:
    rig = Rig()
    rig.feed(1)

    def also(scan: ScanInfo) -> None:
        rig.program.count = "many"  # type: ignore[assignment]

    rig.program.also = also
    with pytest.raises(ProgramFailed, match=r"copy\.count") as caught:
        rig.execute(2)
    assert (caught.value.program, caught.value.variable) == ("copy", "copy.count")


def test_an_overwritten_outbox_is_found() -> None:
    rig = Rig()
    rig.feed(1)

    def also(scan: ScanInfo) -> None:
        rig.program.sent = b"x"  # type: ignore[assignment]

    rig.program.also = also
    with pytest.raises(ProgramFailed, match="overwritten"):
        rig.execute(2)


class Writer(Program):
    out: float = var_output(TagKind.REAL, initial=1.0)

    def execute(self, scan: ScanInfo) -> None:
        pass


class IntReader(Program):
    x: float | None = var_input(TagKind.REAL)

    def execute(self, scan: ScanInfo) -> None:
        pass


def bind(**bindings: InputBinding) -> BoundProgram:
    return BoundProgram("r", IntReader(), bindings)


@pytest.mark.parametrize(
    ("programs", "message"),
    [
        ([BoundProgram("a", Writer(), {}, {"out": "d.out"}), BoundProgram("b", Writer(), {}, {"out": "d.out"})], "two"),
        ([BoundProgram("a", Writer(), {}, {"aus": "d.out"})], "no output 'aus'"),
        ([bind(x=InputBinding("d.real"), y=InputBinding("d.real"))], "no input 'y'"),
        ([bind()], "bound to no tag"),
        ([bind(x=InputBinding("d.nothing"))], "does not exist"),
        ([bind(x=InputBinding("d.bool"))], "differ in kind"),
        ([bind(x=InputBinding("d.real", "drop"))], "if_bad"),
        ([bind(x=InputBinding("d.int", 1.5))], "if_bad"),
    ],
)
def test_bindings_that_make_no_sense_are_refused(programs: list[BoundProgram], message: str) -> None:
    with pytest.raises(FileInvalid, match=message):
        image_for(programs, PLANT)


def test_an_integer_tag_widens_into_a_real_input() -> None:
    bound = bind(x=InputBinding("d.int"))
    layout = image_for([bound], PLANT, watched=["d.bool"])
    memory = memoryview(bytearray(layout.size))
    layout.format(memory)
    image = layout.attach(memory)
    image.writer(INPUTS).publish([TagValue(3, Quality.GOOD), NEVER], 1)
    Scan(image, [bound], 100).execute(2)
    assert isinstance(bound.program.__dict__["x"], float)


@pytest.mark.parametrize(
    "source",
    [
        "relay.st",
        "python: fieldtwin.plc.relay",
        "python: no.such.module:X",
        "python: fieldtwin.plc.relay:Nothing",
        "python: json:loads",
    ],
)
def test_sources_that_are_not_programs_are_refused(source: str) -> None:
    with pytest.raises(FileInvalid):
        load_program(source)


def test_a_program_is_loaded_from_a_source() -> None:
    assert type(load_program("python: fieldtwin.plc.relay:Relay")).__name__ == "Relay"


# -- forces, trips, changes ------------------------------------------------------------------------------------------


def force(rig: Rig, tag: str, value: Scalar) -> None:
    regions = {spec.name: (spec, region.name == INPUTS) for region in rig.layout.regions for spec in region.tags}
    spec, is_input = regions[tag]
    rig.scan.output_image.forces.force(spec, value, is_input, 5, "test")


def test_the_logic_sees_a_forced_input_whatever_the_plant_reports() -> None:
    rig = Rig(n="trip")
    rig.feed(10, x=1.5, n=3)
    force(rig, "d.real", 7)
    force(rig, "d.int", 9)
    seen: list[TagValue] = []
    rig.program.also = lambda scan: seen.extend((rig.program.tag("x"), rig.program.tag("n")))
    out = rig.execute(11)
    assert seen == [TagValue(7.0, Quality.SIMULATED, t_ns=5), TagValue(9, Quality.SIMULATED, t_ns=5)]
    assert out.value("d.out") == TagValue(7.0, Quality.GOOD, t_ns=11 * MS)
    rig.feed(12, x=1.5, n=bad(3))
    rig.execute(12)  # a forced input does not trip
    rig.scan.output_image.forces.clear()
    with pytest.raises(ProgramFailed, match=r"copy, d\.int.*timeout"):
        rig.execute(13)


def test_a_forced_output_is_published_simulated_and_the_logic_sees_it_before_it_runs() -> None:
    rig = Rig()
    rig.feed(10, x=1.5)
    force(rig, "d.out", -4.0)
    force(rig, "copy.count", 100)
    seen: list[int] = []
    rig.program.also = lambda scan: seen.append(rig.program.count)
    out = rig.execute(11)
    assert seen == [101]  # the logic added 1 to the forced value, not to the real one
    assert out.value("d.out") == TagValue(-4.0, Quality.SIMULATED, t_ns=11 * MS)
    assert out.value("copy.count") == TagValue(100, Quality.SIMULATED, t_ns=11 * MS)
    assert out.value("copy.first").quality is Quality.GOOD
    rig.scan.output_image.forces.unforce("copy.count")
    assert rig.execute(12).value("copy.count").value == 101


def test_a_force_that_the_tag_cannot_hold_is_refused() -> None:
    rig = Rig()
    for tag, value in (("d.int", 1.5), ("d.bool", 2), ("d.real", "x"), ("m.inbox", 1)):
        with pytest.raises(UsageError, match="cannot be forced"):
            force(rig, tag, value)


def test_trip_waits_until_the_input_was_good_once() -> None:
    rig = Rig(x="trip")
    rig.feed(10, x=bad(None))
    rig.execute(11)
    rig.feed(12, x=1.0)
    rig.execute(12)
    rig.feed(13, x=bad(1.0))
    with pytest.raises(ProgramFailed, match="must not be bad is: timeout"):
        rig.execute(13)


def test_why_a_tag_changed_is_known() -> None:
    rig = Rig()
    rig.feed(10, x=1.5, n=7)
    rig.execute(11)
    rig.execute(12)
    rig.feed(13, x=2.5, n=8)
    rig.execute(13)
    changes = rig.scan.output_image.changes["d.out"]
    assert [(c.scan, c.program, c.before, c.after) for c in changes] == [(1, "copy", None, 1.5), (3, "copy", 1.5, 2.5)]
    assert changes[-1].inputs == {"x": 2.5, "n": 8, "flag": False, "box": None}
    assert changes[-1].describe(14 * MS)["age_ms"] == 1.0
    assert changes[-1].inputs is rig.scan.output_image.changes["copy.count"][-1].inputs  # read once in each scan
    rig.feed(20, messages=(b"\0\1", b"abc", b"x" * 16))
    rig.execute(21)
    assert changes[-1].inputs["box"] == f"0001, 616263, {'78' * 16}"


def test_outputs_first_publishes_at_the_cycles_start_the_results_of_the_scan_before() -> None:
    rig = Rig()
    scan = Scan(rig.image, [rig.bound], 100, outputs_first=True)
    published: list[object] = []
    rig.program.also = lambda info: published.append(rig.reader.snapshot().value("d.out").value)
    for n, ms in enumerate((10, 20, 30), 1):
        rig.feed(ms, x=float(ms))
        scan.execute(ms * MS)
        after = rig.reader.snapshot()
        assert (after.counter, after.value("d.out").value) == (n, published[-1])  # once a scan, and nothing at its end
    assert published == [None, 10.0, 20.0]


def test_a_paused_task_keeps_publishing_its_last_outputs() -> None:
    rig = Rig()
    rig.feed(10, x=1.5)
    rig.execute(11)
    rig.feed(20, x=9.0)
    rig.scan.hold(21 * MS)
    out = rig.reader.snapshot()
    assert (out.t_ns, out.value("d.out").value, out.stopped) == (21 * MS, 1.5, False)
