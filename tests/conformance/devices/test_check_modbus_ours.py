"""Our emulated devices pass every Modbus case that applies to their wire, on each kind of wire."""

from __future__ import annotations

import pytest
from devices_in_memory import on_modbus

from fieldtwin.conformance.core.case import CasePlan, Impact
from fieldtwin.conformance.devices.device_case import DeviceResult
from fieldtwin.conformance.devices.modbus.session import ModbusOptions, check_modbus
from fieldtwin.emulators.endpoints.memory_ports import MemoryNet
from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.results.model import Verdict

ALL = CasePlan(at_most=Impact.DISRUPT, has=frozenset({"holding", "coil", "i-know"}))
WIRES = (
    "rtu:/virtual/line?baudrate=19200&frame=8E1",
    "ascii:/virtual/line?baudrate=9600&frame=7E1",
    "tcp://127.0.0.1:0",
    "rtu+tcp://127.0.0.1:0",
    "udp://127.0.0.1:0",
)


def check(url: str, plan: CasePlan = ALL, at: int = 1) -> list[DeviceResult]:
    async def use(net: MemoryNet, url: str, clock: VirtualClock) -> list[DeviceResult]:
        options = ModbusOptions(
            url, at, plan, may_write={"holding": (190, 10), "coil": (3, 1)}, connector=net, clock=clock
        )  # fmt: skip
        return (await check_modbus(options)).results

    return on_modbus(url, use, at=at)


@pytest.mark.parametrize("url", WIRES)
def test_our_emulated_devices_pass_all_cases(url: str) -> None:
    results = check(url)
    for r in results:
        print(r.case.id, r.verdict.value, r.reason)
    assert [(r.case.id, r.reason) for r in results if r.verdict not in (Verdict.PASSED, Verdict.SKIPPED)] == []
    skipped = {r.case.id: r.reason for r in results if r.verdict is Verdict.SKIPPED}
    assert set(skipped.values()) <= {"not on this kind of bus"}
