"""The Modbus client over an in-memory wire: timing, quarantine, broadcast, cancellation, loss, counters."""

from __future__ import annotations

import asyncio
from itertools import pairwise

import pytest
from modbus_client_rig import CLOCK, LINE, RTU, Device, answering, wire, with_client
from support import eventually

from fieldtwin.gateway.core.endpoint import Endpoint, SerialSettings
from fieldtwin.gateway.core.errors import (
    ConnectionLost,
    CrcError,
    Desync,
    FieldtwinError,
    ModbusExceptionReply,
    ReplyTimeout,
    UsageError,
    VerifyFailed,
)
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.protocols.modbus.frames.selection import Framing


def test_a_read_over_rtu() -> None:
    async def scenario(client: ModbusClient, device: Device) -> None:
        answering(device, 0x1234)
        before = CLOCK.monotonic_ns()
        reply = await client.read_registers(1, "holding", 0, 1)
        assert reply.registers == (0x1234,)
        assert reply.raw == b"\x12\x34"
        assert before < reply.t_ns <= CLOCK.monotonic_ns()
        assert device.requests[0][1] == bytes.fromhex("01 03 00 00 00 01 84 0a")
        assert (client.counters.requests, client.counters.replies) == (1, 1)

    with_client(scenario)


def test_every_helper_sends_its_function_and_takes_its_reply() -> None:
    replies = {
        1: "01 01 01 05", 2: "01 02 01 02", 3: "01 03 02 00 2a", 4: "01 04 02 00 2b", 5: "01 05 00 07 ff 00",
        6: "01 06 00 07 00 09", 15: "01 0f 00 00 00 03", 16: "01 10 00 00 00 02", 22: "01 16 00 04 00 f2 00 25",
        23: "01 17 02 00 2c",
    }  # fmt: skip

    async def scenario(client: ModbusClient, device: Device) -> None:
        async def answer(request: bytes) -> None:
            await device.send_frame(replies[request[1]])

        device.answer = answer
        assert (await client.read_bits(1, "coil", 0, 3)).bits == (True, False, True)
        assert (await client.read_bits(1, "discrete", 0, 2)).bits == (False, True)
        assert (await client.read_registers(1, "holding", 0, 1)).registers == (42,)
        assert (await client.read_registers(1, "input", 0, 1)).registers == (43,)
        assert (await client.write_coil(1, 7, True)).acknowledged
        assert (await client.write_register(1, 7, 9)).acknowledged
        assert (await client.write_coils(1, 0, [True, False, True])).acknowledged
        assert (await client.write_registers(1, 0, [1, 2])).acknowledged
        assert (await client.mask_write(1, 4, 0xF2, 0x25)).acknowledged
        assert (await client.read_write_registers(1, 0, 1, 5, [6])).registers == (44,)
        assert [r[1] for _, r in device.requests] == [1, 2, 3, 4, 5, 6, 15, 16, 22, 23]

    with_client(scenario)


@pytest.mark.parametrize(("serial", "silence_s"), [(LINE, 0.0020), (SerialSettings(1200, "8N1"), 0.0291), (None, 0.0)])
def test_requests_keep_t35_after_a_reply(serial: SerialSettings | None, silence_s: float) -> None:
    async def scenario(client: ModbusClient, device: Device) -> None:
        answering(device, 1, 2, 3, 4)
        replied = [(await client.read_registers(1, "holding", 0, 1)).t_ns for _ in range(4)]
        for reply_ns, (request_ns, _) in zip(replied, device.requests[1:], strict=False):
            assert request_ns - reply_ns >= silence_s * 1e9

    with_client(scenario, serial=serial)


def test_above_19200_the_silence_is_fixed() -> None:
    async def scenario(client: ModbusClient, device: Device) -> None:
        answering(device, 1, 2)
        reply = await client.read_registers(1, "holding", 0, 1)
        await client.read_registers(1, "holding", 0, 1)
        assert device.requests[1][0] - reply.t_ns >= 1_750_000

    with_client(scenario, serial=SerialSettings(115200, "8E1"))


