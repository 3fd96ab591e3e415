"""Edge detection and bistables: R_TRIG, F_TRIG, SR, RS (IEC 61131-3, 6.6.3.5.2 and 6.6.3.5.3)."""

from __future__ import annotations

from fieldtwin.plc.blocks.block import FunctionBlock


class R_TRIG(FunctionBlock):
    """Rising edge: Q is true in the one call in which CLK became true, also if that is the first call."""

    __slots__ = ("CLK", "Q", "_before")
    inputs = {"CLK": "BOOL"}
    outputs = {"Q": "BOOL"}

    def __init__(self) -> None:
        self.CLK = self.Q = self._before = False

    def execute(self, now_ns: int) -> None:
        self.Q = self.CLK and not self._before
        self._before = self.CLK

    def __call__(self, now_ns: int, *, CLK: bool) -> R_TRIG:
        self.CLK = CLK
        self.execute(now_ns)
        return self


class F_TRIG(FunctionBlock):
    """Falling edge: Q is true in the one call in which CLK became false, and in the first call if CLK is false then."""

    __slots__ = ("CLK", "Q", "_before")
    inputs = {"CLK": "BOOL"}
    outputs = {"Q": "BOOL"}

    def __init__(self) -> None:
        self.CLK = self.Q = self._before = False

    def execute(self, now_ns: int) -> None:
        self.Q = not self.CLK and not self._before
        self._before = not self.CLK

    def __call__(self, now_ns: int, *, CLK: bool) -> F_TRIG:
        self.CLK = CLK
        self.execute(now_ns)
        return self


class SR(FunctionBlock):
    """Bistable, set dominant."""

    __slots__ = ("Q1", "R", "S1")
    inputs = {"S1": "BOOL", "R": "BOOL"}
    outputs = {"Q1": "BOOL"}

    def __init__(self) -> None:
        self.S1 = self.R = self.Q1 = False

    def execute(self, now_ns: int) -> None:
        self.Q1 = self.S1 or (self.Q1 and not self.R)

    def __call__(self, now_ns: int, *, S1: bool, R: bool) -> SR:
        self.S1, self.R = S1, R
        self.execute(now_ns)
        return self


class RS(FunctionBlock):
    """Bistable, reset dominant."""

    __slots__ = ("Q1", "R1", "S")
    inputs = {"S": "BOOL", "R1": "BOOL"}
    outputs = {"Q1": "BOOL"}

    def __init__(self) -> None:
        self.S = self.R1 = self.Q1 = False

    def execute(self, now_ns: int) -> None:
        self.Q1 = not self.R1 and (self.S or self.Q1)

    def __call__(self, now_ns: int, *, S: bool, R1: bool) -> RS:
        self.S, self.R1 = S, R1
        self.execute(now_ns)
        return self
