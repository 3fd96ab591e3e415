"""The digital shadow: Monitor and Analyze process the events that arrive from the plant. It has no object through which it
could send.

It receives from a queue (paper.md, ruling 16). Filling that queue, acknowledging events and requesting missing ones is done
outside this module; import contracts keep it free of connections, drivers, transmitters and threads.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_MS, Clock
from fieldtwin.gateway.core.concurrency.events import Consumer
from fieldtwin.gateway.store.event import Event
from fieldtwin.twin.model.mape.analyze import Analyze
from fieldtwin.twin.model.mape.decisions import DecisionLog
from fieldtwin.twin.model.mape.messages import AnalysisFinding
from fieldtwin.twin.model.mape.monitor import Monitor
from fieldtwin.twin.model.mape.upkeep import Upkeep
from fieldtwin.twin.model.model import DigitalModel
from fieldtwin.twin.model.thread_process import DTDigitalThreadProcess, ReceivingEnd
from fieldtwin.twin.model.variables import ModelVariable

VERDICTS = 1000


class DigitalShadow:
    """The paper's DigitalShadow: its own digital model, thread processes, and a receive-only connection.

    `step` runs the stages one after the other on the arrived events. `declared` are the variables of the model, which
    only events change. `verdicts` is a consumer for callers that want to read the verdicts; `decisions` keeps the newest ones.
    """

    def __init__(
        self, receiving: ReceivingEnd, clock: Clock, *, declared: Iterable[ModelVariable], stale_after_ms: int = 30_000
    ) -> None:
        self.digital_model = DigitalModel(declared)
        self.receiving = receiving
        self.monitor = Monitor(self.digital_model, clock)
        self.analyze = Analyze(self.digital_model, clock, stale_after_ms=stale_after_ms)
        self.upkeep = Upkeep(self.digital_model, self.monitor.emitter.event, self.analyze.emitter.event)
        self.monitor.emitter.subscribe(self.upkeep.measured)
        self.monitor.emitter.subscribe(self.analyze.consumer)
        self.analyze.emitter.subscribe(self.upkeep.analyzed)
        self.verdicts: Consumer[AnalysisFinding] = Consumer(self.analyze.emitter.event, VERDICTS)
        self.analyze.emitter.subscribe(self.verdicts)
        self.decisions = DecisionLog()
        self._found: Consumer[AnalysisFinding] = Consumer(self.analyze.emitter.event, VERDICTS)
        self.analyze.emitter.subscribe(self._found)
        self._clock = clock

    @property
    def processes(self) -> tuple[DTDigitalThreadProcess, ...]:
        """Return the thread processes, whose shared events are the knowledge of the digital side of the thread."""
        return (self.monitor, self.analyze)

    def recall(self, events: Iterable[Event]) -> None:
        """Restore the model's state and the findings from before a restart, from the last event of each name."""
        for event in events:
            self.monitor.arrived(event, event.t_ms)
            self.monitor.handle_state()
            self.monitor.handle_measurements()
            self.upkeep.keep_up()
            self.analyze.recall()

    def step(self) -> int:
        """Process the arrived events one by one: update the model with each, then analyze it. Return the number of events."""
        count = 0
        now_ms = self._clock.utc_ns() // NS_PER_MS
        while self.receiving.queue:
            _, event = self.receiving.consume()
            self.monitor.arrived(event, now_ms)
            self.monitor.handle_state()
            self.monitor.handle_measurements()
            self.upkeep.keep_up()
            self.analyze.compare()
            count += 1
        self.analyze.look()
        self.upkeep.keep_up()
        for finding in self._found.drain():
            self.decisions.observed(finding)
        return count

    def describe(self) -> dict[str, Any]:
        """Return the state and variables of the model, and the twinning figures (`Analyze.figures`), as data for JSON."""
        variables = self.digital_model.variables
        return {
            "state": self.digital_model.state.name,
            "period_s": self.digital_model.period_s,
            **self.analyze.figures(),
            "dropped": self.receiving.dropped,
            "undeclared": variables.undeclared,
            "variables": variables.describe(),
        }
