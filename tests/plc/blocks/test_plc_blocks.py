"""The standard's function blocks against IEC 61131-3's timing diagrams, at the granularity of scans."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.plc.blocks import BLOCKS, CTD, CTU, CTUD, F_TRIG, MS, R_TRIG, RS, SR, TOF, TON, TP

BITS = st.lists(st.booleans(), max_size=40)
STEPS = st.lists(st.tuples(st.integers(1, 30), st.booleans()), max_size=40)
"""Scans: ms since the previous one, and the input."""
PRESETS = st.integers(0, 60)


def scans(steps: list[tuple[int, bool]]) -> list[tuple[int, bool]]:
    """(time in ms, input) of each scan."""
    now, out = 1000, []
    for gap, level in steps:
        now += gap
        out.append((now, level))
    return out


def since(history: list[tuple[int, bool]], level: bool) -> int | None:
    """Return the time when the input took its present `level`; None if it has a different one."""
    start = None
    for t, value in history:
        start = (t if start is None else start) if value is level else None
    return start


# -- the diagrams, as tables: (t in ms, IN) -> (Q, ET in ms), PT = 20 ms, a scan every 10 ms --------------------------------

TON_TABLE = [(0, 0, 0, 0), (10, 1, 0, 0), (20, 1, 0, 10), (30, 1, 1, 20), (40, 1, 1, 20), (50, 0, 0, 0),
             (60, 1, 0, 0), (70, 0, 0, 0), (80, 1, 0, 0), (100, 1, 1, 20)]  # fmt: skip
TOF_TABLE = [(0, 0, 0, 0), (10, 1, 1, 0), (20, 0, 1, 0), (30, 0, 1, 10), (40, 0, 0, 20), (50, 0, 0, 20),
             (60, 1, 1, 0), (70, 0, 1, 0), (80, 1, 1, 0), (90, 0, 1, 0), (115, 0, 0, 20)]  # fmt: skip
TP_TABLE = [(0, 0, 0, 0), (10, 1, 1, 0), (20, 0, 1, 10), (25, 1, 1, 15), (30, 1, 0, 20), (40, 1, 0, 20), (50, 0, 0, 0),
            (60, 1, 1, 0), (70, 1, 1, 10), (80, 0, 0, 0), (90, 1, 1, 0)]  # fmt: skip


@pytest.mark.parametrize(("block", "table"), [(TON, TON_TABLE), (TOF, TOF_TABLE), (TP, TP_TABLE)])
def test_timers_follow_the_timing_diagrams_of_the_standard(
    block: type[TON] | type[TOF] | type[TP], table: list[tuple[int, int, int, int]]
) -> None:
    timer = block()
    for t_ms, level, q, et_ms in table:
        timer(t_ms * MS, IN=bool(level), PT=20 * MS)
        assert (t_ms, timer.Q, timer.ET) == (t_ms, bool(q), et_ms * MS)


@given(STEPS, PRESETS)
def test_ton_is_true_when_in_has_been_true_for_pt(steps: list[tuple[int, bool]], pt: int) -> None:
    timer, history = TON(), list[tuple[int, bool]]()
    for t, level in scans(steps):
        history.append((t, level))
        start = since(history, True)
        timer(t * MS, IN=level, PT=pt * MS)
        assert timer.Q == (start is not None and t - start >= pt)
        assert timer.ET == (0 if start is None else min(t - start, pt) * MS)


@given(STEPS, PRESETS)
def test_tof_is_false_when_in_has_been_false_for_pt(steps: list[tuple[int, bool]], pt: int) -> None:
    timer, history, ever = TOF(), list[tuple[int, bool]](), False
    for t, level in scans(steps):
        history.append((t, level))
        ever = ever or level
        start = since(history, False)
        timer(t * MS, IN=level, PT=pt * MS)
        assert timer.Q == (ever and (start is None or t - start < pt))
        assert timer.ET == (0 if start is None or not ever else min(t - start, pt) * MS)


@given(STEPS, PRESETS)
def test_tp_is_one_pulse_of_pt_whatever_in_does(steps: list[tuple[int, bool]], pt: int) -> None:
    timer, before, start, et = TP(), False, None, 0
    for t, level in scans(steps):
        if start is not None and t - start >= pt:
            ended, start = True, None
        else:
            ended = False
        if level and not before and start is None and not ended:
            start = t
        elif level and not before and ended:
            start = None  # the pulse ends in this scan; the rise came while it still ran
        timer(t * MS, IN=level, PT=pt * MS)
        assert timer.Q == (start is not None and t - start < pt)
        et = min(t - start, pt) if start is not None else pt if ended else et
        if not timer.Q and not level:
            et = 0
        assert timer.ET == et * MS
        if start is not None and pt == 0:
            start = None
        before = level


def test_a_preset_below_zero_is_zero() -> None:
    assert TON()(0, IN=True, PT=-5).Q
    assert TON()(0, IN=True, PT=-5).ET == 0
    assert not TP()(0, IN=True, PT=-5).Q


# -- edges and bistables -------------------------------------------------------------------------------------------------


@given(BITS)
def test_edge_blocks_detect_rising_and_falling_edges(levels: list[bool]) -> None:
    rise, fall = R_TRIG(), F_TRIG()
    for before, level in zip([False, *levels], levels, strict=False):
        assert rise(0, CLK=level).Q == (level and not before)
    for n, level in enumerate(levels):
        before = (
            levels[n - 1] if n else True
        )  # the standard: an input that is false at a cold start is one falling edge
        assert fall(0, CLK=level).Q == (before and not level)


@given(st.lists(st.tuples(st.booleans(), st.booleans()), max_size=30))
def test_bistables_differ_if_both_inputs_are_true(pairs: list[tuple[bool, bool]]) -> None:
    sr, rs, q_sr, q_rs = SR(), RS(), False, False
    for s, r in pairs:
        q_sr = s or (q_sr and not r)
        q_rs = (s or q_rs) and not r
        assert sr(0, S1=s, R=r).Q1 == q_sr
        assert rs(0, S=s, R1=r).Q1 == q_rs


# -- counters ------------------------------------------------------------------------------------------------------------


@given(st.lists(st.tuples(st.booleans(), st.booleans(), st.integers(-3, 5)), max_size=40))
def test_ctu_and_ctd_count_rises_and_reset_wins(rows: list[tuple[bool, bool, int]]) -> None:
    up, down, cv_up, cv_down, before = CTU(), CTD(), 0, 0, False
    for clock, reset, pv in rows:
        rise, before = clock and not before, clock
        cv_up = 0 if reset else cv_up + rise
        cv_down = pv if reset else cv_down - rise
        up(0, CU=clock, R=reset, PV=pv)
        down(0, CD=clock, LD=reset, PV=pv)
        assert (up.CV, up.Q) == (cv_up, cv_up >= pv)
        assert (down.CV, down.Q) == (cv_down, cv_down <= 0)


def test_counters_stop_at_the_limits_of_their_type() -> None:
    up, down, both = CTU(), CTD(), CTUD()
    up.CV, down.CV, both.CV = 32767, -32768, 32767
    assert up(0, CU=True, R=False, PV=0).CV == 32767
    assert down(0, CD=True, LD=False, PV=0).CV == -32768
    assert both(0, CU=True, CD=False, R=False, LD=False, PV=0).CV == 32767
    wide = BLOCKS["CTU_DINT"]()
    wide.CV = 32767  # type: ignore[attr-defined]
    wide.CU = True  # type: ignore[attr-defined]
    wide.execute(0)
    assert wide.CV == 32768  # type: ignore[attr-defined]
    assert BLOCKS["CTU_ULINT"].inputs["PV"] == "ULINT"


def test_ctud_reset_over_load_over_counting_and_rises_cancel() -> None:
    c = CTUD()
    off = {"CU": False, "CD": False, "R": False, "LD": False}
    assert c(0, **off | {"CU": True}, PV=2).CV == 1
    assert c(0, **off, PV=2).CV == 1
    assert c(0, **off | {"CU": True, "CD": True}, PV=2).CV == 1
    assert c(0, **off, PV=2).CV == 1
    assert (c(0, **off | {"CU": True}, PV=2).CV, c.QU, c.QD) == (2, True, False)
    assert c(0, **off | {"LD": True, "CD": True}, PV=7).CV == 7
    assert (c(0, **off | {"R": True, "LD": True}, PV=7).CV, c.QU, c.QD) == (0, False, True)
    assert c(0, **off, PV=7).CV == 0
    assert (c(0, **off | {"CD": True}, PV=7).CV, c.QD) == (-1, True)


@given(st.lists(st.tuples(*[st.booleans()] * 4, st.integers(-3, 5)), max_size=40), st.sampled_from([0, 32766, -32767]))
def test_ctud_equals_the_body_in_the_standard(rows: list[tuple[bool, bool, bool, bool, int]], begin: int) -> None:
    """IEC 61131-3, Table 45, CTUD, with its edges taken from the previous calls."""
    c = CTUD()
    c.CV = cv = begin
    up_before = down_before = False
    for up, down, reset, load, pv in rows:
        rises = up and not up_before, down and not down_before
        up_before, down_before = up, down
        if reset:
            cv = 0
        elif load:
            cv = pv
        elif rises == (True, False) and cv < 32767:
            cv += 1
        elif rises == (False, True) and cv > -32768:
            cv -= 1
        c(0, CU=up, CD=down, R=reset, LD=load, PV=pv)
        assert (c.CV, c.QU, c.QD) == (cv, cv >= pv, cv <= 0)


def test_every_block_declares_its_variables() -> None:
    for name, block in BLOCKS.items():
        made = block()
        for variable in block.inputs | block.outputs:
            value = getattr(made, variable)
            kind = (block.inputs | block.outputs)[variable]
            expected = bool if kind == "BOOL" else float if kind == "LREAL" else int
            assert type(value) is expected, (name, variable)
            assert not isinstance(value, float) or not math.isnan(value)
        assert not hasattr(made, "__dict__"), name
