"""Timers: TON, TOF, TP (IEC 61131-3, 6.6.3.5.5 with its timing diagrams).

Blocks use the scan's time. So a period begins with the scan that detects the edge, and an output changes in the first scan at
or after the end of the period. ET never exceeds PT. Where the standard does not define the behaviour: a PT that changes while
the timer runs counts from the same start; a PT that changes after the timer expired has no effect until the next start; a
negative PT is 0; a rise of TP's IN in the same scan that ends the pulse does not start a new one.
"""

from __future__ import annotations

from typing import Any

from fieldtwin.plc.blocks.block import FunctionBlock


class _Timer(FunctionBlock):
    __slots__ = ()
    IN: bool
    Q: bool
    PT: int
    ET: int
    _since_ns: int | None

    def _runs(self) -> bool:
        """Return whether later outputs still depend on the time at which the timer started."""
        raise NotImplementedError

    def state(self, now_ns: int) -> tuple[Any, ...]:
        """Return `FunctionBlock.state` without the start time of an expired timer, because all expired timers behave the same."""
        since_ns = self._since_ns if self._runs() else None
        phase_ns = None if since_ns is None else now_ns - since_ns
        return self.IN, self.Q, self.PT, self.ET, phase_ns


class TON(_Timer):
    """On-delay: Q becomes true PT after IN, and false together with IN. ET is the time for which IN has been true, at most PT."""

    __slots__ = ("ET", "IN", "PT", "Q", "_since_ns")
    inputs = {"IN": "BOOL", "PT": "TIME"}
    outputs = {"Q": "BOOL", "ET": "TIME"}

    def __init__(self) -> None:
        self.IN = self.Q = False
        self.PT = self.ET = 0
        self._since_ns: int | None = None

    def execute(self, now_ns: int) -> None:
        if not self.IN:
            self.Q, self.ET, self._since_ns = False, 0, None
        elif not self.Q:
            if self._since_ns is None:
                self._since_ns = now_ns
            preset = max(0, self.PT)
            self.ET = min(now_ns - self._since_ns, preset)
            self.Q = self.ET >= preset

    def _runs(self) -> bool:
        return self.IN and not self.Q

    def __call__(self, now_ns: int, *, IN: bool, PT: int) -> TON:
        self.IN, self.PT = IN, PT
        self.execute(now_ns)
        return self


class TOF(_Timer):
    """Off-delay: Q becomes true together with IN, and false PT after IN.

    ET is the time for which IN has been false, at most PT.
    """

    __slots__ = ("ET", "IN", "PT", "Q", "_since_ns")
    inputs = {"IN": "BOOL", "PT": "TIME"}
    outputs = {"Q": "BOOL", "ET": "TIME"}

    def __init__(self) -> None:
        self.IN = self.Q = False
        self.PT = self.ET = 0
        self._since_ns: int | None = None

    def execute(self, now_ns: int) -> None:
        if self.IN:
            self.Q, self.ET, self._since_ns = True, 0, None
        elif self.Q:
            if self._since_ns is None:
                self._since_ns = now_ns
            preset = max(0, self.PT)
            self.ET = min(now_ns - self._since_ns, preset)
            self.Q = self.ET < preset

    def _runs(self) -> bool:
        return self.Q and not self.IN

    def __call__(self, now_ns: int, *, IN: bool, PT: int) -> TOF:
        self.IN, self.PT = IN, PT
        self.execute(now_ns)
        return self


class TP(_Timer):
    """Pulse: a rise of IN makes Q true for PT, even if IN changes meanwhile. Afterwards ET stays at PT until IN is false."""

    __slots__ = ("ET", "IN", "PT", "Q", "_before", "_since_ns")
    inputs = {"IN": "BOOL", "PT": "TIME"}
    outputs = {"Q": "BOOL", "ET": "TIME"}

    def __init__(self) -> None:
        self.IN = self.Q = self._before = False
        self.PT = self.ET = 0
        self._since_ns: int = 0

    def execute(self, now_ns: int) -> None:
        preset = max(0, self.PT)
        if self.IN and not self._before and not self.Q:
            self.Q, self._since_ns = True, now_ns
        if self.Q:
            self.ET = min(now_ns - self._since_ns, preset)
            self.Q = self.ET < preset
        if not self.Q and not self.IN:
            self.ET = 0
        self._before = self.IN

    def _runs(self) -> bool:
        return self.Q

    def __call__(self, now_ns: int, *, IN: bool, PT: int) -> TP:
        self.IN, self.PT = IN, PT
        self.execute(now_ns)
        return self
