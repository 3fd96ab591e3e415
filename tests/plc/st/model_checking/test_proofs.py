"""Properties are proved, bounded or violated, and no counterexample is reported that the program does not do.

The expected results follow from IEC 61131-3, such as the timing diagrams of TON and the wrap-around of UINT.
"""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.plc.program import ScanInfo
from fieldtwin.plc.st.compiler.compile import compile_text
from fieldtwin.plc.st.dialects import STANDARD, Dialect, dialect_of
from fieldtwin.plc.st.model_checking.execution.natives import BUILTINS
from fieldtwin.plc.st.model_checking.proof import NO_FAILURE, Limits, Question, Report, Result, prove
from fieldtwin.plc.st.model_checking.properties import named
from fieldtwin.plc.st.model_checking.replay import ModelDisagrees
from fieldtwin.plc.st.program import program_class
from fieldtwin.plc.st.syntax.parse import parse

PUMP = """
TYPE State : (Idle, Starting, Running, Fault, Unused); END_TYPE
PROGRAM Pump
VAR_INPUT start, stop, flow : BOOL; END_VAR
VAR_OUTPUT motor : BOOL; END_VAR
VAR state : State; no_flow : TON; starts : UINT; END_VAR
  no_flow(IN := motor AND NOT flow, PT := T#3s);
  CASE state OF
    State#Idle: IF start AND NOT stop THEN state := State#Starting; starts := starts + 1; END_IF
    State#Starting: IF flow THEN state := State#Running; END_IF
    State#Running: IF NOT flow THEN state := State#Starting; END_IF
    State#Fault: IF stop THEN state := State#Idle; END_IF
    State#Unused: motor := FALSE;
  END_CASE
  IF stop AND state <> State#Fault THEN state := State#Idle; END_IF
  IF no_flow.Q THEN state := State#Fault; END_IF
  motor := state = State#Starting OR state = State#Running;
END_PROGRAM
"""


def proved(
    text: str, *invariants: str, assume: Sequence[str] = (), scans: int = 8, interval_ms: tuple[float, float] = (10, 60_000),
    dialect: Dialect = STANDARD,
) -> Report:  # fmt: skip
    unit = parse(text)
    program = next(pou.name for pou in unit.pous if pou.kind == "PROGRAM")
    low, high = (round(ms * 1e6) for ms in interval_ms)
    question = Question(
        unit, "", program, dialect, tuple(map(named, invariants)), tuple(map(named, assume)), (low, high)
    )
    return prove(question, Limits(scans, lambda: 50.0))


def one(report: Report) -> Result:
    """Return the result of the first invariant."""
    return report.invariants[0]


def test_an_invariant_that_every_scan_keeps_is_proved_for_all_scans() -> None:
    report = proved(PUMP, "NOT (motor AND stop)")
    assert [r.verdict for r in report.invariants] == ["proved", "proved"]
    assert report.proved
    assert report.invariants[-1].name == NO_FAILURE


def test_a_violated_invariant_has_the_fewest_scans_and_the_shortest_time() -> None:
    result = one(proved(PUMP, "no fault: state <> State#Fault"))
    assert (result.name, result.verdict) == ("no fault", "violated")
    way = result.answer.way
    assert way is not None
    # scan 1 starts the motor, scan 2 calls TON with IN = TRUE for the first time, and scan 3 comes PT later
    assert [dict(scan.values)["start"] for scan in way] == [True, True, True]
    assert [scan.after_ns for scan in way] == [10_000_000, 10_000_000, 3_000_000_000]
    assert result.values["motor"] is False
    assert result.values["state"] == 3


def test_a_counterexample_happens_in_the_program_itself() -> None:
    way = one(proved(PUMP, "starts < 2")).answer.way
    assert way is not None
    program = program_class(compile_text(PUMP))()
    now_ns = 0
    for number, scan in enumerate(way, 1):
        now_ns += scan.after_ns
        program.__dict__.update(scan.values)
        program.execute(ScanInfo(now_ns, number, number == 1))
        assert (program.__dict__["starts"] == 2) == (number == len(way))


def test_what_is_neither_proved_nor_violated_is_bounded() -> None:
    report = proved(PUMP, "starts < 1000", scans=4)
    result = one(report)
    assert (result.verdict, result.answer.scans) == ("bounded", 4)
    assert result.answer.reason == "the limit of 4 scans was reached"
    assert not report.proved


