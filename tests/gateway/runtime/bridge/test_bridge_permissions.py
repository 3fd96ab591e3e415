"""Permissions of a bridge's clients: units, functions, addresses, networks; and their audit records."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from bridge_rig import ANY_PORT, WRITERS, read_adu, rig, take
from support import run

from fieldtwin.gateway.core.errors import ConnectionLost
from fieldtwin.gateway.runtime.bridge.bridge import BridgeConfig, Route
from fieldtwin.gateway.runtime.bridge.policy import AllowRule, Policy, network


def test_an_allow_list_of_units_functions_and_addresses(tmp_path: Path) -> None:
    rules = (
        AllowRule(units=frozenset({1}), addresses={"holding": ((0, 9), (20, 29))}),
        AllowRule(units=frozenset({2}), functions=frozenset({3, 6})),
    )

    async def main() -> None:
        config = BridgeConfig("b", ANY_PORT, to="line", policy=Policy(rules, allow_writes=True))
        async with rig(tmp_path, config) as r, r.raw() as raw:

            async def code(unit: int, pdu: str) -> int:
                data = bytes.fromhex(pdu)
                await raw.write(bytes.fromhex("0001 0000") + (len(data) + 1).to_bytes(2) + bytes([unit]) + data)
                head = await take(raw, 9)
                if head[7] & 0x80:
                    return head[8]
                rest = int.from_bytes(head[4:6]) + 6 - len(head)
                await take(raw, rest)
                return 0

            assert await code(1, "03 0000 000A") == 0
            assert await code(1, "03 0009 0002") == 2  # half in, half out
            assert await code(1, "03 0014 0001") == 0
            assert await code(1, "01 0000 0001") == 2  # a table that is not named
            assert await code(1, "11") == 1  # a function without addresses
            assert await code(1, "06 0000 0001") == 1
            assert await code(2, "06 0000 0007") == 0
            assert await code(2, "10 0000 0001 02 0001") == 1
            assert await code(3, "03 0000 0001") == 0x0A
            assert r.bridge.counters.refused == 6

    run(main())


def test_clients_of_other_networks_are_turned_away(tmp_path: Path) -> None:
    async def main() -> None:
        policy = Policy((AllowRule(networks=(network("10.1.0.0/16"),)),))
        async with rig(tmp_path, BridgeConfig("b", ANY_PORT, to="line", policy=policy)) as r, r.raw() as raw:
            with pytest.raises(ConnectionLost):
                await take(raw, 1)
            assert r.bridge.status().counters["turned_away"] == 1

    run(main())


def test_writes_are_on_record_and_so_are_refusals(tmp_path: Path) -> None:
    async def main() -> None:
        config = BridgeConfig("b", ANY_PORT, to="line", policy=WRITERS)
        async with rig(tmp_path, config) as r, r.client() as client:
            await client.write_register(1, 4, 77)
            assert r.units[1].bank.read("holding", 4, 1, 0) == [77]
            asked, done = r.audit
            assert (asked["result"], done["result"]) == ("asked", "done")
            assert asked["by"].startswith("127.0.0.1:")
            assert (asked["device"], asked["pdu"]) == ("line/1", "060004004d")
        (tmp_path / "b").mkdir()
        config = replace(config, policy=Policy((AllowRule(functions=frozenset({6})),), allow_writes=False))
        async with rig(tmp_path / "b", config) as r, r.raw() as raw:
            for _ in range(5):
                await raw.write(bytes.fromhex("0001 0000 0006 01 06 0004 0001"))
                assert (await take(raw, 9))[-1] == 1
            assert [e["action"] for e in r.audit] == ["refuse"]  # one a second per client
            assert r.heard == []

    run(main())


def test_a_write_that_cannot_be_recorded_does_not_happen(tmp_path: Path) -> None:
    async def main() -> None:
        (tmp_path / "audit.jsonl").symlink_to("/dev/full")
        config = BridgeConfig("b", ANY_PORT, to="line", policy=WRITERS)
        async with rig(tmp_path, config) as r, r.raw() as raw:
            await raw.write(bytes.fromhex("0001 0000 0006 01 06 0004 0001"))
            assert await take(raw, 9) == bytes.fromhex("0001 0000 0003 01 86 04")
            assert r.heard == []

    run(main())


def test_the_wrong_device_is_not_written_to(tmp_path: Path) -> None:
    async def main() -> None:
        config = BridgeConfig("b", ANY_PORT, to="line", policy=WRITERS)
        async with rig(tmp_path, config, blocked=lambda bus, unit: "another device" if unit == 1 else "") as r:
            async with r.raw() as raw:
                await raw.write(bytes.fromhex("0001 0000 0006 01 06 0004 0001"))
                assert (await take(raw, 9))[-1] == 0x0A
                await raw.write(read_adu(2, 1, 4, 1))
                assert (await take(raw, 11))[-2:] == (104).to_bytes(2)
            assert r.audit[-1]["result"] == "another device"

    run(main())


def adu(unit: int, pdu: str) -> bytes:
    data = bytes.fromhex(pdu)
    return bytes.fromhex("0001 0000") + (len(data) + 1).to_bytes(2) + bytes([unit]) + data


@pytest.mark.parametrize(
    ("unit", "pdu", "code", "device", "why"),
    [
        (7, "06 0004 0001", 0x0A, "b/7", "the bridge has no route for this unit ID"),
        (1, "10 0004 0002 02 0001", 3, "line/1", "exception 03h"),
        (2, "06 0004 0001", 0x0B, "line/99", "the unit did not answer, and is not asked for some seconds"),
    ],
)
def test_a_write_that_the_bridge_answers_itself_is_recorded(
    tmp_path: Path, unit: int, pdu: str, code: int, device: str, why: str
) -> None:
    async def main() -> None:
        routes = {1: Route("line", 1), 2: Route("line", 99)}
        async with rig(tmp_path, BridgeConfig("b", ANY_PORT, routes=routes, policy=WRITERS)) as r, r.raw() as raw:
            if unit == 2:
                await raw.write(read_adu(1, 2, 4, 1))
                assert (await take(raw, 9))[-1] == 0x0B
            await raw.write(adu(unit, pdu))
            assert (await take(raw, 9))[-1] == code
            (entry,) = r.audit
            assert (entry["action"], entry["device"], entry["result"]) == ("refuse", device, why)
            assert entry["pdu"] == pdu.replace(" ", "").lower()

    run(main())


@pytest.mark.parametrize("unit", [1, 0], ids=["unit", "broadcast"])
def test_a_write_to_a_line_that_is_away_is_on_record(tmp_path: Path, unit: int) -> None:
    async def main() -> None:
        config = BridgeConfig("b", ANY_PORT, to="line", policy=WRITERS, broadcast=True, answer_broadcast=True)
        async with rig(tmp_path, config) as r, r.raw() as raw:
            await r.unplug()
            await raw.write(adu(unit, "06 0004 0001"))
            assert (await take(raw, 9))[-1] == 0x0A
            (entry,) = r.audit
            assert (entry["action"], entry["device"]) == ("refuse", f"line/{unit}")
            assert str(tmp_path / "line") in entry["result"]

    run(main())


def test_reads_that_are_refused_are_not_in_the_audit_log(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path, BridgeConfig("b", ANY_PORT, routes={1: Route("line", 1)})) as r, r.raw() as raw:
            await raw.write(read_adu(1, 7, 4, 1))
            assert (await take(raw, 9))[-1] == 0x0A
            assert r.audit == []

    run(main())
