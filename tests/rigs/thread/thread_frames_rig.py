"""Events and frames of a thread for tests: any valid ones, and over a link with its size limit."""

from __future__ import annotations

from hypothesis import strategies as st

from fieldtwin.gateway.store.event import Event
from fieldtwin.twin.thread.frames import (
    Frame,
    FrameCodec,
    Schema,
    tag_of,
)

SCHEMA = Schema(("ctd.pressure", "ctd.temperature", "relay"))
ORIGIN = "plant:5f3a91c2"
TAG = tag_of(ORIGIN, SCHEMA.id)
VALUES = (
    st.none()
    | st.integers(-(1 << 63), (1 << 63) - 1)
    | st.floats(allow_nan=False)
    | st.text(max_size=80)
    | st.binary(max_size=80)
)
EVENTS = st.builds(
    Event, st.just(0), st.integers(0, 1 << 42), st.integers(0, 6), st.sampled_from([*SCHEMA.names, "another.tag"]), VALUES,
    st.integers(0, 4), st.integers(0, 14),
)  # fmt: skip


def numbered(events: list[Event], first: int = 1) -> tuple[Event, ...]:
    return tuple(e._replace(sequence=n) for n, e in enumerate(events, first))


def there(codec: FrameCodec, other: FrameCodec, frame: Frame) -> Frame | None:
    """A frame over a link: every datagram within the MTU."""
    got: Frame | None = None
    for datagram in codec.encode(frame):
        assert len(datagram) <= codec.mtu
        got = other.decode(datagram)
    return got
