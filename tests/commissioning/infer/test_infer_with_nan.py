"""Floats that are NaN in some passes, because the device had no value.

Defect: one NaN made the reading as a float impossible, so the draft had two uint16 for the value.
"""

from __future__ import annotations

import json
import random
import subprocess
import sys
from collections.abc import Callable
from itertools import count
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from infer_corpus import START_S, packed

from fieldtwin.commissioning.dump.file import load_dump
from fieldtwin.commissioning.infer.draft import checked, doubts, draft_profile
from fieldtwin.commissioning.infer.fields import Interpretation, Level
from fieldtwin.commissioning.infer.infer import Inference, Series, infer, series_of
from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.gateway.devices.codec import decode

PASSES = 20
NAN, NEGATIVE_NAN = 0x7FC0_0000, 0xFFC0_0000


def meter(order: str, nans: dict[int, int], kind: str = "float32", passes: int = PASSES) -> dict[int, list[int]]:
    """Return the words of four floats. The second one has the bits ``nans[i]`` in the pass i."""
    r = random.Random(5)
    whole = "uint32" if kind == "float32" else "uint64"
    columns: dict[int, list[int]] = {}
    address = count()
    for place, centre in enumerate((230.0, 21.5, 49.98, 3.4)):
        rows = [packed(kind, order, r.gauss(centre, 0.01 * centre)) for _ in range(passes)]
        if place == 1:
            rows = [packed(whole, order, nans[i]) if i in nans else row for i, row in enumerate(rows)]
        columns |= {next(address): list(column) for column in zip(*rows, strict=True)}
    return columns


def inferred(columns: dict[int, list[int]]) -> Inference:
    passes = len(columns[0])
    return infer(Series(tuple(START_S + 10.0 * i for i in range(passes)), {"holding": columns}))


def at(found: Inference, address: int) -> Interpretation:
    return next(r for r in found.readings if r.address <= address < r.address + r.registers)


@pytest.mark.parametrize("order", ["ABCD", "CDAB", "BADC", "DCBA"])
@pytest.mark.parametrize("absent", [{0}, {7}, {PASSES - 1}, {3, 4, 5}, set(range(2, PASSES, 3)), set(range(8, PASSES))])
def test_a_float_that_is_sometimes_nan_stays_a_float(order: str, absent: set[int]) -> None:
    reading = at(inferred(meter(order, dict.fromkeys(absent, NAN))), 2)
    assert (reading.address, reading.type, reading.order) == (2, "float32", order)
    assert reading.level in (Level.LIKELY, Level.CERTAIN)
    assert reading.sentinels == (NAN,)
    assert f"NaN in {len(absent)} of {PASSES} passes: perhaps not available" in reading.notes


def test_nans_of_both_signs_and_of_float64_are_sentinels() -> None:
    assert at(inferred(meter("ABCD", {2: NAN, 9: NEGATIVE_NAN})), 2).sentinels == (NAN, NEGATIVE_NAN)
    reading = at(inferred(meter("CDAB", {2: 0x7FF8 << 48}, "float64")), 4)
    assert (reading.address, reading.type, reading.sentinels) == (4, "float64", (0x7FF8 << 48,))


def test_a_nan_is_not_a_changed_value() -> None:
    """A setting that is sometimes not available has one value, so it is not certain."""
    columns = meter("ABCD", {})
    high, low = packed("float32", "ABCD", 12.5)
    columns[2] = [0x7FC0 if i in (3, 8, 9, 15) else high for i in range(PASSES)]
    columns[3] = [0 if i in (3, 8, 9, 15) else low for i in range(PASSES)]
    reading = at(inferred(columns), 2)
    assert (reading.type, reading.distinct, reading.moves) == ("float32", 1, False)
    assert reading.level is not Level.CERTAIN


def test_too_few_available_values_are_not_certain() -> None:
    reading = at(inferred(meter("ABCD", dict.fromkeys(range(5, PASSES), NAN))), 2)
    assert reading.level is not Level.CERTAIN


