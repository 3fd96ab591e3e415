"""Every row of the two lists of edge cases that concerns drivers, as a scenario in virtual time: the real gateway, PLC
and emulators, a fault on the wire, its effects on the wire, the tag's quality and the program, and the time until
recovery."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from fieldtwin.results.model import Verdict
from fieldtwin.run.targets.virtual_scenario import run_virtual
from fieldtwin.scenarios.language.form import load_scenario

FOLDER = Path(__file__).parent / "scenarios"
FILES = sorted(FOLDER.glob("*.scenario.yaml"))


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.name.removesuffix(".scenario.yaml"))
def test_scenario_of_an_edge_case_passes(path: Path) -> None:
    result = run_virtual(load_scenario(path))
    assert result.verdict is Verdict.PASSED, result.checks[-1]
    assert [r for r in result.requirements if path.name.startswith(r)]


SLAVES, MASTERS, BRIDGE, PORTS, BUS = range(5)
WHERE = {
    SLAVES: ("what devices do", ("vectors/modbus_server.toml", "vectors/canopen_slave.toml")),
    MASTERS: (
        "what a master can do and no system asks of it: broadcasts, block transfers, LSS",
        ("vectors/modbus_client_rows.toml", "vectors/canopen_master.toml"),
    ),
    BRIDGE: ("clients of the bridge, which a scenario has none of", ("wires", "system", "vectors/modbus_gateway.toml")),
    PORTS: ("real ports and sockets, which virtual time has none of", ("wires", "gateway", "emulators")),
    BUS: ("the wire and kernels", ("gateway", "emulators", "vectors/canopen_bus.toml")),
}
"""Why a row has no scenario here, and which test covers it instead."""

ELSEWHERE = {
    **dict.fromkeys(("MB-001", "MB-004", *(f"MB-{n:03}" for n in (*range(29, 48), 49, 53))), SLAVES),
    **dict.fromkeys(("MB-026", "MB-027"), MASTERS),
    **dict.fromkeys(("MB-028", "MB-058", "MB-059", "MB-060", "MB-061"), BRIDGE),
    **dict.fromkeys(("MB-065", "MB-066", "MB-067"), PORTS),
    **dict.fromkeys((f"CO-{n:03}" for n in (3, 9, 10, 11, 12, 31, 32, 41, 45, 49, 50, 51, 55, 56, 59)), SLAVES),
    **dict.fromkeys((f"CO-{n:03}" for n in (14, 15, 16, 17, 18, 19, 20, 21, 24, 30, 33, 40, 47, 57, 58, 66)), MASTERS),
    **dict.fromkeys(("CO-063", "CO-064"), BUS),
}
ALL = [f"MB-{n:03}" for n in range(1, 71)] + [f"CO-{n:03}" for n in range(1, 67)]


def test_every_row_of_the_catalogues_has_a_scenario_or_a_reason() -> None:
    said = [re.findall(r"^requirements: \[(.*)\]$", path.read_text(), re.MULTILINE)[0] for path in FILES]
    written = {row for rows in said for row in rows.split(", ")}
    assert sorted(written | set(ELSEWHERE)) == sorted(ALL)
    assert not written & set(ELSEWHERE)


@pytest.mark.parametrize(("row", "why"), ELSEWHERE.items())
def test_rows_without_a_scenario_are_tested_elsewhere(row: str, why: int) -> None:
    tests = FOLDER.parents[2]
    names = (row, row.replace("-", "_").lower())
    files = [f for place in WHERE[why][1] for f in ([tests / place] if "." in place else (tests / place).rglob("*.py"))]
    assert any(name in file.read_text() for file in files for name in names), WHERE[why]
