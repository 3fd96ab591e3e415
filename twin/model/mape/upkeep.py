"""Upkeep: who keeps the digital model's variables up with what the plant reports.

The Monitor leaves the model as it is at a measurement, and passes it on to whoever listens (SPEC row Monitor). This is one who
listens, as a database is: so everything that is received updates the model (SPEC prose, row 5). It must never know a connection,
nor anything that could send a command.
"""

from __future__ import annotations

from fieldtwin.gateway.core.events import Consumer
from fieldtwin.gateway.core.values import DATA
from fieldtwin.twin.model.mape.messages import SeenMeasurement, Verdict
from fieldtwin.twin.model.model import DigitalModel

CAPACITY = 10_000


class Upkeep:
    """`measured` listens to Monitor, `analyzed` to Analyze. `keep_up` lets the model take what they were told, in order."""

    def __init__(self, model: DigitalModel, measured: str, analyzed: str) -> None:
        self.measured: Consumer[DATA] = Consumer(measured, CAPACITY)
        self.analyzed: Consumer[Verdict] = Consumer(analyzed, CAPACITY)
        self.digital_model = model

    def keep_up(self) -> None:
        """A value or a payload becomes its variable's; a variable of which Analyze finds that it is stale is bad."""
        variables = self.digital_model.variables
        for message in self.measured.drain():
            if isinstance(message, SeenMeasurement):
                event = message.event
                variables.changed(event.name, event.value, message.quality, message.reason, event.t_ms)
        for found in self.analyzed.drain():
            if found.finding == "stale":
                variables.silent(found.subject)
