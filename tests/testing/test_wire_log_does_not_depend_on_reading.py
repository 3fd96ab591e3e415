"""The wire log of a test does not depend on when the test reads it.

Defect: a read of the log 150 ms into a reply that was delayed by 300 ms turned one correct exchange into "no reply" and a
stray frame, permanently, because the log gave every request up after 50 ms. Stray frames were counted as requests.
"""

from __future__ import annotations

import asyncio
import socket
import struct
import time
from collections.abc import Iterator

import pytest
from device_rig import emulated, started_runner

from fieldtwin.capture.decoding.canopen_bus import CanopenBusDecoder
from fieldtwin.capture.decoding.exchange import DecodedExchange as Decoded
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.scenarios.judging.expectation import wire_matches
from fieldtwin.scenarios.language.form import Expect
from fieldtwin.testing.handles import DeviceHandle
from fieldtwin.testing.runner import WorkerProcess
from fieldtwin.testing.wire import Exchange

READ = struct.pack(">BHH", 4, 0, 2)
PATIENCE_S = 30.0


@pytest.fixture(scope="module")
def runner() -> Iterator[WorkerProcess]:
    with started_runner() as runner:
        yield runner


@pytest.fixture
def device(runner: WorkerProcess) -> Iterator[DeviceHandle]:
    with emulated(runner, "eastron-sdm630", on="tcp", values={"voltage_l1": 230.5}) as device:
        yield device


class Client:
    """A Modbus TCP client that sends and receives on request."""

    def __init__(self, device: DeviceHandle) -> None:
        self.unit = device.unit
        self.socket = socket.create_connection((device.host, device.port), PATIENCE_S)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *error: object) -> None:
        self.socket.close()

    def send(self, transaction: int) -> None:
        self.socket.sendall(struct.pack(">HHHB", transaction, 0, len(READ) + 1, self.unit) + READ)

    def receive(self) -> None:
        got = b""
        while len(got) < 13:
            got += self.socket.recv(13 - len(got))

    def ask(self, transaction: int) -> None:
        self.send(transaction)
        self.receive()


def seen(device: DeviceHandle, **like: object) -> list[Exchange]:
    """Return the traffic once there is any."""
    until = time.monotonic() + PATIENCE_S
    while not (found := device.wire.exchanges(**like)) and time.monotonic() < until:
        pass
    return found


def test_a_read_during_a_delayed_reply_shows_it_pending_and_changes_nothing(device: DeviceHandle) -> None:
    with Client(device) as client, device.fault("delay", by_ms=300):
        client.send(1)
        looks = [seen(device)[0].problem]
        while looks[-1] == "pending":
            looks += [e.problem for e in device.wire.exchanges(strays=True)]
        assert set(looks) == {"pending", ""}
        client.receive()
        (whole,) = device.wire.exchanges(strays=True)
    assert (whole.problem, whole.tags["voltage_l1"], whole.transaction) == ("", 230.5, 1)
    assert whole.latency_ms is not None
    assert whole.latency_ms >= 300


def test_expect_waits_for_a_pending_reply(device: DeviceHandle) -> None:
    with Client(device) as client, device.fault("delay", by_ms=200):
        client.send(1)
        (whole,) = device.wire.expect(function=4, within_s=PATIENCE_S)
    assert whole.tags["voltage_l1"] == 230.5


def test_a_request_has_no_reply_at_the_end_of_the_wait_or_of_the_connection(device: DeviceHandle) -> None:
    with Client(device) as client, device.fault("silence"):
        client.send(1)
        assert seen(device)[0].problem == "pending"
        assert len(device.wire.expect(problem="no reply", within_s=0.1)) == 1
        assert device.wire.count(problem="no reply") == 0
    assert [e.problem for e in seen(device, problem="no reply")] == ["no reply"]