@pytest.mark.parametrize("order", ["ABCD", "CDAB", "BADC", "DCBA"])
def test_a_pair_that_was_always_nan_is_a_float_where_the_device_has_floats(order: str) -> None:
    found = inferred(meter(order, dict.fromkeys(range(PASSES), NAN)))
    reading = at(found, 2)
    assert (reading.address, reading.type, reading.order, reading.sentinels) == (2, "float32", order, (NAN,))
    assert reading.level is Level.LIKELY
    assert "always NaN; perhaps not available" in doubts(reading)
    assert [r.type for r in found.readings] == ["float32"] * 4


@pytest.mark.parametrize("others", [0, 1, 2])
def test_a_pair_that_was_always_nan_stays_two_integers_where_floats_are_few(others: int) -> None:
    columns = meter("ABCD", {})
    kept = {a: columns[a] for a in range(8) if a < 2 * others}
    absent = {2 * others: [0x7FC0] * PASSES, 2 * others + 1: [0] * PASSES}
    assert [at(inferred(kept | absent), a).type for a in absent] == ["uint16", "uint16"]


def test_minus_64_and_0_stay_two_integers() -> None:
    found = inferred(meter("ABCD", dict.fromkeys(range(PASSES), NEGATIVE_NAN)))
    assert [(at(found, a).type, at(found, a).registers) for a in (2, 3)] == [("int16", 1), ("uint16", 1)]


@pytest.mark.parametrize("bits", [0x7F80_0000, 0x7FC0_0001, 0x7F80_0001])
def test_infinity_and_other_nans_are_not_taken_for_a_missing_value(bits: int) -> None:
    assert not any(r.sentinels for r in inferred(meter("ABCD", {7: bits})).readings)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.sampled_from([0, 0x7FC0, 0xFFC0, 0x41A8, 0x7FF8]), min_size=28, max_size=28))
def test_any_mixture_of_nans_zeros_and_floats_is_tiled_once(words: list[int]) -> None:
    columns = {i: words[7 * i : 7 * i + 7] for i in range(4)}
    readings = inferred(columns).readings
    assert [a for r in readings for a in range(r.address, r.address + r.registers)] == [0, 1, 2, 3]
    assert all(r.available for r in readings)


@pytest.fixture
def dumped(tmp_path: Path) -> Callable[[dict[int, list[int]]], Path]:
    def write(columns: dict[int, list[int]]) -> Path:
        path = tmp_path / "meter.jsonl"
        lines = ['{"fieldtwin_dump":2,"protocol":"modbus","address":1,"ranges":["holding:0..7"],"profile":null}']
        for i, row in enumerate(zip(*columns.values(), strict=True)):
            lines.append(f'{{"pass":{i},"at":"2026-01-01T00:00:{i:02}+00:00"}}')
            lines.append(f'{{"read":"holding:0..7","hex":"{"".join(f"{w:04x}" for w in row)}","us":1}}')
        path.write_text("\n".join([*lines, '{"ended":"x"}']) + "\n")
        return path

    return write


def test_the_draft_reads_the_nan_as_a_sentinel(dumped: Callable[[dict[int, list[int]]], Path], tmp_path: Path) -> None:
    dumps = [load_dump(dumped(meter("CDAB", {6: NAN})))]
    text = draft_profile(infer(series_of(dumps)), dumps, "meter")
    assert "type: float32, order: CDAB, sentinels: [0x7FC00000]}" in text
    tag = checked(text, tmp_path / "draft.yaml").tags["holding_2"]
    value = decode(tag, bytes.fromhex("00007fc0"), 0)
    assert (value.value, value.quality, value.reason) == (None, Quality.BAD, Reason.SENTINEL)


def test_the_command_writes_json_without_nan(dumped: Callable[[dict[int, list[int]]], Path]) -> None:
    path = dumped(meter("ABCD", {PASSES - 1: NAN}))
    command = [sys.executable, "-m", "fieldtwin", "infer", str(path)]

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    shown = subprocess.run([*command, "--json"], capture_output=True, text=True, check=True).stdout
    row = next(r for r in json.loads(shown, parse_constant=refuse)["readings"] if r["at"] == "holding:2")
    assert (row["type"], row["last"], row["sentinels"]) == ("float32", None, [NAN])
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "NaN in 1 of 20 passes" in " ".join(shown.split())
