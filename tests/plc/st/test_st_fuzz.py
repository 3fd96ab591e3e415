"""Unintended Structured Text: random tokens, mutated programs, expressions of any types, very large programs.

For any input, compiling gives a program or `FileInvalid` with line and column, in bounded time; running it raises only
`LogicError`.
"""

from __future__ import annotations

import random
import re
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from st_bench import scan

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.values import Quality, TagValue
from fieldtwin.plc.st.compiler.compile import compile_text
from fieldtwin.plc.st.program import program_class
from fieldtwin.plc.st.resource import attributes_of
from fieldtwin.plc.st.values import LogicError

ROOT = Path(__file__).resolve().parents[3]
RELAY = (ROOT / "profiles" / "systems" / "relay.st").read_text()
PIECES = """
TYPE Mode : (idle, busy := 5, done); Level : INT(0..100) := 7;
  Point : STRUCT x : REAL := 1.5; y : ARRAY[1..3] OF INT := [1, 2(4)]; END_STRUCT; END_TYPE
VAR_GLOBAL CONSTANT size : INT := 4; END_VAR
VAR_GLOBAL shared : ARRAY[0..size] OF DINT; END_VAR
FUNCTION twice : INT VAR_INPUT n : INT := 3; END_VAR VAR_OUTPUT was : INT; END_VAR VAR_IN_OUT p : Point; END_VAR
  was := n; p.x := p.x + 1; twice := n * 2; END_FUNCTION
FUNCTION_BLOCK Blink VAR_INPUT on : BOOL; END_VAR VAR_OUTPUT q : BOOL; END_VAR VAR t : TON; n : INT; END_VAR
  t(IN := on AND NOT t.Q, PT := T#10ms, Q => q); IF q THEN n := n + 1; END_IF; END_FUNCTION_BLOCK
INTERFACE Reader METHOD Read : INT VAR_INPUT by : INT := 2; END_VAR VAR_OUTPUT ok : BOOL; END_VAR END_METHOD END_INTERFACE
CLASS ABSTRACT Base IMPLEMENTS Reader VAR n : INT; END_VAR VAR PUBLIC m : INT; END_VAR
  METHOD PUBLIC Read : INT VAR_INPUT by : INT := 2; END_VAR VAR_OUTPUT ok : BOOL; END_VAR n := THIS.n + by; ok := TRUE;
  Read := n + More(); END_METHOD METHOD PROTECTED ABSTRACT More : INT END_METHOD END_CLASS
FUNCTION_BLOCK Own EXTENDS Base METHOD PROTECTED OVERRIDE More : INT VAR b : Blink; END_VAR b(); More := m; END_METHOD
  METHOD PUBLIC OVERRIDE Read : INT VAR_INPUT by : INT := 2; END_VAR VAR_OUTPUT ok : BOOL; END_VAR
  Read := SUPER.Read(by, ok => ok); END_METHOD n := n + 1; END_FUNCTION_BLOCK
NAMESPACE Lib.Inner USING Lib; TYPE Kind : (one, two); END_TYPE FUNCTION pick : Kind pick := Kind#two; END_FUNCTION
  END_NAMESPACE NAMESPACE Lib TYPE Gain : INT := 3; END_TYPE END_NAMESPACE
PROGRAM p USING Lib.Inner; VAR k : Kind; g : Lib.Gain; o : Own; reader : Reader; END_VAR
VAR_INPUT go : BOOL; END_VAR VAR_OUTPUT out : REAL; END_VAR
VAR b : ARRAY[1..2] OF Blink; m : Mode := busy; l : Level; s : STRING[9] := 'a$'b'; pt : Point; i, j : INT; w : WORD; END_VAR
VAR RETAIN kept : DINT := -5; END_VAR
b[1](on := go); i := twice(n := i, was => j, p := pt);
CASE m OF idle, busy: m := done; (* on *) done: m := Mode#idle; ELSE ; END_CASE;
FOR i := 10 TO 1 BY -2 DO IF i = 4 THEN CONTINUE; ELSIF i = 2 THEN EXIT; END_IF; shared[i MOD size] := i; END_FOR;
WHILE twice(n := j, p := pt) < 20 DO j := j + 1; END_WHILE;
REPEAT j := j - 1; UNTIL j <= 0 END_REPEAT;
s := CONCAT(LEFT(s, 2), MID(s, 1, 2), INT_TO_STRING(i)); w.3 := go; w := SHL(w, 1) OR 16#F0;
out := REAL#2.5 ** 2 / 3 + SQRT(2.0) * SEL(go, 1.0, 2.0); kept := TRUNC(out) + LEN(s);
k := pick(); k := Lib.Inner.pick(); g := g + 1; reader := o; o();
 o.m := reader.Read(by := i) + o.Read(); IF reader <> NULL THEN reader := NULL; END_IF;
IF IS_GOOD(go) AND_THEN b[1].q OR_ELSE FIRST_SCAN() THEN RETURN; END_IF;
END_PROGRAM
"""
TOKENS = sorted({
    *re.split(r"([(),;])|\s", PIECES), "[",
    "]", "..", ".", ":=", "=>", ":", "**", "^", "&", "%IX0.0", "AT", "'x'", '"w"', "$", "#",
    "16#FF", "2#2", "1e400", "T#1d", "T#1h1h", "D#2024-02-30", "TOD#24:00:00", "9" * 40, "1_0", "-", "+", "\0", "\u017f",
    "\u00e9", "\u2028", "\r", "//", "(*", "*)", "{", "}", "'", '"', "class", "None", "self",
} - {None})  # fmt: skip
quick = settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))


