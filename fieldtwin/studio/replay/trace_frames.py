"""The frames of a trace, indexed in the same way as a capture file (`FrameLog`)."""

from __future__ import annotations

from array import array
from bisect import bisect_left, insort
from collections.abc import Iterator
from pathlib import Path

from fieldtwin.capture.decoding.decoder import can_frame, direction_of
from fieldtwin.capture.decoding.exchange import DecodedExchange
from fieldtwin.gateway.connections.tap import Captured
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.results.trace import TraceEvent, TraceKind, decode_event
from fieldtwin.studio.live.frame_log import FrameLog, FrameRow
from fieldtwin.studio.replay.trace_log import AfterCheck
from fieldtwin.twin.site.system import System

_FRAME, _STEP = (f'"{kind.value}"'.encode() for kind in (TraceKind.FRAME, TraceKind.STEP))
HEAD_BYTES = 40
"""Number of bytes at the beginning of a line that contain time and kind of the event."""


class TraceFrames(FrameLog):
    """The index of the frames of one trace. Times count from the start of the run. Raises `FileInvalid`."""

    def __init__(self, path: Path, system: System) -> None:
        super().__init__(path, system)
        self._after_check = AfterCheck()
        self._of_bus = {name: array("L") for name in system.buses}
        self._of_device = {name: array("L") for name in system.devices}
        self._failed_ns = {name: array("q") for name in system.buses}
        """For each bus, the times in ns at which exchanges failed, in order."""

    def reaches(self, t_ns: int) -> bool:
        """Return whether the frames up to an instant are indexed."""
        return (bool(self._times) and self._times[-1] > t_ns) or self.behind_bytes == 0

    def count_of_bus(self, bus: str, t_ns: int) -> int:
        """Return how many frames a bus had before an instant."""
        return bisect_left(self._of_bus[bus], t_ns, key=self._times.__getitem__)

    def failures_of_bus(self, bus: str, t_ns: int) -> int:
        """Return how many exchanges of a bus had failed before an instant."""
        return bisect_left(self._failed_ns[bus], t_ns)

    def latest_of_device(self, device: str, t_ns: int) -> Iterator[FrameRow]:
        """Yield the frames of a device before an instant, the latest first."""
        numbers = self._of_device[device]
        for position in range(bisect_left(numbers, t_ns, key=self._times.__getitem__) - 1, -1, -1):
            yield self.row(numbers[position])

    def _append(
        self, event: TraceEvent, at: int, text: str, sent: bool, of: DecodedExchange | None, answered: DecodedExchange | None,
        request: int | None,
    ) -> None:  # fmt: skip
        number = len(self)
        super()._append(event, at, text, sent, of, answered, request)
        self._of_bus[event.where].append(number)
        if (device := self._names.names[self._devices[number]]) in self._of_device:
            self._of_device[device].append(number)
        if answered is not None and answered.problem and request is None:
            self._failed(answered)

    def _conclude(self, row: int, exchange: DecodedExchange, reply: int | None) -> None:
        super()._conclude(row, exchange, reply)
        if exchange.problem:
            self._failed(exchange)

    def _failed(self, exchange: DecodedExchange) -> None:
        if exchange.bus in self._failed_ns:
            insort(self._failed_ns[exchange.bus], exchange.end_ns)

    def _event_of(self, line: bytes) -> TraceEvent | None:
        if _FRAME not in line[:HEAD_BYTES] and _STEP not in line[:HEAD_BYTES]:
            return None
        event = decode_event(line)
        event = event._replace(t_ns=self._after_check.time_of(event.t_ns, event.kind, event.data))
        if event.kind is not TraceKind.FRAME or event.where not in self._system.buses:
            return None
        if self._times and event.t_ns < self._times[-1]:
            raise ValueError("the time is earlier than that of the frame before")
        self._item(event)  # a frame that cannot be read is not listed
        return event

    def _captured_of(self, line: bytes) -> Captured:
        event = decode_event(line)
        endpoint = self._system.buses[event.where].endpoint
        return Captured(event.t_ns, endpoint, direction_of(event.data), self._item(event))

    def _item(self, event: TraceEvent) -> bytes | CanFrame:
        data = event.data
        raw = bytes.fromhex(str(data["bytes"]))
        if "id" not in data:
            return raw
        if not isinstance(data["id"], int):
            raise ValueError("the id of a CAN frame is not a number")
        return can_frame(data, raw)
