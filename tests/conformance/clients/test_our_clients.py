"""Our own clients pass every case for their wire; each exception is listed here with its reason."""

from __future__ import annotations

import asyncio
from functools import partial

import pytest
from clients_in_memory import (
    PERIOD_S,
    TIMEOUT_S,
    Publish,
    judge,
    judge_canopen,
    our_canopen,
    ours,
)

from fieldtwin.conformance.clients.modbus.cases import CASES
from fieldtwin.conformance.core.results import CaseResult
from fieldtwin.emulators.endpoints.memory_ports import MemoryNet
from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, FieldtwinError, WireError
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.results.model import Verdict

NOT_ITS_BUSINESS = {
    "MB-021": "poll period is not shorter than its timeout",
    "MB-025": "merges no reads",
}
"""A client does not decide what to read and when: splitting reads is the task of a driver."""
LINE = "rtu:/line?baudrate=19200"


def _unpassed(results: dict[str, CaseResult]) -> dict[str, str]:
    return {
        id: f"{r.verdict.value}: {r.reason}"
        for id, r in results.items()
        if r.verdict not in (Verdict.PASSED, Verdict.SKIPPED) and id not in NOT_ITS_BUSINESS
    }


@pytest.mark.parametrize(
    ("url", "passed"),
    [
        (LINE, 26),
        ("ascii:/line?baudrate=19200&frame=7E1", 20),
        ("tcp://127.0.0.1:0", 29),
        ("rtu+tcp://127.0.0.1:0", 28),
    ],
    ids=["rtu", "ascii", "tcp", "rtu over tcp"],
)
def test_our_modbus_client_bears_every_hostile_device(url: str, passed: int) -> None:
    results = judge(ours, url)
    assert _unpassed(results) == {}
    assert sum(r.verdict is Verdict.PASSED for r in results.values()) >= passed
    assert len(results) == len(CASES)


async def _prompt(net: MemoryNet, endpoint: Endpoint, clock: VirtualClock, publish: Publish) -> None:
    """Read two different ranges, write occasionally, check one echo; send the next request as soon as an answer
    arrives."""
    client = ModbusClient.at(endpoint, await net.open_bytes(endpoint), clock, timeout_s=TIMEOUT_S)
    count = 0
    while True:
        count += 1
        try:
            reply = await client.read_registers(17, "holding", 107, 2)
            publish(str(reply.registers[0]))
            reply = await client.read_registers(17, "holding", 300, 4)
            publish(str(reply.registers[0]))
            if count % 2:
                await _write(client)
        except ConnectionLost:
            raise
        except FieldtwinError:
            pass
        await asyncio.sleep(0.02)


async def _write(client: ModbusClient) -> None:
    try:
        await client.write_register(17, 7, 42)
    except WireError:
        pass
    except FieldtwinError:
        await client.write_register(17, 7, 42)


def test_a_prompt_client_with_several_requests_takes_part_in_the_rest() -> None:
    results = judge(_prompt, LINE, "MB-012", "MB-013", "MB-019", "MB-021", "MB-024")
    found = {id: (r.verdict, r.reason) for id, r in results.items()}
    assert found["MB-012"][0] is Verdict.PASSED, found
    assert found["MB-013"][0] is Verdict.PASSED, found
    assert found["MB-019"] == (Verdict.PASSED, "it wrote again")
    assert found["MB-021"][0] is Verdict.PASSED, found


def test_our_canopen_master_bears_every_hostile_node() -> None:
    results = judge_canopen(our_canopen)
    assert _unpassed(results) == {}
    assert sum(r.verdict is Verdict.PASSED for r in results.values()) >= 32


def test_our_block_uploads_bear_lost_segments_and_wrong_check_sums() -> None:
    results = judge_canopen(partial(our_canopen, block=True), "CO-015", "CO-016", "CO-017", "CO-021")
    assert {id: r.verdict for id, r in results.items() if r.verdict is not Verdict.SKIPPED} == dict.fromkeys(
        ("CO-015", "CO-016", "CO-017", "CO-021"), Verdict.PASSED
    )


def test_our_block_downloads_tolerate_the_behaviour_of_nodes() -> None:
    cases = ("CO-014a", "CO-014b", "CO-015b", "CO-016b")
    results = judge_canopen(partial(our_canopen, download=True), *cases)
    assert {id: (r.verdict, r.reason) for id, r in results.items()} == dict.fromkeys(cases, (Verdict.PASSED, ""))


def test_without_a_probe_cases_about_values_are_skipped_with_the_reason() -> None:
    results = judge(ours, LINE, "MB-002", "MB-020", "MB-022", "MB-013", probed=False)
    assert results["MB-002"].verdict is Verdict.SKIPPED
    assert "--probe" in results["MB-002"].reason
    assert results["MB-020"].verdict is Verdict.SKIPPED
    assert results["MB-022"].verdict is Verdict.PASSED
    assert "its published values were not observed" in results["MB-022"].reason
    assert results["MB-013"].verdict is Verdict.PASSED, "that it quarantines shows on the wire"


def test_period_leaves_room_for_the_timeout() -> None:
    assert PERIOD_S > TIMEOUT_S
