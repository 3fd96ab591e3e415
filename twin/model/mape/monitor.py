"""Monitor: the first stage. It takes what the plant reports, keeps the digital model up to date, and passes every report on.

This module must never depend on a connection, or on code that can send a command.
"""

from __future__ import annotations

from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.concurrency.events import Consumer, Producer
from fieldtwin.gateway.core.errors import Desync
from fieldtwin.gateway.core.statemachine import encode_period
from fieldtwin.gateway.core.values import DATA
from fieldtwin.gateway.store.event import Event, Kind
from fieldtwin.twin.model.mape.messages import SeenMeasurement, SeenStatus
from fieldtwin.twin.model.model import DigitalModel
from fieldtwin.twin.model.status import decode_status
from fieldtwin.twin.model.thread_process import DTDigitalThreadProcess

CAPACITY = 10_000


class Monitor(DTDigitalThreadProcess):
    """The paper's Monitor: it consumes `statuses` and `measurements`, updates the twin's model, and produces for `emitter`."""

    def __init__(self, model: DigitalModel, clock: Clock) -> None:
        super().__init__("monitor", clock)
        self.statuses: Consumer[SeenStatus] = Consumer("status", CAPACITY)
        self.measurements: Consumer[SeenMeasurement] = Consumer("measurement", CAPACITY)
        self.emitter: Producer[DATA] = Producer("monitored")
        self.digital_model = model
        self.unreadable = 0

    def arrived(self, event: Event, arrived_ms: int) -> None:
        """Sort an event into one of the two queues. Events other than statuses and measurements are ignored."""
        if event.kind == Kind.STATE:
            data = event.value if isinstance(event.value, bytes) else b""
            self.statuses.observe(SeenStatus(data, event.name, event.t_ms, arrived_ms))
        elif event.kind in (Kind.VALUE, Kind.PAYLOAD):
            data = event.value if isinstance(event.value, bytes) else str(event.value).encode()
            self.measurements.observe(SeenMeasurement(data, event, arrived_ms))

    def handle_state(self) -> None:
        """Consume each STATUS, apply it to the digital model, and emit it (handleState).

        A status that cannot be decoded is counted and leaves the model unchanged.
        """
        for status in self.statuses.drain():
            try:
                _, period_s = decode_status(status.data)
                self.digital_model.process_event(encode_period(period_s))
            except Desync:
                self.unreadable += 1
            self.emitter.emit(status)

    def handle_measurements(self) -> None:
        """Consume and emit each MEASUREMENT (handleMeasurements). The state machine of the model stays unchanged."""
        for measurement in self.measurements.drain():
            self.emitter.emit(measurement)
