"""A scan explains possible causes of a mismatched reply on this kind of wire, once for all units that gave it.

Defect: with pymodbus 3.9.2, which answers for an absent unit ID as unit 0 with function 80h and code 0B, a scan of TCP printed
245 lines of "two devices with one id, or a bad line".
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest
from commissioning_rig import loop, run_virtually
from modbus_virtual import VirtualWire

from fieldtwin.cli.device.scan_view import modbus_json, show_modbus, unit_ranges
from fieldtwin.commissioning.scan.modbus import ModbusScan, ModbusScanner, ScanOptions
from fieldtwin.commissioning.scan.odd_replies import OddReply
from fieldtwin.gateway.core.connection import ByteConnection, CanConnection
from fieldtwin.gateway.core.endpoint import Endpoint, SerialSettings

Absent = bytes | Callable[[int], bytes]


class Server:
    """A connector to a TCP server that has unit 1 only; `absent` is the body (unit and PDU) of its reply for any other unit,
    or returns it for a unit.
    """

    def __init__(self, absent: Absent) -> None:
        self.absent = absent

    async def open_bytes(self, endpoint: Endpoint) -> ByteConnection:
        def answer(data: bytes) -> None:
            body = (
                b"\x01\x03\x02\x00\x07"
                if data[6] == 1
                else self.absent
                if isinstance(self.absent, bytes)
                else self.absent(data[6])
            )
            frame = data[:4] + len(body).to_bytes(2) + body
            asyncio.get_running_loop().call_later(0.005, wire.feed, frame)

        wire = VirtualWire(endpoint, answer)
        return wire

    async def open_can(self, endpoint: Endpoint, bitrate: int) -> CanConnection:
        raise AssertionError


def scan(absent: Absent, units: tuple[int, ...] | None = None) -> ModbusScan:
    async def main() -> ModbusScan:
        scanner = ModbusScanner("tcp://192.0.2.1:502", ScanOptions(units=units), connector=Server(absent), clock=loop())
        return await scanner.run()

    return run_virtually(main())


def test_the_same_reply_of_many_units_is_one_line_whose_advice_fits_tcp(capsys: pytest.CaptureFixture[str]) -> None:
    found = scan(b"\x00\x80\x0b")
    assert [f.answer.unit for f in found.units] == [1]
    assert len(found.damaged) == 1
    assert len(found.damaged[0].units) > 240
    show_modbus(found)
    lines = [line for line in capsys.readouterr().err.splitlines() if "does not match" in line]
    assert len(lines) == 1
    assert "units (0, 2-247, 255): a reply that does not match the request (80 0B): exception 0B" in lines[0]
    assert "some servers answer this for unit IDs that they do not have" in lines[0]
    assert "two devices" not in lines[0]
    assert "bad line" not in lines[0]
    listed = modbus_json(found)["damaged"]
    assert listed[0] == {"settings": None, "unit": 0, "reply": "800b"}
    assert len(listed) == len(found.damaged[0].units)


def test_a_reply_with_the_transaction_id_of_the_question_ends_the_wait_for_that_unit() -> None:
    """Defect: each of 247 such units cost two timeouts of 1 s, so that a scan that announced 4 minutes took 8."""
    found = scan(b"\x00\x80\x0b")
    assert found.took_s < found.asked / ScanOptions().per_s + 5
    assert found.asked > 480, "each unit was asked twice"


def test_different_replies_are_different_findings() -> None:
    first = scan(b"\x00\x80\x0b", (1, 2, 3)).damaged
    other = scan(b"\x00\x04\x02\x00\x00", (1, 2, 3)).damaged
    assert [(o.units, o.pdu) for o in first + other] == [((2, 3), b"\x80\x0b"), ((2, 3), b"\x04\x02\0\0")]
    assert "exception" not in other[0].advice


def test_the_advice_fits_the_wire() -> None:
    line = SerialSettings()
    assert OddReply((2,), line, b"").advice == "damaged each time: two devices with the same unit ID, or a bad line"
    assert "two devices with the same unit ID" in OddReply((2,), line, b"\x80\x0b").advice
    assert (
        OddReply((2,), None, b"").advice
        == "not a Modbus frame: another protocol or framing at this port, or a faulty server"
    )


def test_ranges_of_units() -> None:
    assert unit_ranges([0, 2, 3, 4, 247, 255]) == "0, 2-4, 247, 255"
    assert unit_ranges([]) == ""


def test_units_that_give_the_same_exception_share_a_row(capsys: pytest.CaptureFixture[str]) -> None:
    """Defect: a server that answers exception 04h for each unit ID that it does not have filled 246 rows."""

    def answer(unit: int) -> bytes:
        return bytes((unit,)) + (b"\x03\x02\x00\x07" if unit == 1 else b"\x83\x04")

    show_modbus(scan(answer, (1, 2, 3)))
    rows = [line.split("  ")[0].strip() for line in capsys.readouterr().out.splitlines()[1:]]
    assert rows == ["1", "2", "3"], "a few units have rows of their own"
    show_modbus(scan(answer))
    captured = capsys.readouterr()
    rows = [line.split("  ")[0].strip() for line in captured.out.splitlines()[1:]]
    assert rows == ["1", "0, 2-247, 255"], captured.out
    assert "exception 04h" in captured.out
    assert len([line for line in captured.err.splitlines() if "04h" in line]) == 1
