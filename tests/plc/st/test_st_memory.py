"""The memory of numbers through pointers, as CODESYS 3 and TwinCAT 3 have it: little-endian, and inside of one variable only."""

from __future__ import annotations

import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as some
from st_bench import program, run, scan

from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid
from fieldtwin.plc.st.runtime.memory import Memory


def value(body: str, variables: str, before: str = "") -> dict[str, Any]:
    return run(variables, body, before, dialect="codesys")


def test_the_bits_of_a_real_are_those_of_iec_60559() -> None:
    got = value(
        "p := ADR(x); bits := p^; x := -2.5; later := p^; p^ := 16#3F80_0000;",
        "x : REAL := 1.5; p : POINTER TO DWORD; bits, later : DWORD;",
    )
    assert (got["bits"], got["later"], got["x"]) == (0x3FC0_0000, 0xC020_0000, 1.0)


def test_the_bytes_of_a_number_begin_with_the_least_significant_one() -> None:
    got = value(
        "p := ADR(d); b[0] := p^; p := p + 3; b[1] := p^; p^ := 16#AA; b[2] := p[-3];",
        "d : DWORD := 16#01020304; p : POINTER TO BYTE; b : ARRAY[0..2] OF BYTE;",
    )
    assert (got["b"], got["d"]) == ([4, 1, 4], 0xAA020304)


def test_an_array_of_numbers_is_seen_as_bytes_and_the_other_way_round() -> None:
    declared = "w : ARRAY[1..2] OF INT := [-2, 16#0102]; b : ARRAY[0..3] OF BYTE; pb : POINTER TO BYTE; i : INT;"
    declared += "pr : POINTER TO ARRAY[0..3] OF BYTE;"
    got = value("pb := ADR(w); FOR i := 0 TO 3 DO b[i] := pb[i]; END_FOR pr := ADR(w); pr^[2] := 16#FF;", declared)
    assert (got["b"], got["w"]) == ([0xFE, 0xFF, 2, 1], [-2, 0x01FF])
    got = value(
        "pr := ADR(b); r := pr^;", "b : ARRAY[0..3] OF BYTE := [0, 0, 16#C0, 16#3F]; pr : POINTER TO REAL; r : REAL;"
    )
    assert got["r"] == 1.5


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("p := ADR(d) + 4; b := p^;", "a pointer outside the variable"),
        ("p := ADR(d); p := p - 1; p^ := 1;", "a pointer outside the variable"),
        ("q := ADR(b); w := q^;", "a pointer outside the variable"),
        ("q := ADR(a[1]); w := q^;", "a pointer into the middle of a value"),
        ("r := ADR(d); b := r^[4];", "an index outside the array"),
        ("whole := r2^; r2 := ADR(d);", "a reference that is NULL"),
        ("r2 := ADR(d); whole := r2^;", "a pointer to an array of another size is used as a whole"),
    ],
)
def test_a_pointer_to_memory_stays_inside_its_variable(body: str, said: str) -> None:
    declared = "d : DWORD; b : BYTE; w : WORD; a : ARRAY[0..3] OF BYTE; p : POINTER TO BYTE; q : POINTER TO WORD;"
    declared += "r : POINTER TO ARRAY[0..9] OF BYTE; r2 : POINTER TO ARRAY[0..3] OF BYTE; whole : ARRAY[0..3] OF BYTE;"
    with pytest.raises(FieldtwinError, match=said):
        value(body, declared)


@pytest.mark.parametrize("kind", ["S", "TIME", "BOOL", "ARRAY[0..1] OF TIME", "Color"])
def test_memory_whose_layout_differs_is_refused(kind: str) -> None:
    types = "TYPE S : STRUCT x : INT; END_STRUCT; Color : (red, green); END_TYPE"
    with pytest.raises(FileInvalid, match=r"the memory of a .* as a .* is not supported"):
        value("p := ADR(x);", f"x : {kind}; p : POINTER TO BYTE;", types)


def test_a_function_may_look_at_the_memory_of_its_input_and_of_its_result() -> None:
    functions = """FUNCTION Bits : ULINT VAR_INPUT x : LREAL; END_VAR VAR p : POINTER TO ULINT := ADR(x); END_VAR
Bits := p^; END_FUNCTION
FUNCTION Hex : STRING(2) VAR_INPUT b : BYTE; END_VAR VAR p : POINTER TO BYTE; END_VAR
p := ADR(Hex); p^ := 65; p := p + 1; p^ := b; p := p + 1; p^ := 0; END_FUNCTION
FUNCTION Number : INT VAR p : POINTER TO INT; END_VAR p := ADR(Number); p^ := 7; Number := Number + 1; RETURN; END_FUNCTION"""
    got = value(
        "bits := Bits(-0.0); text := Hex(66); n := Number();", "bits : ULINT; text : STRING(2); n : INT;", functions
    )
    assert (got["bits"], got["text"], got["n"]) == (1 << 63, "AB", 8)


def test_a_pointer_to_memory_belongs_to_the_state_and_can_be_compared() -> None:
    text = "PROGRAM p VAR x : REAL; a, b : POINTER TO DWORD; same : BOOL; END_VAR\n"
    text += "a := ADR(x); b := ADR(x); same := a = b; END_PROGRAM"
    made: Any = program(text, dialect="codesys")
    scan(made)
    before = made.whole_state(0)
    scan(made)
    assert made.same is True
    assert made.whole_state(0) == before


@given(
    values=some.lists(some.integers(0, 255), min_size=4, max_size=4),
    at=some.integers(0, 1),
    new=some.integers(-(2**15), 2**15 - 1),
)
def test_a_written_value_changes_its_own_bytes_only(values: list[int], at: int, new: int) -> None:
    expected = bytearray(values)
    struct.pack_into("<h", expected, 2 * at, new)
    memory = Memory(values, "B", "h")
    memory[at] = new
    assert (bytes(values), memory[at], len(memory)) == (bytes(expected), new, 2)
