"""Several tasks that send on one end of the software bus while its transmit queue is full: none overtakes another."""

from __future__ import annotations

import asyncio

import pytest

from fieldtwin.emulators.endpoints.can.bus_runner import BusRunner
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost

ENDPOINT = Endpoint.parse("can:fieldtwin/127.0.0.1:1")
FRAMES = 6


def test_senders_that_wait_for_room_keep_their_order() -> None:
    async def main() -> None:
        runner = BusRunner(125_000, queue_frames=1)
        sender, listener = runner.attach(ENDPOINT, "sender"), runner.attach(ENDPOINT, "listener")
        senders = [asyncio.ensure_future(sender.send(CanFrame(0x100 + n))) for n in range(FRAMES)]
        heard = [(await listener.recv()).can_id]
        await sender.send(CanFrame(0x001))  # there is room now, and others wait for it
        heard += [(await listener.recv()).can_id for _ in range(FRAMES)]
        await asyncio.gather(*senders)
        assert heard == [*range(0x100, 0x100 + FRAMES), 0x001]
        # Each attempt at a full queue is counted once.
        assert runner.stats()["nodes"][0]["refused"] == FRAMES

    VirtualLoop().run_until_complete(main())


def test_senders_that_wait_for_room_learn_that_the_end_was_closed() -> None:
    async def main() -> None:
        runner = BusRunner(125_000, queue_frames=1)
        sender = runner.attach(ENDPOINT, "sender")
        senders = [asyncio.ensure_future(sender.send(CanFrame(n))) for n in range(3)]
        await asyncio.sleep(0)
        await sender.aclose()
        assert [type(e) for e in await asyncio.gather(*senders, return_exceptions=True)] == [
            type(None),
            ConnectionLost,
            ConnectionLost,
        ]
        with pytest.raises(ConnectionLost):
            await sender.send(CanFrame(0))

    VirtualLoop().run_until_complete(main())
