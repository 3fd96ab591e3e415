"""Plant safety of checks: impact levels limit what a check sends, it asks first, it restores values, and `--dry-run`
sends nothing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from devices_in_memory import make_unit, on_modbus

from fieldtwin.cli.test.check_command import command
from fieldtwin.conformance.core.case import CasePlan, Impact
from fieldtwin.conformance.devices.device_case import DeviceResult
from fieldtwin.conformance.devices.dry_run import canopen_dry_run, modbus_dry_run
from fieldtwin.conformance.devices.modbus.cases import CASES
from fieldtwin.conformance.devices.modbus.connection import READS, WRITES, DeviceConnection
from fieldtwin.conformance.devices.modbus.session import ModbusOptions, check_modbus
from fieldtwin.emulators.endpoints.memory_ports import MemoryNet
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.gateway.core.connection import ByteConnection
from fieldtwin.gateway.core.errors import Bug, NotAllowed, Unreachable, UsageError
from fieldtwin.results.model import Verdict

URL = "tcp://127.0.0.1:0"


class Listening(ModbusUnit):
    """Record every request."""

    def __init__(self) -> None:
        self.__dict__.update(make_unit().__dict__)
        self.asked: list[bytes] = []

    def respond(self, pdu: bytes, now_ns: int) -> bytes | None:
        self.asked.append(pdu)
        return super().respond(pdu, now_ns)


def check(unit: ModbusUnit, plan: CasePlan, url: str = URL, **options: Any) -> list[DeviceResult]:
    async def use(net: MemoryNet, url: str, clock: VirtualClock) -> list[DeviceResult]:
        to_do = ModbusOptions(url, 1, plan, connector=net, clock=clock, **options)
        return (await check_modbus(to_do)).results

    return on_modbus(url, use, unit)


@pytest.mark.parametrize(
    "url", ["rtu:/virtual/line?baudrate=19200&frame=8E1", "ascii:/virtual/line?baudrate=9600&frame=7E1", URL]
)
def test_without_permission_only_reads_are_sent(url: str) -> None:
    unit = Listening()
    before = bytes(unit.bank.peek("holding", at) & 0xFF for at in range(200))  # type: ignore[attr-defined]
    results = check(unit, CasePlan(), url)
    assert len(unit.asked) > 20
    assert {pdu[0] for pdu in unit.asked} <= READS
    assert before == bytes(unit.bank.peek("holding", at) & 0xFF for at in range(200))  # type: ignore[attr-defined]
    assert all(not r.spoken for r in results if r.case.impact.rank > Impact.READ.rank)


def test_with_write_permission_only_the_given_cells_change_and_are_restored() -> None:
    unit = Listening()
    unit.bank.poke("holding", 199, 4711)  # type: ignore[attr-defined]
    unit.bank.poke("coil", 3, 1)  # type: ignore[attr-defined]
    held = [unit.bank.peek("holding", at) for at in range(200)]  # type: ignore[attr-defined]
    plan = CasePlan(at_most=Impact.WRITE, has=frozenset({"holding", "coil"}))
    results = check(unit, plan, may_write={"holding": (199, 1), "coil": (3, 1)})
    assert {pdu[0] for pdu in unit.asked} <= READS | WRITES
    aimed = {pdu[1:3] for pdu in unit.asked if pdu[0] in WRITES}
    assert aimed == {(199).to_bytes(2), (3).to_bytes(2)}
    assert [unit.bank.peek("holding", at) for at in range(200)] == held  # type: ignore[attr-defined]
    assert unit.bank.peek("coil", 3) == 1  # type: ignore[attr-defined]
    assert all(r.verdict is Verdict.PASSED for r in results if r.case.impact is Impact.WRITE)


def test_a_wire_refuses_requests_above_the_impact_level() -> None:
    async def never() -> Any:
        raise AssertionError

    async def use(net: MemoryNet, url: str, clock: VirtualClock) -> None:
        wire = DeviceConnection(never, clock, "mbap", 1)
        for pdu in (b"\x06\0\0\0\0", b"\x2b\x0d\0", b"\x08\0\0\0\0", b"\x64", b"\x83\0\0\0\x01"):
            with pytest.raises(Bug):
                await wire.ask(pdu)
        wire.impact = Impact.WRITE
        with pytest.raises(Bug):
            await wire.ask(b"\x08\0\0\0\0")

    on_modbus(URL, use)


def test_a_missing_device_is_unreachable() -> None:
    async def use(net: MemoryNet, url: str, clock: VirtualClock) -> None:
        with pytest.raises(Unreachable, match="unit 7"):
            await check_modbus(ModbusOptions(url, 7, CasePlan(), connector=net, clock=clock))

    on_modbus("rtu:/virtual/line?baudrate=19200&frame=8E1", use)


def test_nothing_is_sent_on_a_line_with_foreign_traffic() -> None:
    asked: list[bytes] = []

    async def chatter(end: ByteConnection) -> None:
        """A client that sends a request every 0.3 s, and a passive listener."""
        while True:
            asked.append(await end.read_within(0.3))
            await end.write(bytes.fromhex("05 03 00 00 00 01 85 8E"))

    async def use(net: MemoryNet, url: str, clock: VirtualClock) -> None:
        options = ModbusOptions(url, 1, CasePlan(), connector=net, clock=clock)
        with pytest.raises(NotAllowed, match="--share-bus"):
            await check_modbus(options)

    on_modbus("rtu:/virtual/line?baudrate=19200&frame=8N1", use, serve=chatter)
    assert set(asked) == {b""}


def test_a_rate_is_kept() -> None:
    async def use(net: MemoryNet, url: str, clock: VirtualClock) -> float:
        began_ns = clock.monotonic_ns()
        checked = await check_modbus(ModbusOptions(url, 1, CasePlan(), spacing_s=0.5, connector=net, clock=clock))
        sent = len(checked.before) // 2
        assert sent > 5
        return (clock.monotonic_ns() - began_ns) / 1e9 - 0.5 * sent

    assert on_modbus(URL, use) > 0


# -- the command -------------------------------------------------------------------------------------------------------


def fieldtwin(*words: str) -> Result:
    return CliRunner().invoke(command, list(words), standalone_mode=False)


def test_writes_and_disruptions_need_confirmation() -> None:
    for words in (["--write", "holding:1"], ["--allow", "disrupt"]):
        result = fieldtwin("modbus", "tcp://127.0.0.1:1", *words)
        assert isinstance(result.exception, NotAllowed), words
    # the user is not asked before reads
    assert isinstance(fieldtwin("modbus", "tcp://127.0.0.1:1").exception, Unreachable)


@pytest.mark.parametrize(
    "words",
    [
        ["modbus"],
        ["modbus", "can:socketcan/can0"],
        ["modbus", "tcp://h:1", "--write", "input:3"],
        ["modbus", "tcp://h:1", "--write", "holding:65536"],
        ["modbus", "tcp://h:1", "--write", "holding:3", "--allow", "read"],
        ["modbus", "tcp://h:1", "--only", "MB-999"],
        ["canopen", "can:socketcan/can0"],
        ["canopen", "tcp://h:1", "--node", "5"],
        ["canopen", "can:socketcan/can0", "--node", "5", "--write", "20"],
    ],
)
def test_invalid_options_are_usage_errors(words: list[str]) -> None:
    assert isinstance(fieldtwin(*words).exception, UsageError)


def test_a_dry_run_shows_every_case_that_would_run_and_opens_nothing() -> None:
    result = fieldtwin(
        "modbus", "rtu:/dev/no/such?baudrate=9600&frame=8N1", "--dry-run", "--json", "--write", "holding:7+3", "--write",
        "coil:1", "--allow", "disrupt", "--i-know",
    )  # fmt: skip
    shown = json.loads(result.output)["cases"]
    for_line = {c.id for c in CASES if not c.wires or "rtu-line" in c.wires}
    assert {c["id"] for c in shown} == for_line | {"before"}
    assert all(case["sent"] for case in shown)


@pytest.mark.parametrize("wire", ["ascii:/x", "tcp://h:1", "rtu+tcp://h:1", "udp://h:1"])
def test_a_dry_run_on_every_wire(wire: str) -> None:
    checked = modbus_dry_run(ModbusOptions(wire, 9, CasePlan()))
    assert [r.case.id for r in checked.results if r.verdict is Verdict.FAILED] == []


def test_a_dry_run_of_a_node(tmp_path: Path) -> None:
    from fieldtwin.conformance.devices.canopen.session import CanopenOptions

    plan = CasePlan(at_most=Impact.DISRUPT, has=frozenset({"object", "i-know"}))
    checked = canopen_dry_run(CanopenOptions("can:socketcan/can0", 5, plan, may_write=((0x2000, 0), (0x2100, 3))))
    assert [r.case.id for r in checked.results if r.verdict is Verdict.FAILED] == []
    assert sum(bool(r.spoken) for r in checked.results) > 30


def test_cases_are_listed_as_json() -> None:
    listed = json.loads(fieldtwin("modbus", "--list", "--json").output)
    assert {c["impact"] for c in listed} == {"read", "write", "disrupt"}
    assert len(json.loads(fieldtwin("canopen", "--list", "--json").output)) > 40
