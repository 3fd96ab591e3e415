"""Schemas Connection, RS232Connection, TCPConnection; CAN is our addition (ruling 13).

The asynchronous connection of drivers wraps this stream: `test_Connection_is_what_an_opened_wire_reads_from`.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from spec_rig import rig
from support import run

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import PROTOCOL, CANConnection, Connection, RS232Connection, TCPConnection
from fieldtwin.gateway.core.device import wire
from fieldtwin.gateway.core.errors import Bug

BYTES: list[type[Connection[bytes]]] = [RS232Connection, TCPConnection]


def test_Connection_is_abstract() -> None:
    with pytest.raises(Bug, match="abstract"):
        Connection()


@pytest.mark.parametrize("kind", [*BYTES, CANConnection])
def test_Connection_after_Init_has_an_empty_stream_and_nothing_can_be_read(kind: type[Connection[bytes]]) -> None:
    connection = kind()
    assert len(connection.data_stream) == 0
    with pytest.raises(Bug, match="empty"):
        connection.read()


@pytest.mark.parametrize("kind", BYTES)
@given(before=st.lists(st.binary(max_size=4), max_size=6), value=st.binary(max_size=4))
def test_Connection_Write_appends(kind: type[Connection[bytes]], before: list[bytes], value: bytes) -> None:
    connection = kind()
    for item in before:
        connection.write(item)
    connection.write(value)
    assert list(connection.data_stream) == [*before, value]


@pytest.mark.parametrize("kind", BYTES)
@given(stream=st.lists(st.binary(max_size=4), min_size=1, max_size=6))
def test_Connection_Read_takes_the_head(kind: type[Connection[bytes]], stream: list[bytes]) -> None:
    connection = kind()
    for item in stream:
        connection.write(item)
    assert connection.read() == stream[0]
    assert list(connection.data_stream) == stream[1:]


@pytest.mark.parametrize("kind", BYTES)
@given(steps=st.lists(st.none() | st.binary(max_size=4)))
def test_Connection_loses_and_changes_nothing(kind: type[Connection[bytes]], steps: list[bytes | None]) -> None:
    connection = kind()
    written: list[bytes] = []
    read: list[bytes] = []
    for step in steps:
        if step is not None:
            connection.write(step)
            written.append(step)
        elif len(read) < len(written):
            read.append(connection.read())
    while len(read) < len(written):
        read.append(connection.read())
    assert read == written


@given(there=st.lists(st.binary(max_size=4)), back=st.lists(st.binary(max_size=4)))
def test_Connection_is_a_duplex_medium_with_two_ends(there: list[bytes], back: list[bytes]) -> None:
    """Ruling 4: device and driver each hold an end; neither reads its own output."""
    one, other = wire(RS232Connection)
    for item in there:
        one.write(item)
    for item in back:
        other.write(item)
    assert [other.read() for _ in there] == there
    assert [one.read() for _ in back] == back
    for end in (one, other):
        with pytest.raises(Bug):
            end.read()


def test_Connection_is_what_an_opened_wire_reads_from(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            for name, kind in (("ctd", RS232Connection), ("modem", TCPConnection)):
                connection = r.drivers[name].connection
                assert isinstance(connection.inbound, kind)
                assert connection.type is kind.type
                assert not connection.inbound.data_stream

    run(main())


@pytest.mark.parametrize(
    ("kind", "protocol"), [(RS232Connection, PROTOCOL.RS232), (TCPConnection, PROTOCOL.TCP)], ids=["RS232", "TCP"]
)
@given(steps=st.lists(st.binary(max_size=4)))
def test_RS232Connection_and_TCPConnection_have_their_type_invariantly(
    kind: type[Connection[bytes]], protocol: PROTOCOL, steps: list[bytes]
) -> None:
    connection = kind()
    assert connection.type is protocol
    for step in steps:
        connection.write(step)
        assert connection.type is protocol
        connection.read()
        assert connection.type is protocol


def test_CANConnection_is_a_third_kind_that_carries_frames() -> None:
    """Ruling 13."""
    connection = CANConnection()
    assert connection.type is PROTOCOL.CAN
    frames = [CanFrame(0x185, b"\x01"), CanFrame(0x185, b"\x01")]
    for frame in frames:
        connection.write(frame)
    assert [connection.read(), connection.read()] == frames
