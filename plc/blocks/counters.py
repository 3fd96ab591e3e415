"""Counters of type INT: CTU, CTD, CTUD (IEC 61131-3, 6.6.3.5.4). Names with a suffix are for the standard's other types.

CU and CD count rising edges. A counter stops at the limits of its type; it never wraps.
"""

from __future__ import annotations

from typing import ClassVar

from fieldtwin.plc.blocks.block import FunctionBlock


class CTU(FunctionBlock):
    """Up counter: CV counts rises of CU; R sets it to 0 and takes precedence; Q while CV has reached PV."""

    __slots__ = ("CU", "CV", "PV", "Q", "R", "_before")
    inputs = {"CU": "BOOL", "R": "BOOL", "PV": "INT"}
    outputs = {"Q": "BOOL", "CV": "INT"}
    CV_MAX: ClassVar[int] = 32767

    def __init__(self) -> None:
        self.CU = self.R = self.Q = self._before = False
        self.PV = self.CV = 0

    def execute(self, now_ns: int) -> None:
        if self.R:
            self.CV = 0
        elif self.CU and not self._before and self.CV < self.CV_MAX:
            self.CV += 1
        self._before = self.CU
        self.Q = self.CV >= self.PV

    def __call__(self, now_ns: int, *, CU: bool, R: bool, PV: int) -> CTU:
        self.CU, self.R, self.PV = CU, R, PV
        self.execute(now_ns)
        return self


class CTD(FunctionBlock):
    """Down counter: CV counts rises of CD downwards; LD sets it to PV and takes precedence; Q while CV is 0 or less."""

    __slots__ = ("CD", "CV", "LD", "PV", "Q", "_before")
    inputs = {"CD": "BOOL", "LD": "BOOL", "PV": "INT"}
    outputs = {"Q": "BOOL", "CV": "INT"}
    CV_MIN: ClassVar[int] = -32768

    def __init__(self) -> None:
        self.CD = self.LD = self.Q = self._before = False
        self.PV = self.CV = 0

    def execute(self, now_ns: int) -> None:
        if self.LD:
            self.CV = self.PV
        elif self.CD and not self._before and self.CV > self.CV_MIN:
            self.CV -= 1
        self._before = self.CD
        self.Q = self.CV <= 0

    def __call__(self, now_ns: int, *, CD: bool, LD: bool, PV: int) -> CTD:
        self.CD, self.LD, self.PV = CD, LD, PV
        self.execute(now_ns)
        return self


class CTUD(FunctionBlock):
    """Up-down counter: R takes precedence over LD, and LD over counting; rises of CU and CD in one call cancel out."""

    __slots__ = ("CD", "CU", "CV", "LD", "PV", "QD", "QU", "R", "_down", "_up")
    inputs = {"CU": "BOOL", "CD": "BOOL", "R": "BOOL", "LD": "BOOL", "PV": "INT"}
    outputs = {"QU": "BOOL", "QD": "BOOL", "CV": "INT"}
    CV_MAX: ClassVar[int] = 32767
    CV_MIN: ClassVar[int] = -32768

    def __init__(self) -> None:
        self.CU = self.CD = self.R = self.LD = self.QU = self.QD = self._up = self._down = False
        self.PV = self.CV = 0

    def execute(self, now_ns: int) -> None:
        up, down = self.CU and not self._up, self.CD and not self._down
        self._up, self._down = self.CU, self.CD
        if self.R:
            self.CV = 0
        elif self.LD:
            self.CV = self.PV
        elif up and not down and self.CV < self.CV_MAX:
            self.CV += 1
        elif down and not up and self.CV > self.CV_MIN:
            self.CV -= 1
        self.QU = self.CV >= self.PV
        self.QD = self.CV <= 0

    def __call__(self, now_ns: int, *, CU: bool, CD: bool, R: bool, LD: bool, PV: int) -> CTUD:
        self.CU, self.CD, self.R, self.LD, self.PV = CU, CD, R, LD, PV
        self.execute(now_ns)
        return self


_OTHER_TYPES = {
    "DINT": (-(2**31), 2**31 - 1),
    "LINT": (-(2**63), 2**63 - 1),
    "UDINT": (0, 2**32 - 1),
    "ULINT": (0, 2**64 - 1),
}


def _of(block: type[FunctionBlock], iec_type: str) -> type[FunctionBlock]:
    low, high = _OTHER_TYPES[iec_type]
    body: dict[str, object] = {
        "__slots__": (),
        "__doc__": f"{block.__name__} on {iec_type}.",
        "inputs": {name: iec_type if kind == "INT" else kind for name, kind in block.inputs.items()},
        "outputs": {name: iec_type if kind == "INT" else kind for name, kind in block.outputs.items()},
        "CV_MIN": low,
        "CV_MAX": high,
    }
    return type(f"{block.__name__}_{iec_type}", (block,), body)


VARIANTS: dict[str, type[FunctionBlock]] = {
    f"{block.__name__}_{iec_type}": _of(block, iec_type) for block in (CTU, CTD, CTUD) for iec_type in _OTHER_TYPES
}
"""CTU_DINT and so on, by name (the standard's Table 45 lists them)."""
