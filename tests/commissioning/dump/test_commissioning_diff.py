"""Differences by named field: between two dumps, and between a dump and a profile or an EDS."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import pytest
from canopen_slave_rig import RICH
from click.testing import CliRunner
from commissioning_rig import CAN_URL, URL, Wired, bank, can_bus, loop, run_virtually, unit

from fieldtwin.cli.device.diff_command import command
from fieldtwin.commissioning.access.reading import DeviceTarget
from fieldtwin.commissioning.dump.diff import Leave, diff_dictionary, diff_dumps, diff_profile, spans
from fieldtwin.commissioning.dump.dump import DumpJob
from fieldtwin.commissioning.dump.file import Dump, load_dump
from fieldtwin.commissioning.dump.session import dump, register_spans
from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.node import CanopenNode, NodeContext
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.protocols.canopen.eds.dictionary import parse_dictionary

ROOT = Path(__file__).parents[3]
SDM = load_profile(ROOT / "profiles/devices/eastron-sdm630.yaml")
SPANS = [CellSpan("input", 0, 80), CellSpan("holding", 0, 30)]


def floats(made: MapBank, table: str, values: dict[int, float]) -> None:
    for address, value in values.items():
        raw = struct.pack(">f", value)
        for i in (0, 1):
            made.poke(table, address + i, int.from_bytes(raw[2 * i : 2 * i + 2]))  # type: ignore[arg-type]


def meter(holding: dict[int, float], spans: list[CellSpan] | None = None) -> MapBank:
    made = bank(spans or SPANS)
    floats(made, "input", {0: 230.0, 2: 231.0, 70: 50.0})
    floats(made, "holding", {2: 60.0, 10: 3.0, 18: 1.0, 20: 1.0} | holding)
    return made


def dumped(made: MapBank, out: Path, **how: object) -> Dump:
    async def main() -> None:
        limits = {"read_registers": how.pop("limit")} if "limit" in how else {}
        job = DumpJob(DeviceTarget(URL, 1, SDM if "spans" not in how else None), **how)  # type: ignore[arg-type]
        await dump(job, out, words="", connector=Wired(unit(made, **limits)), clock=loop())

    run_virtually(main())
    return load_dump(out)


def test_two_dumps_by_tag_settings_and_tolerance(tmp_path: Path) -> None:
    one = dumped(meter({}), tmp_path / "a.jsonl")
    changed = meter({2: 30.0})
    floats(changed, "input", {0: 230.4})
    other = dumped(changed, tmp_path / "b.jsonl")
    found = diff_dumps(one, other, SDM).found
    assert [(d.name, d.left, d.right) for d in found] == [
        ("voltage_l1", "230 V", "230.4 V"),
        ("demand_period", "60 min", "30 min"),
    ]
    assert [d.name for d in diff_dumps(one, other, SDM, leave=Leave(settings=True)).found] == ["demand_period"]
    left = Leave(ignore=("demand_*",), tolerance={"*": 0.5})
    assert not diff_dumps(one, other, SDM, leave=left).found
    assert not diff_dumps(one, one, SDM).found


def test_without_a_profile_it_is_registers_and_limits(tmp_path: Path) -> None:
    how = {"spans": register_spans(["input:0..79"]), "functions": False}
    one = dumped(meter({}), tmp_path / "a.jsonl", **how)
    changed = meter({}, [CellSpan("input", 0, 40), CellSpan("input", 41, 39), CellSpan("holding", 0, 30)])
    floats(changed, "input", {2: -5.5})
    other = dumped(changed, tmp_path / "b.jsonl", limit=16, **how)
    found = diff_dumps(one, other)
    kinds = {(d.kind, d.at) for d in found.found}
    assert ("value", "input:2") in kinds
    assert ("not in both", "input:40") in kinds


def test_a_profile_that_contradicts_the_device(tmp_path: Path) -> None:
    good = dumped(meter({}), tmp_path / "good.jsonl")
    assert not diff_profile(good, SDM).found
    bad = meter({10: 7.0, 2: 99.0}, [CellSpan("input", 0, 30), CellSpan("input", 52, 28), CellSpan("holding", 0, 30)])
    found = diff_profile(dumped(bad, tmp_path / "bad.jsonl"), SDM).found
    kinds = {(d.kind, d.name) for d in found}
    assert ("out of range", "demand_period") in kinds
    assert ("not there", "power_factor_l1") in kinds
    assert not any(d.name.startswith("voltage") for d in found)


def test_limits_that_the_profile_states_and_the_device_does_not_keep(tmp_path: Path) -> None:
    made = meter({}, [CellSpan("input", 0, 36), CellSpan("input", 44, 36), CellSpan("holding", 0, 30)])
    how = {"spans": register_spans(["input:0..79", "holding:0..29"]), "functions": False}
    found = diff_profile(dumped(made, tmp_path / "d.jsonl", limit=20, **how), SDM)
    kinds = {(d.kind, d.name) for d in found.found}
    assert ("longest read", "input") in kinds
    assert any("no tag for" in note for note in found.notes) or found.compared


def test_a_node_against_its_data_sheet(tmp_path: Path) -> None:
    sheet = parse_dictionary(RICH, 5)

    async def main() -> None:
        async with can_bus(CanopenNode(parse_eds(RICH, "x"), 5, NodeContext())) as connector:
            job = DumpJob(DeviceTarget(CAN_URL, 5, dictionary=sheet))
            await dump(job, tmp_path / "n.jsonl", words="", connector=connector, clock=loop())

    run_virtually(main())
    node = load_dump(tmp_path / "n.jsonl")
    assert not diff_dictionary(node, sheet).found
    node.passes[0].cells[(0x1000, 0)] = b"\1"
    del node.passes[0].cells[(0x1005, 0)]
    node.passes[0].refused[(0x1005, 0)] = 0x06020000
    node.passes[0].cells[(0x1008, 0)] = b"another node"
    node.passes[0].cells[(0x4711, 0)] = b"\1"
    found = diff_dictionary(node, sheet)
    assert {(d.kind, d.at) for d in found.found} == {
        ("length", "1000h:00"),
        ("not there", "1005h:00"),
        ("constant", "1008h:00"),
    }
    assert "4711h:00" in found.notes[0]


def test_the_exit_code_of_the_command_reports_differences(tmp_path: Path) -> None:
    dumped(meter({}), tmp_path / "a.jsonl")
    dumped(meter({2: 30.0}), tmp_path / "b.jsonl")
    profiles = ["--profiles", str(ROOT / "profiles")]
    same = CliRunner().invoke(command, [str(tmp_path / "a.jsonl"), str(tmp_path / "a.jsonl"), *profiles])
    assert same.exit_code == 0
    args = [str(tmp_path / "a.jsonl"), str(tmp_path / "b.jsonl"), "--json", *profiles]
    result = CliRunner().invoke(command, args, standalone_mode=False)
    assert result.return_value == 1
    assert json.loads(result.stdout)["found"][0]["name"] == "demand_period"


@pytest.mark.parametrize(
    ("cells", "text"),
    [
        ([("holding", 3), ("holding", 1), ("holding", 2), ("input", 4)], ["holding:1..3", "input:4"]),
        ([], []),
    ],
)
def test_neighbours_are_reported_together(cells: list[tuple[str, int]], text: list[str]) -> None:
    assert spans(cells) == text
