"""Upkeep: keeps the digital model's variables up to date with what the plant reports.

The Monitor does not change the model when a measurement arrives; it passes the measurement on to its subscribers,
as the paper's Monitor does. Upkeep is such a subscriber, as a database is. So every received measurement updates the
model. This module must never depend on a connection, or on code that can send a command.
"""

from __future__ import annotations

from fieldtwin.gateway.core.concurrency.events import Consumer
from fieldtwin.gateway.core.values import DATA
from fieldtwin.twin.model.mape.messages import AnalysisFinding, SeenMeasurement
from fieldtwin.twin.model.model import DigitalModel

CAPACITY = 10_000


class Upkeep:
    """A subscriber of Monitor (with `measured`) and of Analyze (with `analyzed`).

    `keep_up` applies the received events to the model, in order.
    """

    def __init__(self, model: DigitalModel, measured: str, analyzed: str) -> None:
        self.measured: Consumer[DATA] = Consumer(measured, CAPACITY)
        self.analyzed: Consumer[AnalysisFinding] = Consumer(analyzed, CAPACITY)
        self.digital_model = model

    def keep_up(self) -> None:
        """Write each value or payload to its variable, and mark variables that Analyze finds stale as bad."""
        variables = self.digital_model.variables
        for message in self.measured.drain():
            if isinstance(message, SeenMeasurement):
                event = message.event
                variables.changed(event.name, event.value, message.quality, message.reason, event.t_ms)
        for found in self.analyzed.drain():
            if found.finding == "stale":
                variables.silent(found.subject)
