"""UNION of the dialects of CODESYS: members that share their memory.

The expected bytes are those of two's complement and IEC 60559 with the least significant byte first, and the
alignment of CODESYS 3.
"""

from __future__ import annotations

import copy
import json
import math
from typing import Any

import pytest
from st_bench import program, scan
from st_bench import run as run_in

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.program import ScanInfo
from fieldtwin.plc.st.values import LogicError

TYPES = """
TYPE Light : (red, green, blue); END_TYPE
TYPE Frame : STRUCT kind : BYTE; length : UDINT; ok : BOOL; END_STRUCT END_TYPE
{attribute 'pack_mode' := '1'} // as on the bus
TYPE Packed : STRUCT kind : BYTE; length : UDINT; ok : BOOL; END_STRUCT END_TYPE
TYPE Halves : UNION whole : DWORD; half : ARRAY[0..1] OF WORD; END_UNION END_TYPE
TYPE Inner : STRUCT id : BYTE; halves : Halves; END_STRUCT END_TYPE
TYPE Data : UNION
    bytes : ARRAY[0..15] OF BYTE;
    word : WORD; int : INT; real : REAL; lreal : LREAL; big : LINT; flag : BOOL;
    duration : TIME; day : DATE; clock : TIME_OF_DAY; long : LTIME;
    text : STRING(6); wide : WSTRING(3); light : Light; small : SINT(-5..5);
    frame : Frame; packed : Packed; frames : ARRAY[1..2] OF Packed; grid : ARRAY[1..2, 0..1] OF INT; inner : Inner;
  END_UNION
END_TYPE
"""


def run(variables: str, body: str, before: str = "", dialect: str = "codesys") -> dict[str, Any]:
    return run_in(variables, body, TYPES + before, dialect=dialect)


@pytest.mark.parametrize("dialect", ["codesys", "twincat"])
@pytest.mark.parametrize(
    ("assigned", "bytes_"),
    [
        ("d.int := -2;", "FE FF"),
        ("d.real := 1.5;", "00 00 C0 3F"),
        ("d.lreal := 1.0;", "00 00 00 00 00 00 F0 3F"),
        ("d.big := -1;", "FF FF FF FF FF FF FF FF"),
        ("d.flag := TRUE;", "01"),
        ("d.duration := T#1s2ms;", "EA 03 00 00"),
        ("d.day := D#1970-01-02;", "80 51 01 00"),
        ("d.clock := TOD#00:00:01;", "E8 03 00 00"),
        ("d.long := LTIME#1us;", "E8 03 00 00 00 00 00 00"),
        ("d.text := 'AB';", "41 42 00"),
        ('d.wide := "A";', "41 00 00 00"),
        ("d.light := blue;", "02 00"),
        ("d.frame.length := 7; d.frame.ok := TRUE;", "00 00 00 00 07 00 00 00 01"),
        ("d.packed.length := 7; d.packed.ok := TRUE;", "00 07 00 00 00 01"),
        ("d.frames[2].kind := 9;", "00 00 00 00 00 00 09"),
        ("d.grid[2, 0] := 16#0102;", "00 00 00 00 02 01"),
        ("d.inner.halves.half[1] := 5;", "00 00 00 00 00 00 05 00"),
        ("d.word.3 := TRUE; d.word.%B1 := 1;", "08 01"),
        ("w := 'ABCDEFGH'; d.text := w;", "41 42 43 44 45 46 00"),
    ],
)
def test_a_member_has_the_bytes_of_a_controller(assigned: str, bytes_: str, dialect: str) -> None:
    found = run("d : Data; w : STRING; a : ARRAY[0..15] OF BYTE;", f"{assigned} a := d.bytes;", dialect=dialect)
    expected = [int(byte, 16) for byte in bytes_.split()]
    assert found["a"] == [*expected, *[0] * (16 - len(expected))]