def test_the_time_limit_ends_the_search() -> None:
    unit = parse(PUMP)
    left = iter([50.0] * 3)
    result = one(
        prove(Question(unit, "", "Pump", invariants=(("n", "starts < 1000"),)), Limits(50, lambda: next(left, 0.0)))
    )
    assert result.verdict == "bounded"
    assert result.answer.reason == "the time limit was reached"


def test_states_are_reached_or_proved_to_be_unreachable() -> None:
    states = {s.state: (s.verdict, len(s.answer.way or ())) for s in proved(PUMP).states}
    assert states == {
        "Idle": ("reached", 0), "Starting": ("reached", 1), "Running": ("reached", 2), "Fault": ("reached", 3),
        "Unused": ("unreachable", 0),
    }  # fmt: skip


def test_a_state_that_is_not_reached_in_the_scans_is_open() -> None:
    text = PUMP.replace("IF no_flow.Q", "IF starts > 100")
    states = {s.state: s for s in proved(text, scans=3).states}
    assert states["Fault"].verdict == "open"
    assert states["Fault"].answer.scans == 3


def test_the_steps_of_a_chart_and_the_states_of_function_blocks_are_states() -> None:
    report = proved("""
    FUNCTION_BLOCK Door
    VAR_INPUT open : BOOL; END_VAR
    VAR phase : INT; END_VAR
      CASE phase OF
        0: IF open THEN phase := 10; END_IF
        10: IF NOT open THEN phase := 0; END_IF
        20: phase := 0;
      END_CASE
    END_FUNCTION_BLOCK
    PROGRAM Lock
    VAR_INPUT a, b : BOOL; END_VAR
    VAR left, right : Door; END_VAR
      INITIAL_STEP Closed: Both(N); END_STEP
      STEP Open: Both(N); END_STEP
      STEP Never: END_STEP
      TRANSITION FROM Closed TO Open := a; END_TRANSITION
      TRANSITION FROM Open TO Never := a AND NOT a; END_TRANSITION
      TRANSITION FROM Never TO Closed := TRUE; END_TRANSITION
      TRANSITION FROM Open TO Closed := NOT a; END_TRANSITION
      ACTION Both: left(open := FALSE); right(open := b); END_ACTION
    END_PROGRAM
    """)
    found = {f"{s.pou}.{s.state}": s.verdict for s in report.states}
    assert found == {
        "Door.0": "reached", "Door.10": "reached", "Door.20": "unreachable",
        "Lock.Closed": "reached", "Lock.Open": "reached", "Lock.Never": "unreachable",
    }  # fmt: skip


def test_an_invariant_that_needs_several_scans_is_proved_by_induction_over_them() -> None:
    text = """
    PROGRAM Ring
    VAR_INPUT go : BOOL; END_VAR
    VAR a, b, c : BOOL; END_VAR
      c := b; b := a; a := go AND NOT go;
    END_PROGRAM
    """
    result = one(proved(text, "NOT c"))
    assert result.verdict == "proved"


def test_invariants_that_hold_only_together_are_proved_together() -> None:
    text = """
    PROGRAM Twins
    VAR_INPUT go : BOOL; END_VAR
    VAR a, b : UINT; old : UINT; END_VAR
      old := a;
      IF go THEN a := b + 1; b := old + 1; END_IF
    END_PROGRAM
    """
    assert [r.verdict for r in proved(text, "a = b").invariants] == ["proved", "proved"]
    swapped = text.replace("a := b + 1; b := old + 1;", "a := b; b := old;").replace("a, b : UINT", "a, b : UINT := 3")
    assert proved(swapped, "a = 3", "b = 3").proved


def test_integers_wrap_around_as_in_the_program() -> None:
    text = """
    PROGRAM Odometer
    VAR_INPUT add : USINT; END_VAR
    VAR n, before : USINT; less : BOOL; END_VAR
      before := n; n := n + add; less := n < before;
    END_PROGRAM
    """
    result = one(proved(text, "NOT less"))
    assert result.verdict == "violated"
    assert result.values["n"] < result.values["before"]
    assert proved(text, "NOT less", assume=["add = 0"]).proved


def test_a_scan_that_divides_by_zero_is_a_violation_with_its_error() -> None:
    text = """
    PROGRAM Mean
    VAR_INPUT sum, count : INT; END_VAR
    VAR mean : INT; END_VAR
      mean := sum / count;
    END_PROGRAM
    """
    result = one(proved(text))
    assert (result.name, result.verdict) == (NO_FAILURE, "violated")
    assert "division by zero" in result.failure
    assert proved(text, assume=["count > 0"]).proved


