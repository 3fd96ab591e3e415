"""A live wire for the commissioning commands: opened by its URL, logged, closed on exit."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest
from support import eventually, run

from fieldtwin.commissioning.access.connection import canopen_at, frame_of, modbus_at
from fieldtwin.commissioning.access.frame_log import FrameLog
from fieldtwin.emulators.endpoints.modbus_server import serve_mbap
from fieldtwin.emulators.endpoints.socket_end import SocketListener
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.connection import ByteConnection, Direction
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FileInvalid, Unreachable, UsageError
from fieldtwin.gateway.protocols.modbus.requests.data import ReadRegisters
from fieldtwin.gateway.wallclock import WallClock


def test_a_request_is_in_the_log_when_the_reply_arrives(tmp_path: Path) -> None:
    async def main() -> None:
        gone = asyncio.Event()
        bank = MapBank([CellSpan("holding", 0, 10)])
        bank.poke("holding", 2, 7)

        async def serve(connection: ByteConnection) -> None:
            try:
                await serve_mbap(connection, MbapServer({1: ModbusUnit(bank)}), WallClock())
            finally:
                gone.set()

        listener = await SocketListener.open(Endpoint.parse("tcp://127.0.0.1:0"), serve)
        try:
            with FrameLog(tmp_path / "sent.jsonl", "fieldtwin read") as log:
                async with modbus_at(str(listener.bound), taps=[log]) as client:
                    reply = await client.read_registers(1, "holding", 2, 1)
                    assert list(reply.registers) == [7]
                    lines = [json.loads(line) for line in log.path.read_text("ascii").splitlines()]
                assert log.sent == 1
            assert lines[0]["command"] == "fieldtwin read"
            assert [(line["direction"], line["hex"]) for line in lines[1:]] == [
                ("sent", "000100000006010300020001"),
                ("received", "0001000000050103020007"),
            ]
            await eventually(gone.is_set, what="the server saw us go")
        finally:
            await listener.aclose()

    run(main())


def test_a_log_continues_and_reports_when_it_is_full(tmp_path: Path) -> None:
    path, endpoint = tmp_path / "sent.jsonl", Endpoint.parse("tcp://127.0.0.1:502")
    for _ in range(2):
        with FrameLog(path, "x", max_bytes=250) as log:
            for _ in range(4):
                log.on_bytes(endpoint, Direction.SENT, 0, bytes(20))
            assert log.full
            assert log.sent == 4
    lines = [json.loads(line) for line in path.read_text("ascii").splitlines()]
    assert [("started" in line) for line in lines].count(True) == 2
    assert len(lines) == 4  # whole lines only
    with pytest.raises(FileInvalid, match="log of sent frames"):
        FrameLog(tmp_path / "no" / "folder", "x")


def test_a_url_of_the_wrong_kind_is_a_users_error_and_a_missing_device_is_unreachable() -> None:
    async def main() -> None:
        with pytest.raises(UsageError, match="does not carry Modbus"):
            async with modbus_at("can:fieldtwin/127.0.0.1:1"):
                pass
        with pytest.raises(UsageError, match="CAN bus"):
            async with canopen_at("tcp://127.0.0.1:1"):
                pass
        with pytest.raises(Unreachable):
            async with modbus_at("tcp://127.0.0.1:1"):
                pass

    run(main())


def test_a_dry_run_shows_the_frame_of_the_wire() -> None:
    request = ReadRegisters("holding", 0, 2)
    assert frame_of("rtu:/dev/ttyUSB0", 1, request).hex() == "010300000002c40b"
    assert frame_of("ascii:/dev/ttyUSB0", 1, request) == b":010300000002FA\r\n"
    assert frame_of("tcp://h", 1, request).hex() == "000100000006010300000002"