def test_every_member_reads_what_another_one_wrote() -> None:
    found = run(
        """d : Data; bits : DWORD; h : Halves; w0, w1 : WORD; f : Frame; p : ARRAY[1..2] OF Packed; g : ARRAY[1..2, 0..1] OF INT;
        t : TIME; s : STRING; yes : BOOL; r : REAL;""",
        """h.whole := 16#12345678; w0 := h.half[0]; w1 := h.half[1];
        d.bytes[0] := 2; d.bytes[4] := 16#10; d.bytes[5] := 1; d.bytes[8] := 2;
        f := d.frame; p := d.frames; g := d.grid; t := d.duration; yes := d.flag;
        d.bytes[0] := 16#C3; s := d.text; d.bytes[2] := 16#C0; d.bytes[3] := 16#7F; d.bytes[0] := 0; r := d.real;""",
    )
    assert (found["w0"], found["w1"]) == (0x5678, 0x1234)
    frame = found["f"]
    assert (frame.m_kind, frame.m_length, frame.m_ok) == (2, 0x110, True)
    assert [one.m_length for one in found["p"]] == [0x10000000, 0x200]
    assert found["g"] == [[2, 0], [0x110, 0]]
    assert (found["t"], found["s"], found["yes"]) == (2_000_000, "\u00c3", True)
    assert math.isnan(found["r"])


def test_a_union_is_copied_and_its_parts_are_passed_by_reference() -> None:
    found = run(
        """a, b : Data; list : ARRAY[1..2] OF Halves; i : INT := 2; f : Frame := (kind := 4); p : POINTER TO WORD;
        r : REFERENCE TO REAL; same, other : BOOL; n, k : INT; m : Raise; bb : ARRAY[0..15] OF BYTE; size : INT;""",
        """a.word := 7; b := a; a.word := 8; n := b.int;
        list[i].half[1] := 1; list[1] := list[2]; list[2].whole := 0;
        b.frame := f; b.frame.length := 3; f := b.frame;
        p := ADR(a.word); p^ := 9; r REF= a.real; r := 0.5;
        m(x := a.int); Grow(a.frame); Grow2(a.bytes); k := Sum(a);
        same := ADR(b.word) = ADR(b.word) AND ADR(list[1].half[0]) = ADR(list[1].half[0]);
        other := ADR(a.bytes[0]) = ADR(a.bytes[1]); bb := a.bytes; size := SIZEOF(Data);""",
        before="""FUNCTION_BLOCK Raise VAR_IN_OUT x : INT; END_VAR x := x + 1; END_FUNCTION_BLOCK
        FUNCTION Grow VAR_IN_OUT f : Frame; END_VAR f.ok := TRUE; END_FUNCTION
        FUNCTION Grow2 VAR_IN_OUT a : ARRAY[*] OF BYTE; END_VAR a[UPPER_BOUND(a, 1)] := 5; END_FUNCTION
        FUNCTION Sum : INT VAR_INPUT d : Data; END_VAR VAR own : Halves; END_VAR
          own.whole := 65536; d.bytes[0] := 200; Sum := d.bytes[0] + d.bytes[15] + own.half[1]; END_FUNCTION""",
    )
    assert (found["n"], found["k"], found["size"]) == (7, 206, 16)
    assert [one.m_whole for one in found["list"]] == [0x10000, 0]
    assert (found["f"].m_kind, found["f"].m_length) == (4, 3)
    assert found["bb"] == [1, 0, 0, 0x3F, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 5]
    assert (found["same"], found["other"]) == (True, False)


def test_initial_values_of_members_and_of_variables() -> None:
    types = """TYPE More EXTENDS Start : UNION d : DWORD; END_UNION END_TYPE
    TYPE Start : UNION w : WORD := 16#0102; b : ARRAY[0..3] OF BYTE; END_UNION END_TYPE"""
    found = run(
        "a : Start; c : Start := (b := [9, 8]); e : ARRAY[0..1] OF Start := [(w := 5)]; d : Data; m : More;", "", types
    )
    assert (found["m"].m_d, list(found["m"].m_b)) == (0x102, [2, 1, 0, 0])
    assert list(found["a"].m_b) == [2, 1, 0, 0]
    assert list(found["c"].m_b) == [9, 8, 0, 0]
    assert [one.m_w for one in found["e"]] == [5, 0x102]
    assert bytes(found["d"].m_bytes) == bytes(16)


