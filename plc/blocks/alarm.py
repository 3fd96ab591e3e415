"""ALARM: two warnings and two alarms on one value, with delay, hysteresis and acknowledgement.

    LL  alarm     L  warning          H  warning     HH  alarm

A limit is violated when X is beyond it, and no longer violated when X is back by more than HYS. A violation that lasts DELAY
raises its condition; a shorter violation raises none. A raised condition stays *unacknowledged* until ACK rises, even if X has
returned. The condition ends when it is acknowledged and X has returned. A value that is not a
number changes nothing.
"""

from __future__ import annotations

from math import inf

from fieldtwin.plc.blocks.block import FunctionBlock


class _Limit:
    """The state of one limit. `sign` is +1 for a high limit and -1 for a low limit."""

    __slots__ = ("_since_ns", "active", "sign", "unacknowledged", "violated")

    def __init__(self, sign: int) -> None:
        self.sign = sign
        self.violated = self.active = self.unacknowledged = False
        self._since_ns: int | None = None
        """The time (ns) at which the violation began. None before the first one, and after a restart: the delay then starts
        again.
        """

    def watch(self, x: float, limit: float, hysteresis: float, delay_ns: int, now_ns: int) -> None:
        beyond = (x - limit) * self.sign
        if not self.violated:
            if beyond > 0:
                self.violated, self._since_ns = True, now_ns
        elif beyond < -hysteresis or (hysteresis == 0 and beyond <= 0):
            self.violated = self.active = False
        if self.violated and not self.active:
            if self._since_ns is None:
                self._since_ns = now_ns
            if now_ns - self._since_ns >= delay_ns:
                self.active = self.unacknowledged = True


class ALARM(FunctionBlock):
    """The block that the module describes.

    QLL, QL, QH and QHH are true while the condition of that limit is raised. UNACK is true while a condition is not
    acknowledged, Q while an alarm is raised, and WARN while a warning is raised.
    """

    __slots__ = (
        "ACK", "DELAY", "H", "HH", "HYS", "L", "LL", "Q", "QH", "QHH", "QL", "QLL", "UNACK", "WARN", "X",
        "_ack_before", "_limits",
    )  # fmt: skip
    inputs = {
        "X": "LREAL", "LL": "LREAL", "L": "LREAL", "H": "LREAL", "HH": "LREAL", "HYS": "LREAL", "DELAY": "TIME",
        "ACK": "BOOL",
    }  # fmt: skip
    outputs = {
        "Q": "BOOL", "WARN": "BOOL", "QLL": "BOOL", "QL": "BOOL", "QH": "BOOL", "QHH": "BOOL", "UNACK": "BOOL",
    }  # fmt: skip

    def __init__(self) -> None:
        self.X = self.HYS = 0.0
        self.LL = self.L = -inf
        self.H = self.HH = inf
        self.DELAY = 0
        self.ACK = self._ack_before = False
        self.Q = self.WARN = self.QLL = self.QL = self.QH = self.QHH = self.UNACK = False
        self._limits = [_Limit(-1), _Limit(-1), _Limit(1), _Limit(1)]

    def execute(self, now_ns: int) -> None:
        if self.ACK and not self._ack_before:
            for limit in self._limits:
                limit.unacknowledged = False
        self._ack_before = self.ACK
        if self.X == self.X:
            hysteresis, delay_ns = max(0.0, self.HYS), max(0, self.DELAY)
            for limit, at in zip(self._limits, (self.LL, self.L, self.H, self.HH), strict=True):
                limit.watch(self.X, at, hysteresis, delay_ns, now_ns)
        self.QLL, self.QL, self.QH, self.QHH = (limit.active for limit in self._limits)
        self.Q = self.QLL or self.QHH
        self.WARN = self.QL or self.QH
        self.UNACK = any(limit.unacknowledged for limit in self._limits)

    def __call__(
        self, now_ns: int, *, X: float, LL: float = -inf, L: float = -inf, H: float = inf, HH: float = inf,
        HYS: float = 0.0, DELAY: int = 0, ACK: bool = False,
    ) -> ALARM:  # fmt: skip
        self.X, self.LL, self.L, self.H, self.HH = X, LL, L, H, HH
        self.HYS, self.DELAY, self.ACK = HYS, DELAY, ACK
        self.execute(now_ns)
        return self