def survives(text: str, scans: int = 2) -> str:
    """Compile it and run its programs. Return the result."""
    try:
        unit = compile_text(text, "fuzz.st")
        programs = [program_class(unit, p.name)() for p in unit.programs]
    except FileInvalid as e:
        if not (e.line > 0 and e.column > 0):
            raise AssertionError("no line and column") from e
        return "refused"
    try:
        for made in programs:
            made._lookup = lambda name: TagValue(1, Quality.GOOD)
            for number in range(1, scans + 1):
                scan(made, number)
    except LogicError:
        return "stopped"
    return "ran"


def test_the_pieces_run_as_they_are() -> None:
    assert survives(PIECES, scans=3) == "ran"


@given(st.lists(st.sampled_from(TOKENS), max_size=40))
@quick
def test_random_tokens_give_only_typed_errors(tokens: list[str]) -> None:
    survives("PROGRAM p VAR i : INT; END_VAR " + " ".join(tokens) + " END_PROGRAM", scans=0)
    survives(" ".join(tokens), scans=0)


@given(st.randoms(use_true_random=False), st.sampled_from((PIECES, RELAY)))
@quick
def test_mutated_programs_give_only_typed_errors(chance: random.Random, text: str) -> None:
    words = text.split(" ")
    for _ in range(chance.randint(1, 3)):
        at = chance.randrange(len(words))
        what = chance.randrange(4)
        if what == 0:
            words.insert(at, chance.choice(TOKENS))
        elif what == 1:
            words[at] = chance.choice(TOKENS)
        elif what == 2:
            del words[at : at + chance.randint(1, 3)]
        else:
            other = chance.randrange(len(words))
            words[at], words[other] = words[other], words[at]
    survives(" ".join(words), scans=0)  # the mutation may have made an endless loop


@given(st.text(max_size=60))
@example("\ufeffPROGRAM p END_PROGRAM")
@example("PROGRAM p\r\nEND_PROGRAM\r")
@quick
def test_any_text_gives_only_typed_errors(text: str) -> None:
    survives(text)


# -- expressions of any types, which run ------------------------------------------------------------------------------

VARIABLES = {
    "b": "BOOL", "i": "INT", "u": "USINT", "d": "DINT", "l": "LINT", "ul": "ULINT", "w": "WORD", "lw": "LWORD", "r": "REAL",
    "lr": "LREAL", "t": "TIME", "lt": "LTIME", "s": "STRING[12]", "ws": "WSTRING[5]", "dt1": "DT", "tod1": "TOD", "day": "DATE",
    "e": "Mode", "sub": "Level",
}  # fmt: skip
ATOMS = [
    *VARIABLES, "0", "1", "-1", "7", "32768", "-2147483649", "18446744073709551615", "0.0", "1.5", "1e38", "1e308", "TRUE",
    "'abc'", '"w"', "''", "T#1h", "T#-5ms", "LT#1ns", "D#1970-01-01", "TOD#12:00", "DT#2024-02-29-12:00:00", "busy", "INT#-3",
    "BYTE#255", "a[i]", "a[2]", "i.3", "w.15",
]  # fmt: skip
OPERATORS = ["+", "-", "*", "/", "MOD", "**", "AND", "OR", "XOR", "AND_THEN", "OR_ELSE", "=", "<>", "<", ">="]
FUNCTIONS = {
    "ABS": 1, "SQRT": 1, "LN": 1, "EXP": 1, "SIN": 1, "ATAN2": 2, "EXPT": 2, "MIN": 2, "MAX": 3, "LIMIT": 3, "SEL": 3, "MUX": 4,
    "SHL": 2, "SHR": 2, "ROL": 2, "LEN": 1, "LEFT": 2, "RIGHT": 2, "MID": 3, "CONCAT": 2, "INSERT": 3, "DELETE": 3,
    "REPLACE": 4, "FIND": 2, "TRUNC": 1, "TO_INT": 1, "TO_USINT": 1, "TO_REAL": 1, "TO_STRING": 1, "TO_TIME": 1, "TO_ULINT": 1,
    "TO_BOOL": 1, "TO_WORD": 1, "TO_LREAL": 1, "CHR": 1, "ASC": 1, "STRING_TO_INT": 1, "REAL_TO_INT": 1, "ADD": 2, "DIV": 2,
    "DT_TO_TOD": 1, "TO_DATE": 1, "TIME_TO_DINT": 1, "TO_WSTRING": 1, "f": 2,
}  # fmt: skip


