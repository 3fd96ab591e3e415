"""The trace of a run: hashed and written in blocks, with the same result as event by event."""

import hashlib
import io
import json
from typing import Any

import pytest

from fieldtwin.results.trace import Trace, TraceEvent, TraceKind, read_trace


def some(count: int) -> list[TraceEvent]:
    kinds = list(TraceKind)
    return [
        TraceEvent(n * 1000, kinds[n % len(kinds)], f"w{n}", {"value": n / 3, "a": None, "Z": "ä"})
        for n in range(count)
    ]


def line(event: TraceEvent) -> bytes:
    said = [event.t_ns, event.kind.value, event.where, event.data]
    text = json.dumps(said, separators=(",", ":"), ensure_ascii=False)
    assert text.endswith(',"a":null,"Z":"ä"}]')
    return (text.replace(',"a":null,"Z":"ä"}]', "}]").replace('{"value', '{"Z":"ä","a":null,"value') + "\n").encode()


class _Kept(io.BytesIO):
    """The content at its closing."""

    whole = b""

    def close(self) -> None:
        if not self.closed:
            self.whole = self.getvalue()
        super().close()


@pytest.mark.parametrize("count", [0, 1, 255, 256, 257, 1000])
def test_hash_and_sink_have_every_event_in_order(count: int) -> None:
    sink, events = _Kept(), some(count)
    trace = Trace(10, sink)
    for event in events:
        trace.note(*event)
    assert (trace.count, trace.dropped) == (count, max(0, count - 10))
    assert trace.events == events[-10:]
    lines = b"".join(map(line, events))
    digest = hashlib.sha256(lines).hexdigest()
    assert trace.hexdigest() == trace.hexdigest() == digest
    assert sink.getvalue() == lines  # the hash identifies the events that it was computed from
    trace.close()
    trace.close()
    assert sink.whole == lines
    assert read_trace(sink.whole.splitlines()) == events
    assert trace.hexdigest() == digest


def test_pending_events_are_in_the_sink_after_closing() -> None:
    sink = _Kept()
    trace = Trace(sink=sink)
    for event in some(3):
        trace.note(*event)
    assert sink.getvalue() == b""
    trace.close()
    assert len(sink.whole.splitlines()) == 3


def test_memory_is_bounded_whatever_an_event_holds() -> None:
    trace = Trace(5)
    trace.note(0, TraceKind.NOTE, "a bug in fieldtwin", {"text": object()})
    for event in some(254):
        trace.note(*event)
    with pytest.raises(TypeError):
        trace.note(0, TraceKind.NOTE, "the end of its block", {})
    for event in some(5000):  # reported once, and no block grows without bound afterwards
        trace.note(*event)
    assert len(trace.events) == 5
    assert len(trace._pending) < 256


def test_listeners_hear_their_kinds_in_the_order_of_asking() -> None:
    heard: list[tuple[str, Any]] = []
    trace = Trace()
    trace.listen(lambda e: heard.append(("states", e.where)), TraceKind.STATE)
    trace.listen(lambda e: heard.append(("all", e.where)))
    trace.listen(lambda e: heard.append(("states and steps", e.where)), TraceKind.STEP, TraceKind.STATE)
    trace.note(1, TraceKind.STATE, "a", {})
    trace.note(2, TraceKind.FRAME, "b", {})
    trace.note(3, TraceKind.STEP, "c", {})
    assert heard == [
        ("states", "a"), ("all", "a"), ("states and steps", "a"), ("all", "b"), ("all", "c"), ("states and steps", "c"),
    ]  # fmt: skip