BITS = """TYPE Bits : STRUCT b0, b1, b2, b3, b4, b5, b6, b7, b8 : BIT; n : BYTE; last : BIT; END_STRUCT END_TYPE
TYPE Flags : UNION bits : Bits; word : WORD; raw : DWORD; END_UNION END_TYPE
"""


def test_members_of_the_type_bit_share_bytes() -> None:
    found = run(
        "f : Flags; b : Bits; yes, no : BOOL; size : INT; w : WORD; raw : DWORD; other : Bits; n : UDINT;",
        """f.word := 16#0182; yes := f.bits.b1 AND f.bits.b7 AND f.bits.b8; no := f.bits.b0 OR f.bits.b6;
        f.bits.b1 := FALSE; f.bits.b0 := yes; b := f.bits; w := f.word; b.last := b.b0; b.n := 7; f.bits := b; raw := f.raw;
        size := SIZEOF(Bits); n := MEMCPY(ADR(other), ADR(b), 3);""",
        BITS,
    )
    assert (found["yes"], found["no"], found["w"], found["size"], found["raw"]) == (True, False, 0x0181, 4, 0x01070181)
    assert (found["b"].m_b7, found["b"].m_b8, found["other"].m_b0, found["other"].m_n) == (True, True, True, 7)


@pytest.mark.parametrize(
    ("variables", "body", "message"),
    [
        ("b : BIT;", "", "BIT outside of a structure; expected BOOL"),
        ("b : Bits; p : POINTER TO BOOL;", "p := ADR(b.b1);", "ADR of a BIT, which has no address"),
        ("b : Bits; m : Raise;", "m(x := b.b1);", "VAR_IN_OUT x of Raise; expected BOOL; got BIT"),
        ("b : Other;", "", "BIT outside of a structure"),
    ],
)
def test_a_bit_has_no_address(variables: str, body: str, message: str) -> None:
    before = f"{BITS} FUNCTION_BLOCK Raise VAR_IN_OUT x : BOOL; END_VAR END_FUNCTION_BLOCK"
    other = "TYPE Other : UNION b : BIT; w : WORD; END_UNION END_TYPE" if "Other" in variables else ""
    with pytest.raises(FileInvalid, match=message):
        run(variables, body, f"{before} {other}")


def test_a_time_that_does_not_fit_its_four_bytes_stops_the_task() -> None:
    for value in ("T#50d", "-T#1ms"):
        with pytest.raises(LogicError, match="a time that does not fit its memory"):
            run("d : Data; t : TIME;", f"t := {value}; d.duration := t;")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("TYPE U : UNION a : TON; b : INT; END_UNION END_TYPE", r":1:16: U\.a has the type TON, whose memory is not known"),
        ("TYPE U : UNION a : INT;\n p : POINTER TO INT; END_UNION END_TYPE", r":2:2: U\.p has the type POINTER TO INT"),
        ("INTERFACE I END_INTERFACE TYPE U : UNION a : ARRAY[0..1] OF I; END_UNION END_TYPE", r"U\.a has the type I"),
        ("TYPE S : STRUCT r : REF_TO INT; END_STRUCT END_TYPE TYPE U : UNION s : S; END_UNION END_TYPE", r"U\.s\.r has the"),
        ("TYPE U : UNION a AT %I* : INT; END_UNION END_TYPE", "a is a member of a union and has an address"),
        ("TYPE U : UNION a : INT; END_UNION END_TYPE TYPE S : STRUCT u AT %I* : U; END_STRUCT END_TYPE",
         "u is or contains a union and has an address"),
        ("TYPE U : UNION a : INT; END_UNION END_TYPE PROGRAM P VAR u AT %I* : U; END_VAR END_PROGRAM",
         "u is or contains a union and has an address"),
        ("TYPE U : UNION END_UNION END_TYPE", "the union U"),
        ("TYPE S : STRUCT a : INT; END_STRUCT END_TYPE TYPE U EXTENDS S : UNION b : INT; END_UNION END_TYPE",
         "U is a UNION and extends a STRUCT"),
        ("TYPE U : UNION u : U; b : INT; END_UNION END_TYPE", "type U contains itself"),
        ("TYPE U : UNION a : INT; a : WORD; END_UNION END_TYPE", "a is declared twice"),
        ("TYPE U : UNION a : INT; END_TYPE", "END_UNION"),
    ],
)  # fmt: skip
def test_what_a_union_cannot_have_is_an_error_with_its_place(text: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message):
        program(f"{text} PROGRAM Q END_PROGRAM", "Q", "codesys")