def _call(made: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    return st.sampled_from(sorted(FUNCTIONS)).flatmap(
        lambda name: st.tuples(*[made] * FUNCTIONS[name]).map(lambda given: f"{name}({', '.join(given)})")
    )


expressions = st.recursive(
    st.sampled_from(ATOMS),
    lambda made: st.one_of(
        st.tuples(made, st.sampled_from(OPERATORS), made).map(lambda x: f"({' '.join(x)})"),
        st.tuples(st.sampled_from(["-", "NOT "]), made).map("".join),
        _call(made),
    ),
    max_leaves=5,
)
DECLARED = (
    "TYPE Mode : (idle, busy := 5, done); Level : INT(0..100); END_TYPE\n"
    "FUNCTION f : INT VAR_INPUT n, m : INT; END_VAR f := n + m; END_FUNCTION\n"
    f"PROGRAM p VAR a : ARRAY[0..3] OF INT; {' '.join(f'{n} : {k};' for n, k in VARIABLES.items())} END_VAR\n"
)
LIMITS = {
    "i": (-(2**15), 2**15 - 1), "u": (0, 255), "d": (-(2**31), 2**31 - 1), "l": (-(2**63), 2**63 - 1), "ul": (0, 2**64 - 1),
    "w": (0, 65535), "lw": (0, 2**64 - 1), "t": (-(2**63), 2**63 - 1), "sub": (0, 100), "e": (0, 6),
}  # fmt: skip


@given(st.lists(st.tuples(st.sampled_from([*VARIABLES, "a[i]", "w.3", "i.15"]), expressions), min_size=1, max_size=4))
@settings(quick, max_examples=60)
def test_expressions_of_any_types(assigned: list[tuple[str, str]]) -> None:
    """Each variable has a value of its type after the run."""
    good = [f"{name} := {code};" for name, code in assigned if _compiles(f"{name} := {code};")]
    made = program_class(compile_text(DECLARED + "\n".join(good) + "\nEND_PROGRAM", "fuzz.st"))()
    try:
        for number in (1, 2, 3):
            scan(made, number)
    except LogicError:
        pass
    held = attributes_of(made.st_body)
    for name, (low, high) in LIMITS.items():
        value = held[f"v_{name}"]
        assert type(value) is int, (name, value)
        assert low <= value <= high, (name, value)
    assert type(held["v_b"]) is bool
    assert type(held["v_r"]) is float
    assert type(held["v_lr"]) is float
    assert len(held["v_s"]) <= 12
    assert len(held["v_ws"]) <= 5
    assert all(type(x) is int and -(2**15) <= x < 2**15 for x in held["v_a"])


def _compiles(statement: str) -> bool:
    return survives(DECLARED + statement + "\nEND_PROGRAM", scans=0) != "refused"


# -- very large programs -------------------------------------------------------------------------------------------------

P = "PROGRAM p VAR i : INT; l : LREAL; b : BOOL; q : ARRAY[0..9] OF INT; END_VAR\n"
BY_COUNT = "TYPE s0 : STRUCT a : INT; END_STRUCT; END_TYPE\n" + "\n".join(
    f"TYPE s{n} : STRUCT a, b : s{n - 1}; END_STRUCT; END_TYPE" for n in range(1, 30)
)
HUGE = {
    "a power of integers": (P + "l := 10 ** 10 ** 10 ** 10;", "refused"),
    "a power at run time": (P + "i := 9999; l := i ** i ** i;", "ran"),
    "many digits": (P + f"i := {'9' * 5000};", "refused"),
    "a product of many digits": (P + f"i := {' * '.join(['9999999999'] * 400)};", "refused"),
    "a real beyond all": (P + "l := 1e999;", "refused"),
    "reals beyond all": (P + "l := 1e300 * 1e300;", "refused"),
    "bits of an index": (P + f"b := i.{'1' * 5000};", "refused"),
    "a base that has no such digit": ("TYPE e : (x := 2#9); END_TYPE", "refused"),
    "a long name": (P + f"{'n' * 100_000} := 1;", "refused"),
    "a long string": (P + f"i := LEN('{'x' * 70_000}');", "refused"),
    "a comment without an end": ("(*" * 10_000, "refused"),
    "parentheses": (P + "i := " + "(" * 5_000 + "i" + ")" * 5_000 + ";", "ran"),
    "parentheses that are kept": (P + "i := " + "(i + " * 500 + "i" + ")" * 500 + ";", "refused"),
    "NOT": (P + "b := " + "NOT " * 500 + "b;", "refused"),
    "a chain of OR": (P + "b := " + " OR ".join(["b"] * 1000) + ";", "ran"),
    "a sum": (P + "i := " + " + ".join(["i"] * 1000) + ";", "ran"),
    "calls": (P + "i := " + "ABS(" * 70 + "i" + ")" * 70 + ";", "ran"),
    "indices": (P + "i := " + "q[" * 70 + "1" + "]" * 70 + ";", "ran"),
    "IF in IF": (P + "IF b THEN " * 100 + "i := 1;" + "END_IF;" * 100, "refused"),
    "ELSIF": (P + "IF b THEN i := 1; " + "ELSIF b THEN i := 2; " * 300 + "ELSE i := 3; END_IF", "ran"),
    "FOR in FOR": (
        P.replace("b :", ", ".join(f"i{n}" for n in range(25)) + " : INT; b :")
        + "".join(f"FOR i{n} := 1 TO 1 DO " for n in range(25))
        + "l := 1;"
        + "END_FOR;" * 25,
        "refused",
    ),
    "an array of arrays": ("PROGRAM p VAR a : ARRAY[1..1000000] OF ARRAY[1..1000000] OF INT; END_VAR", "refused"),
    "ARRAY OF ARRAY OF": (f"PROGRAM p VAR a : {'ARRAY[1..1] OF ' * 200} INT; END_VAR", "refused"),
    "a structure that doubles": (f"{BY_COUNT} PROGRAM p VAR a : s29; END_VAR", "refused"),
    "repeated values": ("PROGRAM p VAR a : ARRAY[1..9] OF INT := [999999999(1)]; END_VAR", "refused"),
    "labels": (P + "CASE i OF " + " ".join(f"{n}: i := {n};" for n in range(1, 400)) + " END_CASE", "ran"),
    "labels with names": (P + "CASE i OF " + ", ".join(["x"] * 3000) + ": i := 1; END_CASE", "refused"),
    "shifts": (P.replace("b :", "w : DWORD; b :") + "w := SHL(w, 1000000000) OR ROL(w, 1000000000);", "ran"),
    "too long a file": (P + " " * 4_000_000, "refused"),
}


@pytest.mark.parametrize("what", HUGE)
def test_huge_programs_are_refused_or_run(what: str) -> None:
    text, expected = HUGE[what]
    assert survives(text + ("" if text.endswith("(*") else "\nEND_PROGRAM")) == expected


def test_each_branch_of_a_long_chain_is_taken() -> None:
    """ELSIF and CASE with more branches than Python can nest: each one is taken, and the ELSE."""
    cases = " ".join(f"{3 * n}, {3 * n + 1}: r := {n};" for n in range(200))
    branches = "".join(f"ELSIF n = {n} THEN e := {n}; " for n in range(200))
    text = f"IF FALSE THEN ; {branches}ELSE e := -1; END_IF; CASE n OF {cases} ELSE r := -1; END_CASE"
    made = program_class(compile_text(f"PROGRAM p VAR n, r, e : INT; END_VAR {text} END_PROGRAM"))()
    for n in (-1, 0, 1, 2, 3, 47, 48, 95, 96, 97, 144, 199, 200, 299, 300, 598, 599, 600):
        made.st_body.v_n = n
        scan(made)
        assert made.st_body.v_r == (n // 3 if 0 <= n < 600 and n % 3 != 2 else -1), n
        assert made.st_body.v_e == (n if 0 <= n < 200 else -1), n
