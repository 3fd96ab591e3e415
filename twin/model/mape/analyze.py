"""Analyze: the second stage. It compares what the plant reports with the digital model and emits its findings.

It finds state mismatches, values outside the model's limits, and bad and stale values. It also computes the twinning figures:
the share of statuses in which plant and model agree, the twinning rate (Hz), and the lag (ms). This module must never depend
on a connection, or on code that can send a command.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any

from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.concurrency.events import Consumer, Producer
from fieldtwin.gateway.core.errors import Desync
from fieldtwin.gateway.core.values import DATA, Quality
from fieldtwin.gateway.store.event import Kind
from fieldtwin.twin.model.mape.messages import AnalysisFinding, SeenMeasurement, SeenStatus, verdict
from fieldtwin.twin.model.model import DigitalModel
from fieldtwin.twin.model.status import decode_status
from fieldtwin.twin.model.thread_process import DTDigitalThreadProcess

CAPACITY = 10_000
LAGS = 10_000
"""The number of events, the latest ones, from which the figures of the lag are computed."""
LATE_MS = 10_000
"""An event that is older than this when it arrives counts as backfilled history, and so does an event from before this twin
was started. Both are counted, and left out of the lag and the rate.
"""


class Analyze(DTDigitalThreadProcess):
    """The paper's Analyze. Compares values with the limits of the model's variables.

    A tag that is not reported for `stale_after_ms` is stale. Every status gets a verdict. For a tag only changes are emitted:
    outside its limits and inside again, bad and good, stale and fresh. A change that first arrived as history is emitted again as
    soon as the plant reports that it still holds, because a planner acts on the present state only.
    """

    def __init__(self, model: DigitalModel, clock: Clock, *, stale_after_ms: int) -> None:
        super().__init__("analyze", clock)
        self.consumer: Consumer[DATA] = Consumer("monitored", CAPACITY)
        self.emitter: Producer[AnalysisFinding] = Producer("analyzed")
        self.digital_model = model
        self.compared = self.equal = 0
        self.measurements = self.backfilled = 0
        self._stale_after_ms = stale_after_ms
        self._lags: deque[int] = deque(maxlen=LAGS)
        self._heard: dict[str, int] = {}
        self._wrong: dict[str, set[str]] = {}
        """By tag: the findings that hold at present."""
        self._history: set[tuple[str, str]] = set()
        """Changes of `_wrong` (additions and removals) that are known from history only."""
        self._began_ms = clock.utc_ns() // 1_000_000
        self._first_ms = self._last_ms = self._reports = 0

    def recall(self) -> None:
        """Restore what was known before a restart.

        A finding that held then is emitted again as soon as the plant confirms it.
        """
        for message in self.consumer.drain():
            if isinstance(message, SeenMeasurement) and message.event.kind == Kind.VALUE:
                name = message.event.name
                self._wrong[name] = {wrong for wrong, _, is_so, _ in self._possible_findings(message) if is_so}
                self._history |= {(name, wrong) for wrong in self._wrong[name]}

    def check_statuses(self, status: SeenStatus) -> bool | None:
        """Return whether the reported state and period equal the model's (CheckStatuses).

        Return None if the status cannot be decoded.
        """
        try:
            state, period_s = decode_status(status.data)
        except Desync:
            return None
        return (state, period_s) == (self.digital_model.state.name, self.digital_model.period_s)

    def compare(self) -> None:
        """Consume statuses and measurements, check them, and emit the verdicts (compare).

        A measurement is compared with its limits.
        """
        for message in self.consumer.drain():
            if isinstance(message, SeenStatus):
                self._note_lag(message.t_ms, message.arrived_ms)
                self._judge(message)
            elif isinstance(message, SeenMeasurement):
                self._note_lag(message.event.t_ms, message.arrived_ms)
                self.measurements += 1
                if message.event.kind == Kind.VALUE:
                    self._weigh(message)

    def _judge(self, status: SeenStatus) -> None:
        equal = self.check_statuses(status)
        if equal is None:
            self._say("unreadable", status.whose, f"an invalid status: {status.data.hex() or 'empty'}", status.t_ms)
            return
        self.compared += 1
        self.equal += equal
        state, period_s = decode_status(status.data)
        model = self.digital_model
        if equal:
            self._say("agree", status.whose, f"{state}, period {period_s} s", status.t_ms)
        else:
            text = f"the plant reports {state} with period {period_s} s; the model is {model.state.name} with {model.period_s} s"
            self._say("mismatch", status.whose, text, status.t_ms)

    def _weigh(self, message: SeenMeasurement) -> None:
        event = message.event
        self._heard[event.name] = message.arrived_ms
        self._turn(event.name, "stale", "fresh", False, f"{event.name} is received again", message.arrived_ms)
        late = message.arrived_ms - event.t_ms > LATE_MS
        for wrong, right, is_wrong, text in self._possible_findings(message):
            self._turn(event.name, wrong, right, is_wrong, text, event.t_ms, late=late)

    def _possible_findings(self, message: SeenMeasurement) -> Iterator[tuple[str, str, bool, str]]:
        """Yield each possible finding about a value: its name if the value is wrong, its name if it is right, whether it is
        wrong, and a sentence.
        """
        event = message.event
        bad = message.quality >= Quality.BAD
        why = f"{event.name} is {message.quality}: {message.reason}" if bad else f"{event.name} is good again"
        yield "bad", "good", bad, why
        variable = self.digital_model.variables.get(event.name)
        limits = variable.limits if variable is not None else None
        if limits is None or bad or not isinstance(event.value, int | float):
            return
        outside = not limits[0] <= event.value <= limits[1]
        text = f"{event.name} is {event.value:g}; the model has {limits[0]:g} to {limits[1]:g}"
        yield "outside", "inside", outside, text

    def look(self) -> None:
        """Report the tags that have not been updated for `stale_after_ms`. The caller must call this method periodically."""
        now_ms = self._clock.utc_ns() // 1_000_000
        for name, heard_ms in self._heard.items():
            if now_ms - heard_ms > self._stale_after_ms:
                text = f"{name} was not received for {(now_ms - heard_ms) / 1000:.0f} s"
                self._turn(name, "stale", "fresh", True, text, now_ms)

    def _turn(
        self, name: str, wrong: str, right: str, is_wrong: bool, text: str, t_ms: int, *, late: bool = False
    ) -> None:
        now, about = self._wrong.setdefault(name, set()), (name, wrong)
        again = is_wrong == (wrong in now)
        if again and (late or about not in self._history):
            return
        (now.add if is_wrong else now.discard)(wrong)
        (self._history.add if late else self._history.discard)(about)
        self._say(wrong if is_wrong else right, name, text, t_ms, again=again)

    def _say(self, finding: str, subject: str, text: str, t_ms: int, *, again: bool = False) -> None:
        made = verdict(finding, subject, text, t_ms, again=again)
        if not made.fine:
            self.share(Kind.VERDICT, subject, f"{finding}: {text}", t_ms)
        self.emitter.emit(made)

    def _note_lag(self, t_ms: int, arrived_ms: int) -> None:
        if arrived_ms - t_ms > LATE_MS or t_ms < self._began_ms:
            self.backfilled += 1
            return
        self._lags.append(max(0, arrived_ms - t_ms))
        self._reports += 1
        self._first_ms = self._first_ms or arrived_ms
        self._last_ms = arrived_ms

    def figures(self) -> dict[str, Any]:
        """Return the twinning figures: the agreement, the twinning rate (Hz), and the lag (ms)."""
        lags = sorted(self._lags)
        seconds = (self._last_ms - self._first_ms) / 1000
        return {
            "statuses": self.compared,
            "agreed": self.equal,
            "agreement": self.equal / self.compared if self.compared else None,
            "measurements": self.measurements,
            "backfilled": self.backfilled,
            "twinning_rate_hz": (self._reports - 1) / seconds if seconds > 0 else None,
            "lag_ms": {"median": lags[len(lags) // 2], "p95": lags[len(lags) * 95 // 100], "max": lags[-1]}
            if lags
            else None,
            "wrong": {name: sorted(what) for name, what in sorted(self._wrong.items()) if what},
        }