def test_the_standard_has_no_union_and_the_name_is_free() -> None:
    with pytest.raises(FileInvalid, match=r"U is a UNION, which is not in the standard.*codesys"):
        program("TYPE U : UNION a : INT; END_UNION END_TYPE PROGRAM Q END_PROGRAM", "Q")
    assert run_in("union : INT; unions : INT;", "union := 3; unions := union;")["unions"] == 3


SOURCE = f"""{TYPES}
PROGRAM Main
VAR RETAIN kept : Data; list : ARRAY[0..1] OF Inner; END_VAR
VAR live : Data; END_VAR
  kept.int := kept.int - 1; list[1].halves.half[0] := 3; live.real := 1.0;
END_PROGRAM
"""


def test_each_member_has_a_path() -> None:
    made = program(SOURCE, "Main", "codesys")
    scan(made)
    names = list(made.internal_names())
    assert {"live.real", "live.frame.length", "live.frames[2].ok", "live.bytes", "list[1].halves.whole"} <= set(names)
    shown = {name: found.value for name in names if (found := made.internal(name)) is not None}
    assert (shown["live.real"], shown["live.word"], shown["live.grid"]) == (1.0, 0, "[0, 16256, 0, 0]")
    assert (shown["live.bytes"], shown["list[1].halves.whole"]) == ("[0, 0, 128, 63, 0, 0, ... 16 elements]", 3)


def test_a_retained_union_keeps_its_bytes() -> None:
    first, second = program(SOURCE, "Main", "codesys"), program(SOURCE, "Main", "codesys")
    first.execute(ScanInfo(0, 1, True))
    kept = json.loads(json.dumps(first.retained()))
    second.restore(kept)
    second.execute(ScanInfo(0, 1, True))
    assert (second.st_body.v_kept.m_int, second.st_body.v_list[1].m_halves.m_whole) == (-2, 3)
    assert second.st_body.v_live.m_real == 1.0
    other = SOURCE.replace("kept : Data", "kept : Halves").replace("kept.int := kept.int - 1;", "kept.whole := 1;")
    assert program(other, "Main", "codesys").retained() != kept


def test_the_state_of_a_program_has_its_unions_and_a_copy_is_separate() -> None:
    text = SOURCE.replace(
        "VAR live : Data;", "VAR live : Data; p : POINTER TO BYTE := ADR(live.bytes[8]); f : REFERENCE TO Frame;"
    )
    text = text.replace("END_PROGRAM", "f REF= live.frame; p^ := p^ + 1; END_PROGRAM")
    first, second = program(text, "Main", "codesys"), program(text, "Main", "codesys")
    for made in (first, second):
        scan(made)
    other = copy.deepcopy(first)
    assert first.whole_state(0) == second.whole_state(0) == other.whole_state(0)
    scan(other, 2)
    assert first.whole_state(0) == second.whole_state(0) != other.whole_state(0)
    assert [made.st_body.v_live.m_bytes[8] for made in (first, other)] == [1, 2]
    assert first.st_body.v_live.m_frame.m_length != 9
    other.st_body.v_f.v.m_length = 9
    assert other.st_body.v_live.m_frame.m_length == 9