def test_a_stray_frame_is_shown_and_is_not_a_request(device: DeviceHandle) -> None:
    with Client(device) as client, device.fault("duplicate"):
        client.ask(7)
        client.receive()
        (stray,) = device.wire.expect(problem="stray", within_s=PATIENCE_S)
    assert stray.transaction == 7
    assert stray.unit == device.unit
    assert f"transaction 7, unit {device.unit}" in str(stray)
    assert stray.reply.hex(" ") in str(stray)
    assert device.wire.count(function=4) == device.wire.count() == 1
    assert len(device.wire.exchanges(strays=True)) == 2


def test_exchanges_are_in_the_order_of_their_requests(device: DeviceHandle) -> None:
    with Client(device) as first, Client(device) as second:
        with device.fault("silence"):
            first.send(1)
            seen(device)
        second.ask(2)
        assert [e.transaction for e in device.wire.exchanges()] == [1, 2]
        first.ask(3)
        assert [e.transaction for e in device.wire.exchanges()] == [1, 2, 3]
    assert [e.problem for e in device.wire.exchanges()] == ["no reply", "", ""]


def test_exchanges_pending_before_clear_do_not_return(device: DeviceHandle) -> None:
    with Client(device) as client, device.fault("delay", by_ms=200):
        client.send(1)
        seen(device)
        device.wire.clear()
        client.receive()
        assert device.wire.exchanges() == []
        client.ask(2)
    assert [e.transaction for e in device.wire.exchanges()] == [2]


def test_expect_takes_bounds(device: DeviceHandle) -> None:
    with Client(device) as client:
        for transaction in (1, 2, 3):
            client.ask(transaction)
    assert len(device.wire.expect(at_least=2, function=4)) == 3
    assert len(device.wire.expect(at_least=1, at_most=3, within_s=0.1)) == 3
    with pytest.raises(AssertionError, match=r"expected at most 2 exchange\(s\) with function=4; got 3"):
        device.wire.expect(at_most=2, function=4)
    with pytest.raises(AssertionError, match=r"expected at least 4 exchange\(s\); got 3"):
        device.wire.expect(at_least=4, within_s=0.1)
    with pytest.raises(TypeError, match="times is exact"):
        device.wire.expect(2, at_most=3)


def test_an_asynchronous_driver_can_be_awaited_during_expect(device: DeviceHandle) -> None:
    async def drive() -> None:
        reader, writer = await asyncio.open_connection(device.host, device.port)
        writer.write(struct.pack(">HHHB", 1, 0, len(READ) + 1, device.unit) + READ)
        await reader.readexactly(13)
        writer.close()

    async def test() -> list[Exchange]:
        expected = asyncio.create_task(device.wire.expect_async(function=4, within_s=PATIENCE_S))
        await asyncio.sleep(0)
        await drive()  # a wait that blocks the loop would keep the driver from sending
        return await expected

    assert [e.problem for e in asyncio.run(test())] == [""]


def test_an_sdo_transfer_that_is_read_between_its_segments_stays_complete() -> None:
    wire = CanopenBusDecoder("can0", [])
    frames = [
        (0x605, "4000200000000000"), (0x585, "410020000a000000"), (0x605, "6000000000000000"),
        (0x585, "0031323334353637"), (0x605, "7000000000000000"), (0x585, "1938393000000000"),
    ]  # fmt: skip
    done: list[Decoded] = []
    for t_ns, (number, data) in enumerate(frames):
        done += wire.feed(CanFrame(number, bytes.fromhex(data)), t_ns)[1]
        waiting = wire.pending()
        assert [e.problem for e in waiting] == ([] if done else ["pending"])
    assert [(e.problem, e.value) for e in done] == [("", b"1234567890".hex())]


def test_a_scenario_does_not_count_a_stray_frame_as_a_request() -> None:
    stray = Decoded(0, 0, "bus", "ctd", 1, 4, "stray", problem="stray")
    asked = Decoded(0, 0, "bus", "ctd", 1, 4, "read input registers")
    form = Expect(wire="ctd", function=4)
    assert wire_matches(form, asked)
    assert not wire_matches(form, stray)
