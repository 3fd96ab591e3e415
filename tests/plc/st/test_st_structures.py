"""Structures of CODESYS and TwinCAT that extend others or are empty, qualified names of libraries, and constant instances."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from st_bench import program, run, scan

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.binding import load_program
from fieldtwin.plc.st.compiler.compile import compile_text
from fieldtwin.plc.st.dialects import dialect_of

TYPES = """TYPE Axis EXTENDS Item : STRUCT position : REAL := 1.5; END_STRUCT END_TYPE
TYPE Item : STRUCT id : INT := 7; name : STRING; END_STRUCT END_TYPE
TYPE Nothing : STRUCT END_STRUCT END_TYPE
TYPE Last EXTENDS Axis : STRUCT END_STRUCT END_TYPE
"""


@pytest.mark.parametrize("dialect", ["codesys", "twincat"])
def test_a_structure_has_the_members_of_its_base_first(dialect: str) -> None:
    text = (
        TYPES
        + """PROGRAM p VAR a, b : Last := (position := 4.0); none, other : Nothing; id : INT; at : REAL; size : DINT; END_VAR
b.id := 9; a := b; id := a.id; at := a.position; none := other; size := SIZEOF(none); END_PROGRAM"""
    )
    made: Any = program(text, dialect=dialect)
    scan(made)
    assert (made.id, made.at, made.size) == (9, 4.0, 0)
    assert list(made.internal_names()) == ["a.id", "a.name", "a.position", "b.id", "b.name", "b.position"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("TYPE A EXTENDS\nB : STRUCT x : INT; END_STRUCT END_TYPE", "2:1: EXTENDS B: 'B' is not declared; expected a STRUCT"),
        ("TYPE A EXTENDS\nB : STRUCT END_STRUCT B : INT; END_TYPE", "2:1: EXTENDS B: 'B' is not declared"),
        ("TYPE A EXTENDS B : STRUCT END_STRUCT B EXTENDS\nA : STRUCT END_STRUCT END_TYPE", "2:1: B extends itself"),
        ("TYPE B : STRUCT x : INT; END_STRUCT A EXTENDS B : STRUCT\nX : INT; END_STRUCT END_TYPE", "2:1: X is declared twice"),
        ("TYPE B : STRUCT END_STRUCT A EXTENDS B,\nB : STRUCT END_STRUCT END_TYPE", "2:1: A extends two structures"),
    ],
)  # fmt: skip
def test_mistakes_in_the_bases_of_structures_are_refused(text: str, said: str) -> None:
    with pytest.raises(FileInvalid, match=said):
        compile_text(text, dialect=dialect_of("codesys"))


@pytest.mark.parametrize("dialect", ["standard", "matiec"])
def test_the_standard_has_no_such_structures(dialect: str) -> None:
    with pytest.raises(FileInvalid, match=r"EXTENDS of a structure is not in the standard"):
        compile_text(TYPES, dialect=dialect_of(dialect))
    with pytest.raises(FileInvalid, match=r"the structure E has no members; expected at least one member"):
        compile_text("TYPE E : STRUCT END_STRUCT; END_TYPE", dialect=dialect_of(dialect))


def test_the_name_of_a_library_may_stand_before_its_declarations(tmp_path: Path) -> None:
    (tmp_path / "Tools").mkdir()
    (tmp_path / "Tools" / "lib.st").write_text(
        "FUNCTION Twice : INT VAR_INPUT x : INT; END_VAR Twice := 2 * x; END_FUNCTION\n"
        "TYPE Kind : (small, large); Range : INT(0..9); END_TYPE\n"
        "FUNCTION_BLOCK Counter VAR_OUTPUT n : INT; END_VAR n := n + 1; END_FUNCTION_BLOCK\n"
    )
    (tmp_path / "main.st").write_text(
        "FUNCTION_BLOCK Mine EXTENDS Tools.Counter SUPER^(); END_FUNCTION_BLOCK\n"
        "PROGRAM Main VAR t : Tc2_Standard.TON; c : Mine; k : Tools.Kind := Tools.Kind#large; n, len : INT;\n"
        "r : Tools.Range; large : BOOL; END_VAR\n"
        "t(IN := TRUE, PT := T#0s); c(); n := Tools.Twice(c.n + 20); len := Standard.LEN('abc'); r := 5;\n"
        "large := k = Tools.Kind.large; END_PROGRAM\n"
    )
    made: Any = load_program(str(tmp_path / "main.st"), dialect="twincat", libraries=[str(tmp_path / "Tools")])
    scan(made)
    assert (made.n, made.len, made.k, made.r, made.large) == (42, 3, 1, 5, True)


def test_a_variable_with_the_name_of_a_library_has_precedence(tmp_path: Path) -> None:
    (tmp_path / "main.st").write_text(
        "TYPE S : STRUCT len : INT := 4; END_STRUCT END_TYPE\n"
        "PROGRAM Main VAR standard : S; n : INT; END_VAR n := standard.len; END_PROGRAM"
    )
    made: Any = load_program(str(tmp_path / "main.st"), dialect="codesys")
    scan(made)
    assert made.n == 4


def test_the_standard_knows_no_names_of_libraries(tmp_path: Path) -> None:
    (tmp_path / "main.st").write_text("PROGRAM Main VAR t : Standard.TON; END_VAR END_PROGRAM")
    with pytest.raises(FileInvalid, match=r"a type 'Standard\.TON' is not declared"):
        load_program(str(tmp_path / "main.st"))


@pytest.mark.parametrize("dialect", ["standard", "matiec"])
def test_an_instance_of_a_function_block_cannot_be_constant(dialect: str) -> None:
    text = "PROGRAM p VAR CONSTANT\nt : TON; END_VAR END_PROGRAM"
    with pytest.raises(
        FileInvalid, match="2:1: t is an instance of TON and cannot be CONSTANT; expected VAR without CONSTANT"
    ):
        compile_text(text, dialect=dialect_of(dialect))
    compile_text(text, dialect=dialect_of("codesys"))


ALIASES = """TYPE Level : INT := 3; Same : Level; Twice : ARRAY[0..1] OF Same; Again : Twice; END_TYPE
TYPE Pair : STRUCT a, b : INT; END_STRUCT; Three : Pair := (a := 3); Four : Three; Five : Four := (b := 5); END_TYPE
TYPE Row : ARRAY[0..2] OF INT := [3, 4]; Line : Row; Light : (red, amber, green); Go : Light := green; Now : Go; END_TYPE
TYPE Part : INT (0..10) := 7; Same_part : Part; Name : STRING[5] := 'abc'; Same_name : Name; END_TYPE
TYPE All : STRUCT level : Same; four : Four; line : Line; END_STRUCT END_TYPE
FUNCTION f : Same VAR_OUTPUT o : Four; END_VAR END_FUNCTION
"""


def test_a_type_without_an_initial_value_has_that_of_the_type_from_which_it_is_derived() -> None:
    """IEC 61131-3:2013, 6.4.4.1. Defect: only a variable of the very type that states the initial value had it, so that
    one of a type derived from it, and an element of an array, began with 0."""
    variables = """same : Same; again : Again; some : ARRAY[0..1, 0..1] OF Same; rest : ARRAY[0..2] OF Level := [1];
    four : Four; five : Five; line : Line; now : Now; part : Same_part; name : Same_name; all : All; out : Four; n : INT;"""
    made = run(variables, "n := f(o => out);", ALIASES)
    assert (made["same"], made["again"], made["some"], made["rest"]) == (3, [3, 3], [[3, 3], [3, 3]], [1, 3, 3])
    assert (made["four"].m_a, made["five"].m_a, made["five"].m_b, made["line"]) == (3, 3, 5, [3, 4, 0])
    assert (made["now"], made["part"], made["name"], made["n"], made["out"].m_a) == (2, 7, "abc", 3, 3)
    assert (made["all"].m_level, made["all"].m_four.m_a, made["all"].m_line) == (3, 3, [3, 4, 0])
    made["some"][0][0] = 9
    assert made["some"] == [[9, 3], [3, 3]]


@pytest.mark.parametrize(
    ("declared", "place", "what"),
    [
        ("VAR x : STRUCT a : INT; END_STRUCT; END_VAR", (1, 19), "STRUCT"),
        ("VAR\nx : ARRAY[1..2] OF struct\n\n a : INT; END_STRUCT; END_VAR", (2, 20), "STRUCT"),
        ("VAR x : REF_TO STRUCT a : INT; END_STRUCT; END_VAR", (1, 26), "STRUCT"),
        ("VAR x : STRUCT END_STRUCT; END_VAR", (1, 19), "STRUCT"),
        ("VAR x : UNION a : INT; END_UNION; END_VAR", (1, 19), "UNION"),
    ],
)
def test_a_structure_without_a_name_is_named_in_its_error(declared: str, place: tuple[int, int], what: str) -> None:
    """Defect: the message was: not Structured Text; expected :=, ;, EDGE, REF=; got a."""
    with pytest.raises(FileInvalid) as caught:
        compile_text(f"PROGRAM p {declared} END_PROGRAM", "p.st")
    error = caught.value
    assert (error.line, error.column) == place
    assert (error.message, error.expected) == (f"a {what} without a name", "the name of a type")
    assert error.hint == f"declare it, TYPE Name : {what} ... END_{what}; END_TYPE, and write Name here"


@pytest.mark.parametrize(
    "text", ["TYPE A : STRUCT 5 : INT; END_STRUCT; END_TYPE", "PROGRAM p VAR STRUCT a : INT; END_VAR END_PROGRAM"]
)
def test_other_errors_near_the_word_are_as_before(text: str) -> None:
    with pytest.raises(FileInvalid, match="not Structured Text"):
        compile_text(text, "p.st")
