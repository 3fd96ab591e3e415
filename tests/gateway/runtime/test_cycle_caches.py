"""Caches of a scan cycle: after any sequence of events, the image shows the same as a fresh computation."""

from __future__ import annotations

import math
from typing import Any

from hypothesis import example, given, settings
from hypothesis import strategies as st

from fieldtwin.gateway.core.concurrency.events import Consumer
from fieldtwin.gateway.core.image.image import (
    INPUTS,
    OUTPUTS,
    Image,
    ImageLayout,
    RegionFlag,
    RegionLayout,
    Snapshot,
    TagKind,
    TagSpec,
    consumed_name,
    message_tag,
    taken_name,
)
from fieldtwin.gateway.core.values import DATA, Quality, Reason, TagValue
from fieldtwin.gateway.runtime.image_io import ImageExchange
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.plc.binding import BoundProgram, InputBinding, image_for
from fieldtwin.plc.cycle.forces import Forces
from fieldtwin.plc.cycle.publishing import OutputImage
from fieldtwin.plc.cycle.scan import Scan
from fieldtwin.plc.program import (
    Message,
    Outbox,
    Program,
    ScanInfo,
    message_input,
    message_output,
    var_input,
    var_output,
)

MS = 1_000_000
LIMIT_MS = 30
TAGS = ("d.real", "d.int", "d.bool", "d.fixed")


class Hands:
    now_ns = MS

    def monotonic_ns(self) -> int:
        return self.now_ns

    def utc_ns(self) -> int:
        return self.now_ns

    async def sleep_until_ns(self, deadline_ns: int) -> None: ...


def one(*regions: RegionLayout) -> Image:
    layout = ImageLayout(tuple(regions))
    memory = memoryview(bytearray(layout.size))
    layout.format(memory)
    return layout.attach(memory)


def same_to_everybody(image: Image, region: str, old: Snapshot) -> Snapshot:
    """A long-lived reader sees the same as a new one, except for messages."""
    fresh = image.reader(region).snapshot()
    assert (old.values, old.qualities, old.reasons, old.stamps) == (
        fresh.values, fresh.qualities, fresh.reasons, fresh.stamps,
    )  # fmt: skip
    assert [type(v) for v in old.values] == [type(v) for v in fresh.values]
    assert (old.counter, old.t_ns, old.flags) == (fresh.counter, fresh.t_ns, fresh.flags)
    return fresh


# -- the gateway's side ---------------------------------------------------------------------------------------------------

VALUES = st.sampled_from([None, 0, 1, 2, 1.5])
STEPS = st.one_of(
    st.tuples(st.just("put"), st.sampled_from(TAGS), VALUES, st.sampled_from(Quality)),
    st.tuples(st.just("bad"), st.sampled_from(TAGS), st.sampled_from([Reason.TIMEOUT, Reason.REFUSED])),
    st.tuples(st.just("amend"), st.sampled_from(TAGS), VALUES),
    st.tuples(st.just("restate"), st.sampled_from(TAGS), st.sampled_from([None, 10, LIMIT_MS])),
    st.tuples(st.just("message")),
    st.tuples(st.just("untaken"), st.integers(0, 2)),
    st.tuples(st.just("late"), st.integers(1, 4)),
    st.tuples(st.just("ticks"), st.integers(1, 5)),
)


def value_of(tag: str, value: Any, quality: Quality, t_ns: int) -> TagValue:
    if value is not None and tag != "d.real":
        value = bool(value) if tag == "d.bool" else int(value)
    return TagValue(value, Quality.BAD if value is None else quality, Reason.NONE, t_ns, b"")


