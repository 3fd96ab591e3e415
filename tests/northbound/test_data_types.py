"""The data type of each kind of tag, and values that a type cannot hold."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.northbound.data_types import INTEGERS, data_type, fitted
from fieldtwin.northbound.opcua.units import CODES, unit_id

PROFILE = """\
device: test/all
source: "a test"
protocol: modbus
tags:
  small:   {at: "holding:0", type: int16}
  word:    {at: "holding:1", type: uint16}
  scaled:  {at: "holding:2", type: int16, scale: 0.1}
  single:  {at: "holding:3", type: float32}
  times10: {at: "holding:5", type: float32, scale: 10}
  exact:   {at: "holding:7", type: float64}
  large:   {at: "holding:11", type: uint64}
  digits:  {at: "holding:15", type: bcd32}
  lamp:    {at: "coil:0", type: bool}
  part:    {at: "holding:17", type: uint16, bits: [4, 7]}
  name:    {at: "holding:18", type: string, registers: 2}
  raw:     {at: "holding:20", type: bytes, registers: 2}
"""


def test_the_type_follows_from_the_profile(tmp_path: Path) -> None:
    (tmp_path / "all.yaml").write_text(PROFILE, encoding="utf-8")
    tags = load_profile(tmp_path / "all.yaml").tags
    assert {name: data_type(tag) for name, tag in tags.items()} == {
        "small": "Int16", "word": "UInt16", "scaled": "Double", "single": "Float", "times10": "Double", "exact": "Double",
        "large": "UInt64", "digits": "UInt32", "lamp": "Boolean", "part": "UInt16", "name": "String", "raw": "ByteString",
    }  # fmt: skip


@given(st.sampled_from(sorted(INTEGERS)), st.integers(-(1 << 65), 1 << 65))
def test_an_integer_is_passed_on_exactly_or_not_at_all(kind: str, value: int) -> None:
    low, high = INTEGERS[kind]
    assert fitted(value, kind) == (value if low <= value <= high else None)


@pytest.mark.parametrize(("unit", "number"), [("degC", 4_408_652), ("%", 20_529), ("m/s", 5_067_859), ("furlong", -1)])
def test_units_have_the_numbers_of_the_unece(unit: str, number: int) -> None:
    assert unit_id(unit) == number


def test_codes_have_two_or_three_characters() -> None:
    assert {len(code) for code in CODES.values()} == {2, 3}
