"""The states that a run's programs went through, read from the process image without disturbing anybody."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gateway.core.image import OUTPUTS, ImageLayout, RegionReader
from gateway.core.statemachine import STATES, encode_period
from twin.model import DigitalModel
from twin.physical import attached
from twin.system import System

NAMES = list(STATES)
MAX_TRANSITIONS = 10_000


def expected_states(periods_s: list[int]) -> list[str]:
    """The states that a digital model goes through at these commands, from STANDBY; the same state twice is one."""
    model = DigitalModel()
    expected = [model.state.name]
    for period_s in periods_s:
        state = model.process_event(encode_period(period_s)).name
        if state != expected[-1]:
            expected.append(state)
    return expected


class StateWatch:
    """Looks at every program's exported `state` and keeps the transitions, with the time since the first look."""

    def __init__(self, system: System) -> None:
        self._programs = list(system.plc.programs)
        self._reader: RegionReader | None = None
        self._first_ns = 0
        self.current: dict[str, str] = {}
        self.transitions: dict[str, list[tuple[float, str]]] = {}

    @contextmanager
    def attached(self, layout: ImageLayout, path: Path) -> Iterator[None]:
        """Read from the image file within this context."""
        with attached(layout, path) as image:
            self._reader = image.reader(OUTPUTS)
            try:
                yield
            finally:
                self._reader = None

    def look(self, now_ns: int) -> None:
        """Note every program's state."""
        if self._reader is None:
            return
        snapshot = self._reader.snapshot()
        if not snapshot.counter:
            return
        for program in self._programs:
            name = f"{program}.state"
            if name not in snapshot.shape.index:
                continue
            value = snapshot.value(name).value
            if isinstance(value, int) and 0 <= value < len(NAMES):
                self.note(program, NAMES[value], now_ns)

    def note(self, program: str, state: str, now_ns: int) -> None:
        """A program is in `state` now."""
        self._first_ns = self._first_ns or now_ns
        if self.current.get(program) == state:
            return
        self.current[program] = state
        seen = self.transitions.setdefault(program, [])
        if len(seen) < MAX_TRANSITIONS:
            seen.append(((now_ns - self._first_ns) / 1e9, state))

    def sequence(self, program: str) -> list[str]:
        """The states of a program in the order in which it was in them."""
        return [state for _, state in self.transitions.get(program, [])]