@settings(max_examples=60)
@given(st.lists(STEPS, max_size=25))
@example([("ticks", 1), ("put", "d.real", 1.5, Quality.GOOD), ("late", 4), ("ticks", 1)])
@example([("ticks", 1), ("put", "d.int", 2, Quality.GOOD), ("ticks", 5), ("put", "d.int", None, Quality.GOOD)])
@example([("ticks", 1), ("message",), ("ticks", 2), ("untaken", 1), ("ticks", 1)])
def test_inputs_equal_the_tag_table(steps: list[Any]) -> None:
    kinds = {"d.real": TagKind.REAL, "d.int": TagKind.INT, "d.bool": TagKind.BOOL, "d.fixed": TagKind.INT}
    inputs = [TagSpec(name, kind) for name, kind in kinds.items()]
    inputs += [message_tag("m.inbox", 8, 4), TagSpec(taken_name("m.out"), TagKind.INT)]
    outputs = [message_tag("m.out", 8, 4), TagSpec(consumed_name("m.inbox"), TagKind.INT)]
    image = one(RegionLayout(INPUTS, tuple(inputs)), RegionLayout(OUTPUTS, tuple(outputs)))
    clock, queue = Hands(), Consumer[DATA]("m.inbox", 16)
    table = TagTable(clock)
    table.declare([name for name in TAGS if name != "d.fixed"], LIMIT_MS)
    table.declare(["d.fixed"], None)
    exchange, plc, reader = ImageExchange(image, table, {"m.inbox": queue}), image.writer(OUTPUTS), image.reader(INPUTS)
    zero = TagValue(0, Quality.GOOD)
    taken = sent = 0
    for what, *args in [*steps, ("ticks", 5)]:
        if what == "put":
            table.put(args[0], value_of(args[0], args[1], args[2], clock.now_ns))
        elif what == "bad":
            table.put_bad([args[0]], args[1])
        elif what == "amend":
            held = table.held(args[0])
            table.amend(args[0], value_of(args[0], args[1], held.quality, held.t_ns))
        elif what == "restate":
            table.restate(*args)
        elif what == "message":
            queue.observe(DATA(b"a"))
            plc.publish([zero, TagValue(sent, Quality.GOOD)], clock.now_ns, {"m.out": [(0, b"b")]})
            taken += 1
        elif what == "late":
            clock.now_ns += args[0] * 10 * MS
        elif what == "untaken":
            exchange.undelivered["m.out"] = args[0]
        for _ in range(args[0] if what == "ticks" else 0):
            clock.now_ns += 10 * MS
            exchange.exchange(clock.now_ns)
            snapshot = reader.snapshot()
            assert snapshot.t_ns == clock.now_ns
            same_to_everybody(image, INPUTS, snapshot)
            for name in TAGS:
                seen, held = snapshot.value(name), table.current(name, clock.now_ns)
                assert (seen.value, seen.quality, seen.reason, seen.t_ns) == (
                    held.value, held.quality, held.reason, held.t_ns,
                ), name  # fmt: skip
            says = taken
            if "m.out" in exchange.undelivered:  # an item that came just now is not yet processed
                says -= exchange.undelivered["m.out"] + len(exchange.new_messages.get("m.out", ()))
            assert snapshot.value(taken_name("m.out")) == TagValue(says, Quality.GOOD, t_ns=clock.now_ns)
            sent = int(snapshot.value("m.inbox").value or 0)
            plc.publish([zero, TagValue(sent, Quality.GOOD)], clock.now_ns)


# -- the PLC's side ---------------------------------------------------------------------------------------------------------


class Quiet(Program):
    """Set what the test requests, and nothing else."""

    x: float | None = var_input(TagKind.REAL)
    box: tuple[Message, ...] = message_input()
    out: float | None = var_output(TagKind.REAL)
    flag: bool | None = var_output(TagKind.BOOL, initial=False)
    sent: Outbox = message_output()

    def __init__(self) -> None:
        self.wanted: float | None = None
        self.messages = 0
        self.rooms: list[int] = []

    def execute(self, scan: ScanInfo) -> None:
        self.out = self.wanted
        self.rooms.append(self.sent.room)
        while self.messages and self.sent.send(b"m", scan.now_ns):
            self.messages -= 1


SCANS = st.one_of(
    st.tuples(st.just("want"), st.sampled_from([None, 0.0, 1.0, math.nan])),
    st.tuples(st.just("force"), st.sampled_from([None, 5.0, 1.0])),
    st.tuples(st.just("send"), st.integers(1, 6)),
    st.tuples(st.just("arrive"), st.integers(1, 3)),
    st.tuples(st.just("taken")),
    st.tuples(st.just("hold")),
    st.tuples(st.just("stop")),
    st.tuples(st.just("scans"), st.integers(1, 3)),
)


