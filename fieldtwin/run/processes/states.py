"""The states that a run's programs passed through, read from the process image without affecting any process."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from fieldtwin.gateway.core.image.image import OUTPUTS, ImageLayout, RegionReader
from fieldtwin.gateway.core.statemachine import STATES, encode_period
from fieldtwin.twin.model.model import DigitalModel
from fieldtwin.twin.plant.physical import attached
from fieldtwin.twin.site.system import System

NAMES = list(STATES)
MAX_TRANSITIONS = 10_000


def expected_states(periods_s: Iterable[int]) -> list[str]:
    """Return the states that a digital model passes through at these commands, from STANDBY; repeated states count once."""
    model = DigitalModel()
    expected = [model.state.name]
    for period_s in periods_s:
        state = model.process_event(encode_period(period_s)).name
        if state != expected[-1]:
            expected.append(state)
    return expected


def state_words(layout: ImageLayout, programs: Iterable[str]) -> dict[str, dict[int, str]]:
    """Return, for each program whose `state` has named values, the name of each value."""
    tags = {tag.name: tag for region in layout.regions for tag in region.tags}
    return {p: dict(tags[f"{p}.state"].words) for p in programs if f"{p}.state" in tags and tags[f"{p}.state"].words}


@dataclass(frozen=True, slots=True)
class SeenStates:
    """The states that the programs of a run passed through."""

    sequences: Mapping[str, Sequence[str]]
    """The states of each program with named states, in order; `transitions` also has the time in s since the first check."""
    transitions: Mapping[str, Sequence[tuple[float, str]]]
    relays: Collection[str]
    """The programs that follow the topside controller's commands."""


class StateWatch:
    """A watcher of every program's exported `state` that keeps the transitions, with the time since the first check."""

    def __init__(self, system: System) -> None:
        self._programs = list(system.plc.programs)
        self._words: dict[str, dict[int, str]] = {}
        self._reader: RegionReader | None = None
        self._first_ns = 0
        self.current: dict[str, str] = {}
        self.transitions: dict[str, list[tuple[float, str]]] = {}

    @contextmanager
    def attached(self, layout: ImageLayout, path: Path) -> Iterator[None]:
        """Read states from the image file within this context."""
        self.knows(layout)
        with attached(layout, path) as image:
            self._reader = image.reader(OUTPUTS)
            try:
                yield
            finally:
                self._reader = None

    def knows(self, layout: ImageLayout) -> None:
        """Read the names of each program's states from the layout of the process image."""
        self._words = state_words(layout, self._programs)

    @property
    def programs(self) -> list[str]:
        """Return the programs that have named states."""
        return list(self._words)

    @property
    def relays(self) -> list[str]:
        """Return the programs that are the reference state machine: only these follow the topside controller's commands."""
        return [p for p in self.current if list(self._words.get(p, {}).values()) == NAMES]

    def look(self, now_ns: int) -> None:
        """Record the present state of every program."""
        if self._reader is None:
            return
        snapshot = self._reader.snapshot()
        if not snapshot.counter:
            return
        for program in self._programs:
            words = self._words.get(program)
            if not words:
                continue
            value = snapshot.value(f"{program}.state").value
            if isinstance(value, int) and value in words:
                self.note(program, words[value], now_ns)

    def note(self, program: str, state: str, now_ns: int) -> None:
        """Record that a program is in `state` now."""
        self._first_ns = self._first_ns or now_ns
        if self.current.get(program) == state:
            return
        self.current[program] = state
        seen = self.transitions.setdefault(program, [])
        if len(seen) < MAX_TRANSITIONS:
            seen.append(((now_ns - self._first_ns) / 1e9, state))

    def sequence(self, program: str) -> list[str]:
        """Return the states of a program, in order of time."""
        return [state for _, state in self.transitions.get(program, [])]

    def seen(self) -> SeenStates:
        """Return all states that were recorded until now."""
        return SeenStates({p: self.sequence(p) for p in self.programs}, dict(self.transitions), tuple(self.relays))
