"""The coverage of Structured Text by unit tests: statements, branches and transitions."""

from __future__ import annotations

from pathlib import Path

from fieldtwin.plc.st.coverage.places import Coverage, Kind, line_ranges
from fieldtwin.plc.st.unit_tests.suite import load_suite

MACHINE = """TYPE States : (IDLE, RUN, FAULT); END_TYPE
FUNCTION_BLOCK Machine
VAR_INPUT go, bad : BOOL; END_VAR
VAR_OUTPUT state : States; END_VAR
  IF bad THEN
    state := FAULT;
  END_IF
  CASE state OF
    IDLE:
      IF go THEN
        state := RUN;
      END_IF
    RUN:
      IF NOT go THEN
        state := IDLE;
      END_IF
  END_CASE
END_FUNCTION_BLOCK
FUNCTION Unused : INT
  Unused := 1;
END_FUNCTION
"""


def covered(folder: Path, tests: str, source: str = MACHINE) -> Coverage:
    (folder / "machine.st").write_text(source)
    (folder / "machine.test.st").write_text(tests)
    suite = load_suite(folder / "machine.test.st")
    assert all(not result.error for result in suite.run())
    found = Coverage()
    found.add(suite.coverage())
    assert found.paths == [str(folder / "machine.st")]
    return found


def test_statements_branches_and_transitions_are_counted(tmp_path: Path) -> None:
    found = covered(
        tmp_path,
        """TEST 'x' VAR m : Machine; END_VAR
        m(go := TRUE); m(bad := TRUE); END_TEST""",
    )
    # lines with a statement: 5, 6, 8, 10, 11, 14, 15 and 20
    assert found.count(Kind.STATEMENT) == (5, 8)
    assert [place.line for place in found.missed(Kind.STATEMENT)] == [14, 15, 20]
    # IF bad: both; CASE: IDLE and ELSE of three; IF go: THEN of two; IF NOT go: none of two
    assert found.count(Kind.BRANCH) == (5, 9)
    assert found.count(Kind.TRANSITION) == (2, 4)
    assert [place.name for place in found.missed(Kind.TRANSITION)] == [
        "Machine.state IDLE -> FAULT",
        "Machine.state RUN -> IDLE",
    ]


def test_a_transition_of_an_assignment_outside_of_the_case_counts_by_its_source(tmp_path: Path) -> None:
    found = covered(tmp_path, "TEST 'x' VAR m : Machine; END_VAR m(bad := TRUE); END_TEST")
    names = {place.name for place in found.missed(Kind.TRANSITION)}
    assert "Machine.state IDLE -> FAULT" not in names
    assert "Machine.state RUN -> FAULT" in names


def test_a_transition_may_leave_a_range_of_numbers(tmp_path: Path) -> None:
    source = """FUNCTION_BLOCK Machine VAR_OUTPUT n : INT := 3; END_VAR
    CASE n OF 1..5: n := 7; 7: ; END_CASE
    END_FUNCTION_BLOCK"""
    found = covered(tmp_path, "TEST 'x' VAR m : Machine; END_VAR m(); END_TEST", source)
    assert found.count(Kind.TRANSITION) == (1, 1)


def test_transitions_of_a_chart_are_counted(tmp_path: Path) -> None:
    chart = """FUNCTION_BLOCK Chart
    VAR_INPUT go : BOOL; END_VAR
    INITIAL_STEP Rest: END_STEP
    STEP Work: END_STEP
    TRANSITION FROM Rest TO Work := go; END_TRANSITION
    TRANSITION FROM Work TO Rest := NOT go; END_TRANSITION
    END_FUNCTION_BLOCK"""
    found = covered(tmp_path, "TEST 'x' VAR c : Chart; END_VAR c(); c(go := TRUE); END_TEST", chart)
    assert found.count(Kind.TRANSITION) == (1, 2)
    assert [place.name for place in found.missed(Kind.TRANSITION)] == ["Chart Work -> Rest"]


def test_probes_do_not_change_what_a_program_does(tmp_path: Path) -> None:
    loops = """FUNCTION Sum : INT VAR_INPUT last : INT; END_VAR VAR n : INT; END_VAR
    FOR n := 1 TO last DO IF n = 3 THEN CONTINUE; END_IF IF n > 5 THEN EXIT; END_IF Sum := Sum + n; END_FOR
    REPEAT Sum := Sum + 100; UNTIL Sum > 150 END_REPEAT
    IF Sum < 0 THEN RETURN; ELSIF Sum < 10 THEN Sum := 0; ELSE Sum := Sum + 1000; END_IF
    END_FUNCTION"""
    (tmp_path / "machine.st").write_text(loops)
    (tmp_path / "machine.test.st").write_text("TEST 'x' ASSERT_EQ(Sum(9), 1212); END_TEST")  # 1+2+4+5, 2*100, 1000
    (result,) = load_suite(tmp_path / "machine.test.st").run()
    assert not result.failed
    assert not result.error


def test_coverages_of_two_files_add_up(tmp_path: Path) -> None:
    one = covered(tmp_path, "TEST 'x' VAR m : Machine; END_VAR m(go := TRUE); END_TEST")
    other = covered(tmp_path, "TEST 'x' ASSERT_EQ(Unused(), 1); END_TEST")
    both = Coverage()
    both.add(one.executed)
    both.add(other.executed)
    assert (one.count(Kind.STATEMENT), other.count(Kind.STATEMENT)) == ((4, 8), (1, 8))
    assert both.count(Kind.STATEMENT) == (5, 8)


def test_ranges_of_lines() -> None:
    assert line_ranges([7, 3, 9, 8, 8]) == "3, 7-9"


def test_statements_of_methods_are_counted(tmp_path: Path) -> None:
    source = """CLASS Counter
VAR n : INT; END_VAR
METHOD PUBLIC Up : INT
  n := n + 1;
  IF n > 1 THEN
    n := 0;
  END_IF
  Up := n;
END_METHOD
METHOD PUBLIC Unused
  n := 3;
END_METHOD
END_CLASS
"""
    found = covered(tmp_path, "TEST 'x' VAR c : Counter; END_VAR ASSERT_EQ(c.Up(), 1); END_TEST", source)
    assert [place.line for place in found.missed(Kind.STATEMENT)] == [6, 11]
    assert found.count(Kind.STATEMENT) == (3, 5)
