"""All 70 cases of the list of Modbus edge cases: each has a row, run in three ways, and a mutation that it catches.

A row is in tests/vectors (bytes and times) or is a test named ``test_mb_NNN_...``, if the case is about sockets, ports or
several clients. `scripts/mutate` proves that the mutations are caught.
"""

from __future__ import annotations

import re
import tomllib
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest

TESTS = Path(__file__).parents[3]
CASES = [f"MB-{number:03}" for number in range(1, 71)]
MUTATIONS = ("modbus_client", "modbus_server", "modbus_gateway", "gateway_bridge")
WIRES_ONLY = {58, 59, 60, 61, 62, 63, 65, 66, 67, 28}
"""Gateways with several clients, connection limits, ports: named tests, not rows of bytes."""
NO_GARBAGE = {
    27: "nothing is sent and nothing comes",
    46: "nothing comes",
    64: "the connection ends in the middle of a frame",
}
"""Cases of the client without a row followed by garbage. (068, the wrong baud rate, consists of garbage.)"""


def toml(name: str) -> Any:
    return tomllib.loads((TESTS / f"{name}.toml").read_text())


SERVER: list[dict[str, Any]] = toml("vectors/modbus_server")["vector"]
CLIENT: list[dict[str, Any]] = toml("vectors/modbus_client_rows")["row"]
REPLIES: list[dict[str, Any]] = toml("vectors/modbus_client")["vector"]
GATEWAY: list[dict[str, Any]] = toml("vectors/modbus_gateway")["row"]


def named_tests() -> set[str]:
    """The cases with a test named after them."""
    texts = (path.read_text() for path in TESTS.rglob("test_*.py"))
    return {f"MB-{number}" for text in texts for number in re.findall(r"^def test_mb_(\d{3})_", text, re.MULTILINE)}


NAMED = named_tests()
ROWS = {row["id"][:6] for row in SERVER} | {row["case"] for row in CLIENT} | {row["case"] for row in GATEWAY}


def test_rows_name_cases() -> None:
    ids = {row["id"][:6] for row in REPLIES if row["id"].startswith("MB-")}
    assert ROWS | NAMED | ids <= set(CASES)


@pytest.mark.parametrize("case", CASES)
def test_each_case_has_a_row(case: str) -> None:
    assert case in ROWS | NAMED
    if int(case[3:]) not in WIRES_ONLY:
        assert case in ROWS


@pytest.mark.parametrize("case", CASES)
def test_each_case_has_a_mutation(case: str) -> None:
    assert case in {mutation["case"] for name in MUTATIONS for mutation in toml(f"mutations/{name}")["mutation"]}


def test_each_row_of_bytes_runs_in_three_ways() -> None:
    """All rows run whole. At least one row of each case runs byte by byte and with trailing garbage."""
    bytewise, garbage = defaultdict[str, bool](bool), defaultdict[str, bool](bool)
    for row in SERVER:
        bytewise[row["id"][:6]] |= not row.get("whole_only", False)
        garbage[row["id"][:6]] |= row.get("tail", True) and not row.get("closed", False)
    assert [case for case, played in bytewise.items() if not played] == ["MB-053"]  # one byte is always valid
    assert all(garbage.values())
    bytewise.clear()
    garbage.clear()
    for row in CLIENT:
        bytewise[row["case"]] |= row.get("bytewise", True)
        garbage[row["case"]] |= any(ask.get("tail", True) and bool(ask.get("arrives")) for ask in row["ask"])
    assert all(bytewise.values())
    assert {int(case[3:]) for case, played in garbage.items() if not played} == {*NO_GARBAGE, 68}


def test_mutations_name_existing_rows() -> None:
    """A renamed row would leave its mutation without a test."""
    ways = ("whole", "bytewise", "garbage")
    there = {
        "tests/emulators/modbus/test_server_vectors.py": {row["id"] for row in SERVER},
        "tests/gateway/protocols/modbus/test_modbus_vectors.py": {row["id"] for row in REPLIES},
        "tests/gateway/protocols/modbus/test_modbus_client_rows.py": {
            f"{r['case']} {r['title']}-{way}" for r in CLIENT for way in ways
        },
        "tests/gateway/runtime/bridge/test_bridge_rows.py": {
            f"{r['case']} {r['title']}-{way}" for r in GATEWAY for way in ways
        },
    }
    for name in MUTATIONS:
        for mutation in toml(f"mutations/{name}")["mutation"]:
            file, _, test = mutation["test"].partition("::")
            if file in there and (found := re.fullmatch(r"test_(?:row|whole)\[(.*)\]", test)):
                assert found[1] in there[file], mutation["test"]