def test_the_deadline_counts_from_the_end_of_transmission() -> None:
    async def scenario(client: ModbusClient, _: Device) -> None:
        start = CLOCK.monotonic_ns()
        with pytest.raises(ReplyTimeout, match=r"rtu:/dev/ttyS9.*unit 1"):
            await client.read_registers(1, "holding", 0, 1)
        waited_s = (CLOCK.monotonic_ns() - start) / 1e9
        assert waited_s >= 0.06 + 8 * 10 / 1200  # eight characters of ten bits

    with_client(scenario, serial=SerialSettings(1200, "8N1"))


def test_mb_026_a_broadcast_write_expects_no_reply_but_leaves_time_to_execute() -> None:
    async def scenario(client: ModbusClient, device: Device) -> None:
        reply = await client.write_registers(0, 0, [7])
        assert not reply.acknowledged
        answering(device, 7)
        await client.read_registers(1, "holding", 0, 1)
        (broadcast_ns, frame), (next_ns, _) = device.requests
        assert frame[0] == 0
        assert 100e6 <= next_ns - broadcast_ns <= 400e6
        assert client.counters.broadcasts == 1

    with_client(scenario)


def test_mb_027_a_broadcast_read_is_refused_locally() -> None:
    async def scenario(client: ModbusClient, device: Device) -> None:
        with pytest.raises(UsageError, match="broadcast"):
            await client.read_registers(0, "holding", 0, 1)
        with pytest.raises(UsageError, match="broadcast"):
            await client.read_write_registers(0, 0, 1, 0, [1])
        with pytest.raises(UsageError, match="unit id"):
            await client.read_registers(256, "holding", 0, 1)
        await asyncio.sleep(0)
        assert not device.requests
        assert client.counters.requests == 0

    with_client(scenario)


def test_unit_0_on_tcp_is_a_unit_like_any_other() -> None:
    async def scenario(client: ModbusClient, device: Device) -> None:
        async def answer(request: bytes) -> None:
            await device.send(f"{request[:2].hex()} 0000 0005 00 03 02 0008")

        device.answer = answer
        assert (await client.read_registers(0, "holding", 0, 1)).registers == (8,)

    with_client(scenario, framing="mbap")


def test_many_callers_are_served_one_at_a_time() -> None:
    async def scenario(client: ModbusClient, device: Device) -> None:
        async def answer(request: bytes) -> None:
            assert len(request) == 12, "two requests in flight"
            await device.send(f"{request[:2].hex()} 0000 0005 01 03 02 {request[8:10].hex()}")

        device.answer = answer
        replies = await asyncio.gather(*(client.read_registers(1, "holding", a, 1) for a in range(50)))
        assert [r.registers[0] for r in replies] == list(range(50))
        assert all(a.t_ns <= b.t_ns for a, b in pairwise(replies))

    with_client(scenario, framing="mbap")


@pytest.mark.parametrize(
    ("frame", "error", "counter"),
    [
        ("01 83 02", ModbusExceptionReply, "exceptions"),
        ("01 04 02 00 00", Desync, "desyncs"),
        ("01 03 02 00 00 00 00", CrcError, "crc_errors"),
    ],
)
def test_errors_are_counted_and_name_their_place(frame: str, error: type[FieldtwinError], counter: str) -> None:
    async def scenario(client: ModbusClient, device: Device) -> None:
        async def answer(_: bytes) -> None:
            await device.send(frame) if error is CrcError else await device.send_frame(frame)

        device.answer = answer
        with pytest.raises(error) as caught:
            await client.read_registers(1, "holding", 0, 1)
        assert str(caught.value).startswith(f"{RTU}: unit 1: ")
        assert getattr(client.counters, counter) == 1
        answering(device, 6)
        assert (await client.read_registers(1, "holding", 0, 1)).registers == (6,)

    with_client(scenario)


def test_mb_019_verify_failed_is_counted() -> None:
    async def scenario(client: ModbusClient, device: Device) -> None:
        async def answer(_: bytes) -> None:
            await device.send_frame("01 06 00 01 00 04")

        device.answer = answer
        with pytest.raises(VerifyFailed):
            await client.write_register(1, 1, 3)
        assert client.counters.verify_failures == 1

    with_client(scenario)


