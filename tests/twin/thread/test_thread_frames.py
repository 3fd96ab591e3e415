"""Messages between the two ends of a thread as bytes: no rounding, no crash of the reader, and little overhead."""

from __future__ import annotations

import math

from hypothesis import example, given, settings
from hypothesis import strategies as st
from thread_frames_rig import EVENTS, ORIGIN, SCHEMA, TAG, numbered, there

from fieldtwin.gateway.core.errors import Desync
from fieldtwin.gateway.store.event import Event
from fieldtwin.twin.thread.frames import (
    Ack,
    Ask,
    Data,
    Frame,
    FrameCodec,
    Hello,
    Lost,
    Refused,
    tag_of,
    varint,
    zigzag,
)


@given(
    events=st.lists(EVENTS, min_size=1, max_size=20), first=st.integers(1, 1 << 40), mtu=st.sampled_from([32, 64, 1400])
)
@settings(max_examples=80)
def test_logged_values_arrive_bit_by_bit_in_frames_of_any_size(events: list[Event], first: int, mtu: int) -> None:
    one, two = FrameCodec([SCHEMA], mtu), FrameCodec([SCHEMA], mtu)
    there(one, two, Hello("p:1", SCHEMA.id, 1, 9, True))
    tag = tag_of("p:1", SCHEMA.id)
    left, got = numbered(events, first), []
    while left:
        count = one.fit(tag, left)
        frame = there(one, two, Data(tag, left[:count]))
        assert isinstance(frame, Data)
        got += frame.events
        left = left[count:]
    assert got == list(numbered(events, first))
    assert [type(e.value) for e in got] == [type(e.value) for e in events]
    assert [math.copysign(1, e.value) for e in got if e.value == 0] == [
        math.copysign(1, e.value) for e in events if e.value == 0
    ]


RUN = st.integers(1, 99)


@given(
    frame=st.builds(Ack, st.just(TAG), st.integers(0, 1 << 50), st.lists(st.tuples(RUN, RUN), max_size=5).map(tuple))
    | st.builds(Lost, st.just(TAG), st.integers(1, 99), st.integers(1, 1 << 40))
    | st.builds(Refused, st.just(TAG), st.binary(min_size=4, max_size=4))
    | st.just(Ask(TAG))
    | st.builds(Hello, st.just(ORIGIN), st.just(SCHEMA.id), st.integers(1, 50), st.integers(50, 1 << 40), st.booleans())
)  # fmt: skip
def test_small_frames_come_back_as_they_went(frame: Frame) -> None:
    assert there(FrameCodec([SCHEMA], 64), FrameCodec([SCHEMA], 64), frame) == frame


@given(data=st.binary(max_size=80))
@example(data=b"\x12" + TAG + b"\x01" + b"\xff" * 12)
@example(data=b"\x13" + TAG + b"\x01\x02\x01")
def test_no_bytes_break_the_reader(data: bytes) -> None:
    codec = FrameCodec([SCHEMA], 64)
    codec.learn(TAG, SCHEMA.id)
    for text in (data, b"\x12" + TAG + data, b"\x13" + TAG + data, b"\x11" + TAG + data):
        try:
            codec.decode(text)
        except Desync:
            pass


def test_a_sample_takes_so_few_bytes_that_six_go_into_a_modems_frame() -> None:
    """Values of a float32 sensor, a second apart: 64 bytes hold five or more, with number and absolute time."""
    codec = FrameCodec([SCHEMA], 64)
    codec.learn(TAG, SCHEMA.id)
    events = numbered(
        [Event(0, 1_790_000_000_000 + 1000 * n, 0, SCHEMA.names[n % 2], n / 8) for n in range(20)], 100_000
    )
    assert codec.fit(TAG, events) == 6
    (one,) = codec.encode(Data(TAG, events[:1]))
    (two,) = codec.encode(Data(TAG, events[:2]))
    assert len(two) - len(one) == 8


@given(st.integers(0, (1 << 63) - 1))
def test_numbers_are_short_when_they_are_small(number: int) -> None:
    assert len(varint(number)) == max(1, math.ceil(number.bit_length() / 7))
    assert len(zigzag(-number)) <= len(varint(2 * number + 1))
