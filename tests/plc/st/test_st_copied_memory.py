"""MEMCPY, MEMMOVE, MEMSET and MEMCMP of Tc2_System, and SysMemCpy and others of CODESYS, with the bounds of variables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from st_bench import run as run_in

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.dialects import DIALECTS
from fieldtwin.plc.st.project import compile_source
from fieldtwin.plc.st.values import LogicError

TYPES = """
TYPE Frame : STRUCT kind : BYTE; length : UDINT; ok : BOOL; name : STRING(3); END_STRUCT END_TYPE
TYPE Bits : UNION real : REAL; bits : DWORD; END_UNION END_TYPE
"""
VARIABLES = """
a : ARRAY[0..3] OF WORD := [16#0102, 2, 3, 4]; b : ARRAY[0..7] OF BYTE; frames : ARRAY[1..2] OF Frame; f : Frame;
raw : ARRAY[0..15] OF BYTE; real : REAL := 1.0; bits : DWORD; s : STRING(10) := 'HELLO'; p : POINTER TO BYTE; n : UDINT; c : DINT;
u : Bits; grid : ARRAY[0..1, 0..1] OF INT; i : INT := 9; flag : BOOL; t : TIME;
"""


def run(body: str, dialect: str = "twincat", more: str = "") -> dict[str, Any]:
    return run_in(VARIABLES, body, TYPES + more, dialect=dialect)


@pytest.mark.parametrize("name", ["MEMCPY", "MEMMOVE", "SysMemCpy", "sysmemmove"])
def test_bytes_are_copied_between_variables_of_different_types(name: str) -> None:
    found = run(
        f"n := {name}(ADR(b), ADR(a), SIZEOF(a)); {name}(ADR(bits), ADR(real), 4); {name}(ADR(u), ADR(bits), 4);"
    )
    assert found["b"] == [2, 1, 2, 0, 3, 0, 4, 0]
    assert (found["n"], found["bits"], found["u"].m_real) == (8, 0x3F800000, 1.0)


def test_a_structure_goes_through_bytes_and_back() -> None:
    found = run("""f.kind := 7; f.length := 16#01020304; f.ok := TRUE; f.name := 'AB';
    MEMCPY(destAddr := ADR(raw), srcAddr := ADR(f), n := SIZEOF(f));
    raw[4] := 5; MEMCPY(ADR(frames[2]), ADR(raw), SIZEOF(Frame)); MEMCPY(ADR(grid[1, 0]), ADR(raw[4]), 2);""")
    assert found["raw"] == [7, 0, 0, 0, 5, 3, 2, 1, 1, 0x41, 0x42, 0, 0, 0, 0, 0]
    frame = found["frames"][1]
    assert (frame.m_kind, frame.m_length, frame.m_ok, frame.m_name) == (7, 0x01020305, True, "AB")
    assert found["grid"] == [[0, 0], [0x305, 0]]


def test_parts_of_elements_and_overlapping_parts_are_copied() -> None:
    found = run(
        "MEMMOVE(ADR(a[1]), ADR(a[0]), 6); MEMCPY(ADR(b[1]), ADR(a[2]), 3); p := ADR(s); MEMCPY(ADR(raw), p + 1, 4);"
    )
    assert found["a"] == [0x102, 0x102, 2, 3]
    assert found["b"] == [0, 2, 0, 3, 0, 0, 0, 0]
    assert found["raw"][:5] == [0x45, 0x4C, 0x4C, 0x4F, 0]


def test_memset_fills_numbers_and_texts() -> None:
    found = run(
        "n := MEMSET(ADR(a[1]), 16#FF, 3); MEMSET(ADR(s), 65, 2); SysMemSet(ADR(frames), 1, 4); t := T#1s; MEMSET(ADR(t), 0, 4);"
    )
    assert (found["a"], found["n"], found["s"], found["t"]) == ([0x102, 0xFFFF, 0xFF, 4], 3, "AALLO", 0)
    assert found["frames"][0].m_kind == 1
    assert run("MEMSET(ADR(s), 0, SIZEOF(s)); MEMSET(ADR(flag), 2, 1);")["flag"] is True


@pytest.mark.parametrize(
    ("second", "count", "expected"), [(3, 2, 0), (4, 2, -1), (2, 2, 1), (4, 1, -1), (4, 0, 0), (0x0103, 2, -1)]
)
def test_memcmp_compares_the_first_different_byte(second: int, count: int, expected: int) -> None:
    assert run(f"a[0] := {second}; c := MEMCMP(ADR(a[2]), ADR(a[0]), {count});")["c"] == expected


def test_a_function_copies_through_its_parameters() -> None:
    more = """FUNCTION Put : UDINT VAR_INPUT target : POINTER TO BYTE; x : WORD; END_VAR
    Put := MEMCPY(target, ADR(x), 2); END_FUNCTION"""
    assert run("n := Put(ADR(b[3]), 16#0A0B);", more=more)["b"] == [0, 0, 0, 11, 10, 0, 0, 0]


@pytest.mark.parametrize(
    ("body", "message", "expected", "got"),
    [
        ("MEMCPY(ADR(b), ADR(a), 9);", "MEMCPY exceeds the variable to which srcAddr points", "at most 8 bytes from there", "9"),
        ("MEMCPY(ADR(b[4]), ADR(a), 8);", "MEMCPY exceeds the variable to which destAddr points", "at most 4 bytes", "8"),
        ("MEMCPY(ADR(f.kind), ADR(a), 2);", "destAddr", "at most 1 bytes", "2"),
        ("MEMCPY(ADR(b), ADR(a), -1);", "srcAddr", "at most 8 bytes", "-1"),
        ("MEMSET(ADR(s), 0, 12);", "MEMSET exceeds the variable to which destAddr points", "at most 11 bytes", "12"),
        ("p := ADR(b); p := p + 9; MEMSET(p, 0, 1);", "MEMSET exceeds", "at most 0 bytes", "1"),
        ("c := MEMCMP(ADR(a), ADR(b[7]), 2);", "MEMCMP exceeds the variable to which pBuf2 points", "at most 1 bytes", "2"),
        ("SysMemCpy(p, ADR(a), 1);", "pDest of SYSMEMCPY is NULL", "the address of a variable", ""),
    ],
)  # fmt: skip
def test_an_access_outside_a_variable_stops_the_task_and_names_what_was_exceeded(
    body: str, message: str, expected: str, got: str
) -> None:
    with pytest.raises(LogicError) as e:
        run(body)
    assert message in e.value.message
    assert expected in e.value.expected
    assert e.value.got == got


@pytest.mark.parametrize(
    ("body", "dialect", "message"),
    [
        ("MEMCPY(ADR(b), a, 2);", "twincat", r":\d+:16: destAddr|srcAddr of MEMCPY.*ADR\(variable\)"),
        (
            "MEMCPY(ADR(timer), ADR(a), 2);",
            "twincat",
            "the variable at destAddr of MEMCPY has the type TON, whose memory",
        ),
        ("MEMCPY(ADR(b), ADR(a), 2.5);", "twincat", "n of MEMCPY.*UDINT.*"),
        ("MEMCPY(ADR(b), ADR(a));", "twincat", "arguments of MEMCPY"),
        ("MEMSET(ADR(b), 'x', 1);", "codesys", "fillByte of MEMSET"),
    ],
)
def test_wrong_arguments_are_errors_with_their_place(body: str, dialect: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message):
        run_in(f"{VARIABLES} timer : TON;", body, TYPES, dialect=dialect)


def test_the_name_of_the_library_may_stand_before_the_function(tmp_path: Path) -> None:
    source = tmp_path / "main.st"
    source.write_text(
        "PROGRAM Main VAR a, b : DWORD; END_VAR\n"
        "Tc2_System.MEMCPY(ADR(a), ADR(b), 4); SysMem.SysMemSet(ADR(a), 0, 1); END_PROGRAM",
        encoding="utf-8",
    )
    assert [one.name for one in compile_source(source, DIALECTS["twincat"]).programs] == ["Main"]


def test_the_standard_has_no_memcpy() -> None:
    with pytest.raises(FileInvalid, match="MEMCPY is not in the standard"):
        run_in("r : REF_TO INT;", "MEMCPY(r, r, 2);")