def test_an_assumption_holds_in_every_scan_of_a_counterexample() -> None:
    result = one(proved(PUMP, "starts < 2", assume=["not both: start <> stop", "NOT flow"]))
    for scan in result.answer.way or ():
        values = dict(scan.values)
        assert values["start"] != values["stop"]
        assert not values["flow"]


def test_an_assumption_may_refer_to_the_outputs_of_the_scan_before() -> None:
    """A pump that delivers at once: `flow` follows `motor`, so TON never runs out."""
    assert one(proved(PUMP, "state <> State#Fault", assume=["flow = motor"])).verdict == "proved"


def test_the_time_between_scans_limits_what_a_timer_can_do() -> None:
    text = """
    PROGRAM Delay
    VAR_INPUT on : BOOL; END_VAR
    VAR t : TON; scans : INT; END_VAR
      IF on THEN scans := MIN(scans + 1, 100); ELSE scans := 0; END_IF
      t(IN := on, PT := T#50ms);
    END_PROGRAM
    """
    assert one(proved(text, "NOT t.Q", interval_ms=(10, 10))).answer.way is not None
    assert one(proved(text, "NOT t.Q OR scans >= 6", interval_ms=(10, 10), scans=12)).verdict == "proved"
    result = one(proved(text, "NOT t.Q OR scans >= 6", interval_ms=(10, 50)))
    assert len(result.answer.way or ()) < 6


def test_arithmetic_of_reals_is_exact() -> None:
    text = """
    PROGRAM Scale
    VAR_INPUT raw : REAL; END_VAR
    VAR scaled : REAL; END_VAR
      scaled := LIMIT(0.0, raw * 0.5, 100.0);
    END_PROGRAM
    """
    assert proved(text, "scaled >= 0.0 AND scaled <= 100.0").proved
    result = one(proved(text, "scaled < 99.5"))
    assert result.values["scaled"] >= 99.5


def test_a_result_without_an_exact_model_never_gives_a_counterexample() -> None:
    text = """
    PROGRAM Wave
    VAR_INPUT x : REAL; END_VAR
    VAR y : REAL; END_VAR
      y := SIN(x);
    END_PROGRAM
    """
    report = proved(text, "y <= 2.0", "x = x")
    assert [what for what, _ in report.unknowns] == ["SIN"]
    assert [r.verdict for r in report.invariants] == ["bounded", "proved", "proved"]
    assert one(report).answer.reason.startswith("the model has no exact result of SIN in line 5")


def test_a_model_that_differs_from_the_program_is_an_error_and_no_counterexample(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    text = """
    PROGRAM Size
    VAR_INPUT x : INT; END_VAR
    VAR size : INT; END_VAR
      size := ABS(x);
    END_PROGRAM
    """
    monkeypatch.setitem(BUILTINS, "abs", lambda x, given: given[0])  # a defect of the model
    with pytest.raises(ModelDisagrees, match="the model and the program Size disagree about 'size > -5'"):
        proved(text, "size > -5")


def test_errors_in_expressions_name_the_expression() -> None:
    with pytest.raises(UsageError, match="no such: a variable 'nothing' is not declared"):
        proved(PUMP, "no such: nothing")
    with pytest.raises(UsageError, match="BOOL"):
        proved(PUMP, "starts")
    with pytest.raises(UsageError, match=r"broken: .*expected"):
        proved(PUMP, "broken: motor AND")


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("PROGRAM P VAR_INPUT n : INT; END_VAR VAR s : STRING; END_VAR s := MAX(INT_TO_STRING(n), 'x'); END_PROGRAM",
         "this operation on a STRING"),
        ("PROGRAM P VAR_INPUT n : DINT; END_VAR VAR i : DINT; END_VAR FOR i := 1 TO n DO ; END_FOR END_PROGRAM",
         "a loop that can run more than 200 times"),
        pytest.param(
         "PROGRAM P VAR_INPUT n : DINT; END_VAR VAR i : DINT; END_VAR WHILE i < n DO i := i + 1; END_WHILE END_PROGRAM",
         "a loop that can run more than 200 times", marks=pytest.mark.long),
        ("INTERFACE I END_INTERFACE FUNCTION_BLOCK F IMPLEMENTS I END_FUNCTION_BLOCK "
         "PROGRAM P VAR f : F; i : I; END_VAR i := f; END_PROGRAM", "a variable of an interface type: i"),
        ("PROGRAM P VAR n : INT; r : REF_TO INT; END_VAR r := REF(n); END_PROGRAM", "a reference or pointer"),
        ("VAR_GLOBAL g : INT; END_VAR PROGRAM P g := 1; END_PROGRAM PROGRAM Q g := 2; END_PROGRAM",
         "Q may change the global variable g"),
    ],
)  # fmt: skip
def test_a_construct_without_a_model_is_refused_by_name(text: str, what: str) -> None:
    with pytest.raises(FileInvalid, match=what):
        proved(text)


