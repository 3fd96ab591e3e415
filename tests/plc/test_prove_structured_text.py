"""The prover on Structured Text: a proved property holds, and a counterexample can be reproduced in a separate program.

Defects: a copied program kept the clock of the original, so that no timer ever ran out: "motor never on" was proved for a
start button and a TON of 50 ms. IS_GOOD raised an internal error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from st_bench import program

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.plc.blocks import MS, TON
from fieldtwin.plc.program import Program, ScanInfo, var_input, var_output
from fieldtwin.plc.prove import Given, Proof, prove
from fieldtwin.plc.st.program import StProgram

MOTOR = """
PROGRAM Motor
VAR_INPUT start : BOOL; END_VAR
VAR_OUTPUT motor : BOOL; END_VAR
VAR delay : TON; END_VAR
  delay(IN := start, PT := T#50ms);
  motor := delay.Q;
END_PROGRAM
"""
NEVER = Proof(
    make=lambda: program(MOTOR),
    domain={"start": [False, True]},
    invariants={"motor never on": lambda p: not p.motor},
)


def replayed(made: Program, way: Sequence[Given]) -> list[Any]:
    """Run `way` with a new program, scan by scan, without any code of the prover; return the program's values after each."""
    now_ns, shown = 0, []
    for number, each in enumerate(way, 1):
        now_ns += round(each.ms * MS)
        quality = {}
        for name, value in each.inputs:
            known = value if isinstance(value, TagValue) else None
            bad = value is None
            setattr(made, name, known.value if known else value)
            quality[name] = known or TagValue(
                value, Quality.BAD if bad else Quality.GOOD, Reason.TIMEOUT if bad else Reason.NONE
            )
        made._lookup = quality.__getitem__
        made.execute(ScanInfo(now_ns, number, number == 1))
        shown.append({name: getattr(made, name) for name in made.variables})
    return shown


def test_a_timer_runs_out_in_the_search() -> None:
    result = prove(NEVER)
    assert result.broken == "motor never on"
    assert [dict(each.inputs)["start"] for each in result.way] == [
        True
    ] * 6  # the rising edge is seen in the first of them
    shown = replayed(program(MOTOR), result.way)
    assert [each["motor"] for each in shown] == [False] * 5 + [True]


@pytest.mark.parametrize("key", [None, lambda p: p.motor, lambda p: 0])
def test_no_key_makes_a_timer_stand_still(key: Any) -> None:
    assert not prove(replace(NEVER, key=key)).proved


def test_true_properties_are_proved_without_a_key() -> None:
    text = MOTOR.replace("motor := delay.Q;", "motor := delay.Q AND NOT start;")
    result = prove(replace(NEVER, make=lambda: program(text)))
    assert (result.proved, result.broken, result.reason) == (True, "", "")
    assert result.states > 5


def test_the_quality_of_an_input_can_be_asked_for() -> None:
    text = """PROGRAM P VAR_INPUT level : REAL; END_VAR VAR_OUTPUT pump : BOOL; END_VAR
      pump := IS_GOOD(level) AND level < 20.0; END_PROGRAM"""
    proof = Proof(
        make=lambda: program(text),
        domain={"level": [10.0, 50.0, None, TagValue(10.0, Quality.UNCERTAIN)]},
        invariants={"pumps on what is good and low": lambda p: not p.pump or p.level == 10.0},
    )
    assert prove(proof).proved
    gullible = replace(proof, make=lambda: program(text.replace("IS_GOOD(level) AND ", "")))
    assert prove(gullible).broken  # an input that was never read is 0.0


def test_the_first_scan_is_a_separate_state() -> None:
    text = """PROGRAM P VAR_INPUT go : BOOL; END_VAR VAR_OUTPUT hit : BOOL; END_VAR
      hit := go AND NOT FIRST_SCAN(); END_PROGRAM"""
    proof = Proof(lambda: program(text), {"go": [False, True]}, {"never hit": lambda p: not p.hit})
    assert len(prove(proof).way) == 2


def test_global_variables_and_blocks_inside_blocks_are_part_of_the_state() -> None:
    text = """VAR_GLOBAL n : INT; END_VAR
    FUNCTION_BLOCK Deep VAR_INPUT go : BOOL; END_VAR VAR_OUTPUT q : BOOL; END_VAR VAR t : ARRAY[1..2] OF TOF; END_VAR
      t[2](IN := go, PT := T#30ms); q := t[2].Q; IF q AND NOT go THEN n := LIMIT(0, n + 1, 5); END_IF END_FUNCTION_BLOCK
    PROGRAM P VAR_INPUT go : BOOL; END_VAR VAR_OUTPUT late : BOOL; END_VAR VAR d : Deep; END_VAR
      d(go := go); late := n > 3; END_PROGRAM"""
    proof = Proof(lambda: program(text), {"go": [False, True]}, {"never late": lambda p: not p.late})
    result = prove(proof)
    assert result.broken == "never late"
    assert replayed(program(text), result.way)[-1]["late"] is True
    bounded = replace(proof, make=lambda: program(text.replace("n > 3", "n > 5")))
    assert prove(bounded).proved


def test_undecidable_properties_are_not_proved() -> None:
    counting = """PROGRAM P VAR_INPUT go : BOOL; END_VAR VAR_OUTPUT hit : BOOL; END_VAR VAR n : DINT; END_VAR
      IF go THEN n := n + 1; END_IF hit := n = 100000; END_PROGRAM"""
    proof = Proof(lambda: program(counting), {"go": [False, True]}, {"never hit": lambda p: not p.hit})
    result = prove(proof, max_states=200)
    assert (result.proved, result.broken, result.reason) == (False, "", "more than 200 states")
    asks = counting.replace("n := n + 1;", ";").replace("n = 100000", "SCAN_TIME() > LT#1h")
    result = prove(replace(proof, make=lambda: program(asks)), max_states=200)
    assert not result.proved  # the time itself decides, and it is unbounded


def test_a_key_that_omits_a_deciding_variable_proves_nothing() -> None:
    text = """PROGRAM P VAR_INPUT go : BOOL; END_VAR VAR_OUTPUT hit : BOOL; END_VAR VAR n : INT; END_VAR
      n := SEL(go, 0, MIN(n + 1, 9)); hit := n >= 4; END_PROGRAM"""
    proof = Proof(lambda: program(text), {"go": [False, True]}, {"never hit": lambda p: not p.hit}, key=lambda p: p.hit)
    result = prove(proof)
    assert not result.proved
    assert replayed(program(text), result.way)[-1]["hit"] is True
    unseen = replace(proof, invariants={"nothing": lambda p: True}, key=lambda p: (p.hit, p.go))
    assert prove(unseen).reason.startswith("the key omits a deciding variable")


class Delayed(Program):
    """Python logic with its own timer."""

    start: bool = var_input(TagKind.BOOL)
    motor: bool = var_output(TagKind.BOOL, initial=False)

    def __init__(self) -> None:
        self.delay = TON()

    def execute(self, scan: ScanInfo) -> None:
        self.motor = self.delay(scan.now_ns, IN=self.start, PT=50 * MS).Q


def test_a_block_of_a_python_program_counts_whatever_the_key_contains() -> None:
    result = prove(replace(NEVER, make=Delayed, key=lambda p: p.motor))
    assert result.broken == "motor never on"
    assert len(result.way) == 6
    with pytest.raises(UsageError, match="a program in Python needs a key"):
        prove(replace(NEVER, make=Delayed))


def test_a_domain_names_exactly_the_inputs() -> None:
    for domain in ({}, {"start": [True], "stop": [True]}, {"begin": [True]}):
        with pytest.raises(UsageError, match="names the program's inputs"):
            prove(replace(NEVER, domain=domain))


BODIES = (
    "t(IN := a, PT := T#20ms); q := t.Q;", "f(IN := a, PT := T#20ms); q := f.Q AND NOT a;", "p(IN := a, PT := T#20ms); q := p.Q;",
    "r(CLK := a); q := r.Q;", "c(CU := a, R := b, PV := 2); q := c.Q;", "s(S1 := a, R := b); q := s.Q1 AND b;",
    "n := SEL(b, n, MIN(n + 1, 3)); q := n > 2;", "q := FIRST_SCAN() AND b;", "q := IS_GOOD(a) AND b;",
)  # fmt: skip


@settings(deadline=None, max_examples=25)
@given(st.lists(st.sampled_from(BODIES), min_size=1, max_size=3), st.lists(st.tuples(st.booleans(), st.booleans())))
def test_a_behaviour_seen_in_a_random_run_is_never_disproved(
    bodies: list[str], inputs: list[tuple[bool, bool]]
) -> None:
    """Every run of the program itself is one of the paths that the prover examines."""
    text = f"""PROGRAM P VAR_INPUT a, b : BOOL; END_VAR VAR_OUTPUT q : BOOL; END_VAR
      VAR t : TON; f : TOF; p : TP; r : R_TRIG; c : CTU; s : SR; n : INT; any_ : BOOL; END_VAR
      q := FALSE; {" any_ := any_ OR q; ".join(bodies)} any_ := any_ OR q; END_PROGRAM"""

    def make() -> StProgram:
        return program(text)

    result = prove(Proof(make, {"a": [False, True], "b": [False, True]}, {"never": lambda p: not p.any_}))
    way = [Given((("a", a), ("b", b)), 10.0) for a, b in inputs]
    if any(shown["any_"] for shown in replayed(make(), way)):
        assert result.broken == "never"
    if result.broken:
        assert replayed(make(), result.way)[-1]["any_"] is True
