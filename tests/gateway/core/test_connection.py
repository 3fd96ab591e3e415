"""The pure stream of the paper's Connection, and the asynchronous end around it."""

from __future__ import annotations

import asyncio
from collections import deque

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import run

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import (
    PROTOCOL,
    ByteConnection,
    CANConnection,
    CanConnection,
    Connection,
    RS232Connection,
    TCPConnection,
    closed_locally,
)
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Bug, ConnectionLost, DeviceRefused, ModbusExceptionReply

ENDPOINT = Endpoint.parse("tcp://h:1")


def test_the_abstract_connection_cannot_be_made() -> None:
    with pytest.raises(Bug):
        Connection()


@pytest.mark.parametrize(
    ("made", "protocol"),
    [(RS232Connection, PROTOCOL.RS232), (TCPConnection, PROTOCOL.TCP), (CANConnection, PROTOCOL.CAN)],
)
def test_type_and_empty_stream_after_init(made: type[Connection[bytes]], protocol: PROTOCOL) -> None:
    connection = made()
    assert connection.type is protocol
    assert not connection.data_stream
    with pytest.raises(Bug, match="empty connection"):
        connection.read()


@given(st.lists(st.none() | st.binary(max_size=4)))
def test_a_stream_is_a_fifo(steps: list[bytes | None]) -> None:
    connection, model = RS232Connection(), deque[bytes]()
    for step in steps:
        if step is not None:
            connection.write(step)
            model.append(step)
        elif model:
            assert connection.read() == model.popleft()
    assert connection.data_stream == model


class End(ByteConnection):
    """An end whose medium is the test."""

    def __init__(self, max_pending: int = 3) -> None:
        super().__init__(TCPConnection(), ENDPOINT, max_pending)
        self.rooms = 0

    def on_room(self) -> None:
        self.rooms += 1

    async def write(self, data: bytes) -> None:
        self.feed(data)

    async def aclose(self) -> None:
        self.feed_lost(closed_locally(self.endpoint))


def test_the_end_reports_when_it_is_full_and_when_there_is_room() -> None:
    async def main() -> None:
        end = End()
        assert [end.feed(b"1"), end.feed(b"2"), end.feed(b"3")] == [True, True, False]
        assert await end.read() == b"1"
        assert end.read_pending() == b"23"
        assert end.read_pending() == b""
        assert end.rooms == 2

    run(main())


def test_a_reader_waits_and_a_second_one_is_a_bug() -> None:
    async def main() -> None:
        end = End()
        reading = asyncio.create_task(end.read())
        await asyncio.sleep(0)
        with pytest.raises(Bug, match="two readers"):
            await end.read()
        end.feed(b"x")
        assert await reading == b"x"

    run(main())


def test_a_reader_that_is_cancelled_loses_nothing() -> None:
    async def main() -> None:
        end = End()
        reading = asyncio.create_task(end.read())
        await asyncio.sleep(0)
        end.feed(b"x")
        reading.cancel()
        with pytest.raises(asyncio.CancelledError):
            await reading
        assert await end.read() == b"x"

    run(main())


def test_a_read_with_a_timeout_returns_the_received_bytes_or_nothing() -> None:
    async def main() -> None:
        end = End()
        end.feed(b"here")
        assert await end.read_within(0.0) == b"here", "what is there needs no time"
        assert await end.read_within(0.001) == b""
        asyncio.get_running_loop().call_later(0.001, end.feed, b"later")
        assert await end.read_within(5.0) == b"later"
        assert end.rooms == 2
        reading = asyncio.create_task(end.read_within(5.0))
        await asyncio.sleep(0)
        with pytest.raises(Bug, match="two readers"):
            await end.read_within(5.0)
        end.feed_lost(ConnectionLost("cable pulled"))
        with pytest.raises(ConnectionLost, match="cable pulled"):
            await reading
        with pytest.raises(ConnectionLost, match="cable pulled"):
            await end.read_within(5.0)

    run(main())


def test_received_bytes_are_read_before_the_loss_and_the_first_reason_stays() -> None:
    async def main() -> None:
        end = End()
        end.feed(b"last")
        end.feed_lost(ConnectionLost("cable pulled"))
        await end.aclose()
        assert await end.read() == b"last"
        with pytest.raises(ConnectionLost, match="cable pulled"):
            await end.read()

    run(main())


def test_each_raise_of_the_loss_is_a_separate_error() -> None:
    """Adding the place of an error must not change the same error for other readers of the loss."""

    async def main() -> None:
        end = End()
        end.feed_lost(ConnectionLost("gone", where="line1", hint="plug it in"))
        for _ in range(3):
            with pytest.raises(ConnectionLost) as caught:
                await end.read()
            assert str(caught.value.at("ctd")) == "ctd: line1: gone (plug it in)"
        assert end.lost is not None
        assert end.lost.where == "line1"
        other = End()
        other.feed_lost(ModbusExceptionReply(3, 2))  # a class with its own arguments
        with pytest.raises(DeviceRefused, match="illegal data address"):
            await other.read()

    run(main())


def test_an_observer_is_notified_at_arrival() -> None:
    async def main() -> None:
        end, seen = End(), []
        end.feed(b"before")
        end.on_arrival = seen.append
        end.feed(b"after")
        assert seen == [b"after"]
        assert end.read_pending() == b"beforeafter"

    run(main())


class Node(CanConnection):
    """A bus end whose medium is the test."""

    def __init__(self) -> None:
        super().__init__(CANConnection(), Endpoint.parse("can:socketcan/can0"), max_pending=2)

    async def send(self, frame: CanFrame) -> None:
        self.feed(frame)

    async def aclose(self) -> None:
        self.feed_lost(closed_locally(self.endpoint))


def test_a_slow_reader_of_a_bus_loses_the_newest_frames_counted_and_unseen_by_observers() -> None:
    async def main() -> None:
        node, seen = Node(), []
        node.on_arrival = seen.append
        frames = [CanFrame(n) for n in range(4)]
        for frame in frames:
            node.feed(frame)
        assert node.overruns == 2
        assert seen == frames[:2]
        assert [await node.recv(), await node.recv()] == frames[:2]
        await node.aclose()
        with pytest.raises(ConnectionLost, match="closed on this side"):
            await node.recv()

    run(main())
