"""A request of the Modbus client never gets a reply meant for a different one: late, damaged, repeated and unsolicited
replies."""

from __future__ import annotations

import asyncio

import pytest
from modbus_client_rig import CLOCK, Device, answering, mbap_answer, register_frame, with_client
from support import eventually

from fieldtwin.gateway.core.errors import (
    CrcError,
    Desync,
    ReplyTimeout,
)
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.protocols.modbus.frames.selection import Framing


def test_mb_003_after_a_truncated_reply_the_next_request_is_clean() -> None:
    async def scenario(client: ModbusClient, device: Device) -> None:
        async def truncated(_: bytes) -> None:
            await device.send("01 03 02")

        device.answer = truncated
        with pytest.raises(ReplyTimeout, match="3 bytes"):
            await client.read_registers(1, "holding", 0, 1)
        answering(device, 5)
        assert (await client.read_registers(1, "holding", 0, 1)).registers == (5,)

    with_client(scenario)


def test_mb_012_mb_013_a_late_reply_is_never_given_to_the_next_request() -> None:
    async def scenario(client: ModbusClient, device: Device) -> None:
        with pytest.raises(ReplyTimeout):
            await client.read_registers(1, "holding", 0, 1)
        asked_ns = CLOCK.monotonic_ns()
        second = asyncio.create_task(client.read_registers(1, "holding", 0, 1))
        await asyncio.sleep(0)  # let it begin its quarantine
        answering(device, 0x2222)
        await device.send_frame(register_frame(0x1111))
        late_ns = CLOCK.monotonic_ns()
        assert (await second).registers == (0x2222,)
        assert client.counters.late_bytes == 7
        assert device.requests[1][0] - late_ns >= 60_000_000 > late_ns - asked_ns  # silent for the whole timeout

    with_client(scenario)


def test_mb_013_the_quarantine_learns_the_longest_latency() -> None:
    async def scenario(client: ModbusClient, device: Device) -> None:
        with pytest.raises(ReplyTimeout):
            await client.read_registers(1, "holding", 0, 1)
        sent_ns = device.requests[0][0]
        second = asyncio.create_task(client.read_registers(1, "holding", 0, 1, timeout_s=0.02))
        loop = asyncio.get_running_loop()
        sent = loop.create_future()
        loop.call_later(0.05, lambda: sent.set_result(None))
        await sent
        await device.send_frame(register_frame(0x1111))
        latency_ns = CLOCK.monotonic_ns() - sent_ns
        with pytest.raises(ReplyTimeout):
            await second
        quiet_ns = device.requests[1][0] - sent_ns - latency_ns
        assert quiet_ns >= latency_ns * 0.95  # the late reply took longer than the timeout
        timed_out_ns = CLOCK.monotonic_ns()
        answering(device, 3)
        assert (await client.read_registers(1, "holding", 0, 1)).registers == (3,)
        # This timeout was only 20 ms. Half of the latency is the limit, because a busy computer resumes this test late.
        assert device.requests[2][0] - timed_out_ns >= latency_ns * 0.5 > 20_000_000

    with_client(scenario)


def test_mb_014_a_duplicate_that_comes_between_requests_is_drained() -> None:
    async def scenario(client: ModbusClient, device: Device) -> None:
        answering(device, 1, 2)
        await client.read_registers(1, "holding", 0, 1)
        await device.send_frame(register_frame(1))
        assert (await client.read_registers(1, "holding", 0, 1)).registers == (2,)
        assert client.counters.late_bytes == 7

    with_client(scenario)


def test_a_babbling_line_is_reported_and_nothing_is_sent() -> None:
    async def scenario(client: ModbusClient, device: Device) -> None:
        with pytest.raises(ReplyTimeout):
            await client.read_registers(1, "holding", 0, 1, timeout_s=0.005)

        async def babble() -> None:
            while True:
                await device.send("55")
                await asyncio.sleep(0.001)

        babbling = asyncio.create_task(babble())
        with pytest.raises(Desync, match="never silent"):
            await client.read_registers(1, "holding", 0, 1)
        babbling.cancel()
        await asyncio.gather(babbling, return_exceptions=True)
        assert len(device.requests) == 1
        silent_ns = CLOCK.monotonic_ns()
        answering(device, 1)
        assert (await client.read_registers(1, "holding", 0, 1)).registers == (1,)
        assert device.requests[1][0] - silent_ns < 400_000_000  # the babbling did not count as a latency

    with_client(scenario)