def test_scan_time_is_any_time_that_grows_from_scan_to_scan() -> None:
    text = """
    PROGRAM Clock
    VAR began, passed : LTIME; n : INT; END_VAR
      IF n = 0 THEN began := SCAN_TIME(); END_IF
      passed := SCAN_TIME() - began;
      IF n < 2 THEN n := n + 1; ELSE began := SCAN_TIME(); n := 1; END_IF
    END_PROGRAM
    """
    report = proved(
        text, "passed >= LT#0s", "passed <= LT#10s", "passed < LT#9s", "began < LT#1h", interval_ms=(10, 5_000)
    )
    assert [r.verdict for r in report.invariants] == ["proved", "proved", "violated", "violated", "proved"]
    way = report.invariants[2].answer.way
    assert way is not None
    assert sum(scan.after_ns for scan in way[1:]) >= 9_000_000_000
    assert report.limits == ("the first scan is at any time of the clock, and SCAN_TIME() stays below 146 years",)


def test_messages_come_in_any_number_up_to_a_limit_that_the_report_names() -> None:
    text = """
    PROGRAM Mail
    VAR_INPUT heard : MESSAGES; second : BOOL; END_VAR
    VAR_OUTPUT said : MESSAGES[16, 4]; END_VAR
    VAR most : DINT; text : STRING; END_VAR
      most := MAX(most, MSG_COUNT(heard));
      IF second THEN text := MSG_AT(heard, 2); END_IF
    END_PROGRAM
    """
    report = proved(text, "most <= 16", "most <= 15", scans=3)
    assert [r.verdict for r in report.invariants] == ["proved", "violated", "violated"]
    assert dict((report.invariants[1].answer.way or ())[-1].values)["heard"] == 16
    assert "an index outside its array" in report.invariants[-1].failure
    assert report.limits == (
        "heard brings at most 16 messages in a scan, with any content",
        "said has room for any number of messages up to 4, at any time",
    )


def test_the_content_of_a_message_and_the_room_for_one_may_be_anything() -> None:
    text = """
    PROGRAM Answer
    VAR_INPUT heard : MESSAGES; END_VAR
    VAR_OUTPUT said : MESSAGES[16, 4]; END_VAR
    VAR sent, stop, full : BOOL; at : LTIME; END_VAR
      IF MSG_COUNT(heard) > 0 THEN
        stop := MSG_AT(heard, 1) = 'stop';
        at := MSG_TIME(heard, 1);
        sent := MSG_SEND(said, 'ok');
      END_IF
      full := MSG_ROOM(said) = 0;
    END_PROGRAM
    """
    report = proved(text, "stop OR TRUE", "NOT stop", "NOT sent", "at = LT#0s", "NOT full", scans=3)
    assert [r.verdict for r in report.invariants] == ["proved", "bounded", "violated", "violated", "bounded", "proved"]
    assert {what for what, _ in report.unknowns} == {"the comparison of a STRING", "MSG_TIME", "MSG_SEND", "MSG_ROOM"}


def test_an_element_with_a_variable_index_can_be_lent_to_a_var_in_out() -> None:
    text = """
    FUNCTION_BLOCK Up VAR_IN_OUT n : INT; END_VAR IF n < 3 THEN n := n + 1; END_IF END_FUNCTION_BLOCK
    PROGRAM P VAR_INPUT at : INT; END_VAR VAR a : ARRAY[0..2] OF INT; up : Up; END_VAR
      up(n := a[LIMIT(0, at, 2)]);
    END_PROGRAM
    """
    report = proved(text, "a[0] <= 3 AND a[2] <= 3", "a[1] < 3", scans=5)
    assert [r.verdict for r in report.invariants] == ["proved", "violated", "proved"]
    assert len(report.invariants[1].answer.way or ()) == 3


