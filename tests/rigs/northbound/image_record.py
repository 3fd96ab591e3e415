"""A record of a run's process image, and the comparison of a client's samples with it."""

from __future__ import annotations

import threading
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple, Self

from asyncua import ua

from fieldtwin.gateway.core.image.image import INPUTS
from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.northbound.opcua.status_codes import status_code
from fieldtwin.twin.plant.physical import attached, image_layout
from fieldtwin.twin.site.system import System

LOOK_S = 0.004
"""The pause between two looks at the image. The gateway publishes every 20 ms."""
NEAR_NS = 30_000_000
"""How far a source time may be from the image's time: the server follows the host's UTC in steps of 10 ms."""


class State(NamedTuple):
    """A state of a tag in the image, and the publication with which it began and after which it ended (monotonic ns)."""

    value: Any
    code: int
    t_ns: int
    began_ns: int


class ImageRecord:
    """A thread that records every publication of the region INPUTS of a run's image, while the block runs."""

    def __init__(self, system: System, path: Path) -> None:
        self.states: dict[str, list[State]] = {}
        self.unseen: list[tuple[int, int]] = []
        """The times between two publications that were seen, if there were others between them: the host was too busy."""
        self._system = system
        self._path = path
        self._has_begun, self._stop = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        assert self._has_begun.wait(60)
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(10)

    def _run(self) -> None:
        counter, seen_ns = 0, 0
        with attached(image_layout(self._system), self._path) as image:
            reader = image.reader(INPUTS)
            while not self._stop.wait(LOOK_S):
                region = reader.snapshot()
                if region.counter == counter:
                    continue
                if counter and region.counter > counter + 1:
                    self.unseen.append((seen_ns, region.t_ns))
                counter, seen_ns = region.counter, region.t_ns
                self._has_begun.set()
                for name, value in region.all().items():
                    code = status_code(Quality(value.quality), Reason(value.reason)).number
                    states = self.states.setdefault(name, [])
                    if not states or states[-1][:3] != (value.value, code, value.t_ns):
                        states.append(State(value.value, code, value.t_ns, region.t_ns))

    def objection(self, name: str, data: ua.DataValue, arrived_ns: int, offset_ns: int) -> str:
        """Return why the image did not hold this sample; "" if it did. `offset_ns` is UTC less monotonic time."""
        stamp = data.SourceTimestamp
        if stamp is None:
            return f"{name}: {data.StatusCode.name} without a time"
        since = stamp.replace(tzinfo=UTC) - datetime(1970, 1, 1, tzinfo=UTC)
        source_ns = int(since.total_seconds() * 1e9) - offset_ns
        states = [s for s in self.states[name] if s.code == data.StatusCode.value]
        if data.StatusCode.is_bad():
            if data.Value.Value is not None:
                return f"{name}: {data.StatusCode.name} with the value {data.Value.Value}"
        else:
            states = [s for s in states if s.value == data.Value.Value]
        for state in states:
            is_near = abs(state.t_ns - source_ns) < NEAR_NS
            is_noticed = state.began_ns - NEAR_NS <= source_ns <= arrived_ns + NEAR_NS
            if is_near or (is_noticed and not data.StatusCode.is_good()):
                return ""
        return f"{name}: {data.Value.Value} {data.StatusCode.name} at {source_ns}, arrived {arrived_ns}: {states[-5:]}"

    def was_unseen(self, arrived_ns: int) -> bool:
        """Return whether publications were missed in the second before a sample arrived."""
        return any(begin - NEAR_NS <= arrived_ns and end >= arrived_ns - 1_000_000_000 for begin, end in self.unseen)