def test_mb_010_echo_over_the_wire() -> None:
    async def scenario(client: ModbusClient, device: Device) -> None:
        async def echo_and_answer(request: bytes) -> None:
            await device.end.write(request)
            if request[0]:
                await device.send_frame(register_frame(9))

        device.answer = echo_and_answer
        assert (await client.read_registers(1, "holding", 0, 1)).registers == (9,)
        await client.write_register(0, 1, 2)
        assert (await client.read_registers(1, "holding", 0, 1)).registers == (9,)
        assert client.counters.late_bytes == 0

    with_client(scenario, echo=True)


def test_mb_056_on_tcp_a_late_reply_is_discarded_without_quarantine() -> None:
    async def scenario(client: ModbusClient, device: Device) -> None:
        with pytest.raises(ReplyTimeout):
            await client.read_registers(1, "holding", 0, 1, timeout_s=0.02)
        await device.send("0001 0000 0005 01 03 02 dead")
        device.answer = mbap_answer(device)
        asked_ns = CLOCK.monotonic_ns()
        assert (await client.read_registers(1, "holding", 0, 1)).registers == (6,)
        assert device.requests[1][0] - asked_ns < 20_000_000
        assert client.counters.late_bytes == 11

    with_client(scenario, framing="mbap")


def test_mb_056_a_reply_that_came_before_its_request_is_no_reply() -> None:
    async def scenario(client: ModbusClient, device: Device) -> None:
        await device.send("0001 0000 0005 01 03 02 dead")
        with pytest.raises(ReplyTimeout):
            await client.read_registers(1, "holding", 0, 1, timeout_s=0.02)

    with_client(scenario, framing="mbap")


@pytest.mark.parametrize("framing", ["rtu", "mbap"])
def test_cancelling_never_pairs_a_reply_with_the_next_request(framing: Framing) -> None:
    async def scenario(client: ModbusClient, device: Device) -> None:
        first = asyncio.create_task(client.read_registers(1, "holding", 0, 1))
        await eventually(lambda: len(device.requests) == 1)
        first.cancel()
        with pytest.raises(asyncio.CancelledError):
            await first
        second = asyncio.create_task(client.read_registers(1, "holding", 0, 1))
        await asyncio.sleep(0)
        if framing == "rtu":
            answering(device, 0x2222)
            await device.send_frame(register_frame(0x1111))
            assert (await second).registers == (0x2222,)
        else:
            device.answer = mbap_answer(device)
            await device.send("0001 0000 0005 01 03 02 dead")
            assert (await second).registers == (6,)
        assert client.counters.abandoned == 1
        assert client.counters.late_bytes > 0

    with_client(scenario, framing=framing)


def test_cancelling_one_that_waits_for_its_turn_sends_nothing() -> None:
    async def scenario(client: ModbusClient, device: Device) -> None:
        first = asyncio.create_task(client.read_registers(1, "holding", 0, 1))
        second = asyncio.create_task(client.read_registers(1, "holding", 9, 1))
        await eventually(lambda: len(device.requests) == 1)
        second.cancel()
        await device.send_frame(register_frame(4))
        assert (await first).registers == (4,)
        with pytest.raises(asyncio.CancelledError):
            await second
        assert client.counters.requests == 1

    with_client(scenario)


def test_mb_002_the_rest_of_a_damaged_reply_does_not_reach_the_next_request() -> None:
    async def scenario(client: ModbusClient, device: Device) -> None:
        async def damaged(_: bytes) -> None:
            await device.send("01 03 02 00 00 00")

        device.answer = damaged
        first = asyncio.create_task(client.read_registers(1, "holding", 0, 1))
        await eventually(lambda: len(device.requests) == 1)
        await device.send("00 99 88 77")
        with pytest.raises(CrcError):
            await first
        damaged_ns = CLOCK.monotonic_ns()
        await device.send("66 55")
        answering(device, 6)
        assert (await client.read_registers(1, "holding", 0, 1)).registers == (6,)
        assert client.counters.late_bytes == 5
        assert device.requests[1][0] - damaged_ns >= 20_000_000  # as long as a USB adapter may delay the rest

    with_client(scenario)