UNION = "TYPE U : UNION w : WORD; b : BYTE; END_UNION END_TYPE"


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (f"{UNION} PROGRAM P VAR u : U; END_VAR u.w := 1; END_PROGRAM", "no model of a union: u"),
        (f"{UNION} FUNCTION F : INT VAR u : U; END_VAR u.w := 1; END_FUNCTION PROGRAM P VAR n : INT; END_VAR n := F(); "
         "END_PROGRAM",
         r":1:\d+: .*no model of a union"),
        ("PROGRAM P VAR a, b : INT; END_VAR MEMCPY(ADR(a), ADR(b), 2); END_PROGRAM", r":1:\d+: .*no model of MEMCPY"),
    ],
)  # fmt: skip
def test_memory_that_variables_share_is_refused_by_name(text: str, what: str) -> None:
    with pytest.raises(FileInvalid, match=what):
        proved(text, dialect=dialect_of("codesys"))


TEXT = "PROGRAM P VAR_INPUT n : INT; on : BOOL; END_VAR VAR s : STRING; b : BOOL; i : INT; END_VAR {} END_PROGRAM"


@pytest.mark.parametrize(
    ("statements", "invariant", "unknown"),
    [
        ("b := LEN(INT_TO_STRING(n)) > 1;", "b", "the length of a STRING"),
        ("b := INT_TO_STRING(n) = '7';", "b", "the comparison of a STRING"),
        ("b := s < 'b'; s := SEL(on, 'a', 'c');", "b", "the comparison of a STRING"),
        ("b := FIND(INT_TO_STRING(n), '7') > 0;", "b", "FIND"),
        ("b := STRING_TO_INT(CONCAT(INT_TO_STRING(n MOD 10), '1')) > 5;", "b", "the conversion of a STRING"),
        ("b := MID(INT_TO_STRING(n), 1, 1) = '7';", "b", "the comparison of a STRING"),
        ("b := ASC(RIGHT(INT_TO_STRING(n), 1), 1) = 16#37;", "b", "ASC"),
    ],
)
def test_the_model_does_not_know_texts_and_proves_nothing_about_them(
    statements: str, invariant: str, unknown: str
) -> None:
    """Each condition can be true and false. So neither it nor its opposite may be proved."""
    report = proved(TEXT.format(statements), invariant, f"NOT {invariant}", scans=3)
    assert "proved" not in [r.verdict for r in report.invariants[:2]]
    assert unknown in {what for what, _ in report.unknowns}


def test_a_program_that_writes_texts_has_proofs_about_its_other_variables() -> None:
    statements = "IF on AND i < 5 THEN i := i + 1; END_IF; s := CONCAT('step ', INT_TO_STRING(i)); b := s = 'step 2';"
    report = proved(TEXT.format(statements), "i <= 5", "i < 5")
    assert [r.verdict for r in report.invariants] == ["proved", "violated", "proved"]


def test_a_choice_between_texts_is_exact_in_its_scan() -> None:
    report = proved(
        TEXT.format("i := LEN(SEL(on, 'off', 'on')); b := SEL(on, 'off', 'on') = 'on';"), "i = 3 - BOOL_TO_INT(b)"
    )
    assert one(report).verdict == "proved"
    assert report.unknowns == ()


def test_programs_that_a_program_calls_are_part_of_the_proof() -> None:
    text = """
    VAR_GLOBAL total : INT; END_VAR
    PROGRAM Main VAR_INPUT on : BOOL; END_VAR IF on THEN Sums(); END_IF END_PROGRAM
    PROGRAM Sums VAR n : INT; END_VAR n := (n + 1) MOD 4; total := 10 * n; END_PROGRAM
    """
    report = proved(text, "total <= 30", "total < 30", dialect=dialect_of("codesys"))
    assert [r.verdict for r in report.invariants] == ["proved", "violated", "proved"]


def test_an_invariant_may_read_local_variables_of_function_blocks() -> None:
    text = """
    FUNCTION_BLOCK Motor VAR_INPUT on : BOOL; END_VAR VAR delay : TON; runs : BOOL; END_VAR
      delay(IN := on, PT := T#1s); runs := delay.Q;
    END_FUNCTION_BLOCK
    PROGRAM Main VAR_INPUT on : BOOL; END_VAR VAR motor : Motor; END_VAR motor(on := on); END_PROGRAM
    """
    report = proved(text, "motor.runs = motor.delay.Q", "NOT motor.runs")
    assert [r.verdict for r in report.invariants] == ["proved", "violated", "proved"]
