"""Each case for Modbus devices can fail: one wrong answer fails exactly the case for it, and careless devices fail
their cases."""

from __future__ import annotations

import pytest
import wrong_devices as wrong
from devices_in_memory import on_modbus

from fieldtwin.conformance.core.case import CasePlan, Impact
from fieldtwin.conformance.devices.device_case import DeviceResult
from fieldtwin.conformance.devices.modbus.session import ModbusOptions, check_modbus
from fieldtwin.emulators.endpoints.memory_ports import MemoryNet
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.results.model import Verdict

HAS = frozenset({"holding", "coil", "i-know"})


def check(url: str, unit: ModbusUnit | None = None, serve: wrong.Serve | None = None) -> list[DeviceResult]:
    async def use(net: MemoryNet, url: str, clock: VirtualClock) -> list[DeviceResult]:
        options = ModbusOptions(
            url, 1, CasePlan(at_most=Impact.DISRUPT, has=HAS), may_write={"holding": (190, 10), "coil": (3, 1)},
            connector=net, clock=clock,
        )  # fmt: skip
        return (await check_modbus(options)).results

    return on_modbus(url, use, unit, serve=serve)


def failed(results: list[DeviceResult]) -> set[str]:
    return {r.case.id for r in results if r.verdict is Verdict.FAILED}


def count(pdu: bytes) -> int:
    return int.from_bytes(pdu[3:5])


TWISTS: dict[str, wrong.Twist] = {
    "MB-033a": wrong.instead(0x64, b"\xe4\x04"),
    "MB-033b": wrong.instead(0x41, None),
    "MB-034": wrong.swallow_after(0x64),
    "MB-035": wrong.alternating(0x83, [b"\x83\x01", None]),
    "MB-036a": wrong.instead(0x03, b"\x03\x00", where=lambda pdu: count(pdu) == 0),
    "MB-036b": wrong.instead(0x03, b"\x83\x02", where=lambda pdu: count(pdu) == 126 and pdu[1] == 0),
    "MB-036c": wrong.instead(0x01, b"\x81\x04", where=lambda pdu: count(pdu) == 2001),
    "MB-036d": wrong.instead(0x10, b"\x10\x00\xbe\x00\x00", where=lambda pdu: len(pdu) == 6),
    "MB-037": wrong.instead(0x03, b"\x83\x03", where=lambda pdu: pdu[1:] == b"\xff\xff\x00\x02"),
    "MB-038": wrong.instead(0x03, b"\x83\x04", where=lambda pdu: pdu[1:] == b"\xff\xff\x00\x7e"),
    "MB-039a": wrong.written("coil", lambda pdu: 1, 0x05, lambda pdu: pdu[3:] == b"\x00\x01"),
    "MB-039b": wrong.instead(0x05, b"\x05\x00\x03\xff\x01", where=lambda pdu: pdu[3:] == b"\xff\x01"),
    "MB-040a": wrong.written(
        "holding", lambda pdu: int.from_bytes(pdu[6:8]), 0x10, lambda pdu: pdu[5] == 4 and len(pdu) == 10
    ),
    "MB-040c": wrong.written(
        "holding", lambda pdu: int.from_bytes(pdu[6:8]), 0x10, lambda pdu: pdu[4:6] == b"\x01\x02"
    ),
    "MB-040d": wrong.instead(0x10, b"\x10\x00\xbe\x00\x01", where=lambda pdu: pdu[5] == 4 and len(pdu) == 8),
    "MB-040e": wrong.instead(0x10, b"\x10\x00\xbe\x00\x00", where=lambda pdu: count(pdu) == 0 and len(pdu) == 8),
    "MB-040b": wrong.written("coil", lambda pdu: pdu[6] & 1, 0x0F, lambda pdu: True),
    "MB-041": wrong.written("holding", lambda pdu: int.from_bytes(pdu[6:8]), 0x10, lambda pdu: count(pdu) == 11),
    "MB-042a": wrong.old_value_of_fc23,
    "MB-042b": wrong.written("holding", lambda pdu: int.from_bytes(pdu[10:12]), 0x17, lambda pdu: count(pdu) == 126),
    "MB-043": wrong.written("holding", lambda pdu: 0x12, 0x16, lambda pdu: True),
    "MB-044": wrong.instead(0x18, b"\x18\x00\x06\x00\x01\x01\xb8\x12\x84"),
    "MB-045a": wrong.instead(0x2B, b"\x2b\x0e\x01\x82\x00\x00\x01\x00\x01A", where=lambda pdu: pdu[2] == 1),
    "MB-045b": wrong.instead(0x2B, b"\x2b\x0e\x02\x82\xff\x01\x01\x01\x01A", where=lambda pdu: pdu[2:] == b"\x02\x04"),
    "MB-045c": wrong.instead(0x2B, b"\xab\x03", where=lambda pdu: pdu[2:] == b"\x04\x7f"),
    "MB-045d": wrong.instead(0x2B, b"\xab\x02", where=lambda pdu: pdu[2] == 7),
    "MB-046": wrong.instead(0x08, b"\x08\x00\x04\x00\x00", where=lambda pdu: pdu[2] == 4),
    "MB-047": wrong.instead(0x08, b"\x08\x00\x0e\x00\x00", where=lambda pdu: pdu[2] == 0x0E),
    "MB-049": wrong.instead(0x01, b"\x01\x01\xf8", where=lambda pdu: count(pdu) == 3),
    "MB-050a": wrong.instead(0x08, None, where=lambda pdu: len(pdu) > 100),
}
"""The failing case, and the behaviour of the device that fails it."""


@pytest.mark.parametrize("case_id", TWISTS)
def test_a_wrong_answer_fails_the_case_for_it(case_id: str) -> None:
    results = check("rtu:/virtual/line?baudrate=19200&frame=8E1", wrong.twisted(TWISTS[case_id]))
    assert failed(results) == {case_id}


def test_a_careless_device_on_a_line_fails_the_cases() -> None:
    found = failed(check("rtu:/virtual/line?baudrate=19200&frame=8E1", serve=wrong.careless_rtu))
    assert found >= {"MB-001", "MB-004", "MB-008a", "MB-008b", "MB-009", "MB-027", "MB-029", "MB-068", "MB-069"}


def test_a_careless_ascii_line() -> None:
    found = failed(check("ascii:/virtual/line?baudrate=9600&frame=7E1", serve=wrong.careless_ascii))
    assert found >= {"MB-026", "MB-027", "MB-029", "MB-070a", "MB-070b", "MB-070c", "MB-070e", "MB-070f"}


def test_a_careless_tcp_server_fails_the_cases() -> None:
    found = failed(check("tcp://127.0.0.1:0", serve=wrong.careless_tcp))
    assert found >= {"MB-051", "MB-052", "MB-053", "MB-054", "MB-055c", "MB-056a", "MB-057a", "MB-057b"}
