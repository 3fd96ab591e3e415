"""HYSTERESIS, RAMP, PID and ALARM: their specified properties, on simulated plants."""

from __future__ import annotations

import math
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.plc.blocks import ALARM, HYSTERESIS, MS, PID, RAMP, SECOND

REALS = st.floats(-1e6, 1e6)


@given(st.lists(st.floats(-20, 20), max_size=40))
def test_hysteresis_changes_only_outside_its_band(values: list[float]) -> None:
    h, q = HYSTERESIS(), False
    for x in values:
        q = True if x > 12 else False if x < 8 else q
        assert h(0, XIN1=x, XIN2=10, EPS=2).Q == q


@given(st.lists(st.tuples(st.integers(1, 500), REALS), min_size=1, max_size=30))
def test_ramp_never_exceeds_its_rates_nor_its_target(rows: list[tuple[int, float]]) -> None:
    ramp, now, before = RAMP(), 0, 5.0
    ramp(0, RUN=True, X=5.0, X0=5.0, UP=100, DOWN=50)
    for gap_ms, x in rows:
        now += gap_ms * MS
        ramp(now, RUN=True, X=x, UP=100, DOWN=50)
        moved, most = ramp.XOUT - before, (100 if x > before else 50) * gap_ms / 1000
        assert abs(moved) <= most + 1e-6 * max(1.0, abs(x))
        assert min(before, x) <= ramp.XOUT <= max(before, x)
        assert ramp.BUSY == (ramp.XOUT != x)
        before = ramp.XOUT


def test_ramp_holds_on_nan_and_follows_when_it_does_not_run() -> None:
    ramp = RAMP()
    assert ramp(0, RUN=False, X=3.0, UP=1, DOWN=1).XOUT == 3.0
    assert ramp(SECOND, RUN=True, X=math.nan, UP=1, DOWN=1).XOUT == 3.0
    assert ramp(2 * SECOND, RUN=True, X=9.0, UP=1, DOWN=1).XOUT == 4.0


def test_pid_brings_a_lag_to_its_set_point_and_stays_inside_the_limits() -> None:
    pid, level, outputs = PID(), 0.0, []
    for n in range(4000):
        pid(n * 10 * MS, AUTO=True, PV=level, SP=50.0, KP=2.0, TR=2 * SECOND, TD=100 * MS)
        outputs.append(pid.XOUT)
        level += (pid.XOUT - level) * 0.01  # a first-order lag of 1 s
    assert abs(level - 50.0) < 0.01
    assert 0.0 <= min(outputs) <= max(outputs) <= 100.0


def test_pid_integral_does_not_wind_up() -> None:
    pid = PID()
    for n in range(1000):  # ten seconds at the limit
        pid(n * 10 * MS, AUTO=True, PV=0.0, SP=100.0, KP=5.0, TR=SECOND)
    assert pid.XOUT == 100.0
    # without anti-windup, the integral would hold the output at its limit for long
    assert pid(1001 * 10 * MS, AUTO=True, PV=110.0, SP=100.0, KP=5.0, TR=SECOND).XOUT < 100.0


def test_pid_switches_to_automatic_without_a_bump() -> None:
    pid = PID()
    for n in range(50):
        pid(n * 10 * MS, AUTO=False, PV=30.0, SP=40.0, X0=62.5, KP=3.0, TR=5 * SECOND)
    assert pid.XOUT == 62.5
    pid(510 * MS, AUTO=True, PV=30.0, SP=40.0, X0=0.0, KP=3.0, TR=5 * SECOND)
    assert abs(pid.XOUT - 62.5) < 0.2


def test_pid_derivative_acts_on_the_measurement_only() -> None:
    pid = PID()
    quiet: Any = {"AUTO": True, "KP": 1.0, "TD": SECOND, "XMIN": -1000.0, "XMAX": 1000.0}
    pid(0, PV=0.0, SP=0.0, **quiet)
    assert pid(10 * MS, PV=0.0, SP=10.0, **quiet).XOUT == 10.0
    assert pid(20 * MS, PV=1.0, SP=10.0, **quiet).XOUT < 9.0 - 5.0


def test_pid_holds_on_nan_and_recovers() -> None:
    pid = PID()
    pid(0, AUTO=True, PV=1.0, SP=2.0, KP=1.0, TR=SECOND)
    held = pid.XOUT
    assert pid(10 * MS, AUTO=True, PV=math.nan, SP=2.0, KP=1.0, TR=SECOND).XOUT == held
    assert math.isfinite(pid(20 * MS, AUTO=True, PV=1.0, SP=2.0, KP=1.0, TR=SECOND).XOUT)


def test_alarm_waits_its_delay_latches_and_is_acknowledged() -> None:
    alarm = ALARM()

    def at(t_ms: int, x: float, ack: bool = False) -> tuple[bool, bool, bool, bool, bool]:
        alarm(t_ms * MS, X=x, LL=0, L=10, H=80, HH=90, HYS=2, DELAY=100 * MS, ACK=ack)
        return alarm.QL, alarm.QH, alarm.QHH, alarm.Q, alarm.UNACK

    assert at(0, 85) == (False, False, False, False, False)
    assert at(90, 85) == (False, False, False, False, False)
    assert at(95, 70) == (False, False, False, False, False)  # shorter than the delay: no effect
    assert at(100, 95) == (False, False, False, False, False)
    assert at(200, 95) == (False, True, True, True, True)
    assert at(210, 89) == (False, True, True, True, True)  # inside the hysteresis
    assert at(220, 87.9) == (False, True, False, False, True)  # back, but not acknowledged
    assert at(230, 70) == (False, False, False, False, True)
    assert at(240, 70, ack=True) == (False, False, False, False, False)
    assert at(250, -5) == (False, False, False, False, False)
    assert at(350, -5, ack=True) == (True, False, False, True, True)  # ACK did not rise: it is not new
    assert alarm.QLL
    assert at(360, math.nan) == (True, False, False, True, True)


def test_alarm_without_limits_is_silent() -> None:
    alarm = ALARM()
    for x in (-1e300, 1e300, 0.0):
        alarm(0, X=x)
        assert (alarm.Q, alarm.WARN, alarm.UNACK) == (False, False, False)
