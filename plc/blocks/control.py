"""Closed-loop blocks: HYSTERESIS, RAMP, PID.

HYSTERESIS follows the example in the annex of IEC 61131-3. RAMP and PID are fieldtwin's own: they use rates and times
instead of the scan's length, have limits with anti-windup, and hold the output while an input is not a number.
"""

from __future__ import annotations

from math import isfinite

from fieldtwin.plc.blocks.block import SECOND, FunctionBlock


class HYSTERESIS(FunctionBlock):
    """Q becomes true when XIN1 exceeds XIN2 by more than EPS, and false when XIN1 is below XIN2 by more than EPS."""

    __slots__ = ("EPS", "Q", "XIN1", "XIN2")
    inputs = {"XIN1": "LREAL", "XIN2": "LREAL", "EPS": "LREAL"}
    outputs = {"Q": "BOOL"}

    def __init__(self) -> None:
        self.XIN1 = self.XIN2 = self.EPS = 0.0
        self.Q = False

    def execute(self, now_ns: int) -> None:
        if self.Q:
            self.Q = not self.XIN1 < self.XIN2 - self.EPS
        else:
            self.Q = self.XIN1 > self.XIN2 + self.EPS

    def __call__(self, now_ns: int, *, XIN1: float, XIN2: float, EPS: float) -> HYSTERESIS:
        self.XIN1, self.XIN2, self.EPS = XIN1, XIN2, EPS
        self.execute(now_ns)
        return self


class RAMP(FunctionBlock):
    """XOUT moves towards X by at most UP units per second upwards and DOWN downwards; BUSY until it has reached X.

    While RUN is false, XOUT follows X at once. The first call starts from X0.
    """

    __slots__ = ("BUSY", "DOWN", "RUN", "UP", "X", "X0", "XOUT", "_before_ns")
    inputs = {"RUN": "BOOL", "X": "LREAL", "X0": "LREAL", "UP": "LREAL", "DOWN": "LREAL"}
    outputs = {"XOUT": "LREAL", "BUSY": "BOOL"}

    def __init__(self) -> None:
        self.RUN = self.BUSY = False
        self.X = self.X0 = self.UP = self.DOWN = self.XOUT = 0.0
        self._before_ns: int | None = None

    def execute(self, now_ns: int) -> None:
        if self._before_ns is None:
            self._before_ns, self.XOUT = now_ns, self.X0
        dt_s = (now_ns - self._before_ns) / SECOND
        self._before_ns = now_ns
        if not isfinite(self.X):
            return
        if self.RUN:
            up, down = max(0.0, self.UP) * dt_s, max(0.0, self.DOWN) * dt_s
            self.XOUT = min(max(self.X, self.XOUT - down), self.XOUT + up)
        else:
            self.XOUT = self.X
        self.BUSY = self.XOUT != self.X

    def __call__(self, now_ns: int, *, RUN: bool, X: float, UP: float, DOWN: float, X0: float = 0.0) -> RAMP:
        self.RUN, self.X, self.X0, self.UP, self.DOWN = RUN, X, X0, UP, DOWN
        self.execute(now_ns)
        return self


class PID(FunctionBlock):
    """XOUT = KP (E + 1/TR int E dt - TD dPV/dt), E = SP - PV, inside XMIN..XMAX.

    The derivative acts on PV, so that a step of SP gives no kick, through a first-order lag of TD/8. The integral stops
    where it would push the output further beyond a limit. AUTO false: XOUT is X0, and the integral follows, so that
    switching to AUTO is bumpless. TR = 0: no integral part; TD = 0: no derivative. A negative KP reverses the action.
    """

    __slots__ = ("AUTO", "KP", "PV", "SP", "TD", "TR", "X0", "XMAX", "XMIN", "XOUT", "_before_ns", "_i", "_lag")
    inputs = {
        "AUTO": "BOOL", "PV": "LREAL", "SP": "LREAL", "X0": "LREAL", "KP": "LREAL", "TR": "TIME", "TD": "TIME",
        "XMIN": "LREAL", "XMAX": "LREAL",
    }  # fmt: skip
    outputs = {"XOUT": "LREAL"}

    def __init__(self) -> None:
        self.AUTO = False
        self.PV = self.SP = self.X0 = self.KP = self.XMIN = self.XOUT = 0.0
        self.XMAX = 100.0
        self.TR = self.TD = 0
        self._before_ns: int | None = None
        self._i = 0.0
        self._lag: float | None = None

    def execute(self, now_ns: int) -> None:
        dt_ns = 0 if self._before_ns is None else now_ns - self._before_ns
        self._before_ns = now_ns
        if not (isfinite(self.PV) and isfinite(self.SP)):
            return
        error = self.SP - self.PV
        p = self.KP * error
        d = self._derivative(dt_ns)
        if not self.AUTO:
            self.XOUT = self._limited(self.X0)
            self._i = self.XOUT - p - d
            return
        step = p * dt_ns / self.TR if self.TR > 0 else 0.0
        if self.TR <= 0:
            self._i = 0.0
        wanted = p + self._i + step + d
        self.XOUT = self._limited(wanted)
        if not (wanted > self.XMAX and step > 0) and not (wanted < self.XMIN and step < 0):
            self._i += step

    def _derivative(self, dt_ns: int) -> float:
        """Return -KP TD dPV/dt, filtered by the first-order lag. The state of the lag is also updated while TD is 0."""
        if self._lag is None or self.TD <= 0:
            self._lag = self.PV
            return 0.0
        lag_ns = self.TD / 8
        slope = (self.PV - self._lag) / (lag_ns + dt_ns)
        self._lag += slope * dt_ns
        return -self.KP * self.TD * slope

    def _limited(self, x: float) -> float:
        return min(max(x, self.XMIN), self.XMAX)

    def __call__(
        self, now_ns: int, *, AUTO: bool, PV: float, SP: float, KP: float, TR: int = 0, TD: int = 0,
        X0: float = 0.0, XMIN: float = 0.0, XMAX: float = 100.0,
    ) -> PID:  # fmt: skip
        self.AUTO, self.PV, self.SP, self.X0, self.KP, self.TR, self.TD = AUTO, PV, SP, X0, KP, TR, TD
        self.XMIN, self.XMAX = XMIN, XMAX
        self.execute(now_ns)
        return self
