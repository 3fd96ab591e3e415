"""Addresses of `check modbus`: hexadecimal numbers are accepted, and cells named by `--write` are tried when the tables
are probed.

Defect: `--read holding:0x163` was refused, and MB-036c and MB-049 were skipped with "it has no such table" although
`--write coil:500` named a coil.
"""

from __future__ import annotations

import pytest
from devices_in_memory import on_modbus

from fieldtwin.cli.test.check_device_command import _cell
from fieldtwin.conformance.core.case import CasePlan
from fieldtwin.conformance.devices.modbus.session import ModbusOptions, check_modbus
from fieldtwin.emulators.endpoints.memory_ports import MemoryNet
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.gateway.core.errors import UsageError


@pytest.mark.parametrize(
    ("text", "cell"),
    [
        ("holding:0x163", ("holding", 0x163, 1)), ("coil:0XFFFF", ("coil", 0xFFFF, 1)), ("holding:355+2", ("holding", 355, 2)),
        ("input:0x10+16", ("input", 16, 16)),
    ],
)  # fmt: skip
def test_addresses_are_decimal_or_hexadecimal(text: str, cell: tuple[str, int, int]) -> None:
    assert _cell(text) == cell


@pytest.mark.parametrize(
    "text", ["holding:0x", "holding:0x10000", "holding:0xFFFF+2", "holding:163h", "holding:65536", "coil:1+0"]
)
def test_an_invalid_address_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(UsageError, match="0x163"):
        _cell(text)


def test_cases_of_bits_run_on_the_writable_coil() -> None:
    unit = ModbusUnit(MapBank([CellSpan("holding", 0, 10), CellSpan("coil", 500, 8)]))

    async def use(net: MemoryNet, url: str, clock: VirtualClock) -> dict[str, str]:
        plan = CasePlan(frozenset({"MB-036c", "MB-049"}), has=frozenset({"coil"}))
        options = ModbusOptions(url, 1, plan, may_write={"coil": (500, 1)}, connector=net, clock=clock)
        return {r.case.id: r.verdict.value for r in (await check_modbus(options)).results}

    found = on_modbus("tcp://127.0.0.1:0", use, unit)
    assert {id: found[id] for id in ("MB-036c", "MB-049")} == {"MB-036c": "passed", "MB-049": "passed"}
