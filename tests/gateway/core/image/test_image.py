"""The process image: any values round-trip, messages arrive in order exactly once, two layouts are never mixed."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.gateway.core.errors import Bug, FileInvalid
from fieldtwin.gateway.core.image.image import (
    INPUTS,
    OUTPUTS,
    Image,
    ImageLayout,
    Message,
    NotEncodable,
    RegionFlag,
    RegionLayout,
    TagKind,
    TagSpec,
    consumed_name,
    message_tag,
    process_image,
    taken_name,
)
from fieldtwin.gateway.core.values import NEVER, Quality, Reason, Scalar, TagValue

I64 = st.integers(-(2**63), 2**63 - 1)
BY_KIND: dict[TagKind, st.SearchStrategy[Scalar]] = {
    TagKind.REAL: st.floats(allow_nan=False),
    TagKind.INT: I64,
    TagKind.BOOL: st.booleans(),
}


def one_region(*tags: TagSpec) -> tuple[Image, ImageLayout]:
    layout = ImageLayout((RegionLayout("r", tags),))
    memory = memoryview(bytearray(layout.size))
    layout.format(memory)
    return layout.attach(memory), layout


def good(value: Scalar | None, t_ns: int = 0) -> TagValue:
    return TagValue(value, Quality.GOOD, t_ns=t_ns)


@st.composite
def publications(draw: st.DrawFn) -> tuple[list[TagKind], list[list[TagValue]]]:
    kinds = draw(st.lists(st.sampled_from(list(BY_KIND)), max_size=12))
    rows = []
    for _ in range(draw(st.integers(1, 6))):
        rows.append(
            [
                TagValue(
                    draw(st.none() | BY_KIND[kind]),
                    draw(st.sampled_from(Quality)),
                    draw(st.sampled_from(Reason)),
                    draw(I64),
                )
                for kind in kinds
            ]
        )
    return kinds, rows


@given(publications(), I64)
def test_any_values_round_trip(published: tuple[list[TagKind], list[list[TagValue]]], now_ns: int) -> None:
    kinds, rows = published
    image, _ = one_region(*(TagSpec(f"t{i}", kind) for i, kind in enumerate(kinds)))
    writer, reader = image.writer("r"), image.reader("r")
    for n, row in enumerate(rows, 1):
        assert writer.publish(row, now_ns) == n
        snapshot = reader.snapshot()
        assert (snapshot.counter, snapshot.t_ns) == (n, now_ns)
        for i, sent in enumerate(row):
            got = snapshot.value(f"t{i}")
            assert got == sent
            assert type(got.value) is type(sent.value)
    assert reader.retries == 0


@given(st.integers(1, 5), st.lists(st.tuples(st.lists(st.binary(max_size=20), max_size=5), st.booleans()), max_size=30))
def test_messages_in_order_exactly_once_and_the_missed_counted(
    depth: int, steps: list[tuple[list[bytes], bool]]
) -> None:
    image, _ = one_region(message_tag("m", 20, depth))
    writer, reader = image.writer("r"), image.reader("r")
    waiting: list[bytes] = []
    sent = missed = 0
    for new, look in [*steps, ([], True)]:
        batch = new[:depth]
        writer.publish([good(0)], 1, {"m": [(sent, data) for data in batch]})
        sent += len(batch)
        waiting += batch
        if look:
            missed += max(0, len(waiting) - depth)
            got = reader.snapshot().messages.get("m", ())
            assert [m.data for m in got] == waiting[-depth:]
            assert [m.seq for m in got] == list(range(sent - len(got) + 1, sent + 1))
            assert reader.missed["m"] == missed
            assert reader.snapshot().messages == {}
            waiting.clear()


def test_a_message_tag_has_quality_and_its_last_sequence_as_value() -> None:
    image, _ = one_region(message_tag("m", 8, 2), TagSpec("x", TagKind.INT))
    writer, reader = image.writer("r"), image.reader("r")
    writer.publish([TagValue(None, Quality.BAD, Reason.TIMEOUT, 5), good(1)], 9, {"m": [(7, b"a"), (8, b"")]})
    snapshot = reader.snapshot()
    assert snapshot.value("m") == TagValue(2, Quality.BAD, Reason.TIMEOUT, 5)
    assert snapshot.messages == {"m": (Message(1, 7, b"a"), Message(2, 8, b""))}


def test_before_the_first_publication_everything_was_never_read() -> None:
    image, _ = one_region(TagSpec("x", TagKind.REAL))
    snapshot = image.reader("r").snapshot()
    assert snapshot.counter == 0
    assert snapshot.value("x") == NEVER
    assert math.isinf(snapshot.age_ns(10))


def test_a_restarted_writer_continues_where_the_dead_one_stopped_mid_write() -> None:
    image, _ = one_region(message_tag("m", 4, 2), TagSpec("x", TagKind.INT))
    writer, reader = image.writer("r"), image.reader("r")
    for n in range(1, 4):
        writer.publish([good(0), good(n)], n, {"m": [(n, bytes([n]))]})
    # killed while it filled the next slot and had already written the next two messages
    writer._memory[writer.shape.slot_offset(4) :][:20] = b"\xff" * 20
    writer._write_messages({"m": [(9, b"lost"), (9, b"lost")]})
    snapshot = reader.snapshot()
    assert (snapshot.counter, snapshot.value("x").value) == (3, 3)
    assert [m.data for m in snapshot.messages["m"]] == [b"\2", b"\3"]  # depth 2: both are still complete
    again = image.writer("r")
    assert again.publish([good(0), good(4)], 4, {"m": [(4, b"new")]}) == 4
    assert reader.snapshot().messages["m"] == (Message(4, 4, b"new"),)
    assert reader.retries == 0


def test_a_slot_that_is_never_consistent_gives_the_last_snapshot_and_is_counted() -> None:
    image, _ = one_region(TagSpec("x", TagKind.INT))
    writer, reader = image.writer("r"), image.reader("r")
    writer.publish([good(1)], 1)
    assert reader.snapshot().value("x").value == 1
    writer.publish([good(2)], 2)
    writer._memory[writer.shape.slot_offset(2) + 30] ^= 1
    assert reader.snapshot().value("x").value == 1
    assert reader.gave_up == 1
    with pytest.raises(FileInvalid, match="damaged"):
        image.writer("r")


def test_a_slot_that_carries_another_number_is_not_believed() -> None:
    image, _ = one_region(TagSpec("x", TagKind.INT))
    writer, reader = image.writer("r"), image.reader("r")
    writer.publish([good(1)], 1)
    writer._words[0] = 5  # the counter is visible before the slot, as on a processor that reorders stores
    assert reader.snapshot().counter == 0
    assert reader.gave_up == 1


def test_a_message_overwritten_or_damaged_while_it_is_read_is_missed_never_handed_out() -> None:
    image, _ = one_region(message_tag("m", 4, 3))
    writer, reader = image.writer("r"), image.reader("r")
    writer.publish([good(0)], 1, {"m": [(1, b"a"), (2, b"b"), (3, b"c")]})
    ring = writer.shape.rings[0]
    writer._last["m"] = 6
    writer._write_messages({"m": [(7, b"new")]})  # message 7 lies where message 1 was
    writer._memory[ring.record_offset(2) + 24] ^= 1  # the payload of message 2
    assert reader.snapshot().messages["m"] == (Message(3, 3, b"c"),)
    assert reader.missed["m"] == 2


def test_a_restarted_reader_resumes_after_the_processed_messages() -> None:
    image, _ = one_region(message_tag("m", 4, 8))
    writer = image.writer("r")
    writer.publish([good(0)], 1, {"m": [(0, b"a"), (0, b"b"), (0, b"c")]})
    reader = image.reader("r")
    reader.resume("m", 2)
    assert [m.data for m in reader.snapshot().messages["m"]] == [b"c"]
    assert reader.missed["m"] == 0


@pytest.mark.parametrize(
    ("kind", "value"),
    [(TagKind.INT, 2**63), (TagKind.INT, 1.5), (TagKind.REAL, "1"), (TagKind.BOOL, b"x"), (TagKind.REAL, 10**400)],
)
def test_a_value_that_does_not_fit_names_its_tag_and_publishes_nothing(kind: TagKind, value: Scalar) -> None:
    image, _ = one_region(TagSpec("a", TagKind.INT), TagSpec("b", kind), message_tag("m", 4, 2))
    writer, reader = image.writer("r"), image.reader("r")
    with pytest.raises(NotEncodable) as caught:
        writer.publish([good(1), good(value), good(0)], 1, {"m": [(0, b"x")]})
    assert caught.value.tag == "b"
    assert reader.snapshot().counter == 0
    assert writer.last_sequence("m") == 0


def test_messages_that_do_not_fit_are_refused() -> None:
    image, _ = one_region(message_tag("m", 4, 2), TagSpec("x", TagKind.INT))
    writer = image.writer("r")
    for messages in ({"m": [(0, b"12345")]}, {"m": [(0, b"")] * 3}, {"x": [(0, b"")]}):
        with pytest.raises(NotEncodable):
            writer.publish([good(0), good(0)], 1, messages)
    with pytest.raises(Bug, match="the number of values is not the number of tags"):
        writer.publish([good(0)], 1)
    assert writer.counter == 0


def test_another_layout_or_no_image_is_refused() -> None:
    layout = process_image([TagSpec("ctd.pressure", TagKind.REAL, "dbar")], [TagSpec("ctd.period_s", TagKind.INT)])
    other = process_image([TagSpec("ctd.pressure", TagKind.REAL, "bar")], [TagSpec("ctd.period_s", TagKind.INT)])
    memory = memoryview(bytearray(layout.size))
    with pytest.raises(FileInvalid, match="not a process image"):
        layout.attach(memory)
    layout.format(memory)
    with pytest.raises(FileInvalid, match="different layout"):
        other.attach(memory)
    with pytest.raises(FileInvalid, match="too small"):
        layout.attach(memory[:-1])
    with layout.attach(memory) as image, pytest.raises(FileInvalid, match="no region"):
        image.reader("retain")


def test_descriptions_survive_json_and_impossible_ones_are_refused() -> None:
    limited = TagSpec(
        "pump.speed", TagKind.INT, "rpm", limits=(0, 1500), words=((0, "off"),), value_names=((7, "fault"),)
    )
    layout = process_image([message_tag("modem.inbox", 250, 16)], [message_tag("modem.outbox", 250, 8), limited])
    again = ImageLayout.from_description(json.loads(json.dumps(layout.describe())))
    assert again.digest == layout.digest  # for two processes that read one description
    assert ImageLayout.from_description(layout.describe()) == layout
    assert [t.name for t in layout.regions[0].tags] == ["modem.inbox", taken_name("modem.outbox")]
    assert [t.name for t in layout.regions[1].tags] == ["modem.outbox", "pump.speed", consumed_name("modem.inbox")]
    assert again.regions[1].tags[1] == limited
    assert [r.name for r in layout.regions] == [INPUTS, OUTPUTS]
    for bad in ({}, {"regions": [{}]}, {"regions": [{"name": "r", "tags": [{"name": "x", "kind": "REEL"}]}]}):
        with pytest.raises(FileInvalid):
            ImageLayout.from_description(bad)
    with pytest.raises(FileInvalid, match="twice"):
        RegionLayout("r", (TagSpec("x", TagKind.INT), TagSpec("x", TagKind.REAL)))
    with pytest.raises(FileInvalid, match="impossible size"):
        message_tag("m", 0, 1)
    with pytest.raises(FileInvalid, match="limits"):
        TagSpec("x", TagKind.INT, limits=(2, 1))


@pytest.mark.parametrize("renewed", [[], [1], [0, 1], None])
@pytest.mark.parametrize("repeated", [False, True])
def test_skipped_publications_count_and_renew_only_the_named_times(renewed: list[int] | None, repeated: bool) -> None:
    layout = ImageLayout((RegionLayout("r", (TagSpec("x", TagKind.REAL), TagSpec("y", TagKind.INT))),))
    memory = memoryview(bytearray(layout.size))
    layout.format(memory)
    image = layout.attach(memory, private=True)
    writer, reader = image.writer("r"), image.reader("r")
    columns = [1.5, 2], bytes([Quality.GOOD] * 2), bytes([Reason.NONE] * 2)
    writer.publish_mixed(*columns, [10, 20], 100)
    before = reader.snapshot()
    if repeated:  # the last publication is not in the memory
        writer.publish_mixed(*columns, [11, 21], 101, same=True)
    writer.skip(3, 400, renewed)
    after = reader.snapshot()
    assert (after.counter, after.t_ns) == (before.counter + repeated + 3, 400)
    assert (after.values, after.qualities, after.reasons) == (before.values, before.qualities, before.reasons)
    old = [11, 21] if repeated else [10, 20]
    times = [400 if renewed is None or at in renewed else old[at] for at in (0, 1)]
    assert [after.time_ns(at) for at in (0, 1)] == times
    assert after.shape.times.unpack(after.stamps) == tuple(times)
    writer.skip(1, 500, [0])  # the times that the earlier skipped publications renewed are kept
    latest = reader.snapshot()
    assert (latest.counter, latest.time_ns(0), latest.time_ns(1)) == (after.counter + 1, 500, times[1])
    assert [after.time_ns(at) for at in (0, 1)] == times
    writer.release()  # the next writer and reader find the latest publication in the memory
    assert image.reader("r").snapshot().stamps == latest.stamps


def test_flags_and_columns() -> None:
    image, _ = one_region(TagSpec("x", TagKind.REAL), TagSpec("y", TagKind.INT), message_tag("m", 4, 1))
    writer, reader = image.writer("r"), image.reader("r")
    writer.publish_columns([1.0, None, None], Quality.BAD, Reason.STALE, 5, {"m": [(5, b"z")]}, RegionFlag.STOPPED)
    snapshot = reader.snapshot()
    assert snapshot.stopped
    assert snapshot.value("x") == TagValue(1.0, Quality.BAD, Reason.STALE, 5)
    assert snapshot.value("y") == TagValue(None, Quality.BAD, Reason.NEVER_READ, 5)
    assert snapshot.value("m").value == 1
    assert snapshot.age_ns(7) == 2


@settings(max_examples=20)
@given(st.integers(0, 3), st.integers(1, 9))
def test_released_memory_can_be_closed(readers: int, count: int) -> None:
    layout = ImageLayout((RegionLayout("r", tuple(TagSpec(f"t{i}", TagKind.INT) for i in range(count))),))
    backing = bytearray(layout.size)
    memory = memoryview(backing)
    layout.format(memory)
    image = layout.attach(memory)
    image.writer("r").publish([good(1)] * count, 1)
    for _ in range(readers):
        image.reader("r").snapshot()
    image.release()
    memory.release()
    backing.append(0)  # BufferError while any view exists


def test_names_of_values_do_not_change_the_layout_because_a_reload_changes_them_while_the_image_stays() -> None:
    """Defect: after a reload with new names, a gateway that was started again refused the image."""

    def layout(unit: str, name: str) -> ImageLayout:
        mode = TagSpec("p.mode", TagKind.INT, unit, value_names=((1, name),))
        return ImageLayout((RegionLayout("inputs", (mode,)),))

    assert layout("", "idle").digest == layout("", "ready").digest
    assert layout("", "idle").digest != layout("m", "idle").digest
    assert layout("", "idle").describe() != layout("", "ready").describe()