@pytest.mark.parametrize("framing", ["rtu", "mbap"])
def test_a_lost_connection_ends_the_exchange_and_the_client(framing: Framing) -> None:
    async def scenario(client: ModbusClient, device: Device) -> None:
        asking = asyncio.create_task(client.read_registers(1, "holding", 0, 1, timeout_s=5.0))
        waiting = asyncio.create_task(client.read_registers(1, "holding", 0, 1, timeout_s=5.0))
        await eventually(lambda: len(device.requests) == 1)
        await device.end.aclose()
        for task in (asking, waiting):
            with pytest.raises(ConnectionLost):
                await task
        assert client.closed
        with pytest.raises(ConnectionLost):
            await client.write_register(1, 0, 0)
        assert client.counters.abandoned == 1

    with_client(scenario, framing=framing)


def test_a_closed_client_reports_it() -> None:
    async def scenario(client: ModbusClient, device: Device) -> None:
        assert not client.closed
        asking = asyncio.create_task(client.read_registers(1, "holding", 0, 1, timeout_s=5.0))
        await eventually(lambda: len(device.requests) == 1)
        await client.aclose()
        await client.aclose()
        assert client.closed
        with pytest.raises(ConnectionLost):
            await asking
        with pytest.raises(ConnectionLost, match="this side"):
            await client.read_registers(1, "holding", 0, 1)

    with_client(scenario)


def test_an_identification_is_read_to_its_end() -> None:
    replies = ["01 2b 0e 01 01 ff 01 01 00 02 41 42", "01 2b 0e 01 01 00 00 02 01 01 43 02 01 44"]

    async def scenario(client: ModbusClient, device: Device) -> None:
        async def answer(_: bytes) -> None:
            await device.send_frame(replies[len(device.requests) - 1])

        device.answer = answer
        assert await client.read_identification(1) == {0: b"AB", 1: b"C", 2: b"D"}
        assert [frame[1:5].hex() for _, frame in device.requests] == ["2b0e0100", "2b0e0101"]

    with_client(scenario)


def test_an_identification_that_goes_round_in_circles_ends() -> None:
    async def scenario(client: ModbusClient, device: Device) -> None:
        async def answer(_: bytes) -> None:
            await device.send_frame("01 2b 0e 01 01 ff 01 01 00 02 41 42")

        device.answer = answer
        with pytest.raises(Desync, match="repeats objects"):
            await client.read_identification(1)
        assert len(device.requests) == 2

    with_client(scenario)


@pytest.mark.parametrize(
    ("url", "settings", "says"),
    [
        ("tcp://h:502", {"echo": True}, "echoes"),
        ("tls://h:802", {"strict": True}, "silences"),
        ("ascii:/dev/x", {"strict": True}, "silences"),
        ("rtu+tcp://h:1", {"strict": True}, "baud rate"),
        ("rtu:/dev/x", {"accepts_zero_id": True}, "transaction ids"),
        ("rtu:/dev/x", {"turnaround_s": 0.0}, "out of range"),
        ("can:socketcan/can0", {}, "does not carry Modbus"),
    ],
)
def test_a_setting_that_a_wire_lacks_cannot_be_set(url: str, settings: dict[str, bool], says: str) -> None:
    near, _ = wire("rtu")
    with pytest.raises(UsageError, match=says):
        ModbusClient.at(Endpoint.parse(url), near, CLOCK, **settings)  # type: ignore[arg-type]


def test_bad_settings_are_refused() -> None:
    near, _ = wire("rtu")
    with pytest.raises(UsageError, match="timeout"):
        ModbusClient(near, CLOCK, framing="rtu", timeout_s=0.0)
    with pytest.raises(UsageError, match="strict"):
        ModbusClient(near, CLOCK, framing="rtu", strict=True)
    with pytest.raises(UsageError, match="framing"):
        ModbusClient(near, CLOCK, framing="xml")  # type: ignore[arg-type]