@settings(max_examples=60)
@given(st.lists(SCANS, max_size=25))
@example(
    [("want", 1.0), ("scans", 2), ("force", 1.0), ("scans", 2), ("force", None)]
)  # the value is the same all the time
@example([("want", 1.0), ("scans", 2), ("stop",)])
@example([("want", math.nan), ("scans", 1), ("want", None)])  # no value in both cases, for different reasons
@example([("want", 1.0), ("scans", 2), ("arrive", 2), ("scans", 1), ("want", 0.0)])
@example([("want", 1.0), ("scans", 2), ("hold",), ("send", 6), ("scans", 2), ("taken",)])
def test_outputs_equal_the_programs_values(steps: list[Any]) -> None:
    program = Quiet()
    plant = {
        "d.x": TagSpec("d.x", TagKind.REAL),
        "d.out": TagSpec("d.out", TagKind.REAL),
        "m.inbox": message_tag("m.inbox", 8, 8),
        "m.out": message_tag("m.out", 8, 4),
    }
    binding = {"x": InputBinding("d.x"), "box": InputBinding("m.inbox")}
    bound = BoundProgram("quiet", program, binding, {"out": "d.out", "sent": "m.out"})
    layout = image_for([bound], plant)
    memory = memoryview(bytearray(layout.size))
    layout.format(memory)
    image = layout.attach(memory)
    forces = Forces()
    outputs = OutputImage(image, [bound], forces)
    scan = Scan(image, [bound], 1e6, outputs)
    gateway, reader = image.writer(INPUTS), image.reader(OUTPUTS)
    index = gateway.shape.index
    now_ns, arrived, taken, sent, expected = 0, 0, 0, 0, None

    def feed(messages: int = 0) -> None:
        row = [TagValue(0.0, Quality.GOOD)] * len(index)
        row[index[taken_name("m.out")]] = TagValue(taken, Quality.GOOD)
        gateway.publish(row, now_ns, {"m.inbox": [(0, b"i")] * messages})

    feed()
    for what, *args in [*steps, ("scans", 2)]:
        now_ns += 10 * MS
        if what == "want":
            program.wanted = args[0]
        elif what == "force":
            forces.unforce("d.out")
            if args[0] is not None:
                forces.force(plant["d.out"], args[0], False, now_ns)
        elif what == "send":
            program.messages += args[0]
        elif what == "arrive":
            feed(args[0])
            arrived += args[0]
        elif what == "taken":
            taken = sent
            feed()
        elif what == "stop":
            scan.stop(now_ns)
            stopped = same_to_everybody(image, OUTPUTS, reader.snapshot())
            assert stopped.flags is RegionFlag.STOPPED
            assert set(stopped.qualities) == {Quality.BAD}
        elif what == "hold":
            scan.hold(now_ns)
        for _ in range(args[0] if what == "scans" else 0):
            now_ns += 10 * MS
            before = sent
            scan.execute(now_ns)
            snapshot = same_to_everybody(image, OUTPUTS, reader.snapshot())
            sent = int(snapshot.value("m.out").value or 0)
            assert program.rooms[-1] == 4 - (before - taken)
            forced = forces.outputs.get("d.out")
            expected = forced.value if forced else program.wanted
            if expected is None or math.isnan(float(expected)):
                reason = Reason.NEVER_READ if expected is None else Reason.NOT_A_NUMBER
                want = TagValue(None, Quality.BAD, reason, now_ns)
            else:
                want = TagValue(expected, Quality.SIMULATED if forced else Quality.GOOD, Reason.NONE, now_ns)
            assert snapshot.value("d.out") == want
            assert snapshot.value(consumed_name("m.inbox")) == TagValue(arrived, Quality.GOOD, t_ns=now_ns)
            assert (snapshot.t_ns, snapshot.flags) == (now_ns, RegionFlag.NONE)
            feed()


# -- the image itself -------------------------------------------------------------------------------------------------------


def test_a_reader_that_is_reset_gets_its_messages_although_nothing_changed() -> None:
    image = one(RegionLayout("r", (message_tag("m", 8, 4),)))
    writer, reader = image.writer("r"), image.reader("r")
    good = [TagValue(0, Quality.GOOD)]
    writer.publish(good, 1, {"m": [(1, b"a"), (1, b"b")]})
    assert len(reader.snapshot().messages["m"]) == 2
    writer.publish(good, 2)
    assert reader.snapshot().messages == {}
    reader.resume("m", 1)
    writer.publish(good, 3)
    assert [m.data for m in reader.snapshot().messages["m"]] == [b"b"]


def test_a_reattached_writer_has_no_cached_value() -> None:
    image = one(RegionLayout("r", (TagSpec("x", TagKind.INT), TagSpec("y", TagKind.REAL))))
    image.writer("r").publish_columns([1, 2.0], Quality.GOOD, Reason.NONE, 1)
    image.writer("r").publish_columns([3, 4.0], Quality.GOOD, Reason.NONE, 2, same=True)
    assert image.reader("r").snapshot().values == (3, 4.0)
    image.writer("r").publish_mixed([5, None], b"\0\3", b"\0\0", [1, 2], 3, same=True)
    assert image.reader("r").snapshot().values == (5, None)
