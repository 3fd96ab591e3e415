"""The findings of `fieldtwin plc check`, and their waivers."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from fieldtwin.cli.plc.check_command import check
from fieldtwin.explain.lookup import everything
from fieldtwin.plc.st.dialects import FINDINGS
from fieldtwin.plc.st.findings.find import findings
from fieldtwin.plc.st.findings.tasks import written_by_several_tasks
from fieldtwin.plc.st.syntax.parse import parse_all

ROOT = Path(__file__).parents[3]
SHIPPED = sorted((*(ROOT / "profiles").rglob("*.st"), *(ROOT / "examples").rglob("*.st")))
MODE = "TYPE Mode : (Idle, Run, Fault); END_TYPE VAR_GLOBAL CONSTANT SHARED : INT := 4; END_VAR\n"
VARIABLES = """VAR_INPUT x, y : REAL; n, m : INT; go : BOOL; END_VAR
VAR_OUTPUT q : BOOL; z : REAL; i : INT; END_VAR
VAR mode : Mode; after : TON; edge : R_TRIG; END_VAR
VAR CONSTANT TEN : INT := 10; END_VAR
after(IN := go, PT := T#1s); edge(CLK := go); q := after.Q OR edge.Q; z := x + y; i := n + m + TEN;
CASE mode OF Idle: ; ELSE ; END_CASE
"""


def ids(body: str) -> list[str]:
    unit = parse_all(f"{MODE}PROGRAM p\n{VARIABLES}{body}\nEND_PROGRAM", "p.st")
    return [one.id for one in findings(unit)]


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("", []),
        ("q := x = y;", ["ST102"]),
        ("q := x <> x;", []),  # the test for NaN
        ("q := INT_TO_REAL(n) <> 2.5;", ["ST102"]),
        ("q := x * 2.0 >= y;", []),
        ("q := n = m;", []),
        ("CASE mode OF Idle: i := 1; Run: i := 2; END_CASE", ["ST103"]),
        ("CASE mode OF Idle, Run: i := 1; Mode#Fault: i := 2; END_CASE", []),
        ("CASE mode OF Idle: i := 1; ELSE i := 2; END_CASE", []),
        ("CASE n OF 1: i := 1; END_CASE", []),
        ("i := n / m;", ["ST106"]),
        ("i := n MOD m;", ["ST106"]),
        ("IF m <> 0 THEN i := n / m; END_IF", []),
        ("IF m = 0 THEN RETURN; END_IF i := n / m;", []),
        ("i := n / TEN; i := n / SHARED; i := n / 2; i := n / MAX(m, 1);", []),
        ("q := m <> 0 AND_THEN n / m > 3;", []),
        ("FOR i := 1 TO 10 DO z := n / i; END_FOR", []),
        ("i := MAX(1, m); z := n / i;", []),
        ("i := n / 0;", ["ST106"]),
        ("z := x / 0.0;", ["ST106"]),
        ("RETURN; i := 1;", ["ST107"]),
        ("FOR i := 1 TO 3 DO EXIT; END_FOR", []),
        ("IF FALSE THEN i := 1; END_IF", ["ST107"]),
    ],
)
def test_a_suspicious_construct_is_found_and_a_sound_one_is_not(body: str, expected: list[str]) -> None:
    assert ids(body) == expected


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("t(IN := go); u(CU := go);", []),
        ("IF go THEN t(IN := TRUE); END_IF u(CU := go);", ["t"]),
        ("IF go THEN t(IN := TRUE); ELSE t(IN := FALSE); END_IF u();", []),
        ("IF go THEN t(IN := TRUE); END_IF t(IN := FALSE); u();", []),
        ("CASE n OF 1: t(); u(); 2: t(); ELSE t(); END_CASE", ["u"]),
        ("t(); u(); IF go THEN v(); END_IF", ["v"]),
        ("IF go THEN IF n = 1 THEN t(); ELSE t(); END_IF ELSE t(); END_IF u();", []),
    ],
)
def test_a_timer_has_to_be_called_in_every_branch(body: str, expected: list[str]) -> None:
    variables = "VAR_INPUT go : BOOL; n : INT; END_VAR VAR t : TON; u : CTU; v : CTU_DINT; END_VAR"
    unit = parse_all(f"PROGRAM p {variables}\n{body}\nEND_PROGRAM", "p.st")
    assert [one.message.split()[0] for one in findings(unit) if one.id == "ST105"] == expected


def test_unused_variables_and_unwritten_outputs_are_found() -> None:
    text = """PROGRAM p
VAR_INPUT a : BOOL; END_VAR
VAR_OUTPUT b : BOOL; c : BOOL := TRUE; d, e, f : BOOL; END_VAR
VAR g, h : INT; size : INT; kept AT %MW0 : INT; other : Block; END_VAR
VAR_TEMP k : INT; END_VAR
INITIAL_STEP One: d(N); END_STEP
ACTION Go: other(x => e, y := f); END_ACTION
END_PROGRAM
FUNCTION_BLOCK Block VAR_OUTPUT x : BOOL; END_VAR VAR_IN_OUT y : BOOL; END_VAR x := y; END_FUNCTION_BLOCK"""
    found = list(findings(parse_all(text, "p.st")))
    assert [(one.id, one.line) for one in found] == [("ST101", 4)] * 3 + [("ST101", 5), ("ST104", 3)]
    assert [one.message.split()[0] for one in found[:4]] == ["g", "h", "size", "k"]
    assert found[4].message == "the output b is never written"


CLASSES = """INTERFACE Level METHOD Read : INT VAR_OUTPUT valid : BOOL; END_VAR END_METHOD END_INTERFACE
FUNCTION_BLOCK Base
VAR_OUTPUT a, b, c : INT; END_VAR
VAR own, derived, through_this, unused : INT; END_VAR
METHOD PUBLIC Go : INT
VAR_INPUT by : INT; END_VAR
VAR_OUTPUT never : BOOL; END_VAR
VAR left_over : INT; after : TON; END_VAR
a := own + THIS.through_this;
IF by > 3 THEN after(); END_IF
Go := 10 / by;
RETURN;
Go := 1;
END_METHOD
END_FUNCTION_BLOCK
FUNCTION_BLOCK Top EXTENDS Base
THIS.b := derived;
END_FUNCTION_BLOCK
"""


def test_methods_have_findings_and_use_the_variables_of_their_block() -> None:
    found = list(findings(parse_all(CLASSES, "p.st")))
    assert [(one.id, one.line, one.message.split()[0]) for one in found if one.id in ("ST101", "ST104")] == [
        ("ST101", 4, "unused"),
        ("ST104", 3, "the"),
        ("ST101", 8, "left_over"),
        ("ST104", 7, "the"),
    ]
    assert [one.message for one in found if one.id == "ST104"] == [
        "the output c is never written",
        "the output never is never written",
    ]
    assert [(one.id, one.line) for one in found if one.id in ("ST105", "ST107")] == [("ST105", 10), ("ST107", 13)]


def test_every_finding_is_explained() -> None:
    assert {one.id for one in everything()} >= set(FINDINGS)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_the_shipped_programs_have_no_findings(path: Path) -> None:
    assert not list(findings(parse_all(path.read_text("utf-8"), str(path))))


def checked(*arguments: str) -> Result:
    return CliRunner().invoke(check, arguments, standalone_mode=False)


X = "FUNCTION x VAR_INPUT s : STRING; END_VAR END_FUNCTION "
DIVISION = (
    X
    + """PROGRAM p VAR_INPUT a, b : INT; END_VAR VAR_OUTPUT q : INT; END_VAR
{before}q := a / b;{after}
END_PROGRAM
"""
)
FOUND = "ST106 a division by b, which no condition tests for 0"


@pytest.mark.parametrize(
    ("before", "after", "listed"),
    [
        ("", "", [f"p.st:2:10: {FOUND}"]),
        ("", " // fieldtwin: allow ST106: b is a gear ratio", []),
        ("(* fieldtwin: allow ST106: b is a gear ratio *)\n", "", []),
        ("(* the next line\n   fieldtwin: allow ST106: b is a gear ratio *)\n", "", []),
        ("x('// fieldtwin: allow ST106: in a string');\n", "", [f"p.st:3:10: {FOUND}"]),
        (
            "",
            " // fieldtwin: allow ST106",
            ["p.st:2:1: ST100 the waiver of ST106 has no reason", f"p.st:2:10: {FOUND}"],
        ),
        (
            "// fieldtwin: allow ST101: no\n",
            "",
            ["p.st:2:1: ST100 the waiver of ST101 matches no", f"p.st:3:10: {FOUND}"],
        ),
        (
            "// fieldtwin: allow ST999: no\n",
            "",
            ["p.st:2:1: ST100 the waiver names no warning: ST999", "p.st:3:10: ST106"],
        ),
    ],
)
def test_a_waiver_with_a_reason_accepts_a_finding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: str, after: str, listed: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("p.st").write_text(DIVISION.format(before=before, after=after))
    done = checked("p.st")
    assert done.return_value == 0
    lines = done.output.splitlines()[:-1]
    assert len(lines) == len(listed)
    assert all(line.startswith(text) for line, text in zip(lines, listed, strict=True)), lines


def test_a_finding_can_be_an_error_and_a_waived_one_is_in_the_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("p.st").write_text(DIVISION.format(before="", after=""))
    assert checked("p.st", "--error", "st106").return_value == 1
    Path("p.st").write_text(DIVISION.format(before="", after=" // fieldtwin: allow ST106: b is a gear ratio"))
    done = checked("p.st", "--error", "all", "--json")
    assert done.return_value == 0
    (waived,) = json.loads(done.output)["waived"]
    assert (waived["id"], waived["line"], waived["reason"]) == ("ST106", 2, "b is a gear ratio")


SHARED = """VAR_GLOBAL total, other : INT; END_VAR
FUNCTION_BLOCK Adder VAR_INPUT x : INT; END_VAR
total := total + x;
END_FUNCTION_BLOCK
PROGRAM Fast VAR total : INT; END_VAR
total := 1; other := 2;
END_PROGRAM
PROGRAM Slow VAR adder : Adder; END_VAR
adder(x := 1);
END_PROGRAM
PROGRAM Third VAR_EXTERNAL total : INT; END_VAR
total := 3;
END_PROGRAM
"""


@pytest.mark.parametrize(
    ("tasks", "lines"),
    [
        ({"fast": "quick", "slow": "slow"}, []),  # Fast has a variable of this name
        ({"slow": "slow", "third": "slow"}, []),
        ({"slow": "slow", "third": "quick"}, [12]),
        ({"slow": "slow"}, []),
        ({"third": "quick", "slow": "slow"}, [12]),
    ],
)
def test_a_variable_that_two_tasks_write_is_found_through_function_blocks(
    tasks: dict[str, str], lines: list[int]
) -> None:
    found = list(written_by_several_tasks(parse_all(SHARED, "p.st"), tasks))
    assert [one.line for one in found] == lines
    assert all(one.message == "total is written by Slow (task slow) and Third (task quick)" for one in found)


def test_a_variable_that_two_tasks_write_is_found_through_interfaces_and_bases() -> None:
    text = """VAR_GLOBAL total, local : INT; END_VAR
INTERFACE Adding METHOD Add END_METHOD END_INTERFACE
FUNCTION_BLOCK Adder IMPLEMENTS Adding
METHOD PUBLIC Add VAR local : INT; END_VAR total := total + 1; local := 1; END_METHOD
END_FUNCTION_BLOCK
FUNCTION_BLOCK Derived EXTENDS Adder END_FUNCTION_BLOCK
PROGRAM Fast VAR adding : Adding; END_VAR
adding.Add();
END_PROGRAM
PROGRAM Slow VAR adder : Derived; END_VAR
local := 2;
adder.Add();
END_PROGRAM"""
    found = list(written_by_several_tasks(parse_all(text, "p.st"), {"fast": "quick", "slow": "slow"}))
    assert [(one.line, one.message) for one in found] == [
        (4, "total is written by Fast (task quick) and Slow (task slow)")
    ]


def test_the_tasks_of_a_system_are_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(ROOT / "examples" / "first-bug", tmp_path / "site")
    monkeypatch.chdir(tmp_path / "site")
    Path("p.st").write_text(SHARED)
    text = Path("tank.yaml").read_text()
    Path("tank.yaml").write_text(
        text[: text.index("plc:")]
        + "plc:\n  tasks: {slow: {interval_ms: 100}, quick: {interval_ms: 10}}\n"
        + "  programs:\n    a: {source: 'p.st:Slow'}\n    b: {source: 'p.st:Third', task: quick}\n"
    )
    done = checked("tank.yaml", "--error", "ST108")
    assert done.return_value == 1
    assert "p.st:12:1: ST108 total is written by Slow (task slow) and Third (task quick)" in done.output
