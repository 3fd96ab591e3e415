"""`shutdown()` of the python-can interface while another thread is in `recv`.

Defect: if a program shut the bus down before it stopped its Notifier, the Notifier's thread raised a CanOperationError.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable

import can
import pytest
from support import eventually, run

from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.gateway.connections.soft_bus import SoftBus
from fieldtwin.gateway.core.endpoint import Endpoint


def on_a_bus(use: Callable[[SoftBus, SoftBus], None]) -> None:
    """Call `use` in a thread, with two interfaces on one bus."""

    async def main() -> None:
        server = await SoftBusServer.open(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), 125_000, paced=False)
        host, port = server.bound.address
        try:
            one, other = [await asyncio.to_thread(SoftBus, f"{host}:{port}") for _ in range(2)]
            await asyncio.to_thread(use, one, other)
            await asyncio.to_thread(other.shutdown)
        finally:
            await server.aclose()

    run(main(), timeout_s=60)


@pytest.mark.parametrize("timeout", [0.0, 0.05, 0.5])
def test_a_notifier_whose_bus_is_shut_down_first_ends_without_an_error(
    timeout: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    uncaught: list[threading.ExceptHookArgs] = []
    monkeypatch.setattr(threading, "excepthook", uncaught.append)

    def use(one: SoftBus, other: SoftBus) -> None:
        heard = threading.Event()
        notifier = can.Notifier(one, [lambda message: heard.set()], timeout=timeout)
        other.send(can.Message(arbitration_id=0x123, is_extended_id=False))
        assert heard.wait(30)
        one.shutdown()
        notifier.stop()
        assert notifier.exception is None

    on_a_bus(use)
    assert uncaught == []


def test_recv_without_a_timeout_returns_none_when_its_bus_is_shut_down() -> None:
    def use(one: SoftBus, other: SoftBus) -> None:
        got: list[can.Message | Exception | None] = []
        first = threading.Event()

        def receive() -> None:
            try:
                got.append(one.recv(None))
                first.set()
                got.append(one.recv(None))
            except Exception as e:
                got.append(e)

        receiver = threading.Thread(target=receive)
        receiver.start()
        other.send(can.Message(arbitration_id=0x123, is_extended_id=False))
        assert first.wait(30)
        one.shutdown()
        receiver.join(30)
        assert not receiver.is_alive()
        assert got[1:] == [None]

    on_a_bus(use)


def test_a_bus_that_closes_is_still_an_error() -> None:
    async def main() -> None:
        server = await SoftBusServer.open(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), 125_000, paced=False)
        host, port = server.bound.address
        one = await asyncio.to_thread(SoftBus, f"{host}:{port}")
        receiving = asyncio.ensure_future(asyncio.to_thread(one.recv, 30.0))
        await eventually(lambda: len(server.bus_stats()["nodes"]) == 1)
        await server.aclose()
        with pytest.raises(can.CanOperationError, match="closed"):
            await receiving
        await asyncio.to_thread(one.shutdown)

    run(main())
